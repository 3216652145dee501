"""How the axes go together in jitter, white and bias: from correlations of errors summed over 1, 2, 5, ... frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry.covariance import correlation
from gpvo.learning.calibrate import residual_correlation
from gpvo.learning.parts import Parts
from gpvo.learning.spans import Chains, sums
from gpvo.types import Array

_PRIOR = 3.0
_LEAST_EIGENVALUE = 1e-3


def curves(spans: NDArray[np.int64], tau_frames: float) -> Array:
    """(S, 3) variance of the sum over m frames of jitter, white and bias of unit variance."""
    rho = np.exp(-1.0 / tau_frames)
    m = spans.astype(np.float64)
    bias = m + 2.0 * (rho * (m * (1.0 - rho) - 1.0 + rho**m)) / (1.0 - rho) ** 2
    return np.stack([np.ones_like(m), m, bias], axis=1)


def part_correlations(error: Chains, sigma: Chains, split: Parts, step_s: float) -> Array:
    """(3, 6, 6) correlations of jitter, white and bias, from those of the errors summed over each span.

    Each sum is over its own stated deviation: among the motions that it sums the worst decide, as they do of the pose,
    and their axes may go together more closely than those of the others.
    Of each pair of axes three numbers are sought whose mixture, by what each part contributes to the sum, is the
    correlation seen over every span; all are drawn towards that of single motions, as few windows show little.
    """
    part = np.stack([curves(split.spans, tau / step_s) for tau in split.tau_s]) * split.share.T[:, None, :]
    whole = part.sum(axis=2).T
    measured = np.array([residual_correlation(_scaled_sums(error, sigma, m)) for m in split.spans])
    windows = 2.0 / split.doubt
    out = np.tile(np.eye(6), (3, 1, 1))
    for i, j in zip(*np.triu_indices(6, 1)):
        mixture = np.sqrt(part[i] * part[j] / (whole[:, i] * whole[:, j])[:, None])
        weight = np.sqrt(np.minimum(windows[:, i], windows[:, j]))
        A = np.vstack([mixture * weight[:, None], _PRIOR * np.eye(3)])
        b = np.concatenate([measured[:, i, j] * weight, np.full(3, _PRIOR * measured[0, i, j])])
        out[:, i, j] = out[:, j, i] = np.linalg.lstsq(A, b, rcond=None)[0]
    return np.array([_nearest_correlation(R) for R in out])


def _scaled_sums(error: Chains, sigma: Chains, m: int) -> Array:
    """(w, D) sums over m motions, over their stated deviation were they independent; each axis of unit mean square."""
    pairs = [(e, s) for es, ss in zip(error, sigma) for e, s in zip(es, ss) if len(e) >= m]
    z = np.concatenate([sums(e, m) / np.sqrt(sums(s**2, m)) for e, s in pairs])
    return np.asarray(z / np.sqrt((z**2).mean(axis=0)))


def _nearest_correlation(R: Array) -> Array:
    """Positive definite, with a unit diagonal."""
    values, vectors = np.linalg.eigh(R)
    R = (vectors * np.maximum(values, _LEAST_EIGENVALUE)) @ vectors.T
    return correlation(R)
