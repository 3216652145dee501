"""A posterior of random data, shared by the tests of what holds one."""

from __future__ import annotations

import numpy as np
from gpvo.online.projected import ProjectedGP


def some_gp(rng: np.random.Generator, d: int = 8, D: int = 6, m: int = 40) -> ProjectedGP:
    """A posterior of random data: unit kernel on m points, diagonalised statistics."""
    points = rng.standard_normal((m, d))
    K = np.exp(-0.5 * ((points[:, None] - points[None]) ** 2).sum(2))
    eigenvalues, V = np.linalg.eigh(K)
    ratio = rng.uniform(0.1, 1.0, (D, 1))
    signal = rng.uniform(0.5, 2.0, D)
    gain = 1.0 / (eigenvalues + ratio)
    return ProjectedGP(
        centre=rng.standard_normal(d),
        lengthscale=rng.uniform(0.5, 3.0, d),
        points=points,
        projection=V.T,
        weights=gain * (V.T @ rng.standard_normal((m, D))).T,
        reduction=gain * signal[:, None],
        signal_var=signal,
        offset=rng.standard_normal(D),
    )
