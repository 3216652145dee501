"""A run judged by its twins: what each stated covariance would score, and the twins' own as one more method. And twins
judged by a run with truth: by how much its errors exceed what a model of its twins predicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpvo.dataset.build import build_run
from gpvo.errors import SourceError
from gpvo.evaluation.document import document
from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, evaluate_run
from gpvo.evaluation.statements import Statement, plain_statement
from gpvo.io.run import Run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from gpvo.twin.covariance import METHOD, twin_covariance
from gpvo.twin.gap import SPAN
from gpvo.types import Array, VoLog

SPANS = (SPAN, "10 m")


def ratios(run: Run, twins: Sequence[Run]) -> Array:
    """(2, 6) root of the mean squared error over its variance, by :data:`SPANS` and axis, of a run with truth, as a
    model of its twins alone predicts it, the truth's own noise counted in; NaN where the run is too short.

    Raises SourceError where the run has no truth.
    """
    if run.truth is None:
        raise SourceError("has no ground truth to compare twins with", where=run.path, cure="leave out --against")
    model = train_sets([build_run(t) for t in twins], TrainConfig(), judge=False)
    found = evaluate_run(run, model.predictor()).consistency["learned"]
    windows = (found.one_second, *(h for h in found.horizons if SPANS[1] == f"{h.span:g} m"))
    return np.sqrt([(np.nan,) * 6 if h is None else h.z2_truth_noise for h in windows])


def with_twins(run: Run, twins: Sequence[Run], predictor: Predictor | None, options: EvaluateOptions) -> Evaluation:
    """A run with truth, and the covariance that its twins show as the method ``twin``."""
    return evaluate_run(run, predictor, options, [_statement(run.log, twins)])


def by_twins(
    run: Run, twins: Sequence[Run], predictor: Predictor | None, options: EvaluateOptions
) -> tuple[dict[str, Any], list[Evaluation]]:
    """A run without truth: the document of :func:`gpvo.evaluation.document.document` as a mean over its twins, and the
    evaluation of each. The method ``twin`` of each twin is that of the others."""
    found = []
    for k, twin in enumerate(twins):
        others = [t for j, t in enumerate(twins) if j != k]
        found.append(evaluate_run(twin, predictor, options, [_statement(twin.log, others)]))
    mean = _mean([document([e])["runs"][0] for e in found])
    return {**mean, "run": run.name, "simulated_truth": {"twins": len(twins), **twins[0].meta["twin"]}}, found


def _statement(log: VoLog, twins: Sequence[Run]) -> Statement:
    return plain_statement(log, METHOD, twin_covariance(log, twins))


def _mean(values: Sequence[Any]) -> Any:
    """Documents of one form averaged number by number; None where none has a number, text from the first."""
    values = [v for v in values if v is not None] or [None]
    first = values[0]
    if isinstance(first, dict):
        return {key: _mean([v[key] for v in values if key in v]) for key in first}
    if isinstance(first, (list, tuple)):
        return [_mean(entries) for entries in zip(*values)]
    numbers = [v for v in values if isinstance(v, (int, float)) and np.isfinite(v)]
    if len(set(numbers)) == 1:
        return numbers[0]
    return float(np.mean(numbers)) if numbers else first
