"""A run judged by its twins: what each stated covariance would score, and the twins' own as one more method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, document, evaluate_run
from gpvo.evaluation.statements import Statement, plain_statement
from gpvo.io.run import Run
from gpvo.online.predictor import Predictor
from gpvo.twin.covariance import METHOD, twin_covariance
from gpvo.types import VoLog


def with_twins(run: Run, twins: Sequence[Run], predictor: Predictor | None, options: EvaluateOptions) -> Evaluation:
    """A run with truth, and the covariance that its twins show as the method ``twin``."""
    return evaluate_run(run, predictor, options, [_statement(run.log, twins)])


def by_twins(
    run: Run, twins: Sequence[Run], predictor: Predictor | None, options: EvaluateOptions
) -> tuple[dict[str, Any], list[Evaluation]]:
    """A run without truth: the document of :func:`gpvo.evaluation.evaluate.document` as a mean over its twins, and the
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
