"""From training sequences to one error model; every choice is made by leaving whole sequences out.

The steps: base variance -> inputs -> log-variance GP -> mean, where it helps -> jitter, white and bias -> correlation ->
calibration on residuals of sequences left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as t_distribution

from gpvo.dataset.build import TrainingSet
from gpvo.dataset.splits import group_labels
from gpvo.learning.basefit import fit_base, t_negative_log_likelihood
from gpvo.learning.calibrate import (
    LEVELS,
    choose_geometry_weight,
    conformal_quantiles,
    fit_joint_factor,
    fit_scale,
    residual_correlation,
)
from gpvo.learning.config import TrainConfig, candidates, geometric_method
from gpvo.learning.meanfit import no_mean
from gpvo.learning.noise import HeteroscedasticFit, HeteroscedasticOptions, fit_heteroscedastic
from gpvo.learning.parts import Parts, fit_parts, stretches
from gpvo.online.base import BaseVariance, base_columns
from gpvo.online.basis import SharedBasis
from gpvo.online.estimate import ErrorModelArrays
from gpvo.online.guard import Domain
from gpvo.types import Array

TRUSTS = (0.25, 0.5, 0.75, 1.0)
"""How much of the GP's log ratio to keep, chosen by cross-validation: a GP of few sequences says too much."""

NONE = "none"
"""The choice of no inputs: the base variance alone."""


@dataclass(frozen=True)
class Rows:
    """All training rows of several sequences below one another, with the groups that cross-validation leaves out."""

    sets: Sequence[TrainingSet]
    error: Array
    dt_s: Array
    group: NDArray[np.int64]
    grouped_by: str
    weight: Array

    @classmethod
    def stack(cls, sets: Sequence[TrainingSet]) -> Rows:
        group, by = group_labels([len(s) for s in sets])
        # Every sequence counts alike, however long: a new sequence is what the model will meet.
        weight = np.concatenate([np.full(len(s), 1.0 / len(s)) for s in sets])
        error, dt = np.concatenate([s.Y for s in sets]), np.concatenate([s.dt_s for s in sets])
        return cls(sets, error, dt, group, by, weight / weight.mean())

    def select(self, names: Sequence[str]) -> Array:
        return np.concatenate([s.select(names) for s in self.sets])

    def geometry(self, method: str | None) -> Array | None:
        return None if method is None else np.concatenate([s.covariances[method] for s in self.sets])

    def by_group(self, values: Array) -> Array:
        """Means of (n, ...) over each group, (G, ...)."""
        return np.array([values[self.group == g].mean(axis=0) for g in np.unique(self.group)])


@dataclass(frozen=True)
class Learned:
    """A fitted model in memory: what goes into the file, and how each choice was made (``choices``)."""

    model: ErrorModelArrays
    arrays: Mapping[str, NDArray[Any]]
    choices: dict[str, Any]
    calibration: dict[str, Any] = field(default_factory=dict)


def fit_model(sets: Sequence[TrainingSet], config: TrainConfig) -> Learned:
    """The error model of some sequences."""
    rows = Rows.stack(sets)
    base, base_oof = choose_base(rows)
    name, inputs, fitted, trust, scores = choose_inputs(rows, base, base_oof, config)
    columns = tuple(dict.fromkeys((*inputs, *base_columns(base.method))))
    fitted, mean_gain = _with_mean(rows, base, base_oof, columns, inputs, fitted, trust, config)
    fitted = None if fitted is None else shrink(fitted, trust)
    error, variance = _out_of_fold(rows, base_oof, fitted)
    model, calibration = _assemble(rows, base, columns, inputs, fitted, error, variance)
    lost = np.mean([(s.select(base_columns(None)) ** 2).mean(axis=0) for s in sets], axis=0)
    arrays = {**model.to_arrays(), "lost_rate_var": np.maximum(lost, 1e-6)}
    use_mean = [False] * 6 if fitted is None else fitted.use_mean.tolist()
    choices = {
        "base": base.method or "motion",
        "inputs": name,
        "trust": trust,
        "inputs_nll": scores,
        "use_mean": use_mean,
        "mean_gain_nats": mean_gain,
        "grouped_by": rows.grouped_by,
    }
    return Learned(model, arrays, choices, calibration)


