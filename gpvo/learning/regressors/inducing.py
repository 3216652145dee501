"""Choice of inducing points: greedy conditional variance, that is, pivoted Cholesky of the kernel matrix.

D. R. Burt, C. E. Rasmussen, M. van der Wilk, "Convergence of Sparse Variational Inference in Gaussian Processes
Regression" (2020), section 7.2.
"""

from __future__ import annotations

import numpy as np

from gpvo.types import Array

_CANDIDATES = 8000


def greedy_points(U: Array, m: int, *, seed: int = 0, tolerance: float = 1e-6) -> Array:
    """At most m of the rows U (n, d), inputs over length scales, each the least explained by those before it.

    All rows if there are no more than m. Otherwise stops early where every candidate is explained to ``tolerance``;
    of more than 8,000 rows a random 8,000 are candidates.
    """
    n = len(U)
    if n <= m:
        return U
    if n > _CANDIDATES:
        U = U[np.sort(np.random.default_rng(seed).permutation(n)[:_CANDIDATES])]
        n = _CANDIDATES
    left = np.ones(n)
    rows, factor = [], np.zeros((m, n))
    half = 0.5 * (U * U).sum(1)
    for j in range(m):
        i = int(np.argmax(left))
        if left[i] < tolerance:
            break
        k = np.exp(-np.maximum(half + half[i] - U @ U[i], 0.0))
        factor[j] = (k - factor[:j, i] @ factor[:j]) / np.sqrt(left[i])
        left -= factor[j] ** 2
        rows.append(i)
        left[rows] = -1.0
    return U[rows]
