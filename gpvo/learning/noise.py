"""Input-dependent noise: a GP of the mean error, and a second GP of the log of the noise variance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.regressors.base import FittedGP, Regressor
from gpvo.online.basis import SharedBasis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeteroscedasticFit:
    """Mean and noise model of D outputs, with what is needed to judge it honestly.

    ``basis``: the predictor. ``mean_fit``: GP of the mean (before axes without mean were zeroed). ``use_mean`` (D,) bool.
    ``nu`` (D,): degrees of freedom of the residuals' Student-t, inf where a Gaussian does; the published noise variance is the
    second moment ``scale nu / (nu - 2)``, already inside ``basis``. Out of fold (hyperparameters of all rows, posterior of
    mean and of noise without the row's own fold): ``oof_mean``, ``oof_epistemic_var``, ``oof_log_noise_var`` (n, D), the last
    without the base; ``fold`` (n,): which fold each row was in.
    """

    basis: SharedBasis
    mean_fit: FittedGP
    use_mean: NDArray[np.bool_]
    nu: Array
    oof_mean: Array
    oof_epistemic_var: Array
    oof_log_noise_var: Array
    fold: NDArray[np.int64]

    def predict(self, X: Array, base_log_var: Array | None = None) -> tuple[Array, Array]:
        """Mean (n, D) and total variance (n, D): noise (times the base, if the fit had one) plus the mean's own."""
        out = self.basis.predict(X)
        base = 0.0 if base_log_var is None else base_log_var
        return out.mean, np.exp(out.log_noise_var + base) + out.epistemic_var


def fit_heteroscedastic(
    X: Array,
    Y: Array,
    groups: NDArray,
    *,
    base_log_var: Array | None = None,
    use_mean: NDArray[np.bool_] | None = None,
    regressor: str | Regressor = "auto",
    sample_weight: Array | None = None,
    heavy_tails: bool = True,
    isotropic: bool = False,
    inducing: int = 256,
    noise_inducing: int = 128,
    profile: str = "common",
    max_folds: int = 8,
    rounds: int = 2,
    seed: int = 0,
    threads: int = 1,
) -> HeteroscedasticFit:
    """Fit ``y_j = f_j(x) + e_j``, ``e_j ~ t_nu(0, exp(base_j + g_j(x)))`` with Gaussian processes f and g.

    X (n, d), Y (n, D) finite; ``groups`` (n,) labels (sequence of each row): a row's residual is always taken from a fit
    without its group; with fewer than two groups, without its block of consecutive rows. ``base_log_var`` (n, D): log of a
    variance known per row (the geometric covariance); g is then the log of the ratio to it. ``use_mean`` (D,): False fixes
    f_j to zero. ``profile``: "common" weights the rows of all outputs by one profile, "output" each by its own (one
    projection per output). ``rounds``: how often mean and noise are fitted in turn.
    """
    raise NotImplementedError
