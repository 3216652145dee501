"""Shared pieces of the regressors: threads, scaling, the unit kernel and its gradient, factorisations."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from gpvo.learning.regressors.base import Hyperparameters
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


@dataclass(frozen=True)
class Scaling:
    """Affine maps that give inputs and outputs zero mean and unit variance: centres and scales (d,), (D,)."""

    x_centre: Array
    x_scale: Array
    y_centre: Array
    y_scale: Array

    @classmethod
    def of(cls, X: Array, Y: Array, weight: Array | None = None) -> Scaling:
        """Weighted moments of the columns; constant columns get scale 1."""
        w = np.ones(len(X)) if weight is None else np.asarray(weight, dtype=np.float64)
        w = w / w.sum()
        x_centre, y_centre = w @ X, w @ Y
        x_scale, y_scale = np.sqrt(w @ (X - x_centre) ** 2), np.sqrt(w @ (Y - y_centre) ** 2)
        x_scale[~(x_scale > 1e-12 * (1 + np.abs(x_centre)))] = 1.0
        y_scale[~(y_scale > 0)] = 1.0
        return cls(x_centre, x_scale, y_centre, y_scale)

    def inputs(self, X: Array) -> Array:
        """Standardised inputs."""
        return (X - self.x_centre) / self.x_scale

    def outputs(self, Y: Array) -> Array:
        """Standardised outputs."""
        return (Y - self.y_centre) / self.y_scale

    def scaled(self, hyper: Hyperparameters) -> Hyperparameters:
        """Hyperparameters of the data as those of the standardised data."""
        y2 = self.y_scale**2
        return Hyperparameters(hyper.lengthscale / self.x_scale, hyper.signal_var / y2, hyper.noise_var / y2)

    def unscaled(self, hyper: Hyperparameters) -> Hyperparameters:
        """Hyperparameters of the standardised data as those of the data."""
        y2 = self.y_scale**2
        return Hyperparameters(hyper.lengthscale * self.x_scale, hyper.signal_var * y2, hyper.noise_var * y2)


def checked(
    X: Array, Y: Array, noise_weight: Array | None, sample_weight: Array | None
) -> tuple[Array, Array, Array, Array]:
    """X (n, d), Y (n, D), noise weights (n,) and sample weights (n,) as float64, or ValueError with the shapes got."""
    X, Y = np.asarray(X, dtype=np.float64), np.asarray(Y, dtype=np.float64)
    Y = Y[:, None] if Y.ndim == 1 else Y
    if X.ndim != 2 or Y.ndim != 2 or len(X) != len(Y) or len(X) < 2:
        raise ValueError(f"expected X (n, d) and Y (n, D) with n >= 2, got {X.shape} and {Y.shape}")
    if not (np.isfinite(X).all() and np.isfinite(Y).all()):
        raise ValueError("X and Y must be finite")
    weights = []
    for name, given in (("noise_weight", noise_weight), ("sample_weight", sample_weight)):
        w = np.ones(len(X)) if given is None else np.asarray(given, dtype=np.float64)
        if w.shape != (len(X),) or not (np.isfinite(w) & (w > 0)).all():
            raise ValueError(f"{name} must be {len(X)} positive numbers, got shape {w.shape}")
        weights.append(w)
    return X, Y, weights[0], weights[1]


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
