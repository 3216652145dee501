"""A run without ground truth, as the report shows it: its path, what was stated of it, and no score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gpvo.dataset.errors import MotionErrors
from gpvo.evaluation.evaluate import Evaluation, judged, predictions_by_stamp
from gpvo.evaluation.statements import statements
from gpvo.evaluation.trajectory import RelativeError, Statistics, TrajectoryErrors
from gpvo.geometry import se3
from gpvo.io.run import Run
from gpvo.online.predictor import Predictor

_NAN = float("nan")


def unjudged_run(run: Run, predictor: Predictor | None = None) -> Evaluation:
    """An evaluation without errors: no frame is covered by truth, and no method has a score.

    Raises ModelError if the model predicts something else than the error of a motion.
    """
    predictions = predictions_by_stamp(run, predictor)
    run = replace(run, log=judged(run.log, predictions))
    T_est, noiseless = run.log.trajectory(), np.zeros(6)
    none = np.zeros((0, 4, 4))
    of_none = RelativeError(Statistics.of(np.zeros(0)), Statistics.of(np.zeros(0)))
    length = float(se3.path_length_m(T_est[:, :3, 3])[-1])
    return Evaluation(
        run=run,
        errors=MotionErrors(np.zeros(0, np.int64), np.zeros((0, 6)), none, none, np.zeros(0)),
        trajectory=TrajectoryErrors(length, _NAN, _NAN, _NAN, of_none, of_none, of_none, ()),
        statements=tuple(statements(run.log, predictions, predictor)),
        consistency={},
        covered=np.zeros(len(run.log), bool),
        T_est=T_est,
        T_true=np.full_like(T_est, _NAN),
        truth_sigma=noiseless,
        truth_sigma_stated=noiseless,
        time_offset_s=0.0,
        in_domain=float(np.mean([p.in_domain > 0.5 for p in predictions.values()])) if predictions else None,
    )
