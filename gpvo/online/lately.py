"""How fast, and how different from the motions before: in plain numbers, as arrays of three are all overhead."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gpvo.geometry import se3
from gpvo.types import Array, VoRecord

TREND_S = 1.0
"""Time constant of the running means that the trends are measured against [s]."""

AGILITY_S = 0.5
"""Time constant of the running mean of the squared jerk [s]."""
_STILL = 1e-3


def twist(record: VoRecord) -> Array:
    """(6,) velocity of the camera over the motion [m/s, rad/s]; NaN where there is no motion."""
    global _latest
    latest = _latest
    if latest is not None and latest[0] is record:
        return latest[1]
    moves = record.usable and record.dt_s > 0
    out = se3.log(record.T_prev_cur) / record.dt_s if moves else np.full(6, np.nan)
    out.setflags(write=False)
    _latest = (record, out)
    return out


# Several groups and the slip detector ask for the twist of one record in turn.
_latest: tuple[VoRecord, Array] | None = None


def log_of(value: float) -> float:
    """Natural logarithm; NaN where there is none."""
    return math.log(value) if value > 0 else math.nan


def lengths(rate: Sequence[float]) -> tuple[float, float]:
    """Of the translation's and the rotation's half of a twist or its derivative."""
    return math.hypot(*rate[:3]), math.hypot(*rate[3:])


class Trend:
    """Change against the motion before and against running means of the last second: linear and angular acceleration,
    log of the inliers, log of the reprojection RMS, brightness."""

    def __init__(self) -> None:
        self._twist: list[float] | None = None
        self._t_ns = 0
        self._mean: list[float] = []

    def __call__(self, r: VoRecord) -> Sequence[float]:
        """The five of the next record."""
        if not r.usable:
            return (math.nan,) * 5
        now = twist(r).tolist()
        level = [log_of(r.n_inliers), log_of(r.reproj_rms_px), float(r.brightness)]
        out = [math.nan] * 5
        if self._twist is not None:
            # A clock may be set back: a trend then begins anew.
            step_s = max((r.t_ns - self._t_ns) * 1e-9, 1e-6)
            change = [new - mean for new, mean in zip(level, self._mean)]
            out = [*lengths([(b - a) / step_s for a, b in zip(self._twist, now)]), *change]
            gain = -math.expm1(-step_s / TREND_S)
            level = [new if c != c else mean + gain * c for new, mean, c in zip(level, self._mean, change)]
        self._twist, self._t_ns, self._mean = now, r.t_ns, level
        return out


class Agility:
    """Logs of how fast the vehicle moves and turns, and of the jerk of its velocity: now, and recently on average.

    A vehicle moves smoothly from frame to frame, so most of the jerk is VO's own noise.
    """

    def __init__(self) -> None:
        self._before: list[list[float]] = []
        self._square = [math.nan, math.nan]

    def __call__(self, r: VoRecord) -> Sequence[float]:
        """The six of the next record: speed, turn rate, both jerks, both lately."""
        if not r.usable or r.dt_s <= 0:
            self._before = []
            return (math.nan,) * 6
        now, jerk = twist(r).tolist(), (math.nan, math.nan)
        if len(self._before) == 2:
            square_s = r.dt_s * r.dt_s
            jerk = lengths([(c - 2.0 * b + a) / square_s for a, b, c in zip(*self._before, now)])
            gain = -math.expm1(-r.dt_s / AGILITY_S)
            self._square = [j * j if q != q else q + gain * (j * j - q) for q, j in zip(self._square, jerk)]
        self._before = [*self._before[-1:], now]
        return [math.log(v + _STILL) for v in (*lengths(now), *jerk, *map(math.sqrt, self._square))]