def choose_base(rows: Rows) -> tuple[BaseVariance, Array]:
    """The geometric method (or none) whose base variance predicts left-out groups best, and its out-of-fold variance."""
    best: tuple[float, str | None, Array] | None = None
    for method in (*geometric_method(rows.sets), None):
        C = _base_inputs(rows, method)
        oof = np.empty_like(rows.error)
        for g in np.unique(rows.group):
            out = rows.group == g
            oof[out] = fit_base(C[~out], rows.dt_s[~out], rows.error[~out], method, rows.weight[~out])(C[out], rows.dt_s[out])
        loss = _loss(rows, rows.error**2, oof)
        if best is None or loss < best[0]:
            best = (loss, method, oof)
    assert best is not None
    _, method, oof = best
    C = _base_inputs(rows, method)
    return fit_base(C, rows.dt_s, rows.error, method, rows.weight), oof


def choose_inputs(
    rows: Rows, base: BaseVariance, base_oof: Array, config: TrainConfig
) -> tuple[str, tuple[str, ...], HeteroscedasticFit | None, float, dict[str, float]]:
    """The inputs and the trust in their log-variance GP that predict left-out groups best.

    The GP's log ratio to the base is shrunk by a trust in (0, 1]; nothing is left of it where no GP beats the base.
    """
    best: tuple[str, tuple[str, ...], HeteroscedasticFit | None, float] = (NONE, (), None, 0.0)
    scores = {NONE: _loss(rows, rows.error**2, base_oof)}
    for name, inputs in candidates(rows.sets, config).items():
        columns = tuple(dict.fromkeys((*inputs, *base_columns(base.method))))
        fitted = _fit_gp(rows, base, columns, inputs, np.zeros(6, dtype=bool), config)
        losses = {t: _loss(rows, rows.error**2, base_oof * np.exp(t * fitted.oof_log_noise_var)) for t in TRUSTS}
        trust = min(losses, key=losses.__getitem__)
        if losses[trust] < min(scores.values()):
            best = (name, inputs, fitted, trust)
        scores[name] = losses[trust]
    return *best, scores


def _loss(rows: Rows, square: Array, variance: Array) -> float:
    """Heavy-tailed negative log-likelihood per axis, each group at its mean, groups alike."""
    return float(rows.by_group(t_negative_log_likelihood(square, variance)).mean())


def _base_inputs(rows: Rows, method: str | None) -> Array:
    C = rows.select(base_columns(method))
    return np.where(np.isfinite(C), C, np.nanmedian(C, axis=0))


def _gp_inputs(rows: Rows, columns: Sequence[str], inputs: Sequence[str]) -> Array:
    domain = Domain.learn(rows.select(columns))
    at = [list(columns).index(n) for n in inputs]
    return domain.locate(rows.select(columns)).inside[:, at]


def _fit_gp(
    rows: Rows,
    base: BaseVariance,
    columns: Sequence[str],
    inputs: Sequence[str],
    use_mean: NDArray[np.bool_],
    config: TrainConfig,
) -> HeteroscedasticFit:
    options = HeteroscedasticOptions(
        regressor=config.regressor, inducing=config.inducing, noise_inducing=config.noise_inducing, seed=config.seed
    )
    log_base = np.log(base(_base_inputs(rows, base.method), rows.dt_s))
    return fit_heteroscedastic(
        _gp_inputs(rows, columns, inputs),
        rows.error,
        rows.group,
        base_log_var=log_base,
        use_mean=use_mean,
        sample_weight=rows.weight,
        options=options,
    )


def shrink(fitted: HeteroscedasticFit, trust: float) -> HeteroscedasticFit:
    """The fit with its log ratio times ``trust``: mean by the factor, variance by its square."""
    noise = fitted.basis.noise
    if noise is not None:
        noise = replace(
            noise,
            weights=noise.weights * trust,
            offset=noise.offset * trust,
            reduction=noise.reduction * trust**2,
            signal_var=noise.signal_var * trust**2,
        )
    basis = SharedBasis(fitted.basis.mean, noise, fitted.basis.log_noise_offset * trust)
    return replace(fitted, basis=basis, oof_log_noise_var=fitted.oof_log_noise_var * trust)


def _with_mean(
    rows: Rows,
    base: BaseVariance,
    base_oof: Array,
    columns: Sequence[str],
    inputs: Sequence[str],
    fitted: HeteroscedasticFit | None,
    trust: float,
    config: TrainConfig,
) -> tuple[HeteroscedasticFit | None, list[float]]:
    """Add the mean on the axes where it makes left-out groups more likely, beyond what groups differ by chance."""
    if fitted is None:
        return None, [0.0] * 6
    # The question is put with few inducing points; only a mean that proves itself is fitted as asked.
    quick = replace(config, regressor="sparse", inducing=min(config.inducing, 64))
    with_mean = _fit_gp(rows, base, columns, inputs, np.ones(6, dtype=bool), quick)
    v0 = base_oof * np.exp(trust * fitted.oof_log_noise_var)
    corrected = (rows.error - with_mean.oof_mean) ** 2
    plain = t_negative_log_likelihood(rows.error**2, v0)
    gain = rows.by_group(plain - t_negative_log_likelihood(corrected, v0 + with_mean.oof_epistemic_var))
    proven = surely_positive(gain)
    gains = gain.mean(axis=0).tolist()
    if not proven.any():
        return fitted, gains
    return _fit_gp(rows, base, columns, inputs, proven, config), gains


