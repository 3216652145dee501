"""From training sequences to one error model; every choice is made by leaving whole sequences out.

The steps: base variance -> inputs -> log-variance GP -> mean, where it helps -> jitter, white and bias ->
correlation -> calibration on residuals of sequences left out, of motions and of poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.learning.assemble import assemble
from gpvo.learning.basefit import fit_base, t_negative_log_likelihood
from gpvo.learning.config import TrainConfig, base_candidates, candidates, guarded
from gpvo.learning.meantest import helps_over_distance, pose_gain
from gpvo.learning.noise import HeteroscedasticFit, HeteroscedasticOptions, fit_heteroscedastic
from gpvo.learning.rows import Rows
from gpvo.learning.scores import beyond_chance
from gpvo.learning.steadymean import steady_mean
from gpvo.online.base import OWN_MOTION, BaseVariance, base_columns
from gpvo.online.basis import SharedBasis
from gpvo.online.estimate import ErrorModelArrays
from gpvo.online.for_filter import FOR_FILTER
from gpvo.online.guard import Domain
from gpvo.types import Array

TRUSTS = (0.25, 0.5, 0.75, 1.0)
"""How much of the GP's log ratio to keep, chosen by cross-validation: a GP of few sequences says too much."""

NONE = "none"
"""The choice of no inputs: the base variance alone, or no mean."""

CONDITIONS, ALL = "conditions", "all"
"""What a mean may see: the inputs that are not VO's own motion, in units of the base's standard deviation; or all."""


@dataclass(frozen=True)
class Learned:
    """A fitted model in memory: what goes into the file, and how each choice was made (``choices``).

    ``mean_inputs``: places, among the model's inputs, of those that its mean sees.
    """

    model: ErrorModelArrays
    arrays: Mapping[str, NDArray[Any]]
    choices: dict[str, Any]
    mean_inputs: NDArray[np.int64]
    calibration: dict[str, Any] = field(default_factory=dict)


def fit_model(sets: Sequence[TrainingSet], config: TrainConfig) -> Learned:
    """The error model of some sequences."""
    rows = Rows.stack(sets)
    base, base_oof = choose_base(rows)
    name, inputs, fitted, trust, scores = choose_inputs(rows, base, base_oof, config)
    plain = None if fitted is None or trust == 0.0 else shrink(fitted, trust)
    inputs, fitted, mean = _with_mean(rows, base, base_oof, inputs, fitted, trust, config)
    fitted = None if fitted is None else shrink(fitted, trust)
    columns = tuple(dict.fromkeys((*inputs, *base.columns, *guarded(rows.sets, config))))
    use_mean = [False] * 6 if fitted is None else fitted.use_mean.tolist()
    error, variance = _out_of_fold(rows, base_oof, fitted)
    in_sigma = mean.name != ALL
    model, calibration = assemble(rows, base, columns, inputs, fitted, error, variance, mean_in_sigma=in_sigma)
    arrays, for_filter = model.to_arrays(), model
    if any(use_mean):
        error, variance = _out_of_fold(rows, base_oof, plain)
        for_filter, _ = assemble(rows, base, columns, inputs, plain, error, variance)
        arrays |= {f"{FOR_FILTER}{name}": array for name, array in for_filter.to_arrays().items()}
    arrays[f"{FOR_FILTER}steady_mean"] = steady = steady_mean(rows, for_filter, error, variance)
    choices = {
        "base": _name_of(base),
        "inputs": name if inputs else NONE,
        "trust": trust,
        "inputs_nll": scores,
        "use_mean": use_mean,
        "mean_inputs": mean.name,
        "mean_gain_nats": mean.gains,
        "steady_mean": steady.tolist(),
        "grouped_by": rows.grouped_by,
    }
    return Learned(model, arrays, choices, mean.inputs, calibration)


