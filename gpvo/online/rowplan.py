"""One row through a shared basis, fast: everything that can be stacked is stacked once, into buffers made once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from gpvo.online.basis import ProjectedGP, SharedBasis

Array = NDArray[np.float64]


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


def stack(basis: SharedBasis) -> StackedBasis:
    """The matrices of a shared basis."""
    mean, noise, D = basis.mean, basis.noise, basis.n_outputs
    own = noise is not None and not basis.shares_kernel
    kernels = (mean, noise) if own and noise is not None else (mean,)
    M, R = sum(len(gp.points) for gp in kernels), sum(len(gp.flat_projection) for gp in kernels)
    B, H, offset = np.zeros((2, D, M)), np.zeros((3, D, R)), np.zeros((4, D))
    B[0, :, : len(mean.points)] = _kernel_weights(mean)
    _place(H[0], mean, -mean.reduction, 0)
    offset[0], offset[1], offset[2] = mean.offset, mean.signal_var, basis.log_noise_offset
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
    """Calls with x (d,) return (4, D): mean, its variance, log noise variance, its spread.

    With v = [u, 1, -|u|^2/2 of each kernel] all exponents are one product ``G v``. Projections are float32, as squares
    forgive it; exponents and means cancel and stay float64.
    """

    def __init__(self, stacked: StackedBasis) -> None:
        kernels, D = stacked.kernels, stacked.offset.shape[1]
        self._centre, self._inverse = kernels[0].centre.copy(), 1.0 / kernels[0].lengthscale
        self._exponents(kernels)
        sizes = [len(gp.points) for gp in kernels]
        flats = [np.ascontiguousarray(gp.flat_projection, dtype=np.float32) for gp in kernels]
        lengths = [len(P) for P in flats]
        self._k, self._k32 = np.empty(sum(sizes)), np.empty(sum(sizes), np.float32)
        self._z = np.empty(sum(lengths), np.float32)
        k_parts, z_parts = np.split(self._k32, np.cumsum(sizes)[:-1]), np.split(self._z, np.cumsum(lengths)[:-1])
        self._products = list(zip(flats, k_parts, z_parts, strict=True))
        self._B = np.ascontiguousarray(stacked.B.reshape(2 * D, -1))
        self._H = np.ascontiguousarray(stacked.H.reshape(3 * D, -1), dtype=np.float32)
        self._offset = stacked.offset.copy()
        self._means, self._variances = np.empty(2 * D), np.empty(3 * D, np.float32)
        self._out = (self._means.reshape(2, D), self._variances.reshape(3, D))

    def _exponents(self, kernels: tuple[ProjectedGP, ...]) -> None:
        """G, and the rows that give ``-|u|^2/2`` of each kernel from u*u, in the scaling of the first."""
        first, rows, squares = kernels[0], [], []
        d = first.n_inputs
        for i, gp in enumerate(kernels):
            ratio = first.lengthscale / gp.lengthscale
            points = gp.points + (gp.centre - first.centre) / gp.lengthscale
            one = np.zeros((len(points), len(kernels)))
            one[:, i] = 1.0
            rows.append(np.hstack([points * ratio, -0.5 * (points**2).sum(1)[:, None], one]))
            squares.append(-0.5 * ratio**2)
        self._G, self._Q = np.ascontiguousarray(np.vstack(rows)), np.array(squares)
        self._v = np.zeros(d + 1 + len(kernels))
        self._v[d] = 1.0
        self._u, self._norms, self._uu = self._v[:d], self._v[d + 1 :], np.empty(d)

    def __call__(self, x: Array) -> Array:
        """x (d,) float64, in the units of training."""
        u, k = self._u, self._k
        np.subtract(x, self._centre, out=u)
        np.multiply(u, self._inverse, out=u)
        np.multiply(u, u, out=self._uu)
        np.dot(self._Q, self._uu, out=self._norms)
        np.dot(self._G, self._v, out=k)
        np.exp(k, out=k)
        self._k32[:] = k
        for P, k32, z in self._products:
            np.dot(P, k32, out=z)
        np.multiply(self._z, self._z, out=self._z)
        np.dot(self._B, k, out=self._means)
        np.dot(self._H, self._z, out=self._variances)
        out = self._offset.copy()
        out[::2] += self._out[0]
        out[1:] += self._out[1]
        np.maximum(out[1::2], 0.0, out=out[1::2])
        return out
