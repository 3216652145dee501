"""From training sequences to one error model; every choice is made by leaving whole sequences out.

The steps: rows -> base variance -> inputs -> log-variance GP with that base as its mean function -> parts and
calibration by the errors of sequences left out. The same without the GP is the row ``base`` of every table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet, group_folds
from gpvo.learning.assemble import VarianceModel, assemble
from gpvo.learning.basefit import fit_coefficients, learn_domain
from gpvo.learning.config import TrainConfig, base_candidates, candidates, guarded
from gpvo.learning.logvariance import fit_log_variance, log_ratio
from gpvo.learning.rows import Rows, significant_gain, simplest_sufficient
from gpvo.online.base import OF_MOTION, BaseVariance, base_columns, parts
from gpvo.online.estimate import ErrorModel
from gpvo.online.projected import ProjectedGP
from gpvo.online.stored import BASE
from gpvo.stats.student_t import negative_log_likelihood
from gpvo.types import Array

NONE = "none"
"""The choice of no inputs: the base variance alone."""

BETWEEN = ", between sequences too"
"""Behind the name of inputs by which also the levels of sequences are told."""

MOST_FOLDS = 8
_CLEARLY = 2.0  # standard errors


@dataclass(frozen=True)
class BaseChoice:
    """What a base variance is made of: ``method`` of the geometric covariance, and whether it uses the residuals."""

    method: str | None
    residual: bool

    def __str__(self) -> str:
        return f"{self.method or 'motion'}{' at the noise of the residuals' if self.residual else ''}"


@dataclass(frozen=True)
class Learned:
    """A fitted model in memory. ``model``: the one that predicts; ``base``: the same with the GP at its mean function.

    ``arrays``: what goes into the file; ``choices``: how each choice was made; ``calibration``: what it rests on.
    """

    model: ErrorModel
    base: ErrorModel
    arrays: Mapping[str, NDArray[Any]]
    choices: dict[str, Any]
    calibration: dict[str, Any] = field(default_factory=dict)


def fit_model(sets: Sequence[TrainingSet], config: TrainConfig) -> Learned:
    """The error model of some sequences."""
    rows = Rows.stack(sets)
    choice, alone = choose_base(rows)
    name, variance, losses = choose_inputs(rows, choice, alone, config)
    columns = tuple(dict.fromkeys((*variance.inputs, *alone.base.columns, *guarded(rows.sets, config))))
    model, calibration = assemble(rows, columns, variance)
    base, arrays = model, dict(model.to_arrays())
    if variance.gp is not None:
        base, _ = assemble(rows, columns, alone)
        own = base.to_arrays().items()
        arrays |= {BASE + n: a for n, a in own if n not in arrays or not np.array_equal(a, arrays[n])}
    choices = {"base": str(choice), "inputs": name, "inputs_nll": losses, "grouped_by": rows.grouped_by}
    return Learned(model, base, arrays, choices, calibration)


def choose_base(rows: Rows) -> tuple[BaseChoice, VarianceModel]:
    """The base variance, with geometry or without, that predicts left-out groups best.

    One that trusts the residuals must beat the best one that does not by a significant gain: if a moving object fills
    the view, residuals are small and the motion is wrong.
    """
    tried = {c: fit_variance(rows, c, ()) for c in (BaseChoice(*c) for c in base_candidates(rows.sets))}
    losses = {c: _losses(rows, model) for c, model in tried.items()}
    simple, trusting = ([c for c in tried if c.residual == residual] for residual in (False, True))
    best = min(simple, key=lambda c: losses[c].mean())
    if trusting:
        rival = min(trusting, key=lambda c: losses[c].mean())
        best = rival if significant_gain(losses[best] - losses[rival]) else best
    return best, tried[best]


def choose_inputs(
    rows: Rows, choice: BaseChoice, alone: VarianceModel, config: TrainConfig
) -> tuple[str, VarianceModel, dict[str, float]]:
    """The simplest set of inputs that no other beats by a significant gain in left-out groups; none is the simplest.

    Whether inputs also tell how noisy a whole sequence is, sequences left out must show clearly: few sequences differ
    in many things by chance. Returned by name, with the model, and the mean loss of each set [nats per axis].
    """
    tried, sets = {NONE: alone}, candidates(rows.sets, config)
    for name, inputs in sets.items():
        tried[name] = fit_variance(rows, choice, inputs, alone.means)
    losses = {name: _losses(rows, model) for name, model in tried.items()}
    best = simplest_sufficient(losses)
    if sets and rows.grouped_by == "sequences":
        between = {name + BETWEEN: inputs for name, inputs in sets.items()}
        tried |= {n: fit_variance(rows, choice, inputs, alone.means, between=True) for n, inputs in between.items()}
        losses |= {name: _losses(rows, tried[name]) for name in between}
        rival = simplest_sufficient({name: losses[name] for name in between})
        best = rival if significant_gain(losses[best] - losses[rival], _CLEARLY) else best
    return best, tried[best], {name: float(loss.mean()) for name, loss in losses.items()}


def fit_variance(
    rows: Rows,
    choice: BaseChoice,
    inputs: tuple[str, ...],
    means: Sequence[Array] | None = None,
    *,
    between: bool = False,
) -> VarianceModel:
    """The variance on ``inputs``, and out of fold: no row is predicted by a fit that saw its group.

    ``means``: see :class:`VarianceModel`, if the base has been fitted before. ``between``: the inputs also explain how
    sequences differ; else each has a level of its own.
    """
    level = np.zeros_like(rows.group) if between else rows.group
    C = rows.select(base_columns(choice.method, choice.residual))
    terms = parts(np.where(np.isfinite(C), C, np.nanmedian(C, axis=0)), rows.dt_s)
    X = rows.select(inputs)
    U = learn_domain(X).locate(X).inside if inputs else X  # as the predictor sees them
    fold = group_folds(rows.group, MOST_FOLDS)
    kept = [np.ones(len(terms), dtype=bool), *(fold != f for f in np.unique(fold))]
    means = means or [fit_coefficients(terms[of], rows.error[of], rows.weight[of]) for of in kept]
    (theta, gp, left), *others = (_fit(rows, terms, U, of, mean, level) for of, mean in zip(kept, means, strict=True))
    plain = fit_coefficients(terms * OF_MOTION, left, rows.weight)
    oof = np.empty_like(rows.error)
    for of, (theta_without, gp_without, _) in zip(kept[1:], others, strict=True):
        lift = 0.0 if gp_without is None else log_ratio(gp_without, U[~of])
        oof[~of] = (terms[~of] * theta_without).sum(axis=-1) * np.exp(lift)
    return VarianceModel(inputs, BaseVariance(theta, plain, choice.method, choice.residual), gp, oof, means)


def _fit(
    rows: Rows, terms: Array, U: Array, of: NDArray[np.bool_], theta: Array, level: NDArray[np.int64]
) -> tuple[Array, ProjectedGP | None, Array]:
    """Coefficients of the base, GP, and what it leaves of the errors, for the rows ``of``. The base, ``theta`` if
    alone, is the GP's mean function, fitted once more with it, in turn (C. E. Rasmussen, C. K. I. Williams, "Gaussian
    Processes for Machine Learning", 2006, section 2.7, explicit basis functions)."""
    terms, error, weight = terms[of], rows.error[of], rows.weight[of]
    if U.shape[1] == 0:
        return theta, None, error
    gp = fit_log_variance(U[of], error**2 / (terms * theta).sum(axis=-1), weight, level[of])
    left = error * np.exp(-0.5 * log_ratio(gp, U[of]))
    return fit_coefficients(terms, left, weight), gp, left


def _losses(rows: Rows, model: VarianceModel) -> Array:
    """(G,) heavy-tailed negative log-likelihood per axis of each group left out [nats]."""
    return rows.by_group(negative_log_likelihood(rows.error**2, model.oof)).mean(axis=1)