def choose_base(rows: Rows) -> tuple[BaseVariance, Array]:
    """The base variance, with geometry or without, that predicts left-out groups best; and the same out of fold.

    One that trusts the residuals must beat the best that does not by more than the standard error of its gain over the
    groups: where a moving object is all there is to see, residuals are small and the motion wrong.
    """
    tried = {choice: _base_out_of_fold(rows, *choice) for choice in base_candidates(rows.sets)}
    losses = {choice: _losses(rows, rows.error**2, oof) for choice, oof in tried.items()}
    simple, trusting = ([c for c in tried if c[1] == residual] for residual in (False, True))
    best = min(simple, key=lambda c: losses[c].mean())
    if trusting:
        rival = min(trusting, key=lambda c: losses[c].mean())
        if beyond_chance(losses[best] - losses[rival]):
            best = rival
    method, residual = best
    C = _base_inputs(rows, base_columns(method, residual))
    return fit_base(C, rows.dt_s, rows.error, method, rows.weight, residual=residual), tried[best]


def _base_out_of_fold(rows: Rows, method: str | None, residual: bool) -> Array:
    """(n, 6) of each group from the others."""
    C = _base_inputs(rows, base_columns(method, residual))
    oof = np.empty_like(rows.error)
    for g in np.unique(rows.group):
        out = rows.group == g
        base = fit_base(C[~out], rows.dt_s[~out], rows.error[~out], method, rows.weight[~out], residual=residual)
        oof[out] = base(C[out], rows.dt_s[out])
    return oof


def choose_inputs(
    rows: Rows, base: BaseVariance, base_oof: Array, config: TrainConfig
) -> tuple[str, tuple[str, ...], HeteroscedasticFit | None, float, dict[str, float]]:
    """The inputs and the trust in their log-variance GP that predict left-out groups best.

    The GP's log ratio to the base is shrunk by a trust in (0, 1], and 0 where no GP beats the base: then the inputs
    are the best of those, as a mean may need them.
    """
    best: tuple[str, tuple[str, ...], HeteroscedasticFit | None, float] = (NONE, (), None, 0.0)
    scores: dict[str, float] = {}
    alone = _loss(rows, rows.error**2, base_oof)
    for name, inputs in candidates(rows.sets, config).items():
        fitted = _fit_gp(rows, base, inputs, np.zeros(6, dtype=bool), config)
        losses = {t: _loss(rows, rows.error**2, base_oof * np.exp(t * fitted.oof_log_noise_var)) for t in TRUSTS}
        trust = min(losses, key=losses.__getitem__)
        if losses[trust] < min(scores.values(), default=np.inf):
            best = (name, inputs, fitted, trust if losses[trust] < alone else 0.0)
        scores[name] = losses[trust]
    return *best, {NONE: alone, **scores}


def _losses(rows: Rows, square: Array, variance: Array) -> Array:
    """(G,) heavy-tailed negative log-likelihood per axis of each group."""
    return rows.by_group(t_negative_log_likelihood(square, variance)).mean(axis=1)


def _loss(rows: Rows, square: Array, variance: Array) -> float:
    """The same, groups alike."""
    return float(_losses(rows, square, variance).mean())


def _name_of(base: BaseVariance) -> str:
    return f"{base.method or 'motion'}{' at the noise of the residuals' if base.residual else ''}"


def _base_inputs(rows: Rows, columns: Sequence[str]) -> Array:
    C = rows.select(columns)
    return np.where(np.isfinite(C), C, np.nanmedian(C, axis=0))


def _gp_inputs(rows: Rows, inputs: Sequence[str]) -> Array:
    X = rows.select(inputs)
    return Domain.learn(X).locate(X).inside


@dataclass(frozen=True)
class _Mean:
    """What the mean sees, by name and place among the inputs; ``gains`` [nats] per axis of a motion's likelihood."""

    name: str
    inputs: NDArray[np.int64]
    gains: list[float] = field(default_factory=lambda: [0.0] * 6)


_NO_MEAN = _Mean(NONE, np.arange(0))


