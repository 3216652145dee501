"""A Gaussian process with several outputs, reduced to one projection of its kernel: what flies on board.

All outputs share the squared-exponential kernel and its points, ``k_i(x) = exp(-|u(x) - u_i|^2 / 2)``. The posterior is

    z(x)   = P k(x)
    mean_j = offset_j + sum_r A_jr z_r
    var_j  = s_j^2 - sum_r W_jr z_r^2

P comes from the eigenvectors of the (weighted) kernel statistics, so that the variance needs only squares of z; one P
serves all outputs exactly, because the rows' noise weights are one common profile times a scale per output. Mean and
variance: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning" (2006), equations 2.25 and 2.26;
with inducing points M. Titsias (2009), equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from gpvo.online.stored import Stored
from gpvo.types import Array

_CHUNK_ROWS = 4096


@dataclass(frozen=True)
class ProjectedGP(Stored):
    """Posterior of a GP with d inputs and D outputs on m points and r directions, all arrays float64.

    ``centre``, ``lengthscale`` (d,): inputs are taken as ``u = (x - centre) / lengthscale``, in the inputs' units.
    ``points`` (m, d): training or inducing points, as u. ``projection`` (r, m): P. ``weights``, ``reduction`` (D, r): A
    and W. ``signal_var``, ``offset`` (D,): prior variance and mean.
    """

    centre: Array
    lengthscale: Array
    points: Array
    projection: Array
    weights: Array
    reduction: Array
    signal_var: Array
    offset: Array

    @classmethod
    def constant(cls, offset: Array) -> ProjectedGP:
        """One that predicts the same (D,) everywhere, from one input."""
        zeros, one = np.zeros((len(offset), 1)), np.zeros((1, 1))
        return cls(one[0], np.ones(1), one, one, zeros, zeros, zeros[:, 0], offset)

    def kernel(self, X: ArrayLike) -> Array:
        """(n, m) unit kernel between the rows of X (n, d) and the points."""
        u = (np.asarray(X, dtype=np.float64) - self.centre) / self.lengthscale
        e = u @ self.points.T
        e -= self._half_square
        e -= 0.5 * (u * u).sum(1)[:, None]
        return np.exp(np.minimum(e, 0.0, out=e), out=e)

    @cached_property
    def _half_square(self) -> Array:
        return 0.5 * (self.points**2).sum(1)

    def evaluate(self, X: ArrayLike) -> tuple[Array, Array]:
        """Mean and latent variance (no noise) of rows X (n, d): (n, D) and (n, D)."""
        X = np.asarray(X, dtype=np.float64)
        if len(X) > _CHUNK_ROWS:
            parts = [self.evaluate(X[i : i + _CHUNK_ROWS]) for i in range(0, len(X), _CHUNK_ROWS)]
            mean, var = (np.concatenate(of_parts) for of_parts in zip(*parts))
            return mean, var
        z = self.kernel(X) @ self.projection.T
        return z @ self.weights.T + self.offset, np.maximum(self.signal_var - (z * z) @ self.reduction.T, 0.0)
