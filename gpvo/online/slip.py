"""Is this motion possible at all? Slips are caught from what is known at the time, before any truth is seen.

The implied acceleration is compared with what the vehicle can do. Odometry's own noise, which enters with the square of
the frame rate, raises the bound to eight times the median of what was seen, but to no more than four times the
vehicle's. Above 33 Hz the change of velocity is compared with what the vehicle can do in 30 ms: odometry that is
propagated at 200 Hz is corrected by millimetres from frame to frame. Disagreement with a gyro is compared with a high
quantile of it, extrapolated from the history's upper tail (B. M. Hill, "A simple general approach to inference about
the tail of a distribution", 1975; quantile after I. Weissman, 1978).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from gpvo.geometry import se3
from gpvo.online.lately import lengths, twist
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, Status, Vehicle, VoLog, VoRecord

FALSE_FLAG_RATE = 1e-6
"""Desired share of good motions that are called impossible."""

_NOISE_MEDIANS = 8.0
_MOST_NOISE = 4.0  # times the vehicle's bound
_LEAST_STEP_S = 0.03
_GYRO_TRUST_RADPS = 0.05  # Disagreement with a gyro of ordinary bias and scale error that is always believed.
_HISTORY = 1000
_ENOUGH = 50  # Fewer motions do not show a tail: then tail index _PRIOR_TAIL and the median stand in.
_PRIOR_TAIL = 3.0
_TAIL_SHARE = 0.1
_PATIENCE_S = 1.0
REASON = "implausible motion"


def _is_beyond(value: float, history: deque[float], vehicle: float) -> bool:
    """Whether it exceeds what a vehicle can do, and what odometry's noise explains, which is unknown at first; a
    history of failures raises the bound fourfold at most."""
    if value <= vehicle:
        return False
    noise = _NOISE_MEDIANS * float(np.median(history)) if len(history) >= _ENOUGH else math.inf
    return value > min(max(vehicle, noise), _MOST_NOISE * vehicle)


def tail_quantile(history: Array, rate: float = FALSE_FLAG_RATE) -> float:
    """Value that a new draw exceeds with probability ``rate``, extrapolated from positive draws (n,). inf for n < 5."""
    x = np.sort(np.asarray(history, dtype=np.float64))
    n = len(x)
    if n < 5:
        return math.inf
    if n < _ENOUGH:
        return float(np.median(x) * (0.5 / rate) ** (1 / _PRIOR_TAIL))
    k = int(n * _TAIL_SHARE)
    edge = max(x[-k - 1], 1e-12)
    tail_index = 1.0 / max(float(np.log(np.maximum(x[-k:], edge) / edge).mean()), 1e-3)
    return float(edge * (_TAIL_SHARE / rate) ** (1 / min(max(tail_index, 2.0), 8.0)))


class SlipDetector:
    """Marks as ``lost`` the motions that the vehicle cannot have made.

    Each motion is compared with the last believed one, however often another velocity repeats itself; if that one is
    more than a second away, or the clock was set, it starts afresh.
    """

    def __init__(self, vehicle: Vehicle | None = None) -> None:
        self._vehicle = vehicle or Vehicle()
        self._linear: deque[float] = deque(maxlen=_HISTORY)
        self._angular: deque[float] = deque(maxlen=_HISTORY)
        self._gyro: deque[float] = deque(maxlen=_HISTORY)
        self._anchor: tuple[float, Array] | None = None
        self.expected: Array | None = None
        """(6,) velocity expected of the latest motion, the last one believed; None before there is one."""
        self.age_s = 0.0
        """How long before the middle of the latest motion that velocity was measured."""

    def step(self, record: VoRecord) -> VoRecord:
        """The record, ``lost`` if its motion is impossible. Call once per record, in time order."""
        record = _unflagged(record)
        middle_s = (record.t_ns + record.t_prev_ns) * 0.5e-9
        if self._anchor is None:
            self.expected, self.age_s = None, 0.0
        else:
            self.expected, self.age_s = self._anchor[1], max(middle_s - self._anchor[0], 0.0)
        if not record.usable or record.dt_s <= 0:
            return record
        now = twist(record)
        if self._anchor is None or abs(middle_s - self._anchor[0]) > _PATIENCE_S:
            self._anchor = (middle_s, now)
            return record
        before_s, before = self._anchor
        change = lengths(((now - before) / max(middle_s - before_s, _LEAST_STEP_S)).tolist())
        disagreement = self._gyro_disagreement(record, now)
        problem = self._problem(record, change, disagreement)
        if problem:
            return record.with_status(Status.LOST, f"{REASON}: {problem}")
        self._linear.append(change[0])
        self._angular.append(change[1])
        if disagreement is not None:
            self._gyro.append(disagreement)
        self._anchor = (middle_s, now)
        return record

    def jump(self, T_prev_cur: Array, dt_s: float) -> Array:
        """(6,) error of the latest motion (4, 4) [m, rad] if the vehicle has kept the velocity expected of it."""
        if self.expected is None:
            return np.zeros(6)
        return se3.log(se3.inverse(se3.exp(self.expected * dt_s)) @ T_prev_cur)

    def _problem(self, record: VoRecord, change: tuple[float, float], disagreement: float | None) -> str:
        acc = record.imu_acc_mean_mps2
        # Whatever the attitude, a camera accelerates by no more than specific force plus gravity.
        felt = 0.0 if acc is None or not all(map(math.isfinite, acc)) else STANDARD_GRAVITY_MPS2 + math.hypot(*acc)
        if change[0] > felt and _is_beyond(change[0], self._linear, self._vehicle.max_acceleration_mps2):
            return f"acceleration of {change[0]:.3g} m/s^2"
        if disagreement is not None:
            if disagreement > _GYRO_TRUST_RADPS and disagreement > tail_quantile(np.array(self._gyro)):
                return f"{disagreement:.3g} rad/s from the gyro"
        elif _is_beyond(change[1], self._angular, self._vehicle.max_turn_radps2):
            return f"angular acceleration of {change[1]:.3g} rad/s^2"
        return ""

    @staticmethod
    def _gyro_disagreement(record: VoRecord, now: Array) -> float | None:
        gyro = record.imu_gyro_mean_radps
        if gyro is None or not all(map(math.isfinite, gyro)):
            return None
        return abs(math.hypot(*now[3:]) - math.hypot(*gyro))


def _unflagged(record: VoRecord) -> VoRecord:
    """A record that an earlier detector flagged, without the flag: flagging twice must change nothing."""
    before, found, _ = record.reason.partition(REASON)
    if record.status is not Status.LOST or not found:
        return record
    return replace(record, status=Status.DEGRADED if before else Status.OK, reason=before.removesuffix("; "))


def flag_slips(log: VoLog) -> VoLog:
    """The log with impossible motions called ``lost``; causal, and the same when applied twice."""
    detector = SlipDetector(log.vehicle)
    return log.judged_as(map(detector.step, log))
