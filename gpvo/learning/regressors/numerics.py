"""Shared pieces of the regressors: threads, the unit kernel and its gradient, safe factors, the optimiser's numbers,
and inducing points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from gpvo.learning.regressors import Hyperparameters
from gpvo.types import Array

LOG_LENGTH_BOUNDS = (np.log(0.05), np.log(50.0))
LOG_SIGNAL_BOUNDS = (np.log(1e-6), np.log(1e3))
LOG_NOISE_BOUNDS = (np.log(1e-6), np.log(1e2))
"""Bounds of the learnt quantities for inputs and outputs of unit variance: sums of many features rarely need more."""


@contextmanager
def fixed_threads(n: int) -> Iterator[None]:
    """Run linear algebra on exactly ``n`` threads: sums split otherwise round otherwise, and a fit must repeat."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        with threadpool_limits(limits=n):
            yield
    finally:
        torch.set_num_threads(before)


def pick_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one."""
    return torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)


def unit_kernel(A: Tensor, B: Tensor) -> Tensor:
    """``exp(-|a - b|^2 / 2)`` between the rows of A (n, d) and B (m, d), over the length scales: (n, m)."""
    e = torch.addmm(0.5 * (A * A).sum(1)[:, None] + 0.5 * (B * B).sum(1)[None], A, B.T, alpha=-1.0)
    return e.clamp_min_(0.0).neg_().exp_()


def length_gradient(W: Tensor, A: Tensor, B: Tensor) -> Tensor:
    """``sum_ij W_ij (a_ik - b_jk)^2`` (d,): derivative by the log length scales, W being dL/dk times k."""
    return W.sum(1) @ (A * A) + W.sum(0) @ (B * B) - 2.0 * (A * (W @ B)).sum(0)


def cholesky(K: Tensor) -> Tensor:
    """Lower factor of a unit kernel matrix, with the least jitter from 1e-10 to 1e-4 that will do."""
    eye = torch.eye(len(K), dtype=K.dtype, device=K.device)
    for jitter in (1e-10, 1e-8, 1e-6, 1e-4):
        L, info = torch.linalg.cholesky_ex(K + jitter * eye)
        if int(info) == 0:
            return L
    raise ValueError("the kernel matrix is not positive definite")


def pack(hyper: Hyperparameters, isotropic: bool) -> Array:
    """Logarithms (1 or d, D, D) for the optimiser."""
    lengths = np.log(hyper.lengthscale)
    lengths = lengths.mean(keepdims=True) if isotropic else lengths
    return np.concatenate([lengths, np.log(hyper.signal_var), np.log(hyper.noise_var)])


def unpack(theta: Array, d: int, D: int) -> Hyperparameters:
    """The inverse of :func:`pack`; one length scale is spread over all d inputs."""
    lengths, signal, noise = theta[: -2 * D], theta[-2 * D : -D], theta[-D:]
    return Hyperparameters(np.exp(np.broadcast_to(lengths, d)).copy(), np.exp(signal), np.exp(noise))


def bounds(theta: Array, D: int) -> list[tuple[float, float]]:
    """Box for the optimiser."""
    n_lengths = len(theta) - 2 * D
    return [LOG_LENGTH_BOUNDS] * n_lengths + [LOG_SIGNAL_BOUNDS] * D + [LOG_NOISE_BOUNDS] * D


def first_guess(d: int, D: int, length: float) -> Hyperparameters:
    """For standardised data: ``length`` times sqrt(d) for every input, half signal, half noise."""
    return Hyperparameters(np.full(d, length * np.sqrt(d)), np.full(D, 0.5), np.full(D, 0.5))


_CANDIDATES = 8000


def greedy_points(U: Array, m: int, *, seed: int = 0, tolerance: float = 1e-6) -> Array:
    """At most m of the rows U (n, d), inputs over length scales, each the least explained by those before it: greedy
    conditional variance, that is, pivoted Cholesky of the kernel matrix.

    D. R. Burt, C. E. Rasmussen, M. van der Wilk, "Convergence of Sparse Variational Inference in Gaussian Processes
    Regression" (2020), section 7.2.

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
