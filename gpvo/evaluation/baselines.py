"""Covariances that others use, as methods beside ours: the best constant in hindsight, scatter, nearest neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpvo.dataset.build import TrainingSet
from gpvo.dataset.errors import MotionErrors
from gpvo.evaluation.statements import Statement, plain_statement
from gpvo.geometry import se3
from gpvo.online.features import THESIS, FeatureStream
from gpvo.types import Array, VoLog

SCATTER_FRAMES = 10
NEIGHBOURS = 20
_TINY = 1e-12 * np.eye(6)


def baselines(log: VoLog, errors: MotionErrors, training: Sequence[TrainingSet]) -> list[Statement]:
    """``constant_hindsight``: the mean square of the run's own errors, which nobody has in flight. ``scatter``: of the
    last ten motions about their mean. ``nearest``: of the errors of the 20 training rows with the nearest velocity and
    inlier count."""
    hindsight = errors.xi.T @ errors.xi / max(len(errors.xi), 1) + _TINY
    constant = np.broadcast_to(hindsight, (len(log), 6, 6))
    return [
        plain_statement(log, "constant_hindsight", constant),
        plain_statement(log, "scatter", _scatter(log)),
        plain_statement(log, "nearest", _nearest(log, training)),
    ]


def _scatter(log: VoLog) -> Array:
    xi = se3.log(log.T_prev_cur)
    out = np.full((len(log), 6, 6), np.nan)
    for k in range(2, len(log)):
        last = xi[max(1, k + 1 - SCATTER_FRAMES) : k + 1]
        out[k] = np.cov(last.T) + _TINY
    return out


def _nearest(log: VoLog, training: Sequence[TrainingSet]) -> Array:
    X = np.concatenate([s.select(THESIS) for s in training])
    Y = np.concatenate([s.Y for s in training])
    known = np.isfinite(X).all(axis=1)
    X, Y = X[known], Y[known]
    spread = np.maximum(X.std(axis=0), 1e-9)
    stream, out = FeatureStream(THESIS, log.camera), np.full((len(log), 6, 6), np.nan)
    for k, record in enumerate(log):
        x = stream.step(record)
        if record.usable and np.isfinite(x).all():
            near = Y[np.argsort((((X - x) / spread) ** 2).sum(axis=1), kind="stable")[:NEIGHBOURS]]
            out[k] = near.T @ near / len(near) + _TINY
    return out
