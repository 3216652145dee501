"""How much of the geometry's correlation to believe, by the errors of single motions and of their sums."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpvo.geometry.covariance import correlation as correlation_of
from gpvo.geometry.covariance import scaled_root
from gpvo.learning.calibrate import robust_mean
from gpvo.learning.spans import Chains, cut, lagged
from gpvo.stats.consistency import nees, nll_per_dim
from gpvo.types import Array

_WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_SPANS, _LEAST_WINDOWS = (1, 10, 100), 30
_LEAST_KNOWN = 0.5
_EYE = np.eye(6)


@dataclass(frozen=True)
class Divided:
    """One chain of n motions: ``error`` (n, 6), deviations ``jitter``, ``white``, ``bias`` (n, 6) of its parts, and the
    geometry's correlation (n, 6, 6), NaN where unknown."""

    error: Array
    jitter: Array
    white: Array
    bias: Array
    geometry: Array


def divided(error: Chains, variance: Chains, share: Chains, geometry: Chains) -> list[Divided]:
    """The chains of all sequences, from variances (n_i, 6), shares (n_i, 3, 6) and covariances (n_i, 6, 6)."""
    out = []
    for of_sequence in zip(error, variance, share, geometry):
        for e, v, s, C in zip(*of_sequence):
            jitter, white, bias = np.moveaxis(np.sqrt(s * v[:, None, :]), 1, 0)
            out.append(Divided(e, jitter, white, bias, correlation_of(C)))
    return out


def choose_geometry_weight(chains: Sequence[Divided], correlation: Array, phi: float) -> float:
    """How much of the geometry's correlation to believe of jitter and white: the weight by which single motions and
    sums over ten and a hundred are likeliest, all alike. 0 where the geometry is mostly unknown.

    ``correlation`` (3, 6, 6) of the parts; ``phi``: that of the bias from one motion to the next.
    """
    known = np.concatenate([np.isfinite(c.geometry).all(axis=(1, 2)) for c in chains])
    if known.mean() < _LEAST_KNOWN:
        return 0.0
    enough = [m for m in _SPANS if m == 1 or sum(len(c.error) // m for c in chains) >= _LEAST_WINDOWS]
    spans = [_Sums.over(chains, correlation, phi, m) for m in enough]
    return min(_WEIGHTS, key=lambda w: sum(s.loss(w) for s in spans))


@dataclass(frozen=True)
class _Sums:
    """Sums (w, 6) over m motions, and what is stated of them (w, 6, 6): of jitter and white by the geometry's
    correlation and by their own, and of the bias."""

    error: Array
    by_geometry: Array
    own: Array
    bias: Array

    @classmethod
    def over(cls, chains: Sequence[Divided], correlation: Array, phi: float, m: int) -> _Sums:
        """Of the separate windows of all chains."""
        parts = [_windows(c, correlation, phi, m) for c in chains if len(c.error) >= m]
        return cls(*(np.concatenate(values) for values in zip(*parts)))

    def loss(self, weight: float) -> float:
        C = weight * self.by_geometry + (1.0 - weight) * self.own + self.bias
        C = C + 1e-6 * _EYE * C
        # The scale is fitted elsewhere: shapes are compared at their own best scale.
        scale = robust_mean(nees(self.error, C) / 6.0)
        return float(np.mean(nll_per_dim(self.error, C * scale)))


def _windows(c: Divided, correlation: Array, phi: float, m: int) -> tuple[Array, ...]:
    """What :class:`_Sums` holds, of each separate window of a chain."""
    error, geometry, jitter, white, bias = (cut(v, m) for v in (c.error, c.geometry, c.jitter, c.white, c.bias))
    known = np.isfinite(geometry).all(axis=(2, 3), keepdims=True)
    of_jitter, of_white = (np.where(known, geometry, R) for R in correlation[:2])
    ends = 0.5 * _outer(jitter[:, [0, -1]])
    white = _outer(white)
    root = bias[..., None] * scaled_root(correlation[2])
    return (
        error.sum(axis=1),
        (ends * of_jitter[:, [0, -1]]).sum(axis=1) + (white * of_white).sum(axis=1),
        ends.sum(axis=1) * correlation[0] + white.sum(axis=1) * correlation[1],
        _outer(bias).sum(axis=1) * correlation[2] + lagged(root, np.full(6, phi)),
    )


def _outer(sigma: Array) -> Array:
    return np.asarray(sigma[..., :, None] * sigma[..., None, :])
