"""scikit-learn's GaussianProcessRegressor behind the protocol: the oracle, and for those who trust it most."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.exact import Spectrum
from gpvo.learning.regressors.numerics import Scaling, checked, fixed_threads
from gpvo.types import Array


@dataclass(frozen=True)
class SklearnRegressor:
    """Constant * RBF + white noise; signal and noise variance are shared by all (standardised) outputs.

    ``restarts``: scikit-learn's ``n_restarts_optimizer``. Other options as in
    :class:`~gpvo.learning.regressors.exact.ExactRegressor`.
    """

    isotropic: bool = False
    hyper: Hyperparameters | None = None
    centre_outputs: bool = True
    restarts: int = 0
    threads: int = 1

    name: ClassVar[str] = "sklearn"

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
            hyper, evidence = self._learn(Xs, Ys, w, seed, None if self.hyper is None else scaling.scaled(self.hyper))
            gp = Spectrum.of(Xs, Ys, w, hyper, torch.device("cpu")).posterior(Xs, hyper, scaling)
        evidence -= len(X) * float(np.log(scaling.y_scale).sum())
        return FittedGP(gp, scaling.unscaled(hyper), evidence, self.name, len(X))

    def _learn(
        self, Xs: Array, Ys: Array, w: Array, seed: int, fixed: Hyperparameters | None
    ) -> tuple[Hyperparameters, float]:
        from sklearn.gaussian_process import GaussianProcessRegressor

        if fixed is not None:
            found = [
                GaussianProcessRegressor(_kernel(w, fixed.lengthscale, s, v), optimizer=None).fit(Xs, Ys[:, [j]])
                for j, (s, v) in enumerate(zip(fixed.signal_var, fixed.noise_var, strict=True))
            ]
            return fixed, float(sum(one.log_marginal_likelihood_value_ for one in found))
        first = np.ones(1 if self.isotropic else Xs.shape[1]) * np.sqrt(Xs.shape[1])
        gpr = GaussianProcessRegressor(
            _kernel(w, first, 0.5, 0.5), n_restarts_optimizer=self.restarts, random_state=seed
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an irrelevant input ends at its bound, which is no news
            gpr.fit(Xs, Ys)
        signal, white = gpr.kernel_.k1, gpr.kernel_.k2
        D = Ys.shape[1]
        hyper = Hyperparameters(
            np.broadcast_to(np.atleast_1d(signal.k2.length_scale), Xs.shape[1]).astype(np.float64),
            np.full(D, float(signal.k1.constant_value)),
            np.full(D, float(white.noise_level)),
        )
        return hyper, float(gpr.log_marginal_likelihood_value_)


def _kernel(w: Array, lengthscale: Array, signal: float, noise: float) -> Any:
    """Constant * RBF + white noise of a precision ``w`` per training row."""
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    class WeightedWhite(WhiteKernel):
        """White noise of variance ``noise_level / w`` on the training rows."""

        def __call__(self, X: Array, Y: Array | None = None, eval_gradient: bool = False) -> Any:
            if Y is not None or len(X) != len(w):
                return super().__call__(X, Y, eval_gradient)
            K = np.diag(self.noise_level / w)
            return (K, K[:, :, None]) if eval_gradient else K

    length = float(lengthscale[0]) if len(lengthscale) == 1 else lengthscale
    white = WeightedWhite(noise, (1e-6, 1e2))
    return ConstantKernel(signal, (1e-6, 1e3)) * RBF(length, (0.05, 50.0)) + white
