"""The collapsed variational bound of sparse GP regression, its closed-form gradient, and the posterior it implies.

M. Titsias, "Variational Learning of Inducing Variables in Sparse Gaussian Processes" (2009), equation 9, with a
weight per row. Everything the bound needs of the rows is a sum over them, so rows may stream and folds may be
subtracted.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpvo.learning.regressors.base import Hyperparameters
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.numerics import (
    LOG_NOISE_BOUNDS,
    LOG_SIGNAL_BOUNDS,
    Scaling,
    bounds,
    cholesky,
    length_gradient,
    pack,
    unit_kernel,
    unpack,
)
from gpvo.online.basis import ProjectedGP
from gpvo.types import Array

CHUNK_ROWS = 8192
FEW_POINTS = 128

TIGHT = 0.05
"""Slack of the bound, in nats per row and output, from which on more points are worth their time."""

_RANK_TOLERANCE = 1e-11
"""Directions of the points' kernel matrix below this share of the largest are rounding, not information."""

Chunk = tuple[Array, Array, Array, Array]
"""Standardised inputs (b, d), standardised outputs (b, D), precision weights (b,), counts (b,)."""


@dataclass(frozen=True)
class Sums:
    """Sums over rows of weight ``c = count * precision``, with k the unit kernel to the m inducing points.

    ``kk`` (m, m): c k k^T. ``ky`` (m, D): c k y. ``k`` (m,): c k. ``yy``, ``y`` (D,): c y^2, c y. ``c``, ``count``,
    ``count_log_w`` (count times log precision): plain sums.
    """

    kk: Tensor
    ky: Tensor
    k: Tensor
    yy: Tensor
    y: Tensor
    c: float
    count: float
    count_log_w: float

    @classmethod
    def zero(cls, m: int, D: int) -> Sums:
        """Of no rows."""
        kk, ky, k, y = (torch.zeros(*shape, dtype=torch.float64) for shape in ((m, m), (m, D), (m,), (D,)))
        return cls(kk, ky, k, y, y, 0.0, 0.0, 0.0)

    def centred(self, shift: Array) -> Sums:
        """The sums had ``shift`` (D,) been subtracted from the outputs."""
        b = torch.tensor(shift)
        ky = self.ky - self.k[:, None] * b[None]
        yy = self.yy - 2.0 * b * self.y + self.c * b * b
        return Sums(self.kk, ky, self.k, yy, self.y - self.c * b, self.c, self.count, self.count_log_w)


def chunks(Xs: Array, Ys: Array, w: Array, count: Array, size: int = CHUNK_ROWS) -> Iterable[Chunk]:
    """Rows held in memory, piece by piece."""
    for i in range(0, len(Xs), size):
        rows = slice(i, i + size)
        yield Xs[rows], Ys[rows], w[rows], count[rows]


def accumulate(rows: Iterable[Chunk], points: Array, lengthscale: Array) -> Sums:
    """One pass over the rows; ``points`` (m, d) are standardised inputs over ``lengthscale`` (d,)."""
    Z = torch.tensor(points)
    sums: Sums | None = None
    for X, Y, w, count in rows:
        sums = sums or Sums.zero(len(Z), Y.shape[1])
        c, y = torch.tensor(w * count), torch.tensor(Y)
        cy, K = c[:, None] * y, unit_kernel(torch.tensor(X / lengthscale), Z)
        sums.ky.addmm_(K.T, cy)
        sums.k.addmv_(K.T, c)
        K.mul_(c.sqrt()[:, None])
        sums.kk.addmm_(K.T, K)
        plain = (float(c.sum()), float(count.sum()), float((count * np.log(w)).sum()))
        yy, y_sum = sums.yy + (cy * y).sum(0), sums.y + cy.sum(0)
        before = (sums.c, sums.count, sums.count_log_w)
        sums = Sums(sums.kk, sums.ky, sums.k, yy, y_sum, *(a + b for a, b in zip(before, plain, strict=True)))
    if sums is None:
        raise ValueError("there are no rows")
    return sums