def _fit_gp(
    rows: Rows,
    base: BaseVariance,
    inputs: Sequence[str],
    use_mean: NDArray[np.bool_],
    config: TrainConfig,
    seen: _Mean | None = None,
) -> HeteroscedasticFit:
    options = HeteroscedasticOptions(
        regressor=config.regressor, inducing=config.inducing, noise_inducing=config.noise_inducing, seed=config.seed
    )
    log_base = np.log(base(_base_inputs(rows, base.columns), rows.dt_s))
    # A bias of noise goes with the noise. What VO is wrong by on average of its motion, with the motion's duration.
    longer = np.repeat((rows.dt_s / rows.step_s)[:, None], 6, axis=1)
    unit = np.exp(0.5 * log_base) if seen is None or seen.name != ALL else longer
    fitted = fit_heteroscedastic(
        _gp_inputs(rows, inputs),
        rows.error / unit,
        rows.group,
        base_log_var=log_base - 2.0 * np.log(unit),
        use_mean=use_mean,
        mean_inputs=None if seen is None else seen.inputs,
        sample_weight=rows.weight,
        options=options,
    )
    return replace(fitted, oof_mean=fitted.oof_mean * unit, oof_epistemic_var=fitted.oof_epistemic_var * unit**2)


def shrink(fitted: HeteroscedasticFit, trust: float) -> HeteroscedasticFit:
    """The fit with its log ratio times ``trust``: mean by the factor, variance by its square."""
    noise = fitted.basis.noise if trust else None
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
    inputs: tuple[str, ...],
    fitted: HeteroscedasticFit | None,
    trust: float,
    config: TrainConfig,
) -> tuple[tuple[str, ...], HeteroscedasticFit | None, _Mean]:
    """Add the mean that makes the path best, on the axes where it makes the errors of left-out groups smaller over any
    distance; none where that may be chance. Returned with the inputs that are still needed.

    One given the conditions alone is tried beside one that sees VO's own motion, and so what was usual in training;
    the latter not where the inputs do not even tell the noise (no ``trust``).
    """
    if fitted is None:
        return (), None, _NO_MEAN
    # The question is put with few inducing points; only a mean that proves itself is fitted as asked.
    quick = replace(config, regressor="sparse", inducing=min(config.inducing, 64))
    v0 = base_oof * np.exp(trust * fitted.oof_log_noise_var)
    plain = t_negative_log_likelihood(rows.error**2, v0)

    def gains_of(fit: HeteroscedasticFit) -> Array:
        left = t_negative_log_likelihood((rows.error - fit.oof_mean) ** 2, v0 + fit.oof_epistemic_var)
        return rows.by_group(plain - left).mean(axis=0)

    best, use, most = _NO_MEAN, np.zeros(6, dtype=bool), 0.0
    for seen in (m for m in _means(inputs) if trust or m.name == CONDITIONS):
        tried = _fit_gp(rows, base, inputs, np.ones(6, dtype=bool), quick, seen)
        gains = gains_of(tried)
        axes = (gains > 0) & helps_over_distance(rows, tried.oof_mean, np.sqrt(v0))
        gain = pose_gain(rows, np.where(axes, tried.oof_mean, 0.0)) if axes.any() else 0.0
        if gain > most:
            best, use, most = seen, axes, gain
    if use.any():
        kept = inputs
        if trust == 0.0:
            kept = tuple(inputs[i] for i in best.inputs)
            best = replace(best, inputs=np.arange(len(kept)))
        asked = _fit_gp(rows, base, kept, use, config, best)
        gains = gains_of(asked)
        # A mean that held with few inducing points may go astray with many: then there is none.
        if (gains[use] > 0).all():
            return kept, asked, replace(best, gains=gains.tolist())
    return (inputs, fitted, _NO_MEAN) if trust else ((), None, _NO_MEAN)


def _means(inputs: Sequence[str]) -> list[_Mean]:
    """The means to try: of the conditions alone, and of all inputs where VO's own motion is among them."""
    conditions = np.array([i for i, name in enumerate(inputs) if name not in OWN_MOTION], dtype=np.int64)
    out = [_Mean(CONDITIONS, conditions)] if len(conditions) else []
    return out if len(conditions) == len(inputs) else [*out, _Mean(ALL, np.arange(len(inputs)))]


def _out_of_fold(rows: Rows, base_oof: Array, fitted: HeteroscedasticFit | None) -> tuple[Array, Array]:
    """Residuals about the mean and their variance, each from a model that did not see the row's group."""
    if fitted is None:
        return rows.error, base_oof
    return rows.error - fitted.oof_mean, np.exp(fitted.oof_log_noise_var) * base_oof + fitted.oof_epistemic_var
