"""Stochastic variational GP (gpytorch): hyperparameters and inducing points from minibatches, then one closing pass.

J. Hensman, N. Fusi, N. Lawrence, "Gaussian Processes for Big Data" (2013). With Gaussian noise the best variational
distribution is known in closed form (Titsias 2009, equation 10), so the one found by the minibatches is used only for
learning.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from gpvo.learning.regressors import Hyperparameters
from gpvo.learning.regressors.numerics import greedy_points
from gpvo.learning.regressors.sparse import OnPoints, start
from gpvo.types import Array


@dataclass(frozen=True, kw_only=True)
class SvgpRegressor(OnPoints):
    """For millions of rows: every row can influence the hyperparameters and the inducing points.

    ``steps`` minibatches of ``batch`` rows at learning rate ``rate``, falling to a tenth. ``device`` "auto" is CUDA
    if available.
    """

    inducing: int = 256
    steps: int = 300
    batch: int = 512
    rate: float = 0.03
    device: str = "auto"

    name: ClassVar[str] = "svgp"

    def _learn(self, Xs: Array, Ys: Array, seed: int) -> tuple[Hyperparameters, Array]:
        """Maximise the variational bound by Adam; standardised hyperparameters, points over the length scales."""
        guess = start(Xs, Ys, seed)
        points = greedy_points(Xs / guess.lengthscale, self.inducing, seed=seed) * guess.lengthscale
        fastest = "cuda" if torch.cuda.is_available() else "cpu"
        device = fastest if self.device == "auto" else self.device
        batches = _minibatches(Xs, Ys, self.batch, seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = _model(points, guess, self.isotropic).to(device=device, dtype=torch.float64)
            log_noise = torch.tensor(np.log(guess.noise_var), device=device, requires_grad=True)
            optimiser = torch.optim.Adam([*model.parameters(), log_noise], lr=self.rate)
            schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, gamma=0.1 ** (1.0 / max(self.steps, 1)))
            for _ in range(self.steps):
                optimiser.zero_grad()
                X, Y = next(batches)
                loss = _negative_bound(model, log_noise, X.to(device), Y.to(device), len(Xs))
                loss.backward()
                optimiser.step()
                schedule.step()
        lengths = model.covar_module.lengthscale.detach().cpu().numpy().ravel()
        lengthscale = np.broadcast_to(lengths, points.shape[1]).copy()
        found = model.variational_strategy.inducing_points.detach().cpu().numpy()
        signal = model.signal_var().detach().cpu().numpy().copy()
        noise = np.exp(log_noise.detach().cpu().numpy())
        return Hyperparameters(lengthscale, signal, noise), found / lengthscale


def _model(points: Array, start: Hyperparameters, isotropic: bool) -> Any:
    """D outputs, each the root of its signal variance times a GP of unit variance with a variational distribution of
    its own: the points, the kernel and all that follows from them are shared, and worked out once."""
    import gpytorch

    m, d = points.shape
    D = len(start.signal_var)
    positive = gpytorch.constraints.Positive()

    class SharedKernelGP(gpytorch.models.ApproximateGP):
        def __init__(self) -> None:
            distribution = gpytorch.variational.CholeskyVariationalDistribution(m, batch_shape=torch.Size([D]))
            super().__init__(gpytorch.variational.VariationalStrategy(self, torch.tensor(points), distribution))
            self.mean_module = gpytorch.means.ZeroMean()
            self.covar_module = gpytorch.kernels.RBFKernel(ard_num_dims=None if isotropic else d)
            self.raw_signal_var = torch.nn.Parameter(positive.inverse_transform(torch.tensor(start.signal_var)))

        def forward(self, x: Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

        def signal_var(self) -> Tensor:
            return positive.transform(self.raw_signal_var)

    model = SharedKernelGP()
    lengths = torch.tensor(start.lengthscale)[None]
    model.covar_module.lengthscale = lengths.mean(1, keepdim=True) if isotropic else lengths
    return model.train()


def _negative_bound(model: Any, log_noise: Tensor, X: Tensor, Y: Tensor, n_rows: int) -> Tensor:
    """Hensman et al., equation 4, per row."""
    q, signal_var = model(X), model.signal_var()[:, None]
    misfit = (Y.T - signal_var.sqrt() * q.mean) ** 2 + signal_var * q.variance
    log_lik = -0.5 * (log_noise[:, None] + np.log(2 * np.pi) + misfit / log_noise.exp()[:, None])
    return -log_lik.sum() / len(X) + model.variational_strategy.kl_divergence().sum() / n_rows


def _minibatches(Xs: Array, Ys: Array, size: int, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    rng = np.random.default_rng(seed)
    while True:
        order = rng.permutation(len(Xs))
        for i in range(0, max(len(Xs) - size, 0) + 1, size):
            rows = order[i : i + size]
            yield torch.tensor(Xs[rows]), torch.tensor(Ys[rows])
