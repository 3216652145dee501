"""The ways in which calibrations are wrong, from the errors of many flights.

A wrong baseline, focal length or rectification makes errors that are linear in the motion, ``e = K v``, with another K
in each flight. So ``vec K`` is a random effect of a linear model (N. Laird, J. Ware, "Random-effects models for
longitudinal data" (1982)): its covariance over the flights and the noise are found by expectation-maximisation, and the
few principal axes of that covariance are patterns, each scaled by how wrong calibrations usually are in that way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.rows import Rows
from gpvo.learning.spans import cut
from gpvo.online.base import TWIST_COLUMNS
from gpvo.stats.consistency import rms
from gpvo.types import Array

PERSISTENT_S = 3600.0
"""How long a calibration stays the same: longer than the flights to learn from, which do not show it."""
_WINDOW = 100
_LEAST_FLIGHTS = 4
_CLEAR = 10.0
_ROUNDS, _BEGIN_VAR, _DIAGONAL = 60, 1e-2, 1.0
_D = 6


@dataclass(frozen=True)
class Patterns:
    """``usual`` (6, 6, 6): see :func:`gpvo.online.division.of_calibration`. ``without`` (F, 6, 6, 6): the patterns of
    all flights but those of each fold. ``error`` (n, 6): what each row's own flight shows of the error of its
    calibration."""

    usual: Array
    without: Array
    error: Array


def learn_patterns(rows: Rows, error: Array, variance: Array, fold: NDArray[np.int64]) -> Patterns | None:
    """From errors (n, 6) of a stated variance (n, 6), in folds (n,) of whole flights; None from fewer than four
    flights, or where no velocity is clear of VO's own error of it."""
    twist = np.nan_to_num(rows.select(TWIST_COLUMNS)) * rows.steps[:, None]
    flights = [_sums(*x) for x in zip(*(rows.chains(v) for v in (error, variance, twist)))]
    flown = [f for f in flights if len(f.error)]
    clear = _clear(flown, rows.step_s) if len(flown) >= _LEAST_FLIGHTS else np.zeros(_D, dtype=bool)
    if not clear.any():
        return None
    unit = _Unit.of(flown, clear)
    evidence = [unit.evidence(f) for f in flights]
    flight = np.repeat(np.arange(len(flights)), [len(s) for s in rows.sets])
    fold_of = fold[np.unique(flight, return_index=True)[1]]
    every, noise = _spread(evidence)
    means = np.array([unit.of_flight(e.posterior(every, noise)[0]) for e in evidence])
    without = [_spread([e for e, of in zip(evidence, fold_of) if of != k])[0] for k in np.unique(fold)]
    return Patterns(
        unit.patterns(every),
        np.array([unit.patterns(S) for S in without]),
        np.einsum("nic,nc->ni", means[flight], twist),
    )


@dataclass(frozen=True)
class _Sums:
    """Of the separate windows of a flight: sums (w, 6) of the errors and of the velocities, each times its duration in
    usual ones, and the stated deviations of the former, were motions independent."""

    error: Array
    sigma: Array
    twist: Array


def _sums(error: Sequence[Array], variance: Sequence[Array], twist: Sequence[Array]) -> _Sums:
    """Over :data:`_WINDOW` motions, so that only persistent errors add up."""
    e, v, t = (np.concatenate([cut(c, _WINDOW).sum(axis=1) for c in chains]) for chains in (error, variance, twist))
    return _Sums(e, np.sqrt(v), t)


def _clear(flights: Sequence[_Sums], step_s: float) -> NDArray[np.bool_]:
    """(6,) which velocities add up to ten times as much as VO's own errors in them: an error that seems to follow any
    other velocity may merely follow VO's error in it."""
    moved, wrong = (rms(np.concatenate(x)) for x in ([f.twist for f in flights], [f.error for f in flights]))
    return np.asarray(moved * step_s > _CLEAR * wrong)


