"""What the model learns: the error of each motion, of a window of motions, or the residual of a position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.align import interpolate_truth
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.online.observer import Window
from gpvo.types import Array, TruthLog, VoRecord


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
