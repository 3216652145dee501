"""Waits during which the vehicle stands still but its truth does not: the apparent error of odometry is the truth's.

Satellite positions wander by decimetres while a car waits at a light, and odometry, which sees that nothing moves,
would be blamed for it. Image and IMU together decide whether the vehicle stands still: a motion to which odometry is
blind does not escape a gyroscope.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.errors import interpolate_truth
from gpvo.types import Array, Status, StereoCamera, TruthLog, VoLog, VoRecord
from gpvo.vo.imu_moments import ImuMoments

STILL_S = 1.0
"""So long a vehicle must stand at least for a wait."""
STILL_PX, TRUTH_PX = 1.0, 2.0
"""Image motion up to which an image is at rest, and that a truth must claim to contradict it."""
GYRO_STD_RADPS, ACC_STD_MPS2 = 0.005, 0.5
"""Spread up to which an IMU is at rest. Small gyroscopes have 0.0015 to 0.0035 rad/s of noise at 200 Hz; on the road,
cars are seldom below 0.007 rad/s for a second (KITTI). The limit on accelerations lets an engine idle."""


def wandering_waits(log: VoLog, truth: TruthLog) -> NDArray[np.int64]:
    """(W, 2) times [ns] of the first and the last frame of waits during which the truth moves.

    Over a wait, odometry moves by less than ``STILL_PX`` of the image and the IMU is still; the truth moves where
    its motion would be more than ``TRUTH_PX``. Without a camera, or an IMU in the log, nothing is called a wait.
    """
    if log.camera is None:
        return np.zeros((0, 2), dtype=np.int64)
    found, (T_true, known) = [], interpolate_truth(truth, log.t_ns)
    for first, last in _waits(log, log.trajectory(), log.camera):
        span = slice(first, last + 1)
        if known[span].all() and _image_motion_px(_extent(T_true[span]), log.records[last], log.camera) > TRUTH_PX:
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
    return replace(log, records=marked)


def _waits(log: VoLog, T_est: Array, camera: StereoCamera) -> list[tuple[int, int]]:
    """First and last frame of the longest stretches at rest, one after the other."""
    sensed, found, first = [ImuMoments.of_record(r) for r in log.records], [], 0
    while first < len(log) - 1:
        last = _rests_until(first, log, T_est, sensed, camera)
        if (log.records[last].t_ns - log.records[first].t_ns) * 1e-9 >= STILL_S:
            found.append((first, last))
            first = last
        first += 1
    return found


def _rests_until(first: int, log: VoLog, T_est: Array, sensed: Sequence[ImuMoments], camera: StereoCamera) -> int:
    """The last frame up to which the vehicle stands from the frame ``first`` on."""
    low, high, moments = np.zeros(3), np.zeros(3), ImuMoments.of(None)
    for k in range(first + 1, len(log)):
        here = (T_est[k, :3, 3] - T_est[first, :3, 3]) @ T_est[first, :3, :3]
        low, high, moments = np.minimum(low, here), np.maximum(high, here), moments.with_later(sensed[k])
        moved_px = _image_motion_px(high - low, log.records[k], camera)
        gyro, acc = np.sqrt(moments.variance).reshape(2, 3).max(axis=1)
        # Written so that what is unknown, NaN, is not at rest; an accelerometer may be missing.
        still = moved_px <= STILL_PX and gyro <= GYRO_STD_RADPS
        if not (log.records[k].usable and still) or acc > ACC_STD_MPS2:
            return k - 1
    return len(log) - 1


def _extent(T_world_cam: Array) -> Array:
    """(3,) how far positions (n, 4, 4) spread along the axes of the first."""
    return np.ptp((T_world_cam[:, :3, 3] - T_world_cam[0, :3, 3]) @ T_world_cam[0, :3, :3], axis=0)


def _image_motion_px(extent_m: Array, seen: VoRecord, camera: StereoCamera) -> float:
    """Image motion [px] that translations (3,) along the camera's axes make of the near points seen:
    ``f / Z (t_xy - (x, y) t_z)``, in the mean square over image coordinates (x, y) of the spread seen."""
    x, y, z = extent_m
    forward = (seen.spread_u**2 + seen.spread_v**2) * z**2
    return float(np.sqrt(x**2 + y**2 + forward) * seen.disparity_p90_px / camera.baseline_m)
