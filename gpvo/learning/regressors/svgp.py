"""Stochastic variational GP (gpytorch): hyperparameters and inducing points from minibatches, then one closing pass.

J. Hensman, N. Fusi, N. Lawrence, "Gaussian Processes for Big Data" (2013). With Gaussian noise the best variational
distribution is known in closed form (Titsias 2009, equation 10), so the one that the minibatches found is used for
learning alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import Chunk
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.likelihood import start
from gpvo.learning.regressors.numerics import checked, fixed_threads, pick_device
from gpvo.learning.regressors.rows import ArrayRows, Rows, draw
from gpvo.learning.regressors.streamed import close, exact_instead, standardised, streamed_scaling
from gpvo.types import Array


@dataclass(frozen=True)
class SvgpRegressor:
    """For millions of rows, streamed if need be: every row can influence the hyperparameters and the inducing points.

    ``steps`` minibatches of ``batch`` rows at learning rate ``rate``, falling to a tenth. Rows are shuffled within
    each chunk that ``rows`` yields: store them in random order. Other options as in
    :class:`~gpvo.learning.regressors.sparse.SparseRegressor`; ``device`` "auto" is CUDA where there is one.
    """

    inducing: int = 256
    isotropic: bool = False
    hyper: Hyperparameters | None = None
    centre_outputs: bool = True
    steps: int = 300
    batch: int = 512
    rate: float = 0.03
    device: str = "auto"
    threads: int = 1

    name: ClassVar[str] = "svgp"

    def fit(
        self,
        X: Array,
        Y: Array,
        *,
        noise_weight: Array | None = None,
        sample_weight: Array | None = None,
        seed: int = 0,
    ) -> FittedGP:
        """See :class:`~gpvo.learning.regressors.base.Regressor`. Rows in memory are put into random order first."""
        X, Y, w, s = checked(X, Y, noise_weight, sample_weight)
        order = np.random.default_rng(seed).permutation(len(X))
        return self.fit_rows(ArrayRows(X[order], Y[order], w[order], s[order]), seed=seed)

    def fit_rows(self, rows: Rows, *, seed: int = 0) -> FittedGP:
        """The same from rows that may stream; they are read as often as the steps need."""
        if len(rows) <= self.inducing:
            return exact_instead(rows, self, seed)
        with fixed_threads(self.threads):
            scaling = streamed_scaling(rows, centre_outputs=self.centre_outputs)
            first = standardised(draw(rows, 8000, seed), scaling)
            if self.hyper is not None:
                hyper = scaling.scaled(self.hyper)
                points = greedy_points(first[0] / hyper.lengthscale, self.inducing, seed=seed)
            else:
                guess = start(first[0], first[1], first[2] * first[3], isotropic=self.isotropic, seed=seed)
                points = greedy_points(first[0] / guess.lengthscale, self.inducing, seed=seed) * guess.lengthscale
                batches = (standardised(chunk, scaling) for chunk in _endless(rows))
                hyper, points = self._learn(_minibatches(batches, self.batch, seed), guess, points, len(rows), seed)
            return close(rows, scaling, hyper, points, self.name, relearn=self.hyper is None)

    def _learn(
        self, batches: Iterator[Chunk], start: Hyperparameters, points: Array, n_rows: int, seed: int
    ) -> tuple[Hyperparameters, Array]:
        """Maximise the variational bound by Adam; standardised hyperparameters, points over the length scales."""
        device = pick_device(self.device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            model = _model(points, start, self.isotropic).to(device=device, dtype=torch.float64)
            log_noise = torch.tensor(np.log(start.noise_var), device=device, requires_grad=True)
            optimiser = torch.optim.Adam([*model.parameters(), log_noise], lr=self.rate)
            schedule = torch.optim.lr_scheduler.ExponentialLR(optimiser, gamma=0.1 ** (1.0 / max(self.steps, 1)))
            for _ in range(self.steps):
                optimiser.zero_grad()
                loss = _negative_bound(model, log_noise, next(batches), n_rows, device)
                loss.backward()
                optimiser.step()
                schedule.step()
        kernel = model.covar_module
        lengths = kernel.base_kernel.lengthscale.detach().cpu().numpy().ravel()
        lengthscale = np.broadcast_to(lengths, points.shape[1]).copy()
        found = model.variational_strategy.base_variational_strategy.inducing_points.detach().cpu().numpy()
        signal = kernel.outputscale.detach().cpu().numpy().ravel().copy()
        noise = np.exp(log_noise.detach().cpu().numpy())
        return Hyperparameters(lengthscale, signal, noise), found.reshape(points.shape) / lengthscale


def _model(points: Array, start: Hyperparameters, isotropic: bool) -> Any:
    """D outputs with their own variational distribution and signal variance; points and length scales are shared."""
    import gpytorch

    m, d = points.shape
    D = len(start.signal_var)

    class SharedKernelGP(gpytorch.models.ApproximateGP):
        def __init__(self) -> None:
            distribution = gpytorch.variational.CholeskyVariationalDistribution(m, batch_shape=torch.Size([D]))
            one = gpytorch.variational.VariationalStrategy(self, torch.tensor(points)[None], distribution)
            super().__init__(gpytorch.variational.IndependentMultitaskVariationalStrategy(one, num_tasks=D))
            self.mean_module = gpytorch.means.ZeroMean(batch_shape=torch.Size([D]))
            base = gpytorch.kernels.RBFKernel(ard_num_dims=None if isotropic else d)
            self.covar_module = gpytorch.kernels.ScaleKernel(base, batch_shape=torch.Size([D]))

        def forward(self, x: Tensor) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    model = SharedKernelGP()
    lengths = torch.tensor(start.lengthscale)[None]
    model.covar_module.base_kernel.lengthscale = lengths.mean(1, keepdim=True) if isotropic else lengths
    model.covar_module.outputscale = torch.tensor(start.signal_var)
    return model.train()


def _negative_bound(model: Any, log_noise: Tensor, chunk: Chunk, n_rows: int, device: torch.device) -> Tensor:
    """Hensman et al., equation 4, per row, with a precision and a count per row."""
    X, Y, w, count = (torch.tensor(part, device=device) for part in chunk)
    q = model(X)
    misfit = (Y - q.mean) ** 2 + q.variance
    log_lik = -0.5 * (log_noise - w.log()[:, None] + np.log(2 * np.pi) + misfit * w[:, None] / log_noise.exp())
    divergence = model.variational_strategy.kl_divergence().sum()
    return -(count[:, None] * log_lik).sum() / len(X) + divergence / n_rows


def _endless(rows: Rows) -> Iterator[Any]:
    while True:
        yield from rows


def _minibatches(stream: Iterator[Chunk], size: int, seed: int) -> Iterator[Chunk]:
    """Shuffled pieces of ``size`` rows; rows left over join the next chunk, too small a chunk is given whole."""
    rng = np.random.default_rng(seed)
    left = _take(next(stream), np.arange(0))
    for chunk in stream:
        X, Y, w, count = (np.concatenate(pair) for pair in zip(left, chunk, strict=True))
        order, n = rng.permutation(len(X)), len(X)
        held = (X, Y, w, count)
        for i in range(0, n - size + 1, size):
            yield _take(held, order[i : i + size])
        if n < size:
            yield held
        left = _take(held, order[n - n % size :] if n >= size else order[:0])


def _take(chunk: Chunk, rows: NDArray[np.int64]) -> Chunk:
    X, Y, w, count = chunk
    return X[rows], Y[rows], w[rows], count[rows]
