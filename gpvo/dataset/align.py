"""Putting ground truth beside a log: interpolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.types import Array, TruthLog

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
