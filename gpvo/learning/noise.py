"""Input-dependent noise: a GP of the mean error, and a second GP of the log of the noise variance.

The second GP sees residuals of rows that their own mean never saw (out of fold, by sequence). Two GPs: P. Goldberg,
C. Williams, C. Bishop, "Regression with Input-Dependent Noise" (1998); in turn: K. Kersting et al., "Most Likely
Heteroscedastic Gaussian Process Regression" (2007), section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.folds import group_folds
from gpvo.learning.logvariance import Residuals, score_log_variance
from gpvo.learning.meanfit import FoldedMean, fit_folded_mean, no_mean, only_inputs, only_outputs
from gpvo.learning.regressors import FittedGP, Regressor, get_regressor
from gpvo.learning.regressors.numerics import checked, fixed_threads
from gpvo.learning.regressors.sparse import SparseRegressor
from gpvo.learning.tails import fit_tail, log_second_moment, row_weight
from gpvo.online.basis import ProjectedGP, SharedBasis

Array = NDArray[np.float64]

_TAIL_ROUNDS = 3
_PRECISION_RANGE = 1e4
_FAR_ASTRAY = 30.0
"""No ratio of variances is as far from one as exp of this: a GP that says so loses the comparison, without overflow."""


@dataclass(frozen=True)
class HeteroscedasticFit:
    """Mean and noise model of D outputs, with what is needed to judge it honestly.

    ``basis``: the predictor. ``mean_fit``: the last fit of the mean on the outputs that use one, None if none does.
    ``use_mean`` (D,) bool. ``nu`` (D,): degrees of freedom of the residuals' Student-t, inf where a Gaussian does;
    the published noise variance is the second moment ``scale nu / (nu - 2)``, already inside ``basis``. Out of fold
    (hyperparameters and tail of all rows, posterior of mean and of noise without the row's own fold): ``oof_mean``,
    ``oof_epistemic_var``, ``oof_log_noise_var`` (n, D), the last without the base; ``fold`` (n,): which fold each row
    was in.
    """

    basis: SharedBasis
    mean_fit: FittedGP | None
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


@dataclass(frozen=True)
class NoiseFit:
    """``gp``: of the log squared scale, given all rows. ``offset`` (D,): to the log of the variance. ``nu`` (D,).

    ``start``: GP of the log squared residuals, whose kernel ``gp`` keeps. Out of fold, (n, D): ``oof_log_var``;
    ``oof_scale``, the squared scale of the residual's t.
    """

    start: FittedGP
    gp: ProjectedGP
    offset: Array
    nu: Array
    oof_log_var: Array
    oof_scale: Array


@dataclass(frozen=True)
class HeteroscedasticOptions:
    """See :func:`fit_heteroscedastic`."""

    regressor: str | Regressor = "auto"
    heavy_tails: bool = True
    isotropic: bool = False
    inducing: int = 256
    noise_inducing: int = 64
    profile: str = "common"
    max_folds: int = 8
    rounds: int = 2
    noise_rows: int = 100_000
    seed: int = 0
    threads: int = 1
    regressor_options: dict[str, object] = field(default_factory=dict)


def fit_heteroscedastic(
    X: Array,
    Y: Array,
    groups: NDArray,
    *,
    base_log_var: Array | None = None,
    use_mean: NDArray[np.bool_] | None = None,
    mean_inputs: NDArray[np.int64] | None = None,
    sample_weight: Array | None = None,
    options: HeteroscedasticOptions | None = None,
) -> HeteroscedasticFit:
    """Fit ``y_j = f_j(x) + e_j``, ``e_j ~ t_nu(0, exp(base_j + g_j(x)))`` with Gaussian processes f and g.

    X (n, d), Y (n, D) finite; ``groups`` (n,) labels (sequence of each row): a row's residual is always taken from a
    fit without its group; with fewer than two groups, without its block of consecutive rows. ``base_log_var`` (n, D):
    log of a variance known per row (the geometric covariance); g is then the log of the ratio to it. ``use_mean``
    (D,): False fixes f_j to zero. ``mean_inputs``: the columns of X that f sees, by default all. ``sample_weight``
    (n,): how often a row counts.

    Options: ``regressor`` of the mean (name or object); ``heavy_tails`` False for Gaussian residuals; ``isotropic``
    kernels; at most ``inducing`` points for the mean and ``noise_inducing`` for the noise; ``profile`` "common"
    weights the rows of all outputs by one profile, "output" each by its own (one projection per output); ``rounds``:
    how often mean and noise are fitted in turn; ``noise_rows``: at most so many random rows teach the noise.
    """
    options = options or HeteroscedasticOptions()
    X, Y, _, count = checked(X, Y, None, sample_weight)
    base = np.zeros_like(Y) if base_log_var is None else np.asarray(base_log_var, dtype=np.float64)
    use = np.ones(Y.shape[1], dtype=bool) if use_mean is None else np.asarray(use_mean, dtype=bool)
    if base.shape != Y.shape or not np.isfinite(base).all() or use.shape != (Y.shape[1],) or len(groups) != len(X):
        shapes = f"base_log_var {base.shape}, use_mean {use.shape}, {len(groups)} groups"
        raise ValueError(f"X {X.shape} and Y {Y.shape} do not go with {shapes}")
    with fixed_threads(options.threads):
        seen = np.arange(X.shape[1]) if mean_inputs is None else np.asarray(mean_inputs)
        return _fit(X, Y, group_folds(groups, options.max_folds), base, use, seen, count, options)


def _fit(
    X: Array,
    Y: Array,
    fold: NDArray[np.int64],
    base: Array,
    use: NDArray[np.bool_],
    seen: NDArray[np.int64],
    count: Array,
    options: HeteroscedasticOptions,
) -> HeteroscedasticFit:
    log_var, robust = base, np.ones_like(Y)
    fitted, mean, noise = None, _zero_mean(X, Y), None
    for _ in range(max(options.rounds, 1) if use.any() else 1):
        if use.any():
            precision = _precision((np.log(robust) - log_var)[:, use], options.profile)
            fitted = _regress(X[:, seen], Y[:, use], precision, count, fitted, options)
            mean = _spread(
                fit_folded_mean(fitted, X[:, seen], Y[:, use], precision, count, fold, options.inducing, options.seed),
                use,
            )
        residuals = Residuals((Y - mean.oof_mean) ** 2, base, mean.oof_var, count)
        noise = fit_noise(X, residuals, fold, options, start=noise.start if noise else None)
        log_var = np.log(noise.oof_scale) + base
        robust = row_weight(residuals.square / (np.exp(log_var) + mean.oof_var), noise.nu)
    assert noise is not None
    gp = only_inputs(mean.gp, seen, X.shape[1]) if use.any() else mean.gp
    basis = SharedBasis(gp, noise.gp, noise.offset)
    return HeteroscedasticFit(basis, fitted, use, noise.nu, mean.oof_mean, mean.oof_var, noise.oof_log_var, fold)


def _zero_mean(X: Array, Y: Array) -> FoldedMean:
    return FoldedMean(no_mean(X.shape[1], Y.shape[1]), np.zeros_like(Y), np.zeros_like(Y))


def _spread(mean: FoldedMean, use: NDArray[np.bool_]) -> FoldedMean:
    """A fit of some outputs as a fit of all, zero elsewhere."""
    oof_mean, oof_var = (np.zeros((len(mean.oof_mean), len(use))) for _ in range(2))
    oof_mean[:, use], oof_var[:, use] = mean.oof_mean, mean.oof_var
    return FoldedMean(only_outputs(mean.gp, use), oof_mean, oof_var)


def _precision(log_precision: Array, profile: str) -> Array:
    """(n, 1) geometric mean over the outputs, or (n, D); relative to the typical row and within a factor of 10,000."""
    if profile not in ("common", "output"):
        raise ValueError(f"profile must be 'common' or 'output', got {profile!r}")
    centred = log_precision - np.median(log_precision, axis=0)
    if profile == "common":
        centred = centred.mean(axis=1, keepdims=True)
    limit = np.log(_PRECISION_RANGE)
    return np.exp(np.clip(centred, -limit, limit))


def _regress(
    X: Array, Y: Array, precision: Array, count: Array, last: FittedGP | None, options: HeteroscedasticOptions
) -> FittedGP:
    """Hyperparameters of the mean by the chosen regressor, under the outputs' average profile, from those of
    ``last``."""
    regressor = options.regressor
    if isinstance(regressor, str):
        more = dict(options.regressor_options)
        if last is not None and last.regressor in ("exact", "sparse"):
            more["guess"] = last.hyper
        regressor = get_regressor(
            regressor, n_rows=len(X), isotropic=options.isotropic, threads=options.threads, **more
        )
    profile = np.exp(np.log(precision).mean(axis=1))
    return regressor.fit(X, Y, noise_weight=profile, sample_weight=count, seed=options.seed)


def fit_noise(
    X: Array,
    residuals: Residuals,
    fold: NDArray[np.int64],
    options: HeteroscedasticOptions,
    start: FittedGP | None = None,
) -> NoiseFit:
    """GP of the log squared scale of out-of-fold residuals, their tail, and both out of fold.

    ``start``: of an earlier round, whose kernel is kept; otherwise it is learnt from the log squared residuals.
    """
    rows = np.arange(len(X))
    if len(X) > options.noise_rows:
        rows = np.sort(np.random.default_rng(options.seed).permutation(len(X))[: options.noise_rows])
    few, few_fold = residuals.subset(rows), fold[rows]
    if start is None:
        sparse = SparseRegressor(options.noise_inducing, isotropic=options.isotropic, threads=options.threads)
        start = sparse.fit(X[rows], few.log_ratio(), sample_weight=few.count, seed=options.seed)
    nu = np.full(residuals.square.shape[1], 6.0 if options.heavy_tails else np.inf)
    log_scale = np.zeros(len(nu))
    for _ in range(_TAIL_ROUNDS):
        gp, without = score_log_variance(start, X[rows], few, nu, few_fold)
        g, spread = _out_of_fold(without, X[rows], few_fold)
        stated = np.exp(g + 0.5 * spread + few.base) + few.mean_var
        tails = [fit_tail(ratio, few.count, heavy=options.heavy_tails) for ratio in (few.square / stated).T]
        before, nu = nu, np.array([tail[0] for tail in tails])
        log_scale = np.array([tail[1] for tail in tails])
        if np.allclose(1.0 / nu, 1.0 / before, atol=0.01):
            break
    offset = log_scale + log_second_moment(nu)
    g, spread = _out_of_fold(without, X, fold)
    log_squared_scale = g + 0.5 * spread + log_scale
    return NoiseFit(start, gp, offset, nu, log_squared_scale + log_second_moment(nu), np.exp(log_squared_scale))


def _out_of_fold(without: dict[int, ProjectedGP], X: Array, fold: NDArray[np.int64]) -> tuple[Array, Array]:
    """Mean and variance of the log squared scale at each row (n, D), from the GP that has not seen its fold."""
    n_outputs = next(iter(without.values())).n_outputs
    g, spread = np.empty((len(X), n_outputs)), np.empty((len(X), n_outputs))
    for f, gp in without.items():
        mine = fold == f
        g[mine], spread[mine] = gp.evaluate(X[mine])
    return np.clip(g, -_FAR_ASTRAY, _FAR_ASTRAY), np.minimum(spread, _FAR_ASTRAY)
