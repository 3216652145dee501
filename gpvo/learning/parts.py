"""How errors add up over a distance: jitter, white and bias, from the errors summed over 1, 2, 5, ... frames.

The variance v of a motion is divided into jitter (n_k - n_(k-1), of the two frames it joins), white noise, and a
first-order Gauss-Markov bias (A. Gelb, "Applied Optimal Estimation" (1974), section 3.8). Above the typical speed, the
parts that add up may grow with speed, because landmarks come and go faster. The bias may grow faster than the noise:
the bias of triangulated points is proportional to the variance of the noise, so its own variance grows with the square
(G. Sibley, L. Matthies, G. Sukhatme, "Bias reduction and filter convergence for long range stereo" (2007)). The
correlations of the sums tell how the axes are correlated in each part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from gpvo.geometry.covariance import correlation
from gpvo.learning.spans import Chains, at_most, span_variances
from gpvo.stats import student_t
from gpvo.stats.series import moving_sums
from gpvo.types import Array

_TAU_FRAMES = (4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)
_NOISE_GROWTHS = (0.0, 0.5, 1.0)
_SPEED_GROWTHS = (1.0, 2.0)
_WORTH = 20.0
"""Gain in log-likelihood that a block must show for an unexpected shape; all spans count the same errors."""
_MOST_WINDOWS = 1000
_MOST_COUNT = 60.0
"""A span's weight is its number of windows, up to this: short spans have many, but they say the same thing."""
MOST_ROWS = 100_000
_MIN_SHARE = 1e-6
_REWEIGHTINGS, _REDIVISIONS = 6, 3
_MOST_RATIO = 16.0


@dataclass(frozen=True)
class Shape:
    """What is chosen for a block of axes: see :class:`Parts`; ``tau`` [frames] is the same for all blocks."""

    by_speed: float
    by_noise: float
    tau: float


@dataclass(frozen=True)
class Parts:
    """``share`` (3, D): of jitter, white noise and bias on each axis at the typical log variance ``level`` (D,).

    ``spans`` (S,) frames; ``ratio`` (S, D): mean square of sums over so many frames, over what is stated. ``shapes``:
    of each block of three axes. ``step_s``: usual duration of a motion.
    """

    share: Array
    level: Array
    spans: NDArray[np.int64]
    ratio: Array
    shapes: Sequence[Shape]
    step_s: float

    @property
    def growth(self) -> Array:
        """(2, D) how the shares change with the speed and the variance (see :func:`gpvo.online.division.divide`)."""
        by_block = np.array([[s.by_speed, s.by_noise] for s in self.shapes]).T
        return by_block.repeat(3, axis=1)[:, : len(self.level)]

    @property
    def tau_s(self) -> Array:
        """(D,) time constant of the bias."""
        return np.full(len(self.level), self.shapes[0].tau * self.step_s)


@dataclass(frozen=True)
class _Windows:
    """W windows of all spans over the N motions of all chains, of one block of d axes.

    Squared sums (d, W), other variance known to add up (d, W), weights of the windows (W,); the motions ``first`` to
    ``end - 1`` (W,) of each; stated variances of the motions (d, N + 1), their logs above the typical level, and those
    of the speed (N + 1,), all closed (see :func:`_closed`). ``spans``: windows of each span.
    """

    square: Array
    known: Array
    count: Array
    first: NDArray[np.int64]
    end: NDArray[np.int64]
    variance: Array
    above: Array
    faster: Array
    spans: Sequence[int]

    def products(self, amplitude: Array, phi: float) -> Array:
        """(d, W) sum over the pairs of motions of a window, k apart, of ``phi^k`` times both amplitudes (d, N + 1).

        One filter over all motions holds what came before a window too, which is taken away again.
        """
        # y_k = x_k + phi y_(k-1), a bidiagonal system, and its transpose, which runs backwards.
        band = np.stack([np.ones(amplitude.shape[1]), np.full(amplitude.shape[1], -phi)])
        before, after = (lapack.dtbtrs(band, amplitude.T, uplo="L", trans=t, diag="U")[0].T for t in ("N", "T"))
        before = before - amplitude
        within = after[:, self.first] - phi ** (self.end - self.first) * after[:, self.end]
        return np.maximum(_sums(amplitude * before, self.first, self.end) - before[:, self.first] * within, 0.0)


@dataclass(frozen=True)
class _Fit:
    """``share`` (3, d) of a shape, mean ratio of squared sums to what is stated (S, d), and the loss, with what the
    shape must be worth."""

    shape: Shape
    loss: float
    share: Array
    ratio: Array


