"""scikit-learn's GaussianProcessRegressor behind the protocol: as the oracle, and for those who trust it most."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gpvo.learning.regressors import Hyperparameters
from gpvo.learning.regressors.sparse import OnPoints
from gpvo.types import Array


@dataclass(frozen=True, kw_only=True)
class SklearnRegressor(OnPoints):
    """Constant * RBF + white noise; signal and noise variance are shared by all (standardised) outputs. The posterior
    is ours, at scikit-learn's optimum.

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