class CollapsedBound:
    """Negative bound on the log marginal likelihood of rows in memory, over all outputs, points fixed."""

    def __init__(self, Xs: Array, Ys: Array, w: Array, count: Array, points: Array) -> None:
        self.rows = (Xs, Ys, w, count)
        self.points = torch.tensor(points)
        self.d, self.D = Xs.shape[1], Ys.shape[1]
        self.weight = float(count.sum()) * self.D

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """At log(length scales, signal variances, noise variances), per row and output."""
        hyper, n_lengths = unpack(theta, self.d, self.D), len(theta) - 2 * self.D
        lengthscale = torch.tensor(hyper.lengthscale)
        Z = self.points / lengthscale
        sums = accumulate(chunks(*self.rows), Z.numpy(), hyper.lengthscale)
        try:
            value, d_kk, d_ky, d_R, R, tail = _bound_gradient(sums, Z, theta[-2 * self.D :])
        except (torch.linalg.LinAlgError, ValueError):
            return 1e6, np.zeros_like(theta)
        lengths = length_gradient(d_R * R, Z, Z)
        d_kk = d_kk + d_kk.T
        for X, Y, w, count in chunks(*self.rows):
            U, c = torch.tensor(X) / lengthscale, torch.tensor(w * count)
            k = unit_kernel(U, Z)
            dk = torch.addmm(torch.tensor(Y) @ d_ky.T, k, d_kk).mul_(k).mul_(c[:, None])
            lengths += length_gradient(dk, U, Z)
        grown = lengths.numpy()
        grown = grown.sum(keepdims=True) if n_lengths < self.d else grown
        return value / self.weight, np.concatenate([grown, tail]) / self.weight

    def slack(self, hyper: Hyperparameters) -> float:
        """What the points leave unexplained of the rows' prior variance, as the bound charges it [nats/row/output].

        Where this is large the bound's maximum calls structure noise, because the points cannot hold it.
        """
        points = self.points.numpy() / hyper.lengthscale
        sums = accumulate(chunks(*self.rows), points, hyper.lengthscale)
        lost = sums.c - float(Eigenbasis.of(sums, points).eigenvalues.sum())
        return float(0.5 * lost * (hyper.signal_var / hyper.noise_var).sum() / self.weight)

    def maximise(self, hyper: Hyperparameters, *, isotropic: bool, iterations: int) -> Hyperparameters:
        """Better hyperparameters by L-BFGS."""
        theta = pack(hyper, isotropic)
        box = bounds(theta, self.D)
        theta = np.clip(theta, *np.array(box).T)
        options = {"maxiter": iterations, "ftol": 1e-6, "gtol": 1e-5}
        found = minimize(self.value_and_gradient, theta, jac=True, method="L-BFGS-B", bounds=box, options=options)
        return unpack(found.x, self.d, self.D)


def _bound_gradient(sums: Sums, Z: Tensor, tail: Array) -> tuple[float, Tensor, Tensor, Tensor, Tensor, Array]:
    """Negative bound and its derivatives by kk, ky, the points' kernel matrix and the logarithms in ``tail``."""
    R = unit_kernel(Z, Z)
    kk, ky, leaf = (t.clone().requires_grad_(True) for t in (sums.kk, sums.ky, R))
    logs = torch.tensor(tail, requires_grad=True)
    value = _bound(sums, kk, ky, leaf, logs)
    d_kk, d_ky, d_R, d_logs = torch.autograd.grad(value, [kk, ky, leaf, logs])
    return float(value.detach()), d_kk, d_ky, d_R, R, d_logs.numpy()


def _bound(sums: Sums, kk: Tensor, ky: Tensor, R: Tensor, logs: Tensor) -> Tensor:
    D = ky.shape[1]
    log_s, log_v = logs[:D], logs[D:]
    ratio = (log_s - log_v).exp()
    L = cholesky(R)
    half = torch.linalg.solve_triangular(L, kk, upper=False)
    S = torch.linalg.solve_triangular(L, half.T, upper=False)
    b = torch.linalg.solve_triangular(L, ky, upper=False)
    B = torch.eye(len(S), dtype=S.dtype) + ratio[:, None, None] * S
    LB = torch.linalg.cholesky(B)
    a = torch.linalg.solve_triangular(LB, b.T[:, :, None], upper=False)[..., 0]
    fit = ((sums.yy - ratio * (a * a).sum(1)) / log_v.exp()).sum()
    lost = (ratio * (sums.c - S.diagonal().sum())).sum()
    constant = D * (sums.count * np.log(2 * np.pi) - sums.count_log_w)
    log_det = 2.0 * LB.diagonal(dim1=1, dim2=2).log().sum() + sums.count * log_v.sum()
    return 0.5 * (log_det + fit + lost + constant)


