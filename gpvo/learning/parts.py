"""How errors add up over a distance: jitter, white and bias, from the errors summed over 1, 2, 5, ... frames.

Of a motion's variance v a share is jitter (n_k - n_(k-1), that of the frames it joins), a share white, a share a
first-order Gauss-Markov bias (A. Gelb, "Applied Optimal Estimation" (1974), section 3.8). Above the typical speed what
adds up may grow with it, as it does so by landmarks that come and go along the path. The bias may grow faster than the
noise: that of triangulated points goes with the variance of the noise, so its own variance with the square (G. Sibley,
L. Matthies, G. Sukhatme, "Bias reduction and filter convergence for long range stereo" (2007)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gpvo.learning.spans import Chains, at_most, carried, cut, span_variances
from gpvo.types import Array

_TAU_FRAMES = (4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)
_NOISE_GROWTHS = (0.0, 0.5, 1.0)
_SPEED_GROWTHS = (1.0, 2.0)
_WORTH = 20.0
"""By so much the log-likelihood of a block must rise for what is not expected; the spans all count the same errors."""
_MOST_WINDOWS = 1000
_MOST_COUNT = 60.0
"""A span counts by its windows, up to this: short spans have many, but say the same over and over."""
MOST_ROWS = 100_000
_MIN_SHARE = 1e-6
_REWEIGHTINGS, _REDIVISIONS = 6, 3
_MOST_RATIO = 16.0


@dataclass(frozen=True)
class Parts:
    """``share`` (3, D): jitter, white, bias of each axis at the typical log variance ``level`` (D,), summing to one.

    ``growth`` (2, D): how the shares change with the speed and the variance (see :func:`gpvo.online.division.divide`).
    ``tau_s`` (D,): of the bias. ``spans`` (S,) frames; ``ratio`` (S, D): mean square of sums over so many frames, over
    what is stated; ``doubt`` (S, D): see :class:`gpvo.learning.spans.SpanVariances`.
    """

    share: Array
    growth: Array
    level: Array
    tau_s: Array
    spans: NDArray[np.int64]
    ratio: Array
    doubt: Array


@dataclass(frozen=True)
class _Windows:
    """Of one span and block of axes: squared sums (w, d); stated variances (w, m, d), their logs above the typical
    level and those of the speed (w, m, 1); what is known to add up besides (w, d); what a window counts."""

    square: Array
    variance: Array
    above: Array
    faster: Array
    known: Array
    count: float


@dataclass(frozen=True)
class _Shape:
    """What is chosen for a block of axes: see :class:`Parts`."""

    by_speed: float
    by_noise: float
    tau: float


@dataclass(frozen=True)
class _Fit:
    """``share`` (3, d) of a shape, mean ratio of squared sums to what is stated (S, d), and the loss."""

    loss: float
    share: Array
    ratio: Array


def fit_parts(error: Chains, sigma: Chains, ln_speed: Chains, step_s: float, lasting: Chains | None = None) -> Parts:
    """From errors, their stated standard deviations, and the logs (n_i, 1) of the speed over the typical one.

    ``step_s``: usual duration of a motion. ``lasting``: roots (n_i, D, P) of what else adds up, by constants of unit
    variance; ``sigma`` is what is stated without it. All axes have one time constant, translation and rotation (each
    three axes) a growth each; the shares are the axis' own.
    """
    lasting = lasting or [[np.zeros((*c.shape, 1)) for c in chains] for chains in error]
    error, sigma, ln_speed, lasting = (at_most(x, MOST_ROWS) for x in (error, sigma, ln_speed, lasting))
    found = span_variances([[e / s for e, s in zip(*pair)] for pair in zip(error, sigma)])
    ln_var = [[2.0 * np.log(s) for s in chains] for chains in sigma]
    level = np.median(np.concatenate([c for chains in ln_var for c in chains]), axis=0)
    D = len(level)
    share, growth, ratio = np.empty((3, D)), np.empty((2, D)), np.empty((len(found.spans), D))
    blocks = [slice(start, min(start + 3, D)) for start in range(0, D, 3)]
    given = (error, ln_var, ln_speed, lasting)
    windows = [[_windows(given, m, block, level) for m in found.spans] for block in blocks]
    tau, shapes = _choose(windows)
    widening = found.widening(tau)
    for block, seen, shape in zip(blocks, windows, shapes):
        fit = _fit_shape(seen, shape, widening[:, block])
        share[:, block], ratio[:, block] = fit.share, fit.ratio
        growth[:, block] = [[shape.by_speed], [shape.by_noise]]
    return Parts(share, growth, level, np.full(D, tau * step_s), found.spans, ratio, found.doubt)


_Choice = tuple[_Shape, _Fit]


def _choose(windows: Sequence[Sequence[_Windows]]) -> tuple[float, list[_Shape]]:
    """The time constant [frames] of all blocks, and the shape of each.

    Sideways errors go with the turns that undo them; with time constants of their own they would part on the way.
    """
    tried: dict[float, list[_Choice]] = {}

    def loss(tau: float) -> float:
        tried.setdefault(tau, [_best(block, tau) for block in windows])
        return sum(_loss(choice) for choice in tried[tau])

    found = min(_TAU_FRAMES, key=loss)
    found = min((found, found / 2.0, found * 2.0), key=loss)
    return found, [shape for shape, _ in tried[found]]


def _best(windows: Sequence[_Windows], tau: float) -> _Choice:
    """The best shape of a block. Expected are shares that do not change."""
    tried = [(s, _fit_shape(windows, s)) for s in (_Shape(0.0, g, tau) for g in _NOISE_GROWTHS)]
    by_noise = min(tried, key=_loss)[0].by_noise
    others = (_Shape(v, by_noise, tau) for v in _SPEED_GROWTHS)
    return min([*tried, *((s, _fit_shape(windows, s)) for s in others)], key=_loss)


def _loss(choice: _Choice) -> float:
    shape, fit = choice
    return fit.loss + _WORTH * ((shape.by_speed > 0) + (shape.by_noise > 0))


def _windows(given: Sequence[Chains], m: int, block: slice, level: Array) -> _Windows:
    e, v, u, root = (np.concatenate([cut(c, m) for chains in x for c in chains]) for x in given)
    some = slice(None, None, max(len(e) // _MOST_WINDOWS, 1))
    e, v, u, root = e[some, :, block], v[some, :, block], u[some], root[some, :, block]
    known = (root.sum(axis=1) ** 2).sum(axis=-1)
    return _Windows(e.sum(axis=1) ** 2, np.exp(v), v - level[block], u, known, min(len(e), _MOST_COUNT) / len(e))


def _fit_shape(windows: Sequence[_Windows], shape: _Shape, widen: Array | None = None) -> _Fit:
    """Shares for one shape, by the likelihood of squared sums, times ``widen`` (S, d) where given.

    A squared sum has the deviation of what is stated of it; so the fit is reweighted by its own statement, because
    weights by what is seen would favour statements that are too small.
    """
    d = windows[0].square.shape[1]
    widen = np.ones((len(windows), d)) if widen is None else widen
    share = np.repeat([[0.5], [0.4], [0.1]], d, axis=1)
    count = np.concatenate([np.full(len(w.square), w.count) for w in windows])
    square = np.concatenate([w.square * more for w, more in zip(windows, widen)])
    known = np.concatenate([w.known for w in windows])
    changes = shape.by_speed > 0 or shape.by_noise > 0
    for k in range(_REWEIGHTINGS):
        if k == 0 or (changes and k <= _REDIVISIONS):
            A = np.concatenate([_terms(w, shape, share) for w in windows])
        stated = known + np.einsum("wpd,pd->wd", A, share)
        seen = np.minimum(square, _MOST_RATIO * stated) - known
        share = np.stack([_solve(A[:, :, j], seen[:, j], count / stated[:, j] ** 2) for j in range(d)], axis=1)
    stated = known + np.einsum("wpd,pd->wd", A, share)
    ratio = np.minimum(square / stated, _MOST_RATIO)
    loss = float((count[:, None] * (np.log(stated) + ratio)).sum())
    edges = np.cumsum([len(w.square) for w in windows])[:-1]
    return _Fit(loss, share, np.array([r.mean(axis=0) for r in np.split(ratio, edges)]) / widen)


def _terms(w: _Windows, shape: _Shape, share: Array) -> Array:
    """(w, 3, d) variance of the sum over each window of jitter, white and bias of unit share at the typical level.

    The motions' variances are divided as :func:`gpvo.online.division.divide` does with ``share``.
    """
    each = white = bias = w.variance
    if shape.by_speed or shape.by_noise:
        gain = np.exp(shape.by_speed * w.faster)
        more = gain * np.exp(shape.by_noise * w.above)
        each = w.variance / (share[0] + share[1] * gain + share[2] * more)
        white, bias = each * gain, each * more
    amplitude = np.sqrt(bias)
    before = carried(amplitude, np.full(amplitude.shape[-1], np.exp(-1.0 / shape.tau)))
    jitter = 0.5 * (each[:, 0] + each[:, -1])
    return np.stack([jitter, white.sum(axis=1), bias.sum(axis=1) + 2.0 * (amplitude * before).sum(axis=1)], axis=1)


def _solve(A: Array, square: Array, weight: Array) -> Array:
    """Shares (3,), not negative and of sum one, that explain squared sums (w,) best; white where nothing shows."""
    M = A[:, [0, 2]] - A[:, 1:2]
    gram = (M * weight[:, None]).T @ M + 1e-9 * (weight @ A[:, 1] ** 2) * np.eye(2)
    L = np.linalg.cholesky(gram)
    jitter, bias = nnls(L.T, np.linalg.solve(L, (M * weight[:, None]).T @ (square - A[:, 1])))[0]
    share = np.maximum([jitter, 1.0 - jitter - bias, bias], _MIN_SHARE)
    return share / share.sum()
