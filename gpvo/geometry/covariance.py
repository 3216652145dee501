"""Transport and compounding of pose covariances under right perturbations (translation, rotation)."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.types import Array

LARGEST = 1e100  # No element of a covariance is larger, no variance as small as its inverse: squares stay finite.
_SKEW, _SKEW_OF_SUM = 1e-8, 1e-12


def symmetrise(C: Array) -> Array:
    """Average of a matrix and its transpose. (..., n, n)."""
    return 0.5 * (C + np.swapaxes(C, -1, -2))


def variances(C: Array) -> Array:
    """(..., n) of covariances (..., n, n)."""
    return np.asarray(np.diagonal(C, axis1=-2, axis2=-1))


def is_symmetric(C: Array) -> NDArray[np.bool_]:
    """(...) which (..., n, n) are symmetric to rounding: of an element, or of those that were summed up to it."""
    size = np.abs(C)
    allowed = _SKEW * size + _SKEW_OF_SUM * size.max(axis=(-2, -1), keepdims=True)
    return np.asarray((np.abs(C - np.swapaxes(C, -1, -2)) <= allowed).all(axis=(-2, -1)))


def is_positive_definite(C: Array) -> bool:
    """Whether one (n, n) matrix is finite, symmetric to rounding and positive definite."""
    return bool(are_covariances(np.asarray(C)[None])[0])


def are_covariances(C: Array) -> NDArray[np.bool_]:
    """(N,) which of (N, n, n) matrices are finite, symmetric to rounding and positive definite."""
    C = np.asarray(C, dtype=np.float64)
    with np.errstate(invalid="ignore"):  # Comparisons with NaN are false.
        good = (np.abs(C) < LARGEST).all(axis=(1, 2)) & (variances(C) > 1 / LARGEST).all(axis=1) & is_symmetric(C)
    good[good] = _have_roots(C[good])
    return np.asarray(good)


def _have_roots(C: Array) -> NDArray[np.bool_]:
    """(N,) which of (N, n, n) have a Cholesky factor: tried together, in halves where one of them has none."""
    try:
        np.linalg.cholesky(C)
    except np.linalg.LinAlgError:
        halves = np.array_split(C, 2)
        return np.zeros(1, bool) if len(C) == 1 else np.concatenate([_have_roots(half) for half in halves])
    return np.ones(len(C), bool)


def are_semidefinite(C: Array) -> NDArray[np.bool_]:
    """(N,) which of (N, n, n) symmetric matrices are finite and positive semidefinite up to rounding: whatever the
    axes' units, as it is their correlations that are judged."""
    C = np.asarray(C, dtype=np.float64)
    variance = variances(C)
    with np.errstate(all="ignore"):
        good: NDArray[np.bool_] = np.asarray((np.abs(C) < LARGEST).all(axis=(1, 2)) & (variance >= 0).all(axis=1))
        sigma = np.sqrt(np.where(variance > 0, variance, 1.0))
        R = C / sigma[:, :, None] / sigma[:, None, :]
    good &= np.isfinite(R).all(axis=(1, 2))
    least = np.linalg.eigvalsh(symmetrise(np.where(good[:, None, None], R, np.eye(C.shape[1]))))
    return np.asarray(good & (least[:, 0] > -1e-9))


def where_stated(C: Array) -> Array:
    """(N, n, n) with NaN in place of what is no covariance: zeros, say, with which other software marks what it does
    not know, or one that says that some error is impossible."""
    return np.where(are_covariances(C)[:, None, None], C, np.nan)


_triangle = cache(np.triu_indices)  # each record asks for it four times


def upper(C: Array) -> Array:
    """(..., n (n + 1) / 2) elements of symmetric matrices (..., n, n) on and above the diagonal, row by row."""
    i, j = _triangle(C.shape[-1])
    return np.asarray(C[..., i, j])


def from_upper(elements: Array, n: int) -> Array:
    """(..., n, n) symmetric matrices: the inverse of :func:`upper`."""
    i, j = _triangle(n)
    C = np.empty((*elements.shape[:-1], n, n))
    C[..., i, j] = C[..., j, i] = elements
    return C


def scaled_root(C: Array) -> Array:
    """L (..., n, n) with ``L L^T = C``, C positive semi-definite: the symmetric root of the correlation, times sigma.

    Where the variances change and the correlation does not, so does L: what drives an axis stays the same, whatever
    the axes' units.
    """
    C = symmetrise(C)
    sigma = np.sqrt(np.maximum(variances(C), 0.0))
    unit = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(C / (unit[..., :, None] * unit[..., None, :]))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(sigma[..., :, None] * root)


def half_axes(C: Array) -> Array:
    """(..., n, n) rows: the half axes of the 3-sigma ellipsoid of covariances (..., n, n)."""
    values, vectors = np.linalg.eigh(C)
    return np.asarray(3.0 * np.swapaxes(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :], -1, -2))


def correlation(C: Array) -> Array:
    """Correlations (..., n, n) of covariances; NaN where a variance is unknown."""
    sigma = np.sqrt(variances(C))
    return np.asarray(C / (sigma[..., :, None] * sigma[..., None, :]))


def compound(T_b_c: Array, cov_a_b: Array, cov_b_c: Array) -> Array:
    """Covariance of ``T_a_b T_b_c`` for independent errors: ``Ad(T_b_c)^-1 S_ab Ad(T_b_c)^-T + S_bc``."""
    return change_body(se3.inverse(T_b_c), cov_a_b) + cov_b_c


def change_body(T_new_old: Array, covariance: Array) -> Array:
    """Covariance of a motion or twist of the same rigid body, seen at another of its frames: ``Ad C Ad^T``."""
    A = se3.adjoint(T_new_old)
    return A @ covariance @ np.swapaxes(A, -1, -2)


def growth(covariance: Array, motions: Array) -> Array:
    """(N, 6, 6) what motions (N - 1, 4, 4) add to the covariance of the pose before, (N, 6, 6); NaN for the first."""
    out = np.full_like(covariance, np.nan)
    out[1:] = symmetrise(covariance[1:] - change_body(se3.inverse(motions), covariance[:-1]))
    return out


def position_in_world(T_world_cur: Array, covariance: Array) -> Array:
    """(..., 3, 3) covariance of the position in world axes, from the right-perturbation (..., 6, 6)."""
    R = T_world_cur[..., :3, :3]
    return R @ covariance[..., :3, :3] @ np.swapaxes(R, -1, -2)


_ANY_MPS = 15.0  # a car in town, a multirotor at its fastest


def lost_covariance(dt_s: float, twist: Array | None) -> Array:
    """(6, 6) covariance of a motion that was not measured but extrapolated over ``dt_s``.

    A vehicle may have stopped, or doubled its speed, or started from rest at one m/s and half a radian per second.
    ``twist`` (6,) is the last one measured; None where none was yet: it may have come as fast as vehicles go.
    """
    speed, rate = (_ANY_MPS, 0.0) if twist is None else (float(np.linalg.norm(v)) for v in (twist[:3], twist[3:]))
    sigma_m, sigma_rad = dt_s * max(speed, 1.0), dt_s * max(rate, 0.5)
    return np.diag([max(sigma_m, 1e-3) ** 2] * 3 + [max(sigma_rad, 1e-3) ** 2] * 3)
