"""GP regression on inducing points: hyperparameters by the collapsed bound, then the posterior of all rows.

M. Titsias, "Variational Learning of Inducing Variables in Sparse Gaussian Processes" (2009), equation 9. All that the
bound needs of the rows are sums over them, so they are taken piece by piece. With every row an inducing point the bound
is the log marginal likelihood itself and the posterior the exact one.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from gpvo.learning.regressors import FittedGP, Hyperparameters, Scaling, checked
from gpvo.learning.regressors.numerics import (
    LOG_LENGTH_BOUNDS,
    LOG_NOISE_BOUNDS,
    LOG_SIGNAL_BOUNDS,
    Posterior,
    cholesky,
    chunks,
    fixed_threads,
    greedy_points,
    length_gradient,
    pack,
    sums,
    unit_kernel,
    unpack,
)
from gpvo.types import Array

START_ROWS = 400
_STEP = 0.2
TIGHT, TIGHT_EXACT = 0.05, 0.005
"""What the points leave unexplained of a row, in nats per output, above which more of them are worth their time."""


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
            learned = self._learn(Xs, Ys, seed) if self.hyper is None else (scaling.scaled(self.hyper), None)
            return self._closed(Xs, Ys, scaling, *learned, seed)

    def _closed(
        self, Xs: Array, Ys: Array, scaling: Scaling, hyper: Hyperparameters, points: Array | None, seed: int
    ) -> FittedGP:
        if points is None:
            points = greedy_points(Xs / hyper.lengthscale, self.inducing or len(Xs), seed=seed)
        return close(Xs, Ys, scaling, hyper, points, relearn=self.relearns and self.hyper is None)

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
        some = some_rows(len(Xs), self.optimise_rows, seed)
        if self.isotropic:
            return OneLength(Xs[some], Ys[some], self.inducing).hyper(slice(None)), None
        hyper, tight = start(Xs, Ys, seed), TIGHT_EXACT if self.inducing is None else TIGHT
        # With fewer, the bound's maximum would take structure for noise, because the points cannot represent it.
        tolerance = 2.0 * tight * float((hyper.noise_var / hyper.signal_var).min())
        most = min(self.inducing or len(some), len(some) - 1)
        points = greedy_points(Xs[some] / hyper.lengthscale, most, seed=seed, tolerance=tolerance)
        bound = CollapsedBound(Xs[some], Ys[some], points * hyper.lengthscale)
        return bound.maximise(hyper, self.max_iterations), None

    def fit_each(self, X: Array, Y: Array, *, seed: int = 0) -> list[FittedGP]:
        """Of each output, with one length scale of its own. What the rows say at a length serves all outputs."""
        X, Y = checked(X, Y)
        scaling, some = Scaling.of(X, Y), some_rows(len(X), self.optimise_rows, seed)
        Xs, Ys = scaling.inputs(X), scaling.outputs(Y)
        with fixed_threads(self.threads):
            rows = OneLength(Xs[some], Ys[some], self.inducing)
            each = [slice(j, j + 1) for j in range(Y.shape[1])]
            return [self._closed(Xs, Ys[:, j], Scaling.of(X, Y[:, j]), rows.hyper(j), None, seed) for j in each]


def exact(**options: Any) -> SparseRegressor:
    """For up to a few thousand rows: O(n^2) memory, O(n^3) time."""
    return SparseRegressor(inducing=None, **options)


@dataclass(frozen=True, kw_only=True)
class SklearnRegressor(OnPoints):
    """scikit-learn's GaussianProcessRegressor, as the oracle, and for those who trust it most: constant * RBF + white
    noise; signal and noise variance are shared by all (standardised) outputs. The posterior is ours, at its optimum.

    ``restarts``: scikit-learn's ``n_restarts_optimizer``.
    """

    inducing: None = None
    restarts: int = 0

    name: ClassVar[str] = "sklearn"
    relearns: ClassVar[bool] = False

    def _learn(self, Xs: Array, Ys: Array, seed: int) -> tuple[Hyperparameters, None]:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        d, D = Xs.shape[1], Ys.shape[1]
        length = np.sqrt(d) if self.isotropic else np.full(d, np.sqrt(d))
        kernel = ConstantKernel(0.5, (1e-6, 1e3)) * RBF(length, (0.05, 50.0)) + WhiteKernel(0.5, (1e-6, 1e2))
        gpr = GaussianProcessRegressor(kernel, n_restarts_optimizer=self.restarts, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an irrelevant input ends at its bound, which is no news
            gpr.fit(Xs, Ys)
        signal, white = gpr.kernel_.k1, gpr.kernel_.k2
        lengths = np.broadcast_to(np.atleast_1d(signal.k2.length_scale), d).astype(np.float64)
        hyper = Hyperparameters(
            lengths, np.full(D, float(signal.k1.constant_value)), np.full(D, float(white.noise_level))
        )
        return hyper, None


def some_rows(n: int, most: int, seed: int) -> NDArray[np.int64]:
    """At most that many of n rows, in order."""
    return np.sort(np.random.default_rng(seed).permutation(n)[:most])


class OneLength:
    """Kernels with one length scale for all inputs: how likely standardised rows are at each, on at most ``most``
    points, fewer where these explain every row to a thousandth. The length is one number: it is searched for."""

    def __init__(self, Xs: Array, Ys: Array, most: int | None) -> None:
        self.Xs, self.Ys, self.most = Xs, Ys, most or len(Xs)
        self._found: dict[int, tuple[Array, Array, Array]] = {}

    def at(self, place: int) -> tuple[Array, Array, Array]:
        """Signal and noise variances, and bounds, of all outputs (D,) at a place of the grid."""
        if place not in self._found:
            length = np.full(self.Xs.shape[1], np.exp(LOG_LENGTH_BOUNDS[0] + _STEP * place))
            points = greedy_points(self.Xs / length, self.most, tolerance=1e-3)
            self._found[place] = Posterior.of(self.Xs, self.Ys, points, length).most_likely()
        return self._found[place]

    def hyper(self, outputs: slice) -> Hyperparameters:
        """Those under which some outputs, which share the length scale, are likeliest."""

        def bound(place: int) -> float:
            return float(self.at(place)[2][outputs].sum())

        best = max(range(1, int((LOG_LENGTH_BOUNDS[1] - LOG_LENGTH_BOUNDS[0]) / _STEP), 2), key=bound)
        best = max(best, best - 1, best + 1, key=bound)
        low, mid, high = (bound(best + k) for k in (-1, 0, 1))
        # The top of the parabola through the three.
        between = np.clip(0.5 * (high - low) / max(2.0 * mid - low - high, 1e-12), -1.0, 1.0)
        signal, noise, _ = (x[outputs] for x in self.at(best))
        length = np.exp(LOG_LENGTH_BOUNDS[0] + _STEP * (best + between))
        return Hyperparameters(np.full(self.Xs.shape[1], length), signal, noise)


def start(Xs: Array, Ys: Array, seed: int) -> Hyperparameters:
    """Where to start from: the best single length scale of a few hundred standardised rows."""
    rows = some_rows(len(Xs), START_ROWS, seed)
    return OneLength(Xs[rows], Ys[rows], None).hyper(slice(None))


def close(Xs: Array, Ys: Array, scaling: Scaling, hyper: Hyperparameters, points: Array, *, relearn: bool) -> FittedGP:
    """One pass over all rows: with ``relearn`` the signal and noise variances too, then the optimal posterior.

    ``hyper`` and ``points`` (m, d) (over the length scales) belong to the standardised data.
    """
    posterior = Posterior.of(Xs, Ys, points, hyper.lengthscale)
    if relearn:
        hyper = Hyperparameters(hyper.lengthscale, *posterior.most_likely()[:2])
    evidence = posterior.bound(hyper) - len(Xs) * np.log(scaling.y_scale).sum()
    gp = posterior.projected(hyper, scaling, points)
    return FittedGP(gp, scaling.unscaled(hyper), float(evidence))


class CollapsedBound:
    """Negative bound on the log marginal likelihood of standardised rows, per row and output, points (m, d) fixed."""

    def __init__(self, Xs: Array, Ys: Array, points: Array) -> None:
        self.rows, self.points = (Xs, Ys), torch.tensor(points)
        self.n, self.d, self.D = len(Xs), Xs.shape[1], Ys.shape[1]
        self._yy = torch.tensor((Ys**2).sum(axis=0))

    def value_and_gradient(self, theta: Array) -> tuple[float, Array]:
        """At log(length scales, signal variances, noise variances); infeasible points give a large value."""
        hyper = unpack(theta, self.D)
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

    def maximise(self, hyper: Hyperparameters, iterations: int) -> Hyperparameters:
        """Better hyperparameters by L-BFGS, all of them at once."""
        box = [LOG_LENGTH_BOUNDS] * self.d + [LOG_SIGNAL_BOUNDS] * self.D + [LOG_NOISE_BOUNDS] * self.D
        theta = np.clip(pack(hyper), *np.array(box).T)
        options = {"maxiter": iterations, "ftol": 1e-6, "gtol": 1e-5}
        found = minimize(self.value_and_gradient, theta, jac=True, method="L-BFGS-B", bounds=box, options=options)
        return unpack(found.x, self.D)
