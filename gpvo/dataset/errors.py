"""Ground truth beside a log, and what the model learns from it: the error of each motion, of a window of motions, or
the residual of a position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.online.observer import Window
from gpvo.types import Array, TruthLog, VoLog, VoRecord

MAX_GAP_S = 0.5


def interpolate_truth(
    truth: TruthLog, t_ns: NDArray[np.int64], max_gap_s: float = MAX_GAP_S
) -> tuple[Array, NDArray[np.bool_]]:
    """Truth poses at the stamps (N,): (N, 4, 4) and whether each is known (N,).

    A stamp is known where it lies within the truth and the truth's neighbours are no further apart than ``max_gap_s``
    (or one of them is the stamp itself).
    """
    t = np.asarray(t_ns, dtype=np.int64)
    if len(truth.t_ns) == 0:
        return np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy(), np.zeros(len(t), dtype=bool)
    right = np.clip(np.searchsorted(truth.t_ns, t), 1, len(truth.t_ns) - 1)
    t_a, t_b = truth.t_ns[right - 1], truth.t_ns[right]
    fraction = np.clip((t - t_a) / np.maximum(t_b - t_a, 1), 0.0, 1.0)
    T = se3.interpolate(truth.T_world_cam[right - 1], truth.T_world_cam[right], fraction)
    exact = (t == t_a) | (t == t_b)
    known = exact | ((t >= t_a) & (t <= t_b) & (t_b - t_a <= max_gap_s * 1e9))
    return T, known


@dataclass(frozen=True)
class MotionErrors:
    """Errors of M motions: ``xi = Log(T_true^-1 T_est)``, right perturbation, in ``cam`` [m, rad].

    ``index`` (M,) into the log; ``xi`` (M, 6); ``T_true``, ``T_est`` (M, 4, 4); ``dt_s`` (M,).
    """

    index: NDArray[np.int64]
    xi: Array
    T_true: Array
    T_est: Array
    dt_s: Array


def motion_errors(log: VoLog, truth: TruthLog) -> MotionErrors:
    """Errors of all ``ok`` and ``degraded`` motions with truth at both ends."""
    t_prev = np.array([r.t_prev_ns for r in log], dtype=np.int64)
    start, has_start = interpolate_truth(truth, t_prev)
    end, has_end = interpolate_truth(truth, log.t_ns)
    index = np.flatnonzero(log.usable & has_start & has_end)
    T_true = se3.inverse(start[index]) @ end[index]
    T_est = log.T_prev_cur[index]
    xi = se3.log(se3.inverse(T_true) @ T_est)
    return MotionErrors(index, xi, T_true, T_est, log.column("dt_s")[index])


def check_target(target: str) -> str:
    """The target's name, or GpvoError: ``frame``, ``window:1s``, ``length:1m`` (any size) or ``position``."""
    Window.of(target)
    return target


def motion_targets(records: Sequence[VoRecord], truth: TruthLog) -> tuple[Array, NDArray[np.bool_]]:
    """Errors ``xi = Log(T_true^-1 T_est)`` (N, 6) of records that span ``t_prev_ns`` to ``t_ns``, and which are known.

    Known are usable motions with truth at both ends; the rest is NaN.
    """
    if not records:
        return np.zeros((0, 6)), np.zeros(0, dtype=bool)
    t_prev = np.array([r.t_prev_ns for r in records], dtype=np.int64)
    t_cur = np.array([r.t_ns for r in records], dtype=np.int64)
    start, has_start = interpolate_truth(truth, t_prev)
    end, has_end = interpolate_truth(truth, t_cur)
    known = np.array([r.usable for r in records], dtype=bool) & has_start & has_end
    xi = np.full((len(records), 6), np.nan)
    T_true = se3.inverse(start[known]) @ end[known]
    T_est = np.array([r.T_prev_cur for r in records], dtype=np.float64).reshape(-1, 4, 4)[known]
    xi[known] = se3.log(se3.inverse(T_true) @ T_est)
    return xi, known


def position_targets(
    trajectory: Array, t_ns: NDArray[np.int64], usable: NDArray[np.bool_], truth: TruthLog
) -> tuple[Array, NDArray[np.bool_]]:
    """The thesis' target: residual of the position [m] (N, 3) in the axes of the first camera, and which are known.

    ``trajectory`` (N, 4, 4) ``T_first_cam``; its first pose with truth is made equal to the truth there.
    """
    T_true, has = interpolate_truth(truth, t_ns)
    if not has.any():
        raise GpvoError("no frame has ground truth")
    first = int(np.argmax(has))
    T_first_world = trajectory[first] @ se3.inverse(T_true[first])
    residual = trajectory[:, :3, 3] - (T_first_world @ T_true)[:, :3, 3]
    known = has & usable
    return np.where(known[:, None], residual, np.nan), known
