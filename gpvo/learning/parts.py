"""How errors add up over a distance: jitter, white and bias, from the variance of sums over 1, 2, 5, ... frames.

With unit variance per frame, the variance of the sum over m frames is ``a`` for jitter (n_k - n_(k-1)), ``w m`` for
white noise and ``b (m + 2 sum_i (m - i) rho^i)`` for a first-order Gauss-Markov bias with correlation rho per frame
(A. Gelb, "Applied Optimal Estimation" (1974), section 3.8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gpvo.types import Array

SPANS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_TAU_FRAMES = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0, 1024.0, 2048.0, 4096.0)
_MIN_WINDOWS = 3.0
_MIN_SHARE = 1e-6
_REWEIGHTINGS = 8
_SAME_NS = 1000
_MAX_DOUBT = 1.0


@dataclass(frozen=True)
class Parts:
    """``share`` (3, D): jitter, white, bias of each axis, summing to one. ``tau_s`` (D,): of the bias.

    ``spans`` (S,) frames, ``measured`` and ``fitted`` (S, D): variance of the sum over so many frames.
    """

    share: Array
    tau_s: Array
    spans: NDArray[np.int64]
    measured: Array
    fitted: Array


@dataclass(frozen=True)
class SpanVariances:
    """``spans`` (S,) that occur; ``mean_square`` (S, D) of sums over each; ``doubt`` (S, D): squared relative standard
    error of that, by which sequences differ or, where they are few, by the number of separate windows."""

    spans: NDArray[np.int64]
    mean_square: Array
    doubt: Array

    @property
    def predictive(self) -> Array:
        """(S, D) variance to state of a sequence not seen: what is squared over an uncertain variance ``v`` is, on
        average, too large by ``1 + var(v) / v^2``."""
        return self.mean_square * (1.0 + self.doubt)


def fit_parts(z: Sequence[Sequence[Array]], step_s: float) -> Parts:
    """From normalised residuals: per sequence its unbroken chains (n_i, D); ``step_s``: usual duration of a motion.

    Translation and rotation (each three axes) have one time constant each; the shares are the axis' own.
    """
    found = span_variances(z)
    spans, curve = found.spans, found.predictive / found.predictive[0]
    windows = 2.0 / found.doubt
    share, tau = np.empty((3, curve.shape[1])), np.empty(curve.shape[1])
    for start in range(0, curve.shape[1], 3):
        block = range(start, min(start + 3, curve.shape[1]))
        fits = {t: [_fit_axis(spans, curve[:, j], windows[:, j], t) for j in block] for t in _TAU_FRAMES}
        best = min(fits, key=lambda t: sum(loss for loss, _ in fits[t]))
        for j, (_, chosen) in zip(block, fits[best]):
            share[:, j], tau[j] = chosen, best
    fitted = np.stack([curves(spans, tau[j]) @ share[:, j] for j in range(curve.shape[1])], axis=1)
    return Parts(share, tau * step_s, spans, curve, fitted)


def span_variances(z: Sequence[Sequence[Array]]) -> SpanVariances:
    """Of the sums over each of :data:`SPANS` that occurs three times at least; sequences count by their length."""
    spans, mean_square, doubt = [], [], []
    for m in SPANS:
        long = [[chain for chain in chains if len(chain) >= m] for chains in z]
        squares = np.array([np.concatenate([_sums(c, m) ** 2 for c in some]).mean(axis=0) for some in long if some])
        windows = np.array([sum(len(c) for c in some) / m for some in long if some])
        if windows.sum() >= _MIN_WINDOWS:
            weight = windows / windows.sum()
            mean = np.maximum(weight @ squares, 1e-12)
            between = (weight**2) @ (squares / mean - 1.0) ** 2
            spans.append(m)
            mean_square.append(mean)
            doubt.append(np.clip(_by_block(between), 2.0 / windows.sum(), _MAX_DOUBT))
    if not spans:
        raise ValueError("no residuals to fit the parts to")
    return SpanVariances(np.array(spans), np.array(mean_square), np.array(doubt))


def _by_block(values: Array) -> Array:
    """Each block of three axes at its mean, as three axes show better than one by how much sequences differ."""
    out = values.copy()
    for start in range(0, len(out), 3):
        out[start : start + 3] = out[start : start + 3].mean()
    return out


def _sums(z: Array, m: int) -> Array:
    total = np.cumsum(np.vstack([np.zeros(z.shape[1]), z]), axis=0)
    return total[m:] - total[:-m]


def curves(spans: NDArray[np.int64], tau_frames: float) -> Array:
    """(S, 3) variance of the sum over m frames of jitter, white and bias of unit variance."""
    rho = np.exp(-1.0 / tau_frames)
    m = spans.astype(np.float64)
    bias = m + 2.0 * (rho * (m * (1.0 - rho) - 1.0 + rho**m)) / (1.0 - rho) ** 2
    return np.stack([np.ones_like(m), m, bias], axis=1)


def _fit_axis(spans: NDArray[np.int64], measured: Array, windows: Array, tau_frames: float) -> tuple[float, Array]:
    """Loss and shares (3,) for one time constant, by the likelihood of a chi-squared mean square.

    Each mean square has a relative deviation of sqrt(2 / windows); the fit is reweighted by its own curve, because
    weights by the measured values would favour curves that lie too low.
    """
    C, curve = curves(spans, tau_frames), measured
    for _ in range(_REWEIGHTINGS):
        weight = np.sqrt(windows) / curve
        coefficients = nnls(C * weight[:, None], measured * weight)[0]
        share = np.maximum(coefficients / max(coefficients.sum(), 1e-300), _MIN_SHARE)
        share = share / share.sum()
        curve = C @ share
    return float(windows @ (np.log(curve) + measured / curve)), share


def chains(t_ns: NDArray[np.int64], dt_s: Array) -> list[NDArray[np.int64]]:
    """Rows of the motions that add up to the path, in unbroken chains: each starts where the one before ended.

    A vehicle that hardly moves keeps its reference, and several motions start there; only the last of them leads on.
    """
    if len(t_ns) == 0:
        return []
    begins = t_ns - np.round(dt_s * 1e9).astype(np.int64)
    last_of_reference = np.append(np.abs(np.diff(begins)) > _SAME_NS, True)
    rows = np.flatnonzero(last_of_reference)
    breaks = np.flatnonzero(np.abs(begins[rows[1:]] - t_ns[rows[:-1]]) > _SAME_NS) + 1
    return list(np.split(rows, breaks))
