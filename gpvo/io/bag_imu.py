"""The IMU of a bag: one topic, or two where a driver publishes gyroscope and accelerometer apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.io.bag_reader import messages, open_bag, stamp_ns
from gpvo.io.imu import make_imu
from gpvo.types import Array, ImuLog

Stamps = NDArray[np.int64]


def imu_topics(topics: list[str]) -> list[tuple[str, ...]]:
    """What can serve as IMU, the best first: whole topics, then gyroscopes with the accelerometer beside them.

    realsense-ros publishes ``/camera/gyro/sample`` and ``/camera/accel/sample``, each with the other's fields zero.
    """
    pairs = []
    for gyro, acc in (("gyro", "accel"), ("Gyro", "Accel")):
        pairs += [(t, t.replace(gyro, acc)) for t in topics if gyro in t and t.replace(gyro, acc) in topics]
    halves = {topic for pair in pairs for topic in pair}
    return [*((t,) for t in topics if t not in halves), *pairs]


def read_imu(
    path: Path, candidates: list[tuple[str, ...]], shift_s: float, remark: Callable[[str], None]
) -> ImuLog | None:
    """The first of the candidates that measures rates, in the camera's time by ``t_imu = t_cam + shift_s``.

    An accelerometer of its own is interpolated onto the gyroscope's stamps, inside the time that both cover.
    ``acc_mps2`` is NaN throughout where nothing measured it.
    """
    for topics in candidates:
        t_ns, data = _samples(path, topics[0])
        if len(topics) == 2:
            t_ns, data = _with_accelerometer(t_ns, data, *_samples(path, topics[1]))
        no_acc = bool(np.isnan(data[:, 3:]).all())
        good = np.isfinite(data[:, :3]).all(axis=1) & (no_acc | np.isfinite(data[:, 3:]).all(axis=1))
        if not good.any():
            when = f" while '{topics[1]}' runs" if len(topics) == 2 else ""
            remark(f"'{topics[0]}' not used as IMU: it measures no rates{when}")
            continue
        if no_acc:
            remark(f"'{topics[0]}' is a gyroscope only: it measures no acceleration")
        elif len(topics) == 2:
            remark(f"IMU of '{topics[0]}', with '{topics[1]}' interpolated onto its stamps")
        return make_imu(t_ns[good], data[good], shift_s=shift_s, remark=remark)
    return None


def _samples(path: Path, topic: str) -> tuple[Stamps, Array]:
    """Stamps (N,) and samples (N, 6), gyro first; NaN where the topic does not measure.

    That is where a covariance begins with -1, as ROS has it, or nothing but exact zeros came.
    """
    stamps, rows = [], []
    with open_bag(path) as reader:
        for _, m in messages(reader, [topic]):
            w, a = m.angular_velocity, m.linear_acceleration
            stamps.append(stamp_ns(m))
            covariances = (m.angular_velocity_covariance[0], m.linear_acceleration_covariance[0])
            rows.append((w.x, w.y, w.z, a.x, a.y, a.z, *covariances))
    data = np.array(rows, dtype=np.float64).reshape(-1, 8)
    for values, stated in ((data[:, :3], data[:, 6]), (data[:, 3:6], data[:, 7])):
        if np.all(stated == -1) or not values.any():
            values[:] = np.nan
    return np.array(stamps, dtype=np.int64), data[:, :6]


def _with_accelerometer(t_ns: Stamps, data: Array, t_acc_ns: Stamps, acc_data: Array) -> tuple[Stamps, Array]:
    good = np.isfinite(acc_data[:, 3:]).all(axis=1)
    t_acc, first = np.unique(t_acc_ns[good], return_index=True)
    if len(t_acc) == 0:
        return t_ns, data
    acc = acc_data[good, 3:][first]
    inside = (t_ns >= t_acc[0]) & (t_ns <= t_acc[-1])
    t, out = t_ns[inside], data[inside].copy()
    # From the first stamp on: nanoseconds of an epoch are finer than a float.
    out[:, 3:] = np.stack([np.interp(t - t_acc[0], t_acc - t_acc[0], acc[:, i]) for i in range(3)], axis=1)
    return t, out
