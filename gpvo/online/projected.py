"""A Gaussian process with several outputs, reduced to one projection of its kernel: what flies on board.

All outputs share the squared-exponential kernel and its points, ``k_i(x) = exp(-|u(x) - u_i|^2 / 2)``. The posterior is

    z(x)   = P k(x)
    mean_j = offset_j + sum_r A_jr z_r
    var_j  = s_j^2 - sum_r W_jr z_r^2

P comes from the eigenvectors of the (weighted) kernel statistics, so that the variance needs squares of z alone. One
P serves all outputs, exactly, while the rows' noise weights are one common profile times a scale per output;
otherwise P has one slice per output. Mean and variance: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for
Machine Learning" (2006), equations 2.25 and 2.26; with inducing points M. Titsias (2009), equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from gpvo.errors import ModelError
from gpvo.types import Array

_CHUNK_ROWS = 4096


@dataclass(frozen=True)
class ProjectedGP:
    """Posterior of a GP with d inputs and D outputs on m points and r directions, all arrays float64.

    ``centre``, ``lengthscale`` (d,): inputs are taken as ``u = (x - centre) / lengthscale``, in the inputs' units.
    ``points`` (m, d): training or inducing points, as u. ``projection`` (r, m), or (D, r, m) with one slice per output.
    ``weights`` (D, r): A. ``reduction`` (D, r): W. ``signal_var``, ``offset`` (D,): prior variance and mean.
    """

    centre: Array
    lengthscale: Array
    points: Array
    projection: Array
    weights: Array
    reduction: Array
    signal_var: Array
    offset: Array

    def __post_init__(self) -> None:
        m, d = self.points.shape
        D, r = self.weights.shape
        wanted = {
            "centre": {(d,)},
            "lengthscale": {(d,)},
            "projection": {(r, m), (D, r, m)},
            "reduction": {(D, r)},
            "signal_var": {(D,)},
            "offset": {(D,)},
        }
        for name, shapes in wanted.items():
            if getattr(self, name).shape not in shapes:
                raise ModelError(f"GP array '{name}' has shape {getattr(self, name).shape}, expected {sorted(shapes)}")

    @property
    def n_inputs(self) -> int:
        """d."""
        return int(self.points.shape[1])

    @property
    def n_outputs(self) -> int:
        """D."""
        return int(self.weights.shape[0])

    @property
    def flat_projection(self) -> Array:
        """(r, m), or (D r, m) with the outputs' slices below one another."""
        return self.projection.reshape(-1, self.points.shape[0])

    def kernel(self, X: ArrayLike) -> Array:
        """(n, m) unit kernel between the rows of X (n, d) and the points."""
        u = (np.asarray(X, dtype=np.float64) - self.centre) / self.lengthscale
        e = u @ self.points.T
        e -= 0.5 * (self.points**2).sum(1)
        e -= 0.5 * (u**2).sum(1)[:, None]
        return np.exp(np.minimum(e, 0.0))

    def evaluate(self, X: ArrayLike) -> tuple[Array, Array]:
        """Mean and latent variance (no noise) of rows X (n, d): (n, D) and (n, D)."""
        X = np.asarray(X, dtype=np.float64)
        mean, var = np.empty((len(X), self.n_outputs)), np.empty((len(X), self.n_outputs))
        for i in range(0, len(X), _CHUNK_ROWS):
            rows = slice(i, i + _CHUNK_ROWS)
            z = self.kernel(X[rows]) @ self.flat_projection.T
            if self.projection.ndim == 2:
                mean[rows], var[rows] = z @ self.weights.T, (z * z) @ self.reduction.T
            else:
                z = z.reshape(len(z), *self.weights.shape)
                mean[rows], var[rows] = (z * self.weights).sum(2), (z * z * self.reduction).sum(2)
        return mean + self.offset, np.maximum(self.signal_var - var, 0.0)
