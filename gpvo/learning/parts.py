"""How errors add up over a distance: jitter, white and bias, from the errors summed over 1, 2, 5, ... frames.

Of a motion's variance v a share is jitter (n_k - n_(k-1), that of the frames it joins), a share white, a share a
first-order Gauss-Markov bias (A. Gelb, "Applied Optimal Estimation" (1974), section 3.8). Above the typical speed what
adds up may grow with it, as it does so by landmarks that come and go along the path. The bias may grow faster than the
noise: that of triangulated points goes with the variance of the noise, so its own variance with the square (G. Sibley,
L. Matthies, G. Sukhatme, "Bias reduction and filter convergence for long range stereo" (2007)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gpvo.learning.spans import Chains, at_most, carried, cut, span_variances
from gpvo.types import Array

_TAU_FRAMES = (4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)
_LASTING_FRAMES = (1024.0, 16384.0)
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
class Calibration:
    """What a wrong calibration adds: its ``share`` (D,) of the variance at the usual velocity, ``follows`` (D, 6) (see
    :func:`gpvo.online.division.of_calibration`), how long it lasts ``tau_s`` (D,), and its mean part of the sums over
    each span ``sums`` (S, D), in variances of a motion."""

    share: Array
    follows: Array
    tau_s: Array
    sums: Array


@dataclass(frozen=True)
class Parts:
    """``share`` (3, D): jitter, white, bias of each axis at the typical log variance ``level`` (D,), summing to one.

    ``growth`` (2, D): how the shares change with the speed and the variance (see :func:`gpvo.online.division.divide`).
    ``tau_s`` (D,): of the bias. They divide what ``calibration`` leaves of the variance. ``spans`` (S,) frames;
    ``ratio`` (S, D): mean square of sums over so many frames, over what is stated; ``doubt`` (S, D): see
    :class:`SpanVariances`.
    """

    share: Array
    growth: Array
    level: Array
    tau_s: Array
    calibration: Calibration
    spans: NDArray[np.int64]
    ratio: Array
    doubt: Array


@dataclass(frozen=True)
class _Windows:
    """Of one span and block of axes: squared sums (w, d); stated variances (w, m, d), their logs above the typical
    level and those of the speed (w, m, 1); velocities over the usual ones (w, m, 6); what a window counts."""

    square: Array
    variance: Array
    above: Array
    faster: Array
    twist: Array
    count: float


@dataclass(frozen=True)
class _Shape:
    """What is chosen for a block of axes, or for an axis: see :class:`Parts`. ``follows``: the velocity with which a
    wrong calibration goes, ``lasts``: its time constant."""

    by_speed: float
    by_noise: float
    tau: float
    follows: int | None = None
    lasts: float = 1.0

    @property
    def longest(self) -> float:
        """The longer time constant [frames]."""
        return self.tau if self.follows is None else self.lasts


@dataclass(frozen=True)
class _Fit:
    """``share`` (4, d) of a shape, mean ratio of squared sums to what is stated (S, d), and the loss (d,)."""

    loss: Array
    share: Array
    ratio: Array


def fit_parts(error: Chains, sigma: Chains, ln_speed: Chains, step_s: float, twist: Chains | None = None) -> Parts:
    """From errors, their stated standard deviations, and the logs (n_i, 1) of the speed over the typical one.

    ``step_s``: usual duration of a motion. All axes have one time constant, translation and rotation (each three axes)
    a growth each; the shares are the axis' own. Given velocities ``twist`` (n_i, 6), so is a part of wrong calibration.
    """
    velocities = range(6 if twist else 0)
    twist = twist or [[np.zeros((len(c), 6)) for c in chains] for chains in ln_speed]
    error, sigma, ln_speed, twist = (at_most(values, MOST_ROWS) for values in (error, sigma, ln_speed, twist))
    usual = _usual(twist)
    found = span_variances([[e / s for e, s in zip(*pair)] for pair in zip(error, sigma)])
    ln_var = [[2.0 * np.log(s) for s in chains] for chains in sigma]
    level = np.median(np.concatenate([c for chains in ln_var for c in chains]), axis=0)
    D = len(level)
    share, growth, ratio = np.empty((4, D)), np.empty((2, D)), np.empty((len(found.spans), D))
    tau, lasts, follows, carried_on = np.empty(D), np.ones(D), np.zeros((D, 6)), np.zeros((len(found.spans), D))
    blocks = [slice(start, min(start + 3, D)) for start in range(0, D, 3)]
    given = (error, ln_var, ln_speed, [[_relative(c, usual) for c in chains] for chains in twist])
    windows = [[_windows(*given, m, block, level) for m in found.spans] for block in blocks]
    for block, seen, shape in zip(blocks, windows, _choose(windows)):
        of_axes = _with_calibration(seen, shape, velocities)
        fits = {s: _fit_shape(seen, s, found.widening(s.longest)[:, block]) for s in set(of_axes)}
        for i, s in zip(range(block.start, block.stop), of_axes):
            j = i - block.start
            share[:, i], ratio[:, i] = fits[s].share[:, j], fits[s].ratio[:, j]
            growth[:, i], tau[i], lasts[i] = (s.by_speed, s.by_noise), s.tau, s.lasts
            if s.follows is not None:
                follows[i, s.follows] = np.sqrt(share[3, i] / (1.0 - share[3, i])) / usual[s.follows]
                carried_on[:, i] = [_of_calibration(w, s, fits[s].share)[j] for w in seen]
    rest = share[:3] / (1.0 - share[3])
    lasts = np.where(follows.any(axis=1), lasts * step_s, 1.0)
    calibration = Calibration(share[3], follows, lasts, carried_on)
    return Parts(rest, growth, level, tau * step_s, calibration, found.spans, ratio, found.doubt)


def _usual(twist: Chains) -> Array:
    """(6,) root mean squares of the velocities."""
    squares = np.nan_to_num(np.concatenate([c for chains in twist for c in chains])) ** 2
    return np.sqrt(np.maximum(squares.mean(axis=0), 1e-12))


def _relative(twist: Array, usual: Array) -> Array:
    return np.asarray(np.nan_to_num(twist) / usual)


def _of_calibration(w: _Windows, shape: _Shape, share: Array) -> Array:
    """(d,) mean of what is stated of sums for a wrong calibration, in variances of a motion."""
    return np.asarray((_terms(w, shape, share)[:, 3] * share[3]).mean(axis=0) / w.variance.mean(axis=(0, 1)))


_Choice = tuple[_Shape, _Fit]


def _choose(windows: Sequence[Sequence[_Windows]]) -> list[_Shape]:
    """The shape of each block, with one time constant [frames].

    Sideways errors go with the turns that undo them; with time constants of their own they would part on the way.
    """
    tried: dict[float, list[_Choice]] = {}

    def loss(tau: float) -> float:
        tried.setdefault(tau, [_best(block, tau) for block in windows])
        return sum(_loss(choice) for choice in tried[tau])

    found = min(_TAU_FRAMES, key=loss)
    found = min((found, found / 2.0, found * 2.0), key=loss)
    return [shape for shape, _ in tried[found]]


def _with_calibration(windows: Sequence[_Windows], shape: _Shape, velocities: Sequence[int]) -> list[_Shape]:
    """The shape of each axis of a block: with an error of calibration where that is worth it, going with that of the
    velocities by which it is likeliest. What seemed to grow with the speed may be that, too."""
    if not velocities:
        return [shape] * windows[0].square.shape[1]
    plain = _Shape(0.0, 0.0, shape.tau)
    shapes = [
        replace(own, follows=velocity, lasts=lasts)
        for own in dict.fromkeys((shape, plain)) for lasts in _LASTING_FRAMES for velocity in velocities
    ]  # fmt: skip
    loss = np.array([_fit_shape(windows, s).loss for s in (shape, *shapes)])
    loss[1:] += _WORTH
    return [(shape, *shapes)[i] for i in loss.argmin(axis=0)]


def _best(windows: Sequence[_Windows], tau: float) -> _Choice:
    """The best shape of a block. Expected are shares that do not change."""
    tried = [(s, _fit_shape(windows, s)) for s in (_Shape(0.0, g, tau) for g in _NOISE_GROWTHS)]
    by_noise = min(tried, key=_loss)[0].by_noise
    others = (_Shape(v, by_noise, tau) for v in _SPEED_GROWTHS)
    return min([*tried, *((s, _fit_shape(windows, s)) for s in others)], key=_loss)


def _loss(choice: _Choice) -> float:
    shape, fit = choice
    return float(fit.loss.sum()) + _WORTH * ((shape.by_speed > 0) + (shape.by_noise > 0))


def _windows(
    error: Chains, ln_var: Chains, ln_speed: Chains, twist: Chains, m: int, block: slice, level: Array
) -> _Windows:
    given = (error, ln_var, ln_speed, twist)
    e, v, u, t = (np.concatenate([cut(c, m) for chains in x for c in chains]) for x in given)
    some = slice(None, None, max(len(e) // _MOST_WINDOWS, 1))
    e, v, u, t = e[some, :, block], v[some, :, block], u[some], t[some]
    return _Windows(e.sum(axis=1) ** 2, np.exp(v), v - level[block], u, t, min(len(e), _MOST_COUNT) / len(e))


def _fit_shape(windows: Sequence[_Windows], shape: _Shape, widen: Array | None = None) -> _Fit:
    """Shares for one shape, by the likelihood of squared sums, times ``widen`` (S, d) where given.

    A squared sum has the deviation of what is stated of it; so the fit is reweighted by its own statement, because
    weights by what is seen would favour statements that are too small.
    """
    d = windows[0].square.shape[1]
    widen = np.ones((len(windows), d)) if widen is None else widen
    begin = [0.5, 0.4, 0.1, 0.0] if shape.follows is None else [0.5, 0.3, 0.1, 0.1]
    share = np.repeat(np.array(begin)[:, None], d, axis=1)
    count = np.concatenate([np.full(len(w.square), w.count) for w in windows])
    square = np.concatenate([w.square * more for w, more in zip(windows, widen)])
    changes = shape.by_speed > 0 or shape.by_noise > 0 or shape.follows is not None
    for k in range(_REWEIGHTINGS):
        if k == 0 or (changes and k <= _REDIVISIONS):
            A = np.concatenate([_terms(w, shape, share) for w in windows])
        stated = np.einsum("wpd,pd->wd", A, share[: A.shape[1]])
        seen = np.minimum(square, _MOST_RATIO * stated)
        share = np.stack([_solve(A[:, :, j], seen[:, j], count / stated[:, j] ** 2) for j in range(d)], axis=1)
    stated = np.einsum("wpd,pd->wd", A, share[: A.shape[1]])
    ratio = np.minimum(square / stated, _MOST_RATIO)
    loss = (count[:, None] * (np.log(stated) + ratio)).sum(axis=0)
    edges = np.cumsum([len(w.square) for w in windows])[:-1]
    return _Fit(loss, share, np.array([r.mean(axis=0) for r in np.split(ratio, edges)]) / widen)


def _terms(w: _Windows, shape: _Shape, share: Array) -> Array:
    """(w, 4, d) variance of the sum over each window of jitter, white, bias and calibration of unit share at the
    typical level and velocity; without the last, (w, 3, d).

    The motions' variances are divided as :func:`gpvo.online.division.divide` and ``of_calibration`` do with ``share``.
    """
    variance, calibration = w.variance, []
    if shape.follows is not None:
        lever = w.twist[:, :, [shape.follows]]
        variance = w.variance / (1.0 - share[3] + share[3] * lever**2)
        calibration = [_persistent(lever * np.sqrt(variance), shape.lasts)]
    each = white = bias = variance
    if shape.by_speed or shape.by_noise:
        gain = np.exp(shape.by_speed * w.faster)
        more = gain * np.exp(shape.by_noise * w.above)
        each = variance * (1.0 - share[3]) / (share[0] + share[1] * gain + share[2] * more)
        white, bias = each * gain, each * more
    jitter = 0.5 * (each[:, 0] + each[:, -1])
    return np.stack([jitter, white.sum(axis=1), _persistent(np.sqrt(bias), shape.tau), *calibration], axis=1)


def _persistent(amplitude: Array, tau: float) -> Array:
    """(w, d) variance of the sum over each window of a bias of such signed deviations (w, m, d)."""
    before = carried(amplitude, np.full(amplitude.shape[-1], np.exp(-1.0 / tau)))
    return np.asarray((amplitude**2).sum(axis=1) + 2.0 * (amplitude * before).sum(axis=1))


def _solve(A: Array, square: Array, weight: Array) -> Array:
    """Shares (4,), not negative and of sum one, that explain squared sums (w,) best; white where nothing shows.

    ``A`` (w, 4), or (w, 3) without calibration, whose share is then zero.
    """
    M = np.delete(A, 1, axis=1) - A[:, 1:2]
    gram = (M * weight[:, None]).T @ M + 1e-9 * (weight @ A[:, 1] ** 2) * np.eye(M.shape[1])
    L = np.linalg.cholesky(gram)
    jitter, *persistent = nnls(L.T, np.linalg.solve(L, (M * weight[:, None]).T @ (square - A[:, 1])))[0]
    share = np.maximum([jitter, 1.0 - jitter - sum(persistent), *persistent], _MIN_SHARE)
    share /= share.sum()
    return share if len(share) == 4 else np.append(share, 0.0)
