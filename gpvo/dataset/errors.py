"""The error of each motion against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.align import interpolate_truth
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoLog


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
