"""GP regression on inducing points: hyperparameters by the collapsed bound, then the posterior of all rows.

M. Titsias, "Variational Learning of Inducing Variables in Sparse Gaussian Processes" (2009), equation 9. All that the
bound needs of the rows are sums over them, so they are taken piece by piece. With every row an inducing point the bound
is the log marginal likelihood itself and the posterior the exact one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpvo.learning.regressors import FittedGP, Hyperparameters, Scaling, checked
from gpvo.learning.regressors.numerics import (
    Posterior,
    bounds,
    cholesky,
    chunks,
    first_guess,
    fixed_threads,
    greedy_points,
    length_gradient,
    pack,
    sums,
    unit_kernel,
    unpack,
)
from gpvo.types import Array

START_ROWS, START_ITERATIONS, PROBE_ITERATIONS = 400, 15, 8
START_LENGTHS = (0.8, 0.2)
"""Times sqrt(d): the typical distance of two standardised rows is sqrt(2 d)."""

FEW_POINTS = 128
TIGHT, TIGHT_EXACT = 0.05, 0.005
"""Slack of the bound, in nats per row and output, above which more points are worth their time."""


@dataclass(frozen=True, kw_only=True)
class OnPoints(ABC):
    """What all regressors here share: each learns in its own way from data of unit variance, and finishes with the
    best posterior of all rows on inducing points.

    ``inducing``: points; None: every row. ``isotropic``: one length scale for all inputs. ``hyper``: fixed
    hyperparameters, in the units of the data; nothing is learned then.
    """

    inducing: int | None = 256
    isotropic: bool = False
    hyper: Hyperparameters | None = None
    threads: int = 1

    relearns: ClassVar[bool] = True
    """Whether signal and noise variances are finally relearned on all rows."""

    @property
    @abstractmethod
    def name(self) -> str:
        """By which it is chosen."""

    def fit(self, X: Array, Y: Array, *, seed: int = 0) -> FittedGP:
        """See :class:`~gpvo.learning.regressors.Regressor`."""
        X, Y = checked(X, Y)
        scaling = Scaling.of(X, Y)
        Xs, Ys = scaling.inputs(X), scaling.outputs(Y)
        with fixed_threads(self.threads):
            if self.hyper is not None:
                hyper, points = scaling.scaled(self.hyper), None
            else:
                hyper, points = self._learn(Xs, Ys, seed)
            if points is None:
                points = greedy_points(Xs / hyper.lengthscale, self.inducing or len(X), seed=seed)
            relearn = self.relearns and self.hyper is None
            return close(Xs, Ys, scaling, hyper, points, self.name, relearn=relearn)

    @abstractmethod
    def _learn(self, Xs: Array, Ys: Array, seed: int) -> tuple[Hyperparameters, Array | None]:
        """Standardised hyperparameters, and points over the length scales if they are learned too."""


@dataclass(frozen=True, kw_only=True)
class SparseRegressor(OnPoints):
    """O(m^2) memory beside the rows and O(n m^2) time for m ``inducing`` points; None: every row, the exact GP.

    Length scales are learned on at most ``optimise_rows`` rows; signal and noise variances, and the posterior, on all.
    """

    optimise_rows: int = 5000
    max_iterations: int = 25

    @property
    def name(self) -> str:
        """By which it is chosen."""
        return "exact" if self.inducing is None else "sparse"

    def _learn(self, Xs: Array, Ys: Array, seed: int) -> tuple[Hyperparameters, Array | None]:
        """First guess from a few hundred rows, then the bound of ``optimise_rows`` rows."""
        hyper = start(Xs, Ys, isotropic=self.isotropic, seed=seed)
        some = np.sort(np.random.default_rng(seed).permutation(len(Xs))[: self.optimise_rows])
        most, tight = self.inducing or len(some), TIGHT_EXACT if self.inducing is None else TIGHT
        bound = tight_bound(Xs[some], Ys[some], hyper, most, tight, seed=seed)
        return bound.maximise(hyper, isotropic=self.isotropic, iterations=self.max_iterations), None


def exact(**options: Any) -> SparseRegressor:
    """For up to a few thousand rows: O(n^2) memory, O(n^3) time."""
    return SparseRegressor(inducing=None, **options)


def start(Xs: Array, Ys: Array, *, isotropic: bool, seed: int) -> Hyperparameters:
    """Where to start from: the likelihood of a few hundred standardised rows, roughly maximised.

    Smooth and rough guesses both climb a little first: from a smooth one alone a rough function can look like noise.
    """
    rows = np.sort(np.random.default_rng(seed).permutation(len(Xs))[:START_ROWS])
    guesses = []
    for length in START_LENGTHS:
        guess = first_guess(Xs.shape[1], Ys.shape[1], length)
        bound = tight_bound(Xs[rows], Ys[rows], guess, FEW_POINTS, TIGHT, seed=seed)
        climbed = bound.maximise(guess, isotropic=isotropic, iterations=PROBE_ITERATIONS)
        guesses.append((bound.value_and_gradient(pack(climbed, False))[0], climbed, bound))
    _, hyper, bound = min(guesses, key=lambda g: g[0])
    return bound.maximise(hyper, isotropic=isotropic, iterations=START_ITERATIONS)


def close(
    Xs: Array, Ys: Array, scaling: Scaling, hyper: Hyperparameters, points: Array, name: str, *, relearn: bool
) -> FittedGP:
    """One pass over all rows: with ``relearn`` the signal and noise variances too, then the optimal posterior.

    ``hyper`` and ``points`` (m, d) (over the length scales) belong to the standardised data.
    """
    posterior = Posterior.of(Xs, Ys, points, hyper.lengthscale)
    if relearn:
        hyper = posterior.maximise(hyper)
    evidence = posterior.bound(hyper) - len(Xs) * np.log(scaling.y_scale).sum()
    gp = posterior.projected(hyper, scaling, points)
    return FittedGP(gp, scaling.unscaled(hyper), float(evidence), name, len(Xs))


class CollapsedBound:
    """Negative bound on the log marginal likelihood of standardised rows, per row and output, points (m, d) fixed."""

    def __init__(self, Xs: Array, Ys: Array, points: Array) -> None:
        self.rows, self.points = (Xs, Ys), torch.tensor(points)
        self.n, self.d, self.D = len(Xs), Xs.shape[1], Ys.shape[1]
        self._yy = torch.tensor((Ys**2).sum(axis=0))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """At log(length scales, signal variances, noise variances); infeasible points give a large value."""
        hyper, n_lengths = unpack(theta, self.d, self.D), len(theta) - 2 * self.D
        lengthscale = torch.tensor(hyper.lengthscale)
        Z = self.points / lengthscale
        R = unit_kernel(Z, Z)
        kk, ky = sums(*self.rows, Z, hyper.lengthscale)
        leaves = [t.requires_grad_(True) for t in (kk, ky, R.clone())]
        logs = torch.tensor(theta[-2 * self.D :], requires_grad=True)
        try:
            value = self._value(leaves[0], leaves[1], leaves[2], logs)
        except (torch.linalg.LinAlgError, ValueError):
            return 1e6, np.zeros_like(theta)
        d_kk, d_ky, d_R, d_logs = torch.autograd.grad(value, [*leaves, logs])
        lengths = length_gradient(d_R * R, Z, Z)
        d_kk = d_kk + d_kk.T
        for X, Y in chunks(*self.rows):
            U = X / lengthscale
            k = unit_kernel(U, Z)
            lengths += length_gradient(torch.addmm(Y @ d_ky.T, k, d_kk).mul_(k), U, Z)
        lengths = lengths.sum()[None] if n_lengths < self.d else lengths
        return float(value.detach()) / (self.n * self.D), torch.cat([lengths, d_logs]).numpy() / (self.n * self.D)

    def _value(self, kk: Tensor, ky: Tensor, R: Tensor, logs: Tensor) -> Tensor:
        log_s, log_v = logs[: self.D], logs[self.D :]
        ratio = (log_s - log_v).exp()
        L = cholesky(R)
        half = torch.linalg.solve_triangular(L, kk, upper=False)
        S = torch.linalg.solve_triangular(L, half.T, upper=False)
        b = torch.linalg.solve_triangular(L, ky, upper=False)
        LB = torch.linalg.cholesky(torch.eye(len(S), dtype=S.dtype) + ratio[:, None, None] * S)
        a = torch.linalg.solve_triangular(LB, b.T[:, :, None], upper=False)[..., 0]
        fit = ((self._yy - ratio * (a * a).sum(1)) / log_v.exp()).sum()
        lost = (ratio * (self.n - S.diagonal().sum())).sum()
        log_det = 2.0 * LB.diagonal(dim1=1, dim2=2).log().sum() + self.n * log_v.sum()
        return 0.5 * (log_det + fit + lost + self.D * self.n * np.log(2 * np.pi))

    def slack(self, hyper: Hyperparameters) -> float:
        """What the points leave unexplained of the rows' prior variance, as the bound charges it.

        If this is large, the bound's maximum takes structure for noise, because the points cannot represent it.
        """
        lost = Posterior.of(*self.rows, self.points.numpy() / hyper.lengthscale, hyper.lengthscale).lost
        return float(0.5 * lost * (hyper.signal_var / hyper.noise_var).sum() / (self.n * self.D))

    def maximise(self, hyper: Hyperparameters, *, isotropic: bool, iterations: int) -> Hyperparameters:
        """Better hyperparameters by L-BFGS, all of them at once."""
        theta = pack(hyper, isotropic)
        box = bounds(theta, self.D)
        theta = np.clip(theta, *np.array(box).T)
        options = {"maxiter": iterations, "ftol": 1e-6, "gtol": 1e-5}
        found = minimize(self.value_and_gradient, theta, jac=True, method="L-BFGS-B", bounds=box, options=options)
        return unpack(found.x, self.d, self.D)


def tight_bound(Xs: Array, Ys: Array, hyper: Hyperparameters, most: int, tight: float, *, seed: int) -> CollapsedBound:
    """The bound on as few greedy points as hold the rows at ``hyper``, ``most`` at most."""
    m = FEW_POINTS
    while True:
        points = greedy_points(Xs / hyper.lengthscale, min(m, most), seed=seed)
        bound = CollapsedBound(Xs, Ys, points * hyper.lengthscale)
        if m >= min(most, len(Xs)) or len(points) < m or bound.slack(hyper) < tight:
            return bound
        m *= 2
