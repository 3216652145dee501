"""A run judged by its twins: what each stated covariance would score, with the twins' own as one more method, ``twin``:
the covariance of each motion from the errors that the twins made there. And twins judged by a run with truth: how far
its errors exceed what a model of its twins predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.dataset.build import build_run, leave_out
from gpvo.dataset.errors import motion_errors
from gpvo.errors import SourceError
from gpvo.evaluation.document import run_document
from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, evaluate_run
from gpvo.evaluation.statements import Statement, plain_statement
from gpvo.io.run import Run
from gpvo.learning.config import TrainConfig
from gpvo.learning.methods import average
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from gpvo.stats.series import moving_sums
from gpvo.twin.gap import SPAN
from gpvo.types import Array, VoLog

METHOD = "twin"
_HALF_WINDOW = 10  # motions on either side that share the shape of a covariance
_ROUNDS = 5
_DOF = 6
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


def by_twins(
    run: Run,
    twins: Sequence[Run],
    predictor: Predictor | None,
    options: EvaluateOptions,
    misfits: tuple[str, ...] | None = None,
) -> tuple[dict[str, Any], list[Evaluation]]:
    """Document (:func:`gpvo.evaluation.document.run_document`) and evaluation of a run with truth, with the covariance
    that its twins show as the method ``twin``. Of a run without: the mean over its twins, without a verdict, and the
    evaluation of each; the method ``twin`` of each is that of the others."""

    def statement(run: Run, twins: Sequence[Run]) -> Statement:
        return plain_statement(run.log, METHOD, twin_covariance(run.log, twins))

    if run.truth is not None:
        own = evaluate_run(run, predictor, options, [statement(run, twins)], misfits)
        return run_document(own), [own]
    options = replace(options, truth_sigma=options.truth_sigma or (0.0, 0.0))  # simulated truth is exact
    found = [evaluate_run(t, predictor, options, [statement(t, others)], ()) for (t,), others in leave_out(twins)]
    mean = average([run_document(e) for e in found])
    # A verdict is in words, which have no mean: the numbers speak.
    about = {"run": run.name, "source": run.meta.get("source"), "verdict": None}
    return {**mean, **about, "simulated_truth": {"twins": len(twins), **twins[0].meta["twin"]}}, found


def twin_covariance(log: VoLog, twins: Sequence[Run]) -> Array:
    """(N, 6, 6) second moment of the twins' errors of each motion; NaN where too few measured it.

    Few twins show the size of a motion's error, not its shape: eight have 48 numbers for a matrix of 21. So motions
    within a second or so share a shape, and each has a size of its own (D. Tyler, "A distribution-free M-estimator of
    multivariate scatter", 1987, over a moving window): ``C_k = q_k P_k`` with ``P_k`` the mean of ``xi xi^T / q`` of
    the neighbours and ``q_k`` the mean of ``xi^T P_k^-1 xi / 6``. Sizes are widened for what few draws leave unknown.
    """
    xi = np.stack([_errors(log, twin) for twin in twins])
    known = np.isfinite(xi[:, :, 0])
    count = known.sum(axis=0)
    moment = np.einsum("rni,rnj->nij", np.nan_to_num(xi), np.nan_to_num(xi))
    size, shape = np.ones(len(log)), np.full((len(log), _DOF, _DOF), np.nan)
    enough = _over_window(count) >= 4 * _DOF
    if not enough.any():
        return shape
    for _ in range(_ROUNDS):
        mean = _over_window(moment / size[:, None, None]) / np.maximum(_over_window(count), 1)[:, None, None]
        shape[enough] = mean[enough]
        # trace(P^-1 sum xi xi^T) is the sum of the squared, whitened errors.
        solved = np.linalg.solve(shape[enough], moment[enough])
        found = np.trace(solved, axis1=1, axis2=2) / (_DOF * np.maximum(count[enough], 1))
        size[enough] = np.where(count[enough] > 0, np.maximum(found, 1e-6), 1.0)
    dof = _DOF * count.astype(np.float64)
    widened = size * dof / np.maximum(dof - 2.0, 1.0)
    return np.where((enough & (count >= 2))[:, None, None], widened[:, None, None] * shape, np.nan)


def _errors(log: VoLog, twin: Run) -> Array:
    """(N, 6) errors of the twin's motions; NaN where it did not measure the same motion."""
    out = np.full((len(log), _DOF), np.nan)
    assert twin.truth is not None
    place = {(r.t_prev_ns, r.t_ns): k for k, r in enumerate(log)}
    errors = motion_errors(twin.log, twin.truth)
    for k, xi in zip(errors.index, errors.xi, strict=True):
        record = twin.log.records[k]
        own = place.get((record.t_prev_ns, record.t_ns))
        if own is not None and record.dt_s > 0:
            out[own] = xi
    return out


def _over_window(values: Array) -> Array:
    """Sums over each entry (N, ...) and its neighbours."""
    padding = [(_HALF_WINDOW, _HALF_WINDOW), *[(0, 0)] * (values.ndim - 1)]
    return moving_sums(np.pad(values, padding), 2 * _HALF_WINDOW + 1)
