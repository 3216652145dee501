"""Which IMU samples are plausible: in the range of a sensor, consistent with earlier ones, noisy, and on one clock.

What cannot be is missing, not wrong: the filter bridges it and is less sure (see ``Timeline``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.stats.series import Doubt
from gpvo.types import Array, ImuLog

MOST_RADPS, MOST_MPS2 = 30.0, 150.0
"""A reading beyond is saturation or a fault: usual sensors end at 2000 deg/s and 16 g, and VO long before."""
LONGEST_GAP_S = 1.0
"""A sample that comes later is believed when the next one confirms its clock."""
_LIMITS = np.repeat([MOST_RADPS, MOST_MPS2], 3)
_LEAST_STEP = np.repeat([3.0, 30.0], 3)  # [rad/s, m/s^2] that two samples may always differ by
_STUCK = 8  # samples with the very same reading: a sensor has noise, and held ones repeat two or four times
_TIMES_USUAL = 20.0  # the usual step that they may differ by, where that is more
_FORGET = 0.02


class ImuGuard:
    """Judges one sample after the other. What looks odd beside the sample before is believed when the next one is
    like it: a true blow costs one sample, and so does a clock that was set."""

    def __init__(self) -> None:
        self._t_ns: int | None = None
        self._sample = np.zeros(6)
        self._usual = np.zeros(6)
        self._reading, self._repeats = np.zeros(6), 0
        self._doubt: Doubt[tuple[int, Array]] = Doubt()

    def judge(self, t_ns: int, sample: Array) -> str:
        """Empty where the sample (6,), gyroscope first, can be used, else what it is: a name to count it by."""
        if not np.isfinite(sample).all():
            return "imu_not_finite"
        if (np.abs(sample) > _LIMITS).any():
            return "imu_out_of_range"
        if self._is_stuck(sample):
            return "imu_stuck"
        if self._t_ns is not None:
            problem = self._beside(t_ns, sample, self._t_ns, self._sample)
            if problem == "imu_repeated" or (problem and not self._doubt.is_settled_by((t_ns, sample), self._agree)):
                return problem
            if not problem:
                self._usual += _FORGET * (np.minimum(np.abs(sample - self._sample), _LEAST_STEP) - self._usual)
        self._t_ns, self._sample = t_ns, sample
        self._doubt.clear()
        return ""

    def _is_stuck(self, sample: Array) -> bool:
        """Whether a sensor that had noise says the same again and again."""
        self._repeats = self._repeats + 1 if (sample == self._reading).all() else 0
        self._reading = sample
        return self._repeats >= _STUCK and bool(self._usual.any())

    def _agree(self, before: tuple[int, Array], now: tuple[int, Array]) -> bool:
        return not self._beside(*now, *before)

    def _beside(self, t_ns: int, sample: Array, before_ns: int, before: Array) -> str:
        """What is odd about a sample after the one before."""
        step_s = (t_ns - before_ns) * 1e-9
        if step_s <= 0:
            return "imu_repeated" if step_s == 0 else "imu_out_of_order"
        if step_s > LONGEST_GAP_S:
            return "imu_stamp_ahead"
        # Over a gap readings may become anything.
        far = np.abs(sample - before) > np.maximum(_LEAST_STEP, _TIMES_USUAL * self._usual)
        return "imu_jump" if far.any() and step_s < 0.05 else ""


def usable(imu: ImuLog) -> NDArray[np.bool_]:
    """(N,) which samples of a log are finite, in range and on one growing clock."""
    both = np.concatenate([imu.gyro_radps, imu.acc_mps2], axis=1)
    with np.errstate(invalid="ignore"):
        good = (np.abs(both) <= _LIMITS).all(axis=1)
    return on_one_clock(imu.t_ns, good)


def on_one_clock(t_ns: NDArray[np.int64], good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Those of the ``good`` samples (N,) whose stamps (N,) grow; one far ahead is left out, not those after it."""
    if len(t_ns) < 2:
        return good
    step = np.diff(t_ns)
    alone = (np.append(0, step[:-1]) > LONGEST_GAP_S * 1e9) & (step < 0)
    good = good & np.append(~alone, True)
    never = np.iinfo(np.int64).min
    newest = np.maximum.accumulate(np.where(good, t_ns, never))
    return good & (t_ns > np.append(never, newest[:-1]))


def cleaned(imu: ImuLog) -> ImuLog:
    """The log without samples that cannot be used."""
    good = usable(imu)
    return ImuLog(imu.t_ns[good], imu.gyro_radps[good], imu.acc_mps2[good], imu.noise)