@dataclass(frozen=True)
class _Evidence:
    """What flights (..., leading axes) say about their K, in the least-squares sense: ``gram`` (..., 6, c, c) and
    ``moment`` (..., 6, c) of each axis, sum of squares ``square`` (..., 6), number of windows."""

    gram: Array
    moment: Array
    square: Array
    count: int | Array

    def posterior(self, S: Array, noise: Array) -> tuple[Array, Array]:
        """Mean (..., 6 c) and covariance of ``vec K``, given the covariance S over flights and the noise (6,) of a
        window."""
        c, each, lead = self.gram.shape[-1], np.arange(_D), self.gram.shape[:-3]
        P = np.zeros((*lead, _D, c, _D, c))
        P[..., each, :, each, :] = np.moveaxis(self.gram / noise[:, None, None], -3, 0)
        C = np.linalg.inv(np.linalg.inv(S) + P.reshape(*lead, _D * c, _D * c))
        moment = (self.moment / noise[:, None]).reshape(*lead, _D * c)
        return (C @ moment[..., None])[..., 0], C

    def residual(self, mean: Array, C: Array) -> Array:
        """(..., 6) expected sum of squares that K does not explain."""
        K = mean.reshape(self.moment.shape)
        blocks = C.reshape(K.shape + K.shape[-2:])
        own = np.einsum("...iaib->...iab", blocks) + K[..., :, None] * K[..., None, :]
        return np.asarray(self.square - 2.0 * (K * self.moment).sum(axis=-1) + (self.gram * own).sum(axis=(-1, -2)))


@dataclass(frozen=True)
class _Unit:
    """Units in which all elements of K are alike: usual errors of windows (6,) and usual sums of velocities (c,), of
    those that are clear."""

    error: Array
    twist: Array
    clear: NDArray[np.bool_]

    @classmethod
    def of(cls, flights: Sequence[_Sums], clear: NDArray[np.bool_]) -> _Unit:
        """By all windows."""
        error, twist = (rms(np.concatenate(x)) for x in ([f.sigma for f in flights], [f.twist for f in flights]))
        return cls(error, twist[clear], clear)

    def evidence(self, f: _Sums) -> _Evidence:
        """Of a flight; each window is divided by its stated deviation."""
        weight = (self.error / f.sigma) ** 2
        e, t = f.error / self.error, f.twist[:, self.clear] / self.twist
        gram = np.einsum("wi,wa,wb->iab", weight, t, t)
        return _Evidence(gram, np.einsum("wi,wi,wa->ia", weight, e, t), (weight * e**2).sum(axis=0), len(e))

    def of_flight(self, k: Array) -> Array:
        """(6, 6) K from its elements (6 c,)."""
        K = np.zeros((_D, _D))
        K[:, self.clear] = k.reshape(_D, -1) * self.error[:, None] / self.twist
        return K

    def patterns(self, S: Array) -> Array:
        """(6, 6, 6) from the covariance of ``vec K``: its longest principal axes."""
        values, vectors = np.linalg.eigh(S)
        axes = vectors * np.sqrt(np.maximum(values, 0.0))
        longest = np.argsort(values)[::-1][:_D]
        return np.array([self.of_flight(axes[:, i]) for i in longest])


def _spread(evidence: Sequence[_Evidence]) -> tuple[Array, Array]:
    """Covariance of ``vec K`` over the flights, shrunk towards its diagonal, and noise (6,) of the windows."""
    every = _Evidence(*(np.array([getattr(e, f.name) for e in evidence]) for f in fields(_Evidence)))
    n = _D * every.gram.shape[-1]
    S, noise = _BEGIN_VAR * np.eye(n), np.ones(_D)
    for _ in range(_ROUNDS):
        mean, C = every.posterior(S, noise)
        second = mean.T @ mean + C.sum(axis=0)
        S = (second + _DIAGONAL * np.diag(np.diag(second)) / len(mean)) / (len(mean) + _DIAGONAL)
        noise = np.maximum(every.residual(mean, C).sum(axis=0) / np.sum(every.count), 1e-12)
    return S, noise
