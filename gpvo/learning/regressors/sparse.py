"""GP regression on inducing points: hyperparameters by the collapsed bound, then the posterior of all rows.

M. Titsias, "Variational Learning of Inducing Variables in Sparse Gaussian Processes" (2009), equation 9. All that the
bound needs of the rows are sums over them, so they are taken piece by piece. With every row an inducing point the bound
is the log marginal likelihood itself and the posterior the exact one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from gpvo.learning.regressors import FittedGP, Hyperparameters, Scaling, checked
from gpvo.learning.regressors.numerics import (
    LOG_NOISE_BOUNDS,
    LOG_SIGNAL_BOUNDS,
    bounds,
    cholesky,
    first_guess,
    fixed_threads,
    greedy_points,
    length_gradient,
    pack,
    unit_kernel,
    unpack,
)
from gpvo.online.projected import ProjectedGP
from gpvo.types import Array

CHUNK_ROWS = 8192
START_ROWS, START_ITERATIONS, PROBE_ITERATIONS = 400, 15, 8
START_LENGTHS = (0.8, 0.2)
"""Times sqrt(d): the typical distance of two standardised rows is sqrt(2 d)."""

FEW_POINTS = 128
TIGHT, TIGHT_EXACT = 0.05, 0.005
"""Slack of the bound, in nats per row and output, from which on more points are worth their time."""

_RANK_TOLERANCE = 1e-11
"""Directions of the points' kernel matrix below this share of the largest are rounding, not information."""


@dataclass(frozen=True)
class SparseRegressor:
    """O(m^2) memory beside the rows and O(n m^2) time for m ``inducing`` points; None: every row, the exact GP.

    Length scales are learnt on at most ``optimise_rows`` rows; signal and noise variances, and the posterior, on all.
    ``isotropic``: one length scale for all inputs. ``hyper``: fixed hyperparameters, in the units of the data; nothing
    is learnt then.
    """

    inducing: int | None = 256
    isotropic: bool = False
    hyper: Hyperparameters | None = None
    optimise_rows: int = 5000
    max_iterations: int = 25
    threads: int = 1

    @property
    def name(self) -> str:
        """By which it is chosen."""
        return "exact" if self.inducing is None else "sparse"

    def fit(self, X: Array, Y: Array, *, seed: int = 0) -> FittedGP:
        """See :class:`~gpvo.learning.regressors.Regressor`."""
        X, Y = checked(X, Y)
        scaling = Scaling.of(X, Y)
        Xs, Ys = scaling.inputs(X), scaling.outputs(Y)
        with fixed_threads(self.threads):
            if self.hyper is not None:
                hyper = scaling.scaled(self.hyper)
            else:
                hyper = self._learn(Xs, Ys, seed)
            points = greedy_points(Xs / hyper.lengthscale, self.inducing or len(X), seed=seed)
            return close(Xs, Ys, scaling, hyper, points, self.name, relearn=self.hyper is None)

    def _learn(self, Xs: Array, Ys: Array, seed: int) -> Hyperparameters:
        """First guess from a few hundred rows, then the bound of ``optimise_rows`` rows."""
        hyper = start(Xs, Ys, isotropic=self.isotropic, seed=seed)
        some = np.sort(np.random.default_rng(seed).permutation(len(Xs))[: self.optimise_rows])
        most, tight = self.inducing or len(some), TIGHT_EXACT if self.inducing is None else TIGHT
        bound = tight_bound(Xs[some], Ys[some], hyper, most, tight, seed=seed)
        return bound.maximise(hyper, isotropic=self.isotropic, iterations=self.max_iterations)


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


def _chunks(*arrays: Array) -> Iterator[tuple[Tensor, ...]]:
    for i in range(0, len(arrays[0]), CHUNK_ROWS):
        yield tuple(torch.tensor(a[i : i + CHUNK_ROWS]) for a in arrays)


