"""Exact GP regression in float64: Cholesky factors, closed-form gradients, one eigendecomposition for the posterior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import CollapsedBound
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.numerics import (
    Scaling,
    bounds,
    checked,
    first_guess,
    fixed_threads,
    length_gradient,
    pack,
    pick_device,
    unit_kernel,
    unpack,
)
from gpvo.online.basis import ProjectedGP

Array = NDArray[np.float64]

START_ROWS = 400
START_ITERATIONS = 20
BOUND_POINTS = 128


@dataclass(frozen=True)
class ExactRegressor:
    """For up to a few thousand rows: O(n^2) memory, O(n^3) per step.

    ``isotropic``: one length scale for all inputs. ``hyper``: fixed hyperparameters, in the units of the data;
    nothing is learnt then. ``centre_outputs``: subtract the outputs' weighted mean first (a constant mean function).
    ``polish``: steps on the exact likelihood of all rows, after the climb on its bound, where there are more than a
    few hundred.
    """

    isotropic: bool = False
    hyper: Hyperparameters | None = None
    centre_outputs: bool = True
    max_iterations: int = 25
    polish: int = 2
    device: str = "auto"
    threads: int = 1

    name: ClassVar[str] = "exact"

    def fit(
        self,
        X: Array,
        Y: Array,
        *,
        noise_weight: Array | None = None,
        sample_weight: Array | None = None,
        seed: int = 0,
    ) -> FittedGP:
        """See :class:`~gpvo.learning.regressors.base.Regressor`. A sample weight multiplies the row's precision."""
        X, Y, w, s = checked(X, Y, noise_weight, sample_weight)
        w = w * s
        scaling = Scaling.of(X, Y, w)
        if not self.centre_outputs:
            scaling = Scaling(scaling.x_centre, scaling.x_scale, np.zeros(Y.shape[1]), scaling.y_scale)
        Xs, Ys = scaling.inputs(X), scaling.outputs(Y)
        with fixed_threads(self.threads):
            device = pick_device(self.device)
            if self.hyper is not None:
                hyper = scaling.scaled(self.hyper)
            else:
                hyper = learn(
                    Xs,
                    Ys,
                    w,
                    isotropic=self.isotropic,
                    iterations=self.max_iterations,
                    polish=self.polish,
                    device=device,
                    seed=seed,
                )
            evidence = -ExactEvidence(Xs, Ys, w, device).value_and_gradient(pack(hyper, False))[0]
            gp = condition(X, scaling, Ys, w, hyper, device)
        evidence -= len(X) * np.log(scaling.y_scale).sum()
        return FittedGP(gp, scaling.unscaled(hyper), float(evidence), self.name, len(X))


def learn(
    Xs: Array,
    Ys: Array,
    w: Array,
    *,
    isotropic: bool,
    iterations: int,
    polish: int,
    device: torch.device,
    seed: int,
) -> Hyperparameters:
    """Maximise the log marginal likelihood of standardised data.

    Beyond a few hundred rows an exact step costs seconds, so the climb is made on a subset, then on the collapsed
    bound of all rows, and ``polish`` last steps on the exact likelihood.
    """
    n = len(Xs)
    if n <= START_ROWS:
        return _maximise(
            ExactEvidence(Xs, Ys, w, device), first_guess(Xs.shape[1], Ys.shape[1]), isotropic, 2 * iterations
        )
    hyper = start(Xs, Ys, w, isotropic=isotropic, seed=seed)
    points = greedy_points(Xs / hyper.lengthscale, BOUND_POINTS, seed=seed) * hyper.lengthscale
    bound = CollapsedBound(Xs, Ys, w, np.ones(n), points)
    hyper = bound.maximise(hyper, isotropic=isotropic, iterations=iterations)
    return _maximise(ExactEvidence(Xs, Ys, w, device), hyper, isotropic, polish) if polish else hyper


def start(Xs: Array, Ys: Array, w: Array, *, isotropic: bool, seed: int) -> Hyperparameters:
    """Where to start from: the exact likelihood of a few hundred standardised rows, roughly maximised."""
    rows = np.sort(np.random.default_rng(seed).permutation(len(Xs))[:START_ROWS])
    evidence = ExactEvidence(Xs[rows], Ys[rows], w[rows], torch.device("cpu"))
    return _maximise(evidence, first_guess(Xs.shape[1], Ys.shape[1]), isotropic, START_ITERATIONS)


