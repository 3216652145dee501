"""Exact GP regression in float64: learnt on Cholesky factors, posterior from one eigendecomposition for all outputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from scipy.optimize import minimize

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import TIGHT, tight_bound
from gpvo.learning.regressors.likelihood import START_ROWS, ExactEvidence, maximise, start
from gpvo.learning.regressors.numerics import (
    LOG_NOISE_BOUNDS,
    LOG_SIGNAL_BOUNDS,
    Scaling,
    checked,
    fixed_threads,
    pack,
    pick_device,
    unit_kernel,
)
from gpvo.online.basis import ProjectedGP
from gpvo.types import Array

BOUND_POINTS = 512

_EXACT_STEPS = 10
"""Steps on the exact likelihood of many rows: each costs O(n^3), and the start is the optimum of 400 of them."""

_LOOSE_BOUND = 0.002
"""Nats per row and output by which the collapsed bound may fall short before the exact likelihood is climbed too."""


@dataclass(frozen=True)
class ExactRegressor:
    """For up to a few thousand rows: O(n^2) memory, O(n^3) time.

    ``isotropic``: one length scale for all inputs. ``hyper``: fixed hyperparameters, in the units of the data;
    nothing is learnt then. ``centre_outputs``: subtract the outputs'
    weighted mean first (a constant mean function). Beyond a few hundred rows the length scales climb the collapsed
    bound of all rows where it is tight, and the exact likelihood elsewhere; signal and noise variances are always
    those of the exact likelihood.
    """

    isotropic: bool = False
    hyper: Hyperparameters | None = None
    centre_outputs: bool = True
    max_iterations: int = 25
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
                spectrum = Spectrum.of(Xs, Ys, w, hyper, device)
            else:
                hyper, spectrum = self._learn(Xs, Ys, w, device, seed)
            gp = spectrum.posterior(Xs, hyper, scaling)
        evidence = spectrum.log_evidence(hyper) - len(X) * np.log(scaling.y_scale).sum()
        return FittedGP(gp, scaling.unscaled(hyper), float(evidence), self.name, len(X))

    def _learn(
        self, Xs: Array, Ys: Array, w: Array, device: torch.device, seed: int
    ) -> tuple[Hyperparameters, Spectrum]:
        """Hyperparameters of standardised data, and the spectrum at them."""
        n, D = Ys.shape
        hyper = start(Xs, Ys, w, isotropic=self.isotropic, seed=seed)
        loose = n <= START_ROWS
        if not loose:
            bound, slack = tight_bound((Xs, Ys, w, np.ones(n)), hyper, BOUND_POINTS, seed=seed)
            loose = slack > TIGHT
        if not loose:
            hyper = bound.maximise(hyper, isotropic=self.isotropic, iterations=self.max_iterations)
            reached = -bound.value_and_gradient(pack(hyper, False))[0]
            spectrum = Spectrum.of(Xs, Ys, w, hyper, device)
            loose = spectrum.log_evidence(hyper) / (n * D) - reached > _LOOSE_BOUND
        if loose:
            steps = self.max_iterations if n <= START_ROWS else min(self.max_iterations, _EXACT_STEPS)
            hyper = maximise(ExactEvidence(Xs, Ys, w, device), hyper, self.isotropic, steps)
            spectrum = Spectrum.of(Xs, Ys, w, hyper, device)
        return spectrum.maximise(hyper), spectrum


@dataclass(frozen=True)
class Spectrum:
    """Eigendecomposition of the weighted kernel matrix: one factorisation that serves every output.

    With ``W^1/2 R W^1/2 = V diag(l) V^T`` and noise ``v W^-1``, ``s R + v W^-1 = W^-1/2 V diag(s l + v) V^T W^-1/2``.
    ``eigenvalues`` (n,): l. ``projection`` (n, n): V^T W^1/2. ``z_y`` (n, D): projection times the outputs.
    ``log_w``: sum of the logarithms of the weights.
    """

    eigenvalues: Array
    projection: Array
    z_y: Array
    log_w: float

    @classmethod
    def of(cls, Xs: Array, Ys: Array, w: Array, hyper: Hyperparameters, device: torch.device) -> Spectrum:
        """Of standardised rows at the length scales of ``hyper``."""
        U = torch.tensor(Xs / hyper.lengthscale, device=device)
        root = torch.tensor(np.sqrt(w), device=device)
        eigenvalues, V = torch.linalg.eigh(unit_kernel(U, U).mul_(root[:, None]).mul_(root[None]))
        P = (V.flip(1).T * root[None]).contiguous()
        z_y = (P @ torch.tensor(Ys, device=device)).cpu().numpy()
        return cls(eigenvalues.flip(0).clamp_min(0.0).cpu().numpy(), P.cpu().numpy(), z_y, float(np.log(w).sum()))

    def value_and_gradient(self, output: int, logs: Array) -> tuple[float, Array]:
        """Negative log marginal likelihood of one output, per row, and its gradient, at log(signal, noise variance)."""
        s, v = np.exp(logs)
        n, total = len(self.eigenvalues), s * self.eigenvalues + v
        misfit = self.z_y[:, output] ** 2 / total
        value = 0.5 * (np.log(total).sum() - self.log_w + misfit.sum() + n * np.log(2 * np.pi))
        slope = 0.5 * (1.0 - misfit) / total
        return value / n, np.array([(slope * s * self.eigenvalues).sum(), slope.sum() * v]) / n

    def maximise(self, hyper: Hyperparameters) -> Hyperparameters:
        """Signal and noise variances of each output at the maximum, length scales kept: O(n) per step."""
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

    def log_evidence(self, hyper: Hyperparameters) -> float:
        """Log marginal likelihood summed over the outputs [nats]."""
        logs = np.log(np.stack([hyper.signal_var, hyper.noise_var], 1))
        return -len(self.eigenvalues) * sum(self.value_and_gradient(j, logs[j])[0] for j in range(len(logs)))

    def posterior(self, Xs: Array, hyper: Hyperparameters, scaling: Scaling) -> ProjectedGP:
        """On all rows, in the units of the data; ``hyper`` of the standardised data."""
        ratio = hyper.noise_var / hyper.signal_var
        gain = 1.0 / (self.eigenvalues[None] + ratio[:, None])
        signal = hyper.signal_var * scaling.y_scale**2
        return ProjectedGP(
            centre=scaling.x_centre.copy(),
            lengthscale=hyper.lengthscale * scaling.x_scale,
            points=Xs / hyper.lengthscale,
            projection=self.projection,
            weights=gain * self.z_y.T * scaling.y_scale[:, None],
            reduction=gain * signal[:, None],
            signal_var=signal,
            offset=scaling.y_centre.copy(),
        )
