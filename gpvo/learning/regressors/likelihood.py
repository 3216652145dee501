"""The exact log marginal likelihood in float64: one Cholesky factor per output, closed-form gradient."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize

from gpvo.learning.regressors.base import Hyperparameters
from gpvo.learning.regressors.numerics import bounds, first_guess, length_gradient, pack, unit_kernel, unpack
from gpvo.types import Array

START_ROWS = 400
START_ITERATIONS = 15
PROBE_ITERATIONS = 8
START_LENGTHS = (0.8, 0.2)
"""Times sqrt(d): the typical distance of two standardised rows is sqrt(2 d)."""


def start(Xs: Array, Ys: Array, w: Array, *, isotropic: bool, seed: int) -> Hyperparameters:
    """Where to start from: the exact likelihood of a few hundred standardised rows, roughly maximised.

    Smooth and rough guesses both climb a little first: from a smooth one alone a rough function can look like noise.
    """
    rows = np.sort(np.random.default_rng(seed).permutation(len(Xs))[:START_ROWS])
    evidence = ExactEvidence(Xs[rows], Ys[rows], w[rows], torch.device("cpu"))
    guesses = []
    for length in START_LENGTHS:
        guess = first_guess(Xs.shape[1], Ys.shape[1], length)
        climbed = maximise(evidence, guess, isotropic, PROBE_ITERATIONS)
        guesses.append((evidence.value_and_gradient(pack(climbed, False))[0], climbed))
    return maximise(evidence, min(guesses, key=lambda g: g[0])[1], isotropic, START_ITERATIONS)


def maximise(evidence: ExactEvidence, hyper: Hyperparameters, isotropic: bool, iterations: int) -> Hyperparameters:
    """Better hyperparameters by L-BFGS, all of them at once."""
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
