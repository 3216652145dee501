"""What VO and an IMU both measure of one motion: how it turns, how its force changes, and by how much their clocks
differ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from gpvo.filters.run import Flight
from gpvo.geometry import se3
from gpvo.stats.series import integral, interpolated
from gpvo.types import Array, ImuLog, VoRecord

MIN_ROTATIONS = 10
MIN_ROTATION_RAD = 0.02
"""Rms rotation of all motions together below which rotation says nothing."""
_LONGEST_S = 1.0  # of a motion, unless frames are slower
_MIN_POINTS = 5  # of a cubic
_LATEST_S, _STEP_S = 0.2, 0.005  # shifts of the clock that are tried
_SHIFT_S = 1.5 * _STEP_S  # one step may be chance
_MIN_CORRELATION = 0.7
_LESS_UNEXPLAINED = 0.7  # of the variance, as a factor


@dataclass(frozen=True)
class ClockShift:
    """By how much the IMU's stamps are late [s], with the correlation of the rotations as given and so shifted."""

    shift_s: float
    given: float
    shifted: float

    @property
    def at_limit(self) -> bool:
        """Whether it is the largest that is tried, so that they may be later."""
        return abs(self.shift_s) > _LATEST_S - 0.5 * _STEP_S


class Rotations:
    """``vo`` (M, 3): rotation vectors of VO's motions, in IMU axes [rad], and those of the gyroscope between the same
    stamps, ``dt_s`` (M,) apart.

    Motions within ``margin_s`` of the ends of the IMU's log are left out.
    """

    def __init__(self, flight: Flight, imu: ImuLog, margin_s: float = 0.0) -> None:
        R_imu_cam = np.eye(3) if flight.T_imu_cam is None else flight.T_imu_cam[:3, :3]
        first, last = imu.t_ns[0] + round(margin_s * 1e9), imu.t_ns[-1] - round(margin_s * 1e9)
        used = [r for r in flight.records if r.usable and np.isfinite(r.T_prev_cur).all() and r.dt_s > 0]
        longest_s = max(_LONGEST_S, 1.5 * float(np.median([r.dt_s for r in used]))) if used else 0.0
        used = [r for r in used if r.dt_s < longest_s and first <= r.t_prev_ns and r.t_ns <= last]
        T = np.array([r.T_prev_cur[:3, :3] for r in used]).reshape(-1, 3, 3)
        self.vo: Array = se3.so3_log(T) @ R_imu_cam.T
        self._ends = [np.array([(getattr(r, n) - imu.t_ns[0]) * 1e-9 for r in used]) for n in ("t_ns", "t_prev_ns")]
        self.dt_s: Array = self._ends[0] - self._ends[1]
        self._t = (imu.t_ns - imu.t_ns[0]) * 1e-9
        self._turned = integral(imu.gyro_radps, self._t)

    def __len__(self) -> int:
        return len(self.vo)

    def gyro(self, late_s: float = 0.0) -> Array:
        """(M, 3) of the integrated gyroscope [rad], its stamps taken to be late by ``late_s``."""
        end, start = (interpolated(t_s + late_s, self._t, self._turned) for t_s in self._ends)
        return end - start


def about_their_means(vo: Array, gyro: Array) -> tuple[Array, Array]:
    """Both rotations (M, 3) less their means, without the largest twentieth of VO's, which may be failures."""
    size = np.linalg.norm(vo, axis=1)
    keep = size <= np.quantile(size, 0.95)
    return vo[keep] - vo[keep].mean(axis=0), gyro[keep] - gyro[keep].mean(axis=0)


def clock_shift(flight: Flight, imu: ImuLog) -> ClockShift | None:
    """The shift of the IMU's clock, up to 0.2 s, by which it turns as VO does; None where that is no clear gain."""
    turns = Rotations(flight, imu, _LATEST_S)
    if len(turns) < MIN_ROTATIONS:
        return None
    shifts = np.arange(-round(_LATEST_S / _STEP_S), round(_LATEST_S / _STEP_S) + 1) * _STEP_S
    pairs = [about_their_means(turns.vo, turns.gyro(s)) for s in shifts]
    if (pairs[0][0] ** 2).sum() < MIN_ROTATION_RAD**2:
        return None
    correlation = np.array([(a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-300) for a, b in pairs])
    best, given = int(np.argmax(correlation)), float(correlation[len(shifts) // 2])
    found = ClockShift(float(shifts[best]), given, float(correlation[best]))
    is_clear = found.shifted > _MIN_CORRELATION and 1 - found.shifted**2 < _LESS_UNEXPLAINED * (1 - given**2)
    return found if is_clear and abs(found.shift_s) > _SHIFT_S else None


def jerks(flight: Flight, imu: ImuLog, window_s: float) -> tuple[Array, Array]:
    """VO's jerk (M, 3) and the slope of the specific force (M, 3, 3, 3) [m/s^3] in camera axes at the start of each
    window: [m, :, i, j] is that of the force that the log calls j, where it lies along axis i of the IMU.

    VO's motion is taken to be a cubic over ``window_s``.
    """
    R_cam_imu = np.eye(3) if flight.T_imu_cam is None else flight.T_imu_cam[:3, :3].T
    t_imu = (imu.t_ns - imu.t_ns[0]) * 1e-9
    impulse = integral(imu.acc_mps2, t_imu)
    found = []
    for window in _unbroken(flight.records, window_s):
        t = np.array([(r.t_ns - imu.t_ns[0]) * 1e-9 for r in window])
        if t[0] < 0 or t[-1] > t_imu[-1] or len(t) < _MIN_POINTS:
            continue
        T = np.array(list(accumulate((r.T_prev_cur for r in window[1:]), np.matmul, initial=np.eye(4))))
        middle = 0.5 * (t[1:] + t[:-1])
        felt = np.diff(interpolated(t, t_imu, impulse), axis=0) / np.diff(t)[:, None]
        force = (T[1:, :3, :3] @ R_cam_imu)[..., None] * felt[:, None, None]
        slope = np.polyfit(middle - t[0], force.reshape(len(felt), 27), 1)[0]
        found.append((6.0 * np.polyfit(t - t[0], T[:, :3, 3], 3)[0], slope))
    return np.array([f[0] for f in found]).reshape(-1, 3), np.array([f[1] for f in found]).reshape(-1, 3, 3, 3)


def _unbroken(records: Sequence[VoRecord], window_s: float) -> Iterator[list[VoRecord]]:
    """Windows of usable records each of which starts where the one before ended."""
    window: list[VoRecord] = []
    for record in records:
        good = record.usable and bool(np.isfinite(record.T_prev_cur).all())
        if window and not (good and record.t_prev_ns == window[-1].t_ns):
            window = []
        window.append(record)
        if (record.t_ns - window[0].t_ns) * 1e-9 >= window_s:
            yield window
            window = [record]