def _maximise(evidence: ExactEvidence, hyper: Hyperparameters, isotropic: bool, iterations: int) -> Hyperparameters:
    theta, n_values = pack(hyper, isotropic), evidence.n * evidence.D
    box = bounds(theta, evidence.D)

    def objective(t: Array) -> tuple[float, Array]:
        value, gradient = evidence.value_and_gradient(t)
        return value / n_values, gradient / n_values

    theta = np.clip(theta, *np.array(box).T)
    options = {"maxiter": iterations, "ftol": 1e-5, "gtol": 1e-5}
    found = minimize(objective, theta, jac=True, method="L-BFGS-B", bounds=box, options=options)
    return unpack(found.x, evidence.d, evidence.D)


class ExactEvidence:
    """Negative log marginal likelihood summed over the outputs (Rasmussen & Williams, equations 5.8 and 5.9)."""

    def __init__(self, Xs: Array, Ys: Array, w: Array, device: torch.device) -> None:
        self.X = torch.tensor(Xs, device=device)
        self.Y = torch.tensor(Ys, device=device)
        self.inverse_w = torch.tensor(1.0 / w, device=device)
        self.n, self.d = Xs.shape
        self.D = Ys.shape[1]

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """At log(length scales, signal variances, noise variances); infeasible points give a large value."""
        hyper, n_lengths = unpack(theta, self.d, self.D), len(theta) - 2 * self.D
        U = self.X / torch.tensor(hyper.lengthscale, device=self.X.device)
        R = unit_kernel(U, U)
        value, signal, noise = 0.5 * self.n * self.D * np.log(2 * np.pi), np.empty(self.D), np.empty(self.D)
        total = torch.zeros_like(R)
        for j in range(self.D):
            s, v = float(hyper.signal_var[j]), float(hyper.noise_var[j])
            K = R * s
            K.diagonal().add_(v * self.inverse_w + 1e-12 * s)
            L, info = torch.linalg.cholesky_ex(K)
            if int(info):
                return 1e12, np.zeros_like(theta)
            alpha = torch.cholesky_solve(self.Y[:, j : j + 1], L)
            value += 0.5 * float((self.Y[:, j] * alpha[:, 0]).sum()) + float(L.diagonal().log().sum())
            G = torch.cholesky_inverse(L, out=K)
            G.addmm_(alpha, alpha.T, alpha=-1.0).mul_(0.5)  # dL/dK
            noise[j] = v * float((G.diagonal() * self.inverse_w).sum())
            G.mul_(s)
            total.add_(G)
            signal[j] = float((G * R).sum())
        lengths = length_gradient(total.mul_(R), U, U).cpu().numpy()
        lengths = lengths.sum(keepdims=True) if n_lengths < self.d else lengths
        return value, np.concatenate([lengths, signal, noise])


def condition(
    X: Array, scaling: Scaling, Ys: Array, w: Array, hyper: Hyperparameters, device: torch.device
) -> ProjectedGP:
    """Posterior given standardised hyperparameters, on all training points.

    With C = W^1/2 R W^1/2 = V diag(l) V^T and eta_j = noise / signal, ``(R + eta W^-1)^-1 = W^1/2 V (l + eta)^-1 V^T
    W^1/2``: one factorisation serves every output, whatever its eta.
    """
    lengthscale = hyper.lengthscale * scaling.x_scale
    points = (X - scaling.x_centre) / lengthscale
    U = torch.tensor(points, device=device)
    root = torch.tensor(np.sqrt(w), device=device)
    C: Tensor = unit_kernel(U, U) * root[:, None] * root[None]
    eigenvalues, V = torch.linalg.eigh(C)
    eigenvalues = eigenvalues.clamp_min(0.0).flip(0).cpu().numpy()
    P = (V.flip(1).T * root[None]).contiguous()
    z_y = (P @ torch.tensor(Ys, device=device)).cpu().numpy()
    ratio = hyper.noise_var / hyper.signal_var
    gain = 1.0 / (eigenvalues[None] + ratio[:, None] + 1e-12)
    return ProjectedGP(
        centre=scaling.x_centre,
        lengthscale=lengthscale,
        points=points,
        projection=P.cpu().numpy(),
        weights=gain * z_y.T * scaling.y_scale[:, None],
        reduction=gain * (hyper.signal_var * scaling.y_scale**2)[:, None],
        signal_var=hyper.signal_var * scaling.y_scale**2,
        offset=scaling.y_centre.copy(),
    )
