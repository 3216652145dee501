"""Is a stated covariance honest? NEES, coverage, NLL and CRPS of Gaussian statements.

NEES: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
section 5.4.2. CRPS of a Gaussian: T. Gneiting, A. Raftery, "Strictly Proper Scoring Rules" (2007), section 4.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SQRT2 = math.sqrt(2.0)
_erf = np.vectorize(math.erf, otypes=[np.float64])


def _checked(error: Array, covariance: Array) -> tuple[Array, Array]:
    error = np.asarray(error, dtype=np.float64)
    covariance = np.asarray(covariance, dtype=np.float64)
    d = error.shape[-1]
    if covariance.shape[-2:] != (d, d):
        raise ValueError(f"error has shape {error.shape}, covariance {covariance.shape}: last axes must be (d), (d, d)")
    return error, covariance


def whiten(error: Array, covariance: Array) -> Array:
    """``L^-1 e`` with ``L L^T = covariance``: standard normal if the statement is right. (..., d)."""
    error, covariance = _checked(error, covariance)
    return np.linalg.solve(np.linalg.cholesky(covariance), error[..., None])[..., 0]


def nees(error: Array, covariance: Array) -> Array:
    """Normalised estimation error squared ``e^T C^-1 e``, of mean d if right. (..., d), (..., d, d) -> (...)."""
    return (whiten(error, covariance) ** 2).sum(-1)


def nll_per_dim(error: Array, covariance: Array) -> Array:
    """Joint Gaussian negative log-likelihood divided by the dimension [nats]. -> (...)."""
    error, covariance = _checked(error, covariance)
    L = np.linalg.cholesky(covariance)
    z = np.linalg.solve(L, error[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(-1)
    d = error.shape[-1]
    return 0.5 * ((z**2).sum(-1) + log_det + d * math.log(2 * math.pi)) / d


def coverage(error: Array, sigma: Array, levels: tuple[float, ...] = (1.0, 2.0, 3.0)) -> Array:
    """Share of |error| <= level * sigma, averaged over everything. (..., d) -> (len(levels),)."""
    ratio = np.abs(np.asarray(error)) / np.asarray(sigma)
    return np.array([(ratio <= level).mean() for level in levels])


def crps_gaussian(error: Array, sigma: Array) -> Array:
    """Continuous ranked probability score of ``N(0, sigma^2)`` at ``error``, in the error's unit."""
    sigma = np.asarray(sigma, dtype=np.float64)
    z = np.asarray(error, dtype=np.float64) / sigma
    pdf = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    cdf = 0.5 * (1.0 + _erf(z / _SQRT2))
    return sigma * (z * (2 * cdf - 1) + 2 * pdf - 1 / math.sqrt(math.pi))
