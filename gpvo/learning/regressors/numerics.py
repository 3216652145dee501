"""Shared pieces of the regressors: threads, the unit kernel and its gradient, safe factors, the optimiser's numbers,
inducing points, and the posterior on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from gpvo.learning.regressors import Hyperparameters, Scaling
from gpvo.online.projected import ProjectedGP
from gpvo.types import Array

LOG_LENGTH_BOUNDS = (np.log(0.05), np.log(50.0))
LOG_SIGNAL_BOUNDS = (np.log(1e-6), np.log(1e3))
LOG_NOISE_BOUNDS = (np.log(1e-6), np.log(1e2))
"""Bounds of the learned quantities for inputs and outputs of unit variance: sums of many features rarely need more."""
CHUNK_ROWS = 8192
_ROUNDS, _TRIED = 4, 25
_RANK_TOLERANCE = 1e-11
"""Directions of the points' kernel matrix below this share of the largest are rounding errors, not information."""


@contextmanager
def fixed_threads(n: int) -> Iterator[None]:
    """Run linear algebra on exactly ``n`` threads: sums split differently round differently, and fits must repeat."""
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        with threadpool_limits(limits=n):
            yield
    finally:
        torch.set_num_threads(before)


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


def pack(hyper: Hyperparameters) -> Array:
    """Logarithms (d, D, D) for the optimiser."""
    return np.log(np.concatenate([hyper.lengthscale, hyper.signal_var, hyper.noise_var]))


def unpack(theta: Array, D: int) -> Hyperparameters:
    """The inverse of :func:`pack`."""
    return Hyperparameters(*np.split(np.exp(theta), [len(theta) - 2 * D, len(theta) - D]))


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


def chunks(*arrays: Array) -> Iterator[tuple[Tensor, ...]]:
    """The rows piece by piece."""
    for i in range(0, len(arrays[0]), CHUNK_ROWS):
        yield tuple(torch.tensor(a[i : i + CHUNK_ROWS]) for a in arrays)


def sums(Xs: Array, Ys: Array, Z: Tensor, lengthscale: Array) -> tuple[Tensor, Tensor]:
    """``k k^T`` (m, m) and ``k y`` (m, D) summed over the rows, k being the unit kernel to the m points Z (m, d)."""
    kk = torch.zeros(len(Z), len(Z), dtype=torch.float64)
    ky = torch.zeros(len(Z), Ys.shape[1], dtype=torch.float64)
    for X, Y in chunks(Xs / lengthscale, Ys):
        K = unit_kernel(X, Z)
        ky.addmm_(K.T, Y)
        kk.addmm_(K.T, K)
    return kk, ky


@dataclass(frozen=True)
class Posterior:
    """Directions in which the rows say different things: one decomposition that serves every output.

    ``projection`` P (r, m) of the kernel's values at the points onto directions of unit prior variance;
    ``eigenvalues`` (r,) of the rows' sums of squares along them; ``z_y`` (r, D) their sums with the outputs; ``yy``
    (D,) squares of the outputs; ``lost``: prior variance of the ``n`` rows that the points do not explain.
    """

    projection: Array
    eigenvalues: Array
    z_y: Array
    yy: Array
    lost: float
    n: int

    @classmethod
    def of(cls, Xs: Array, Ys: Array, points: Array, lengthscale: Array) -> Posterior:
        """Of standardised rows; ``points`` (m, d) over the length scales, the exact one where they are the rows."""
        Z = torch.tensor(points)
        prior, V = torch.linalg.eigh(unit_kernel(Z, Z))
        kept = prior > _RANK_TOLERANCE * prior[-1]
        whiten = V[:, kept].T / prior[kept].sqrt()[:, None]
        if len(points) == len(Xs) and np.array_equal(points, Xs / lengthscale):
            P, eigenvalues = whiten.flip(0), prior[kept].flip(0)
            z_y = eigenvalues[:, None] * (P @ torch.tensor(Ys))
        else:
            kk, ky = sums(Xs, Ys, Z, lengthscale)
            S = whiten @ kk @ whiten.T
            eigenvalues, U = torch.linalg.eigh(0.5 * (S + S.T))
            # Less than rounding errors, which the points' rarest directions enlarge, is not known to be less.
            least = np.finfo(np.float64).eps * float(kk.trace() / prior[kept][0])
            P, eigenvalues = (U.flip(1).T @ whiten).contiguous(), eigenvalues.flip(0).clamp_min(least)
            z_y = P @ ky
        lost = max(len(Xs) - float(eigenvalues.sum()), 0.0)
        return cls(P.numpy().copy(), eigenvalues.numpy(), z_y.numpy(), (Ys**2).sum(axis=0), lost, len(Xs))

    def at_ratio(self, ratio: Array, noise_var: Array | None = None) -> tuple[Array, Array]:
        """Lower bounds (D, G) on the log marginal likelihood of each output [nats], at ratios (D, G) of signal to noise
        variance, and the noise variances: those given, or those that make the outputs likeliest."""
        grown = 1.0 + ratio[..., None] * self.eigenvalues
        explained = ratio * (1.0 / grown @ self.z_y.T[..., None] ** 2)[..., 0]
        left = np.maximum(self.yy[:, None] - explained, 0.0)
        noise = np.clip(left / self.n, *np.exp(LOG_NOISE_BOUNDS)) if noise_var is None else noise_var
        log_det = np.log(grown).sum(axis=-1) + self.n * np.log(2 * np.pi * noise)
        return -0.5 * (log_det + left / noise + ratio * self.lost), noise

    def most_likely(self) -> tuple[Array, Array, Array]:
        """Signal and noise variances (D,) under which each output is likeliest, and its bound (D,) there: the ratio of
        the two is found on ever finer grids."""
        ln_ratio, width = np.zeros(len(self.yy)), LOG_SIGNAL_BOUNDS[1] - LOG_NOISE_BOUNDS[0]
        for _ in range(_ROUNDS):
            tried = ln_ratio[:, None] + np.linspace(-width, width, _TRIED)
            bound, noise = self.at_ratio(np.exp(tried))
            each, best = np.arange(len(tried)), bound.argmax(axis=1)
            ln_ratio, width = tried[each, best], 2.0 * width / (_TRIED - 1)
        signal = np.clip(np.exp(ln_ratio) * noise[each, best], *np.exp(LOG_SIGNAL_BOUNDS))
        return signal, noise[each, best], bound[each, best]

    def bound(self, hyper: Hyperparameters) -> float:
        """Lower bound on the log marginal likelihood, all outputs [nats]."""
        signal, noise = hyper.signal_var[:, None], hyper.noise_var[:, None]
        return float(self.at_ratio(signal / noise, noise)[0].sum())

    def projected(self, hyper: Hyperparameters, scaling: Scaling, points: Array) -> ProjectedGP:
        """In the units of the data; ``hyper`` and ``points`` (over the length scales) of the standardised data."""
        ratio = (hyper.signal_var / hyper.noise_var)[:, None]
        gain = ratio / (1.0 + ratio * self.eigenvalues[None])
        signal = hyper.signal_var * scaling.y_scale**2
        return ProjectedGP(
            centre=scaling.x_centre.copy(),
            lengthscale=hyper.lengthscale * scaling.x_scale,
            points=points.copy(),
            projection=self.projection,
            weights=gain * self.z_y.T * scaling.y_scale[:, None],
            reduction=gain * self.eigenvalues[None] * signal[:, None],
            signal_var=signal,
            offset=scaling.y_centre.copy(),
        )