def fit_parts(
    error: Chains,
    sigma: Chains,
    ln_speed: Chains,
    step_s: float,
    lasting: Chains | None = None,
    like: Parts | None = None,
) -> Parts:
    """From errors, their stated standard deviations, and the logs (n_i, 1) of the speed over the typical one.

    ``step_s``: usual duration of a motion. ``lasting``: roots (n_i, D, P) of what else adds up, by constants of unit
    variance; ``sigma`` is what is stated without it. ``like``: the shares alone are fitted, the rest is taken from
    there. All axes have one time constant, translation and rotation (each three axes) a growth each; the shares are the
    axis' own.
    """
    lasting = lasting or [[np.zeros((*c.shape, 1)) for c in chains] for chains in error]
    error, sigma, ln_speed, lasting = (at_most(x, MOST_ROWS) for x in (error, sigma, ln_speed, lasting))
    found = span_variances([[e / s for e, s in zip(*pair)] for pair in zip(error, sigma)])
    ln_var = [[2.0 * np.log(s) for s in chains] for chains in sigma]
    level = np.median(np.concatenate([c for chains in ln_var for c in chains]), axis=0)
    blocks = [slice(start, start + 3) for start in range(0, len(level), 3)]
    given = (error, ln_var, ln_speed, lasting)
    windows = [_windows(given, found.spans, block, level) for block in blocks]
    shapes = _choose(windows) if like is None else like.shapes
    widening = found.widening(shapes[0].tau)
    fits = [_fit_shape(w, shape, widening[:, block]) for w, shape, block in zip(windows, shapes, blocks)]
    share, ratio = (np.concatenate(of, axis=1) for of in zip(*((fit.share, fit.ratio) for fit in fits)))
    return Parts(share, level, found.spans, ratio, shapes, step_s)


def _choose(windows: Sequence[_Windows]) -> list[Shape]:
    """The shape of each block, with one time constant for all. Sideways errors are correlated with the
    rotations that undo them; with time constants of their own, the two would drift apart along the way."""

    @cache
    def best(tau: float) -> list[_Fit]:
        return [_best(block, tau) for block in windows]

    def loss(tau: float) -> float:
        return sum(fit.loss for fit in best(tau))

    found = min(_TAU_FRAMES, key=loss)
    found = min((found, found / 2.0, found * 2.0), key=loss)
    return [fit.shape for fit in best(found)]


def _best(windows: _Windows, tau: float) -> _Fit:
    """The best shape of a block. By default the shares are constant."""
    loss = attrgetter("loss")
    tried = [_fit_shape(windows, Shape(0.0, by_noise, tau)) for by_noise in _NOISE_GROWTHS]
    by_noise = min(tried, key=loss).shape.by_noise
    tried += [_fit_shape(windows, Shape(by_speed, by_noise, tau)) for by_speed in _SPEED_GROWTHS]
    return min(tried, key=loss)