def surely_positive(gain: Array, risk: float = 0.05) -> NDArray[np.bool_]:
    """(D,) whether the mean over groups of gain (G, D) is positive: one-sided t-test, risk shared among the D axes."""
    groups, axes = gain.shape
    if groups < 2:
        return np.zeros(axes, dtype=bool)
    statistic = gain.mean(axis=0) / np.maximum(gain.std(axis=0, ddof=1) / np.sqrt(groups), 1e-300)
    return statistic > t_distribution.ppf(1.0 - risk / axes, groups - 1)


def _out_of_fold(rows: Rows, base_oof: Array, fitted: HeteroscedasticFit | None) -> tuple[Array, Array]:
    """Residuals about the mean and their variance, each from a model that did not see the row's group."""
    if fitted is None:
        return rows.error, base_oof
    return rows.error - fitted.oof_mean, np.exp(fitted.oof_log_noise_var) * base_oof + fitted.oof_epistemic_var


def _assemble(
    rows: Rows,
    base: BaseVariance,
    columns: tuple[str, ...],
    inputs: Sequence[str],
    fitted: HeteroscedasticFit | None,
    error: Array,
    variance: Array,
) -> tuple[ErrorModelArrays, dict[str, Any]]:
    """Parts, correlation and calibration from the out-of-fold residuals; then everything in one place."""
    scale = fit_scale(error / np.sqrt(variance), rows.group)
    sigma = np.sqrt(variance * scale.factor)
    z = error / sigma
    split = fit_parts(_stretches(rows, z), float(np.median(rows.dt_s)))
    correlation = residual_correlation(z)
    geometry = rows.geometry(base.method)
    weight = choose_geometry_weight(error, sigma, correlation, geometry, split.share)
    X = rows.select(columns)
    if fitted is None:
        inputs, basis = (columns[0],), SharedBasis(no_mean(1, 6), None, np.zeros(6))
        high = np.zeros(6)
    else:
        basis = fitted.basis
        high = np.quantile(fitted.oof_log_noise_var, 0.95, axis=0)
    at = np.array([columns.index(n) for n in inputs], dtype=np.int64)
    model = ErrorModelArrays(
        columns=columns,
        inputs=at,
        basis=basis,
        domain=Domain.learn(X),
        base=base,
        factor=scale.factor,
        high=high,
        correlation=correlation,
        geometry_weight=np.array([weight]),
        share=split.share,
        bias_tau_s=split.tau_s,
        typical_ln_det=np.zeros(1),
        dt_s=float(np.median(rows.dt_s)),
    )
    whole = _covariance(model, sigma, geometry)
    joint = fit_joint_factor(error, whole, rows.group)
    typical = float(np.median(np.linalg.slogdet(whole * joint)[1]))
    model = replace(model, factor=scale.factor * joint, typical_ln_det=np.array([typical]))
    return model, _calibration(rows, scale, joint, split, weight, np.abs(z) / np.sqrt(joint))


def _covariance(model: ErrorModelArrays, sigma: Array, geometry: Array | None) -> Array:
    root = np.sqrt(model.share)
    kept = sum(np.outer(r, r) for r in root)
    return sigma[:, :, None] * model.correlations(len(sigma), geometry) * sigma[:, None, :] * kept


def _stretches(rows: Rows, z: Array) -> list[Array]:
    out, start = [], 0
    for s in rows.sets:
        out += [z[start : start + len(s)][part] for part in stretches(s.t_ns, s.dt_s)]
        start += len(s)
    return out


def _calibration(rows: Rows, scale: Any, joint: float, split: Parts, weight: float, score: Array) -> dict[str, Any]:
    axes = [conformal_quantiles(score[:, j], rows.group) for j in range(6)]
    return {
        "by": rows.grouped_by,
        "groups": len(np.unique(rows.group)),
        "scale_of_groups": scale.by_group,
        "log_scale_spread": scale.spread,
        "joint_factor": joint,
        "geometry_correlation_weight": weight,
        "interval_levels": LEVELS,
        "interval_sigmas": [widths for widths, _ in axes],
        "interval_guaranteed": [sure for _, sure in axes],
        "parts": {"spans_frames": split.spans, "measured": split.measured, "fitted": split.fitted},
    }
