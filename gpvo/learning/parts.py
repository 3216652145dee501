"""How errors add up over a distance: jitter, white and bias, from the variance of sums over 1, 2, 5, ... frames.

With unit variance per frame, the variance of the sum over m frames is ``a`` for jitter (n_k - n_(k-1)), ``w m`` for
white noise and ``b (m + 2 sum_i (m - i) rho^i)`` for a first-order Gauss-Markov bias with correlation rho per frame
(A. Gelb, "Applied Optimal Estimation" (1974), section 3.8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gpvo.types import Array

SPANS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_TAU_FRAMES = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0)
_MIN_WINDOWS = 3.0
_MIN_SHARE = 1e-6
_REWEIGHTINGS = 8


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


def fit_parts(z: Sequence[Array], step_s: float) -> Parts:
    """From normalised residuals, one array (n_i, D) per unbroken stretch; ``step_s``: usual duration of a motion.

    Translation and rotation (each three axes) have one time constant each; the shares are the axis' own.
    """
    spans, measured, windows = span_variances(z)
    curve = measured / measured[0]
    share, tau = np.empty((3, curve.shape[1])), np.empty(curve.shape[1])
    for start in range(0, curve.shape[1], 3):
        block = range(start, min(start + 3, curve.shape[1]))
        fits = {t: [_fit_axis(spans, curve[:, j], windows, t) for j in block] for t in _TAU_FRAMES}
        best = min(fits, key=lambda t: sum(loss for loss, _ in fits[t]))
        for j, (_, found) in zip(block, fits[best]):
            share[:, j], tau[j] = found, best
    fitted = np.stack([curves(spans, tau[j]) @ share[:, j] for j in range(curve.shape[1])], axis=1)
    return Parts(share, tau * step_s, spans, curve, fitted)


def span_variances(z: Sequence[Array]) -> tuple[NDArray[np.int64], Array, Array]:
    """Mean square of sums over each span that occurs: spans (S,), (S, D), and how many separate windows fit (S,)."""
    spans, out, windows = [], [], []
    for m in SPANS:
        sums = [_sums(s, m) for s in z if len(s) >= m]
        count = sum(len(s) for s in z if len(s) >= m) / m
        if sums and count >= _MIN_WINDOWS:
            spans.append(m)
            out.append((np.concatenate(sums) ** 2).mean(axis=0))
            windows.append(count)
    if not spans:
        raise ValueError("no residuals to fit the parts to")
    return np.array(spans), np.maximum(np.array(out), 1e-12), np.array(windows)


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


def stretches(t_ns: NDArray[np.int64], dt_s: Array) -> list[slice]:
    """Unbroken stretches of motions: each starts where the one before ended."""
    if len(t_ns) == 0:
        return []
    begins = t_ns[1:] - np.round(dt_s[1:] * 1e9).astype(np.int64)
    breaks = np.flatnonzero(np.abs(begins - t_ns[:-1]) > 1000) + 1
    edges = [0, *breaks.tolist(), len(t_ns)]
    return [slice(a, b) for a, b in pairwise(edges)]
