"""One row through a shared basis, fast: everything that can be stacked is stacked once, into buffers made once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.online.projected import ProjectedGP
from gpvo.types import Array


@dataclass(frozen=True)
class StackedBasis:
    """A shared basis as plain matrices. With k (M,) the kernels' values below one another and z (R,) the directions':

        means     = offset[0], offset[2]          + B k            (the error's mean; the log noise variance)
        variances = offset[1], offset[2], offset[3] + H z^2        (of the mean; added to the log noise; its spread)

    ``kernels``: one GP, or two where the noise has its own kernel. ``B`` (2, D, M) = A P. ``H`` (3, D, R).
    ``offset`` (4, D): mean, its variance, log noise variance, its spread.
    """

    kernels: tuple[ProjectedGP, ...]
    B: Array
    H: Array
    offset: Array


def stack(mean: ProjectedGP, noise: ProjectedGP | None, log_noise_offset: Array) -> StackedBasis:
    """The matrices of a shared basis: GPs of the mean and the log noise variance, and what is added to the latter."""
    D = mean.n_outputs
    own = noise is not None and noise.points is not mean.points
    kernels = (mean, noise) if own and noise is not None else (mean,)
    M, R = sum(len(gp.points) for gp in kernels), sum(len(gp.flat_projection) for gp in kernels)
    B, H, offset = np.zeros((2, D, M)), np.zeros((3, D, R)), np.zeros((4, D))
    B[0, :, : len(mean.points)] = _kernel_weights(mean)
    _place(H[0], mean, -mean.reduction, 0)
    offset[0], offset[1], offset[2] = mean.offset, mean.signal_var, log_noise_offset
    if noise is not None:
        k_start, z_start = (len(mean.points), len(mean.flat_projection)) if own else (0, 0)
        B[1, :, k_start : k_start + len(noise.points)] = _kernel_weights(noise)
        _place(H[1], noise, -0.5 * noise.reduction, z_start)
        _place(H[2], noise, -noise.reduction, z_start)
        offset[2] += noise.offset + 0.5 * noise.signal_var
        offset[3] = noise.signal_var
    return StackedBasis(kernels, B, H, offset)


def _kernel_weights(gp: ProjectedGP) -> Array:
    """(D, m) weights of the kernel itself: ``A P``."""
    if gp.projection.ndim == 2:
        return gp.weights @ gp.projection
    return np.einsum("jr,jrm->jm", gp.weights, gp.projection)


def _place(block: Array, gp: ProjectedGP, values: Array, start: int) -> None:
    """Write per-output coefficients (D, r) into ``block`` (D, R) at the columns of the directions they multiply."""
    D, r = values.shape
    for j in range(D):
        first = start + (j * r if gp.projection.ndim == 3 else 0)
        block[j, first : first + r] = values[j]


class RowPlan:
    """Calls with x (d,) return four (D,): mean, its variance, log noise variance, its spread; fresh arrays.

    With v = [y, y^2, 1], y = x - centre, all exponents are one product ``G v``; k and z^2 carry a last 1 that adds the
    offsets. Projections are float32, as squares forgive it; exponents and means cancel and stay float64.
    """

    def __init__(self, stacked: StackedBasis) -> None:
        kernels, D = stacked.kernels, stacked.offset.shape[1]
        d, sizes = kernels[0].n_inputs, [len(gp.points) for gp in kernels]
        flats = [_aligned(gp.flat_projection, np.float32) for gp in kernels]
        lengths = [len(P) for P in flats]
        mean, mean_var, log_noise, spread = stacked.offset
        B = _aligned(_with_offset(stacked.B, [mean, log_noise - 0.5 * spread]), np.float64)
        H = _aligned(_with_offset(stacked.H[[1, 0, 2]], [0.5 * spread, mean_var, spread]), np.float32)
        G = _aligned(np.vstack([_exponent_rows(gp, kernels[0].centre) for gp in kernels]), np.float64)
        v, k = np.ones(2 * d + 1), _aligned(np.ones(B.shape[1]), np.float64)
        k32, z = _aligned(np.ones(sum(sizes)), np.float32), _aligned(np.ones(H.shape[1]), np.float32)
        means, narrow, wide = np.zeros((2, D)), np.zeros(3 * D, np.float32), np.zeros((3, D))
        parts_k, parts_z = np.split(k32, np.cumsum(sizes)[:-1]), np.split(z[: sum(lengths)], np.cumsum(lengths)[:-1])
        self._centre = kernels[0].centre.copy()
        self._y, self._yy, self._v = v[:d], v[d : 2 * d], v
        self._k, self._k_one, self._k32, self._z = k[: sum(sizes)], k, k32, z
        self._exponents, self._means, self._variances = G.dot, B.dot, H.dot
        self._projections = [(P.dot, part_k, part_z) for P, part_k, part_z in zip(flats, parts_k, parts_z, strict=True)]
        self._flat_means, self._narrow, self._wide = means.reshape(-1), narrow, wide.reshape(-1)
        self._log_noise, self._half_spread, self._vars, self._zeros = means[1], wide[0], wide[1:], np.zeros((2, D))
        self._results = (means[0].copy, wide[1].copy, means[1].copy, wide[2].copy)

    def __call__(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """x (d,) float64, in the units of training."""
        y, k, z = self._y, self._k, self._z
        np.subtract(x, self._centre, y)
        np.multiply(y, y, self._yy)
        self._exponents(self._v, k)
        np.exp(k, k)
        self._k32[:] = k
        for project, part_k, part_z in self._projections:
            project(part_k, part_z)
        np.multiply(z, z, z)
        self._means(self._k_one, self._flat_means)
        self._variances(z, self._narrow)
        self._wide[:] = self._narrow
        np.add(self._log_noise, self._half_spread, self._log_noise)
        np.maximum(self._vars, self._zeros, out=self._vars)
        mean, var, log_noise, spread = self._results
        return mean(), var(), log_noise(), spread()


def _with_offset(weights: Array, offset: list[Array]) -> Array:
    """(a D, N) from (a, D, n) and a rows (D,): weights, offset, and zeros that fill up to whole cache lines."""
    a, D, n = weights.shape
    joined = np.zeros((a, D, -(-(n + 1) // 16) * 16))
    joined[:, :, :n], joined[:, :, n] = weights, np.stack(offset)
    return joined.reshape(a * D, -1)


def _aligned(values: Array, dtype: type) -> NDArray[Any]:
    """A copy that starts on a cache line, as products of small matrices are a fifth faster there."""
    size = int(values.size) * np.dtype(dtype).itemsize
    raw = np.empty(size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    out: NDArray[Any] = raw[start : start + size].view(dtype).reshape(values.shape)
    out[...] = values
    return out


def _exponent_rows(gp: ProjectedGP, centre: Array) -> Array:
    """(m, 2 d + 1): products with [y, y^2, 1], y = x - centre, are ``-|u - u_i|^2 / 2``."""
    points = gp.points + (gp.centre - centre) / gp.lengthscale
    square = np.broadcast_to(-0.5 / gp.lengthscale**2, points.shape)
    return np.hstack([points / gp.lengthscale, square, -0.5 * (points**2).sum(1)[:, None]])
