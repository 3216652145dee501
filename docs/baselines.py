"""Covariances that others use, as methods beside ours: the best constant in hindsight, the scatter of the last motions,
nearest neighbours, RTAB-Map's rule, and the twins of the run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gpvo.dataset.build import TrainingSet
from gpvo.dataset.errors import MotionErrors
from gpvo.evaluation.by_twins import METHOD as TWIN
from gpvo.evaluation.by_twins import twin_covariance
from gpvo.evaluation.statements import Statement, plain_statement
from gpvo.geometry import se3
from gpvo.io.run_read import Run
from gpvo.online.features import THESIS, FeatureStream
from gpvo.types import Array, StereoTracks, VoLog
from gpvo.vo.points import triangulate

SCATTER_FRAMES = 10
NEIGHBOURS = 20
_TINY = 1e-12 * np.eye(6)
_MAD = 2.1981  # (1.4826)^2: from a median of squares to a variance
_RTABMAP_FLOOR = 1e-6


def baselines(
    log: VoLog,
    errors: MotionErrors,
    training: Sequence[TrainingSet],
    tracks: StereoTracks | None = None,
    twins: Sequence[Run] = (),
) -> list[Statement]:
    """``constant_hindsight``: the mean square of the run's own errors, which nobody has in flight. ``scatter``: of the
    last ten motions about their mean. ``nearest``: of the errors of the 20 training rows with the nearest velocity and
    inlier count. With what odometry saw, ``rtabmap``: :func:`rtabmap_covariance`; with twins, ``twin``."""
    hindsight = errors.xi.T @ errors.xi / max(len(errors.xi), 1) + _TINY
    constant = np.broadcast_to(hindsight, (len(log), 6, 6))
    out = [
        plain_statement(log, "constant_hindsight", constant),
        plain_statement(log, "scatter", _scatter(log)),
        plain_statement(log, "nearest", _nearest(log, training)),
    ]
    if tracks is not None:
        out.append(plain_statement(log, "rtabmap", rtabmap_covariance(log, tracks)))
    if twins:
        out.append(plain_statement(log, TWIN, twin_covariance(log, twins)))
    return out


def rtabmap_covariance(log: VoLog, tracks: StereoTracks) -> Array:
    """(N, 6, 6) by RTAB-Map's rule (introlab/rtabmap, ``util3d_motion_estimation.cpp``), NaN of unmeasured motions.

    One variance for translation and one for rotation: 2.1981 times the lower quartile of the squared distances, and of
    the squared angles, between the inliers' points as seen and as the motion carries them, and 1e-6 besides. It is the
    scatter of the points, and does not shrink with their number. Raises ValueError where the log does not know its
    camera.
    """
    if log.camera is None:
        raise ValueError("the points of an unknown camera cannot be triangulated")
    edges = np.searchsorted(tracks.t_ns, log.t_ns, side="left"), np.searchsorted(tracks.t_ns, log.t_ns, side="right")
    out = np.full((len(log), 6, 6), np.nan)
    for k, (record, start) in enumerate(zip(log, log.parent)):
        if not record.usable or start < 0:
            continue
        before, now = slice(edges[0][start], edges[1][start]), slice(edges[0][k], edges[1][k])
        _, i, j = np.intersect1d(tracks.track[before], tracks.track[now], return_indices=True)
        inlier = tracks.is_inlier[now][j]
        i, j = i[inlier], j[inlier]
        if len(i) == 0:
            continue
        P = triangulate(tracks.uvd[now][j], log.camera)
        Q = se3.transform(se3.inverse(record.T_prev_cur), triangulate(tracks.uvd[before][i], log.camera))
        cosine = (P * Q).sum(1) / (np.linalg.norm(P, axis=1) * np.linalg.norm(Q, axis=1))
        squares = ((P - Q) ** 2).sum(1), np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2
        linear, angular = (_MAD * np.sort(s)[len(s) // 4] + _RTABMAP_FLOOR for s in squares)
        out[k] = np.diag([linear] * 3 + [angular] * 3)
    return out


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
