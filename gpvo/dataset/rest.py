"""Where a vehicle stands and its truth does not: what the truth then says of odometry's error is the truth's own.

Satellite positions wander by decimetres while a car waits at a light, and odometry, which sees that nothing moves,
would be charged with it. Whether the vehicle stands is said by picture and IMU together: odometry that is blind to a
motion does not deceive a gyroscope.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.align import interpolate_truth
from gpvo.types import Array, StereoCamera, TruthLog, VoLog, VoRecord


@dataclass(frozen=True)
class RestTest:
    """When a vehicle counts as standing: for how long at least, the image motion [px] up to which a picture is at rest,
    and limits on the spread of the IMU; and the image motion that a truth must claim to contradict it.

    Small gyroscopes have 0.0015 to 0.0035 rad/s of noise at 200 Hz; on the road, cars are seldom below 0.007 rad/s for
    a second (KITTI). The limit on accelerations lets an engine idle.
    """

    still_s: float = 1.0
    motion_px: float = 1.0
    truth_px: float = 2.0
    gyro_std_radps: float = 0.005
    acc_std_mps2: float = 0.5


def wandering_waits(log: VoLog, truth: TruthLog, test: RestTest | None = None) -> NDArray[np.int64]:
    """(W, 2) times [ns] of the first and the last frame of waits during which the truth moves.

    Over a wait, odometry moves by less than ``motion_px`` of the picture and the IMU is still; the truth moves where
    its motion would be more than ``truth_px``. Without a camera, or an IMU in the log, nothing is called a wait.
    """
    if log.camera is None:
        return np.zeros((0, 2), dtype=np.int64)
    test, found = test or RestTest(), []
    T_est, (T_true, known) = log.trajectory(), interpolate_truth(truth, log.t_ns)
    for first, last in _waits(log, T_est, test):
        span = slice(first, last + 1)
        if known[span].all() and _image_motion_px(T_true[span], log.records[last], log.camera) > test.truth_px:
            found.append(log.t_ns[[first, last]])
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def in_waits(records: Sequence[VoRecord], waits: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) which motions, or windows of motions, share time with one of the waits (W, 2)."""
    start = np.array([r.t_prev_ns for r in records], dtype=np.int64)[:, None]
    end = np.array([r.t_ns for r in records], dtype=np.int64)[:, None]
    return np.asarray(((start < waits[:, 1]) & (end > waits[:, 0])).any(axis=1), dtype=np.bool_)


def _waits(log: VoLog, T_est: Array, test: RestTest) -> list[tuple[int, int]]:
    """First and last frame of the longest stretches at rest, one after the other."""
    assert log.camera is not None
    records, spread, found, first = log.records, _Spread(log.records), [], 0
    while first < len(records):
        last = first
        while last + 1 < len(records) and records[last + 1].usable:
            moved_px = _image_motion_px(T_est[first : last + 2], records[last + 1], log.camera)
            gyro, acc = spread.over(first + 1, last + 1)
            # Written so that what is unknown, NaN, is not at rest; an accelerometer may be missing.
            if not (moved_px <= test.motion_px and gyro <= test.gyro_std_radps) or acc > test.acc_std_mps2:
                break
            last += 1
        waited = (records[last].t_ns - records[first].t_ns) * 1e-9 >= test.still_s
        if waited:
            found.append((first, last))
        first = last + 1 if waited else first + 1
    return found


class _Spread:
    """Standard deviation of the IMU over stretches of records, from the mean and deviation that each knows."""

    def __init__(self, records: Sequence[VoRecord]) -> None:
        unknown = np.full(3, np.nan)

        def column(name: str) -> Array:
            return np.array([unknown if (v := getattr(r, name)) is None else v for r in records]).reshape(-1, 3)

        mean = np.hstack([column("imu_gyro_mean_radps"), column("imu_acc_mean_mps2")])
        std = np.hstack([column("imu_gyro_std_radps"), column("imu_acc_std_mps2")])
        self._mean, self._square = mean, mean**2 + std**2

    def over(self, first: int, last: int) -> tuple[float, float]:
        """Of gyroscope and accelerometer, the worst axis, over the records ``first`` to ``last``; NaN where unknown."""
        span = slice(first, last + 1)
        variance = self._square[span].mean(axis=0) - self._mean[span].mean(axis=0) ** 2
        std = np.sqrt(np.maximum(variance, 0.0))
        return float(std[:3].max()), float(std[3:].max())


def _image_motion_px(T_world_cam: Array, seen: VoRecord, camera: StereoCamera) -> float:
    """Image motion [px] between the extremes of n positions (n, 4, 4), in the axes of the first, of the near points:
    ``f / Z (t_xy - (x, y) t_z)``, in the mean square over image coordinates (x, y) of the spread seen."""
    t = np.ptp((T_world_cam[:, :3, 3] - T_world_cam[0, :3, 3]) @ T_world_cam[0, :3, :3], axis=0)
    forward = np.square([seen.spread_u, seen.spread_v]).sum() * t[2] ** 2
    return float(np.sqrt(t[0] ** 2 + t[1] ** 2 + forward) * seen.disparity_p90_px / camera.baseline_m)