def _windows(given: Sequence[Chains], spans: NDArray[np.int64], block: slice, level: Array) -> _Windows:
    lengths, firsts = np.array([len(c) for chains in given[0] for c in chains]), []
    for m in spans:
        some = np.concatenate([at + m * np.arange(n // m) for at, n in zip(np.cumsum(lengths) - lengths, lengths)])
        firsts.append(some[:: max(len(some) // _MOST_WINDOWS, 1)])
    sizes = [len(f) for f in firsts]
    first, end = np.concatenate(firsts), np.concatenate([f + m for f, m in zip(firsts, spans)])
    error, ln_var, faster, root = (np.concatenate([c for chains in x for c in chains]).T for x in given)
    ln_var, known = ln_var[block], _sums(_closed(root[:, block]), first, end)
    return _Windows(
        square=_sums(_closed(error[block]), first, end) ** 2,
        known=(known**2).sum(axis=0),
        count=np.repeat(np.minimum(sizes, _MOST_COUNT) / sizes, sizes),
        first=first,
        end=end,
        variance=_closed(np.exp(ln_var)),
        above=_closed(ln_var - level[block, None]),
        faster=_closed(faster[0]),
        spans=sizes,
    )


def _closed(each: Array) -> Array:
    """(..., N + 1) values of the motions, and zero, with which the last window ends."""
    return np.concatenate([each, np.zeros((*each.shape[:-1], 1))], axis=-1)


def _sums(each: Array, first: NDArray[np.int64], end: NDArray[np.int64]) -> Array:
    """(..., W) sums of values (..., N + 1) over ``first`` to ``end - 1`` of each window."""
    return np.asarray(np.add.reduceat(each, np.stack([first, end], axis=1).ravel(), axis=-1)[..., ::2])


def _fit_shape(windows: _Windows, shape: Shape, widen: Array | None = None) -> _Fit:
    """Shares for one shape, by the likelihood of squared sums, times ``widen`` (S, d) if given.

    The standard deviation of a squared sum is its own stated variance (times root two). So the fit is reweighted by
    its own stated variances: weights from the observed squares would favour variances that are too small.
    """
    d, sizes = len(windows.square), windows.spans
    widen = np.ones((len(sizes), d)) if widen is None else widen
    share = np.repeat([[0.5], [0.4], [0.1]], d, axis=1)
    square, known = windows.square * np.repeat(widen.T, sizes, axis=1), windows.known
    gains = None
    if shape.by_speed > 0 or shape.by_noise > 0:
        gain = np.broadcast_to(np.exp(shape.by_speed * windows.faster), windows.above.shape)
        gains = gain, gain * np.exp(shape.by_noise * windows.above)
    for k in range(_REWEIGHTINGS):
        if k == 0 or (gains is not None and k <= _REDIVISIONS):
            A = _terms(windows, gains, shape.tau, share)
        stated = known + (A * share[:, :, None]).sum(axis=0)
        seen = np.minimum(square, _MOST_RATIO * stated) - known
        share = _solve(A, seen, windows.count / stated**2)
    stated = known + (A * share[:, :, None]).sum(axis=0)
    ratio = np.minimum(square / stated, _MOST_RATIO)
    loss = float((windows.count * (np.log(stated) + ratio)).sum())
    loss += _WORTH * ((shape.by_speed > 0) + (shape.by_noise > 0))
    means = np.array([r.mean(axis=1) for r in np.split(ratio, np.cumsum(sizes)[:-1], axis=1)])
    return _Fit(shape, loss, share, means / widen)


def _terms(w: _Windows, gains: tuple[Array, Array] | None, tau: float, share: Array) -> Array:
    """(3, d, W) variance of the sum over each window of jitter, white and bias of unit share at the typical level,
    divided as :func:`gpvo.online.division.divide` does with ``share``; white and bias have ``gains`` (d, R) over the
    jitter."""
    each = white = bias = w.variance
    if gains is not None:
        each = w.variance / (share[0, :, None] + share[1, :, None] * gains[0] + share[2, :, None] * gains[1])
        white, bias = each * gains[0], each * gains[1]
    amplitude = np.sqrt(bias)
    pairs = w.products(amplitude, float(np.exp(-1.0 / tau)))
    white, bias = (_sums(x, w.first, w.end) for x in (white, bias))
    return np.stack([0.5 * (each[:, w.first] + each[:, w.end - 1]), white, bias + 2.0 * pairs])


def _solve(A: Array, square: Array, weight: Array) -> Array:
    """Shares (3, d), non-negative with sum one, that explain squared sums (d, W) best; white noise if nothing shows."""
    J, B, rest = A[0] - A[1], A[2] - A[1], square - A[1]
    least = 1e-9 * (weight * A[1] ** 2).sum(axis=1)
    wJ, wB = weight * J, weight * B
    jj, jb, bb = (wJ * J).sum(axis=1) + least, (wJ * B).sum(axis=1), (wB * B).sum(axis=1) + least
    rj, rb = (wJ * rest).sum(axis=1), (wB * rest).sum(axis=1)
    # Where the best of both would be negative, the better of one alone.
    jitter, bias = (bb * rj - jb * rb) / (jj * bb - jb**2), (jj * rb - jb * rj) / (jj * bb - jb**2)
    both = (jitter >= 0) & (bias >= 0)
    rj, rb = np.maximum(rj, 0.0), np.maximum(rb, 0.0)
    by_jitter = rj**2 / jj > rb**2 / bb
    jitter = np.where(both, jitter, np.where(by_jitter, rj / jj, 0.0))
    bias = np.where(both, bias, np.where(by_jitter, 0.0, rb / bb))
    share = np.maximum([jitter, 1.0 - jitter - bias, bias], _MIN_SHARE)
    return np.asarray(share / share.sum(axis=0))


PRIORS = (9.0, 0.3)
"""Windows that the correlations of single motions may count for, as what to expect of each part."""
_ROUNDS, _CONVERGED = 100, 1e-3
_OVERLAP = 4
_EXACT = 1e-5  # of the largest deviation, as of simulated motions: sums lose the digits of what is less


def curves(spans: NDArray[np.int64], tau_frames: float) -> Array:
    """(S, 3) variance of the sum over m frames of jitter, white and bias of unit variance."""
    rho = np.exp(-1.0 / tau_frames)
    m = spans.astype(np.float64)
    bias = m + 2.0 * (rho * (m * (1.0 - rho) - 1.0 + rho**m)) / (1.0 - rho) ** 2
    return np.stack([np.ones_like(m), m, bias], axis=1)


def part_correlations(error: Chains, sigma: Chains, split: Parts) -> Array:
    """(P, 3, 6, 6) correlations of jitter, white noise and bias, for each of :data:`PRIORS`, from those of the errors
    summed over each span.

    Each sum is divided by its own stated deviation: the worst of the motions in it dominate it, as they dominate the
    pose, and their axes may be more strongly correlated than those of the others. The covariance over a span is that
    of its parts, by what each contributes: variance components of a Wishart likelihood, by the MM algorithm of H. Zhou
    et al., "MM algorithms for variance components models" (2019), which keeps them positive definite. All spans hold
    the same errors, so that they share one count of windows; the correlations of single motions are the prior.
    """
    part = curves(split.spans, split.shapes[0].tau) * split.share.T[:, None, :]
    scale = np.moveaxis(np.sqrt(part / part.sum(axis=2, keepdims=True)), 0, 2)
    D = scale[..., :, None] * scale[..., None, :]
    measured = np.array([correlation(student_t.scatter(_scaled_sums(error, sigma, m))) for m in split.spans])
    weighted = D * (_independent(error, split, scale[:, 2] ** 2) / len(split.spans))[:, None, None, None]
    prior = np.array(PRIORS)[:, None, None, None]
    R = np.tile(measured[0], (len(PRIORS), 3, 1, 1))
    for _ in range(_ROUNDS):
        inverse = np.linalg.inv((D * R[:, None]).sum(axis=2))
        own = (weighted * inverse[:, :, None]).sum(axis=1) + prior * np.linalg.inv(R)
        seen = (weighted * (inverse @ measured @ inverse)[:, :, None]).sum(axis=1)
        before, R = R, _balanced(own, R @ seen @ R + prior * measured[0])
        if np.abs(R - before).max() < _CONVERGED:
            break
    return correlation(R)


def _independent(error: Chains, split: Parts, bias: Array) -> Array:
    """(S,) independent windows of each span, where ``bias`` (S, D) of the variance of a sum is that of the bias, which
    lasts from one window to the next (M. Bartlett, "On the theoretical specification and sampling properties of
    autocorrelated time-series" (1946)); those of different sequences always are."""
    windows = np.array([[sum(len(c) // m for c in chains) for chains in error] for m in split.spans])
    kept = np.exp(-2.0 * split.spans[:, None] * split.step_s / split.tau_s)
    alone = (windows.sum(axis=1, keepdims=True) / (1.0 + 2.0 * bias**2 * kept / (1.0 - kept))).min(axis=1)
    return np.asarray(np.maximum(alone, (windows > 0).sum(axis=1)))


def _balanced(N: Array, M: Array) -> Array:
    """(..., n, n) positive definite X that solves ``X N X = M``, all symmetric."""
    L = np.linalg.cholesky(N)
    values, vectors = np.linalg.eigh(np.swapaxes(L, -1, -2) @ M @ L)
    half = np.linalg.solve(np.swapaxes(L, -1, -2), vectors)
    return np.asarray((half * np.sqrt(values)[..., None, :]) @ np.swapaxes(half, -1, -2))


def _scaled_sums(error: Chains, sigma: Chains, m: int) -> Array:
    """(w, D) sums over m motions, over their stated deviation if independent; each axis has unit mean square. Of
    windows that hold nearly the same motions, some are enough."""
    pairs = [(moving_sums(e, m), moving_sums(s**2, m)) for es, ss in zip(error, sigma) for e, s in zip(es, ss)]
    some = slice(None, None, max(m // _OVERLAP, 1))
    least = _EXACT**2 * np.max([s2.max(axis=0) for _, s2 in pairs if len(s2)], axis=0)
    z = np.concatenate([e[some] / np.sqrt(np.maximum(s2, least)[some]) for e, s2 in pairs])
    return np.asarray(z / np.sqrt((z**2).mean(axis=0)))