def tight_bound(rows: Chunk, hyper: Hyperparameters, max_points: int, *, seed: int) -> tuple[CollapsedBound, float]:
    """The bound on as few greedy points as hold the rows at ``hyper``, and its slack there; ``max_points`` at most."""
    m = FEW_POINTS
    while True:
        points = greedy_points(rows[0] / hyper.lengthscale, min(m, max_points), seed=seed) * hyper.lengthscale
        bound = CollapsedBound(*rows, points)
        slack = bound.slack(hyper)
        if slack < TIGHT or m >= min(max_points, len(rows[0])):
            return bound, slack
        m *= 2


@dataclass(frozen=True)
class Eigenbasis:
    """Directions diagonalising the rows' sums: ``P`` (r, m), ``eigenvalues`` (r,), ``z_y`` (r, D) = P ky; r <= m."""

    P: Tensor
    eigenvalues: Array
    z_y: Array

    @classmethod
    def of(cls, sums: Sums, points: Array) -> Eigenbasis:
        """From the sums and the scaled inducing points (m, d)."""
        Z = torch.tensor(points)
        prior, V = torch.linalg.eigh(unit_kernel(Z, Z))
        kept = prior > _RANK_TOLERANCE * prior[-1]
        whiten = V[:, kept].T / prior[kept].sqrt()[:, None]
        S = whiten @ sums.kk @ whiten.T
        eigenvalues, U = torch.linalg.eigh(0.5 * (S + S.T))
        P = (U.flip(1).T @ whiten).contiguous()
        return cls(P, eigenvalues.flip(0).clamp_min(0.0).numpy(), (P @ sums.ky).numpy())

    def value_and_gradient(self, sums: Sums, output: int, logs: Array) -> tuple[float, Array]:
        """Negative bound of one output, per row, and its gradient, at log(signal, noise variance): O(m)."""
        s, v = np.exp(logs)
        ratio, zy2, lam = s / v, self.z_y[:, output] ** 2, self.eigenvalues
        grown = 1.0 + ratio * lam
        explained, lost = ratio * (zy2 / grown).sum(), sums.c - lam.sum()
        yy = float(sums.yy[output])
        log_det = np.log(grown).sum() + sums.count * (logs[1] + np.log(2 * np.pi)) - sums.count_log_w
        value = 0.5 * (log_det + (yy - explained) / v + ratio * lost)
        d_ratio = 0.5 * ratio * ((lam / grown).sum() - (zy2 / grown**2).sum() / v + lost)
        d_v = 0.5 * (sums.count - (yy - explained) / v)
        return value / sums.count, np.array([d_ratio, d_v - d_ratio]) / sums.count

    def maximise(self, sums: Sums, hyper: Hyperparameters) -> Hyperparameters:
        """Signal and noise variances of each output re-learnt on all rows, length scales kept."""
        signal, noise = hyper.signal_var.copy(), hyper.noise_var.copy()
        box = [LOG_SIGNAL_BOUNDS, LOG_NOISE_BOUNDS]
        for j in range(len(signal)):
            start = np.clip(np.log([signal[j], noise[j]]), *np.array(box).T)
            found = minimize(
                lambda logs, j=j: self.value_and_gradient(sums, j, logs),
                start,
                jac=True,
                method="L-BFGS-B",
                bounds=box,
                options={"ftol": 1e-10, "gtol": 1e-7},
            )
            signal[j], noise[j] = np.exp(found.x)
        return Hyperparameters(hyper.lengthscale, signal, noise)

    def bound(self, sums: Sums, hyper: Hyperparameters) -> float:
        """Lower bound on the log marginal likelihood, all outputs [nats]."""
        logs = np.log(np.stack([hyper.signal_var, hyper.noise_var], 1))
        return -sums.count * sum(self.value_and_gradient(sums, j, logs[j])[0] for j in range(len(logs)))

    def posterior(self, hyper: Hyperparameters, scaling: Scaling, points: Array) -> ProjectedGP:
        """In the units of the data; ``hyper`` and ``points`` (over the length scales) of the standardised data."""
        ratio = (hyper.signal_var / hyper.noise_var)[:, None]
        gain = ratio / (1.0 + ratio * self.eigenvalues[None])
        signal = hyper.signal_var * scaling.y_scale**2
        return ProjectedGP(
            centre=scaling.x_centre.copy(),
            lengthscale=hyper.lengthscale * scaling.x_scale,
            points=points.copy(),
            projection=self.P.numpy().copy(),
            weights=gain * self.z_y.T * scaling.y_scale[:, None],
            reduction=gain * self.eigenvalues[None] * signal[:, None],
            signal_var=signal,
            offset=scaling.y_centre.copy(),
        )
