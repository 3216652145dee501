"""Is a stated covariance honest? NEES, coverage, CRPS of Gaussian statements; NLL of those and of Student-t ones.

NEES: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation" (2001),
section 5.4.2. CRPS of a Gaussian and energy score: T. Gneiting, A. Raftery, "Strictly Proper Scoring Rules,
Prediction, and Estimation" (2007), sections 4.2 and 4.3.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.stats import student_t
from gpvo.types import Array

_SQRT2 = math.sqrt(2.0)
_AT_ONCE = 1000
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


BLOCKS = {"translation": (0, 1, 2), "rotation": (3, 4, 5), "joint": (0, 1, 2, 3, 4, 5)}
"""Of the tangent vector."""
SEEN = 2e-6
"""m, rad: an axis whose errors are smaller throughout, as height, roll and pitch of a robot in a plane, tells nothing
of a covariance: neither odometry nor truth speaks of it."""
_SMALL_BESIDE, _LEAST_SEEN_M = 0.03, 1e-8


def seen_axes(error: Array) -> NDArray[np.intp]:
    """The axes (k,) of errors, or of motions, (n, d) that reach :func:`least_seen` in the root mean square; none where
    no axis reaches :data:`SEEN`."""
    if not len(error):
        return np.arange(0)
    size = rms(error)
    return np.flatnonzero((size >= least_seen(size)) & (size >= SEEN).any())


def least_seen(size: Array) -> Array:
    """(d,) what the root mean square errors ``size`` (d,) must reach: :data:`SEEN`; for a translation less, where even
    the largest is tiny, as of an endoscope with a baseline of millimetres."""
    least = np.full(len(size), SEEN)
    least[:3] = np.clip(_SMALL_BESIDE * size[:3].max(), _LEAST_SEEN_M, SEEN)
    return least


def rms(error: Array) -> Array:
    """(d,) root mean squares of errors (n, d)."""
    with np.errstate(over="ignore"):  # of a log that is absurd otherwise, too
        return np.asarray(np.sqrt((error**2).mean(axis=0)))


def counted_axes(axes: ArrayLike | None, d: int) -> NDArray[np.intp]:
    """Those of the first d axes that are among ``axes``; all d where none is, and for None."""
    counted = np.arange(d) if axes is None else np.intersect1d(axes, np.arange(d)).astype(np.intp)
    return counted if len(counted) else np.arange(d)


def marginal(covariance: Array, axes: ArrayLike) -> Array:
    """Covariances (..., k, k) of some of the axes of (..., d, d); of all of them, in order, no copy."""
    C, chosen = np.asarray(covariance), np.asarray(axes)
    return C if np.array_equal(chosen, np.arange(C.shape[-1])) else C[..., chosen[:, None], chosen]


def nees_by_block(error: Array, covariance: Array, axes: ArrayLike | None = None) -> dict[str, Array]:
    """NEES per degree of freedom (n,) of each of :data:`BLOCKS` that errors (n, 6), or (n, 3) of translations, hold.

    ``axes``: those that count, as in :func:`counted_axes`; a block without any is left out.
    """
    d = error.shape[-1]
    counted = counted_axes(axes, d)
    held = {name: counted[np.isin(counted, b)] for name, b in BLOCKS.items() if max(b) < d}
    return {n: nees(error[:, b], marginal(covariance, b)) / len(b) for n, b in held.items() if len(b)}


def nees_median(d: int, nu: float = math.inf) -> float:
    """Median of the NEES of a d-variate t with ``nu`` degrees of freedom and the stated second moment: by summing up
    its density over the squared distance."""
    ln_squared = np.linspace(-30.0, 40.0, 20_001)
    ln_share = 0.5 * d * ln_squared - student_t.joint_nll(np.exp(ln_squared), d, nu)
    share = np.exp(ln_share - ln_share.max())
    below = np.cumsum(share) - 0.5 * share
    return float(np.exp(np.interp(0.5 * share.sum(), below, ln_squared)))


def nll_per_dim(error: Array, covariance: Array, nu: float = math.inf) -> Array:
    """Joint negative log-likelihood divided by the dimension [nats], of a Student-t with ``nu`` degrees of freedom
    whose second moment is ``covariance``; of a Gaussian by default. -> (...)."""
    error, covariance = _checked(error, covariance)
    L = np.linalg.cholesky(covariance)
    z = np.linalg.solve(L, error[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(-1)
    d = error.shape[-1]
    return (student_t.joint_nll((z**2).sum(-1), d, nu) + 0.5 * log_det) / d


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


def energy_score(error: Array, covariance: Array, *, draws: int = 256) -> Array:
    """``E|X - e| - E|X - X'| / 2`` for X, X' ~ N(0, C): the CRPS of vectors, in the error's unit. (..., d) -> (...).

    By antithetic draws, the same for all rows.
    """
    error, covariance = _checked(error, covariance)
    d = error.shape[-1]
    half = np.random.default_rng(0).standard_normal((draws // 2, d))
    z, out = np.concatenate([half, -half]), np.empty(error.shape[:-1])
    rows, spreads, scores = error.reshape(-1, d), covariance.reshape(-1, d, d), out.reshape(-1)
    for k in range(0, len(rows), _AT_ONCE):  # draws of a million rows fill no memory
        part = slice(k, k + _AT_ONCE)
        x = np.swapaxes(np.linalg.cholesky(spreads[part]) @ z.T, -1, -2)  # (rows, draws, d)
        to_error = np.linalg.norm(x - rows[part, None, :], axis=-1).mean(axis=-1)
        # Differences of independent draws are draws of twice the covariance.
        scores[part] = to_error - np.linalg.norm(x, axis=-1).mean(axis=-1) / _SQRT2
    return out


def correlation_gain(error: Array, covariance: Array) -> Array:
    """Nats per dimension by which the stated correlations make the errors likelier than the variances alone. (...).

    Negative where the correlations are wrong: to know some axes then misleads about the others.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    return nll_per_dim(error, variances[..., None] * np.eye(variances.shape[-1])) - nll_per_dim(error, covariance)


def by_difficulty(error: Array, covariance: Array) -> tuple[Array, Array]:
    """(4,) NEES/dof and (4,) coverage at one sigma in quartiles of rising stated uncertainty.

    A covariance that is right on average but blind to what makes a motion hard is too wide in the first and too narrow
    in the last. Difficulty is the determinant of the covariance. NaN with fewer than four rows.
    """
    if len(error) < 4:
        return np.full(4, np.nan), np.full(4, np.nan)
    rows = np.array_split(np.argsort(np.linalg.slogdet(covariance)[1], kind="stable"), 4)
    sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    d = error.shape[-1]
    return (
        np.array([nees(error[r], covariance[r]).mean() / d for r in rows]),
        np.array([coverage(error[r], sigma[r], (1.0,))[0] for r in rows]),
    )
