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
from gpvo.types import Array, Status, StereoCamera, TruthLog, VoLog, VoRecord


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
        if known[span].all() and _image_motion_px(_extent(T_true[span]), log.records[last], log.camera) > test.truth_px:
            found.append(log.t_ns[[first, last]])
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def in_waits(records: Sequence[VoRecord], waits: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(N,) which motions, or windows of motions, share time with one of the waits (W, 2)."""
    start = np.array([r.t_prev_ns for r in records], dtype=np.int64)[:, None]
    end = np.array([r.t_ns for r in records], dtype=np.int64)[:, None]
    return np.asarray(((start < waits[:, 1]) & (end > waits[:, 0])).any(axis=1), dtype=np.bool_)


def without_wandering_truth(log: VoLog, truth: TruthLog) -> VoLog:
    """The log with what falls into such waits called lost, so that neither an error nor a sum of errors reaches over
    it; for statistics alone."""
    waits = wandering_waits(log, truth)
    if not len(waits):
        return log
    inside = in_waits(log.records, waits)
    marked = [r.with_status(Status.LOST, "truth moves at rest") if i else r for r, i in zip(log.records, inside)]
    return VoLog(marked, log.camera)


def _waits(log: VoLog, T_est: Array, test: RestTest) -> list[tuple[int, int]]:
    """First and last frame of the longest stretches at rest, one after the other."""
    records, (mean, square) = log.records, _imu_moments(log.records)
    found, first = [], 0
    while first < len(records) - 1:
        last = _rests_until(first, log, T_est, mean, square, test)
        if (records[last].t_ns - records[first].t_ns) * 1e-9 >= test.still_s:
            found.append((first, last))
            first = last
        first += 1
    return found


def _rests_until(first: int, log: VoLog, T_est: Array, mean: Array, square: Array, test: RestTest) -> int:
    """The last frame up to which the vehicle stands from the frame ``first`` on."""
    assert log.camera is not None
    low, high, sums = np.zeros(3), np.zeros(3), np.zeros((2, 6))
    for k in range(first + 1, len(log)):
        here = (T_est[k, :3, 3] - T_est[first, :3, 3]) @ T_est[first, :3, :3]
        low, high, sums = np.minimum(low, here), np.maximum(high, here), sums + (mean[k], square[k])
        moments = sums / (k - first)
        std = np.sqrt(np.maximum(moments[1] - moments[0] ** 2, 0.0))
        moved_px = _image_motion_px(high - low, log.records[k], log.camera)
        # Written so that what is unknown, NaN, is not at rest; an accelerometer may be missing.
        still = moved_px <= test.motion_px and std[:3].max() <= test.gyro_std_radps
        if not (log.records[k].usable and still) or std[3:].max() > test.acc_std_mps2:
            return k - 1
    return len(log) - 1


def _imu_moments(records: Sequence[VoRecord]) -> tuple[Array, Array]:
    """Mean and mean square (N, 6) of gyroscope and accelerometer over each record's motion; NaN where unknown."""
    unknown = np.full(3, np.nan)

    def column(name: str) -> Array:
        return np.array([unknown if (v := getattr(r, name)) is None else v for r in records]).reshape(-1, 3)

    mean = np.hstack([column("imu_gyro_mean_radps"), column("imu_acc_mean_mps2")])
    std = np.hstack([column("imu_gyro_std_radps"), column("imu_acc_std_mps2")])
    return mean, mean**2 + std**2


def _extent(T_world_cam: Array) -> Array:
    """(3,) how far positions (n, 4, 4) spread along the axes of the first."""
    return np.ptp((T_world_cam[:, :3, 3] - T_world_cam[0, :3, 3]) @ T_world_cam[0, :3, :3], axis=0)


def _image_motion_px(extent_m: Array, seen: VoRecord, camera: StereoCamera) -> float:
    """Image motion [px] that translations (3,) along the camera's axes make of the near points seen:
    ``f / Z (t_xy - (x, y) t_z)``, in the mean square over image coordinates (x, y) of the spread seen."""
    x, y, z = extent_m
    forward = (seen.spread_u**2 + seen.spread_v**2) * z**2
    return float(np.sqrt(x**2 + y**2 + forward) * seen.disparity_p90_px / camera.baseline_m)