def _sums(Xs: Array, Ys: Array, Z: Tensor, lengthscale: Array) -> tuple[Tensor, Tensor]:
    """``k k^T`` (m, m) and ``k y`` (m, D) summed over the rows, k being the unit kernel to the m points Z (m, d)."""
    kk = torch.zeros(len(Z), len(Z), dtype=torch.float64)
    ky = torch.zeros(len(Z), Ys.shape[1], dtype=torch.float64)
    for X, Y in _chunks(Xs / lengthscale, Ys):
        K = unit_kernel(X, Z)
        ky.addmm_(K.T, Y)
        kk.addmm_(K.T, K)
    return kk, ky


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
        kk, ky = _sums(*self.rows, Z, hyper.lengthscale)
        leaves = [t.requires_grad_(True) for t in (kk, ky, R.clone())]
        logs = torch.tensor(theta[-2 * self.D :], requires_grad=True)
        try:
            value = self._value(leaves[0], leaves[1], leaves[2], logs)
        except (torch.linalg.LinAlgError, ValueError):
            return 1e6, np.zeros_like(theta)
        d_kk, d_ky, d_R, d_logs = torch.autograd.grad(value, [*leaves, logs])
        lengths = length_gradient(d_R * R, Z, Z)
        d_kk = d_kk + d_kk.T
        for X, Y in _chunks(*self.rows):
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

        Where this is large the bound's maximum calls structure noise, because the points cannot hold it.
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
            kk, ky = _sums(Xs, Ys, Z, lengthscale)
            S = whiten @ kk @ whiten.T
            eigenvalues, U = torch.linalg.eigh(0.5 * (S + S.T))
            P, eigenvalues = (U.flip(1).T @ whiten).contiguous(), eigenvalues.flip(0).clamp_min(0.0)
            z_y = P @ ky
        lost = max(len(Xs) - float(eigenvalues.sum()), 0.0)
        return cls(P.numpy().copy(), eigenvalues.numpy(), z_y.numpy(), (Ys**2).sum(axis=0), lost, len(Xs))

    def value_and_gradient(self, output: int, logs: Array) -> tuple[float, Array]:
        """Negative bound of one output, per row, and its gradient, at log(signal, noise variance): O(r)."""
        s, v = np.exp(logs)
        ratio, zy2, lam = s / v, self.z_y[:, output] ** 2, self.eigenvalues
        grown = 1.0 + ratio * lam
        left = (self.yy[output] - ratio * (zy2 / grown).sum()) / v
        log_det = np.log(grown).sum() + self.n * (logs[1] + np.log(2 * np.pi))
        d_ratio = 0.5 * ratio * ((lam / grown).sum() - (zy2 / grown**2).sum() / v + self.lost)
        gradient = np.array([d_ratio, 0.5 * (self.n - left) - d_ratio])
        return 0.5 * (log_det + left + ratio * self.lost) / self.n, gradient / self.n

    def maximise(self, hyper: Hyperparameters) -> Hyperparameters:
        """Signal and noise variances of each output learnt anew on all rows, length scales kept."""
        box = [LOG_SIGNAL_BOUNDS, LOG_NOISE_BOUNDS]
        found = []
        for j, logs in enumerate(np.log(np.stack([hyper.signal_var, hyper.noise_var], 1))):
            best = minimize(
                lambda t, j=j: self.value_and_gradient(j, t),
                np.clip(logs, *np.array(box).T),
                jac=True,
                method="L-BFGS-B",
                bounds=box,
                options={"ftol": 1e-10, "gtol": 1e-7},
            )
            found.append(np.exp(best.x))
        signal, noise = np.array(found).T.copy()
        return Hyperparameters(hyper.lengthscale, signal, noise)

    def bound(self, hyper: Hyperparameters) -> float:
        """Lower bound on the log marginal likelihood, all outputs [nats]."""
        logs = np.log(np.stack([hyper.signal_var, hyper.noise_var], 1))
        return -self.n * sum(self.value_and_gradient(j, logs[j])[0] for j in range(len(logs)))

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
