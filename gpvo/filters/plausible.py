"""Which IMU samples are plausible: in the range of a sensor, consistent with earlier ones, noisy, and on one clock.

What cannot be is missing, not wrong: the filter bridges it by the likeliest readings and is less sure
(:class:`Samples`).
"""

from __future__ import annotations

import bisect
import math

import numpy as np
from numpy.typing import NDArray

from gpvo.stats.series import Doubt, integral, interpolated
from gpvo.types import MOST_MPS2, MOST_RADPS, Array, ImuLog

LONGEST_GAP_S = 1.0
"""A sample that comes later is believed when the next one confirms its clock."""
_LIMITS = np.repeat([MOST_RADPS, MOST_MPS2], 3)
_LEAST_STEP = np.repeat([3.0, 30.0], 3)  # [rad/s, m/s^2] that two samples may always differ by
_STUCK = 8  # samples with the very same reading: a sensor has noise, and held ones repeat two or four times
_TIMES_USUAL = 20.0  # the usual step that they may differ by, where that is more
_FORGET = 0.02
# An interval this many times the usual one, and at least this long, is a gap: from it on readings are guessed. Where
# truth may be interpolated, or a stretch be judged whole, is asked of slower data (dataset.errors, filters.start).
_GAP_FACTOR, GAP_S = 5.0, 0.05
_NEARBY = 1000  # samples that tell how far a guess over a gap may be off
_SATURATED, _NEIGHBOURS = 10, 5  # readings at the end of a range, and the values next to it that are far rarer
_LEAST_RANGE = 1.0, 15.0  # rad/s and m/s^2: no sensor ends below; a turn at one rate may, in a simulation without noise


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


def saturated(imu: ImuLog) -> NDArray[np.bool_]:
    """(N,) which samples of a log stop at the end of a sensor's range, on any axis: the largest reading is far commoner
    than those next to it. What was felt is more than they say."""
    at_end = np.zeros(len(imu.t_ns), bool)
    for reading, least in zip((imu.gyro_radps, imu.acc_mps2), _LEAST_RANGE, strict=True):
        for column in np.abs(reading).T:
            values, counts = np.unique(column[np.isfinite(column)], return_counts=True)
            next_to = counts[-1 - _NEIGHBOURS : -1]
            if len(next_to) < _NEIGHBOURS or values[-1] < least:
                continue
            if counts[-1] >= max(_SATURATED, _NEIGHBOURS * next_to.max()):
                at_end |= column == values[-1]
    return at_end


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


class Samples:
    """Stamps ``t_ns``, growing, and readings ``values`` (6,) each, gyroscope first [rad/s, m/s^2]."""

    def __init__(self) -> None:
        self.t_ns: list[int] = []
        self.values: list[Array] = []

    def copy(self) -> Samples:
        """An independent list of the same samples."""
        other = Samples()
        other.t_ns, other.values = self.t_ns.copy(), self.values.copy()
        return other

    def insert(self, t_ns: int, sample: Array) -> None:
        """Put a sample in its place."""
        i = bisect.bisect_left(self.t_ns, t_ns)
        self.t_ns.insert(i, t_ns)
        self.values.insert(i, sample)

    def reach(self, t_ns: int) -> bool:
        """Whether there is one at or past ``t_ns``."""
        return bool(self.t_ns) and self.t_ns[-1] >= t_ns

    def drop_before(self, t_ns: int) -> None:
        """Forget what comes before the last one at or before ``t_ns``, but for those nearby, once that is as many."""
        old = bisect.bisect_right(self.t_ns, t_ns) - 1 - _NEARBY
        if old > _NEARBY:
            del self.t_ns[:old], self.values[:old]

    def shortest_gap_s(self, i: int) -> float:
        """Of an interval near sample i, from which on samples are missing."""
        return max(GAP_S, _GAP_FACTOR * self.usual_step_s(i))

    def is_missing(self, i: int) -> bool:
        """Whether there is a gap before sample i, which samples that come late may fill."""
        return i > 0 and self.t_ns[i] - self.t_ns[i - 1] > 2.5e9 * self.usual_step_s(i)  # two came to show it

    def usual_step_s(self, i: int) -> float:
        """Median step near sample i, 0 where nothing tells."""
        steps = np.diff(self.t_ns[max(0, i - 100) : i + 100])
        return 1e-9 * float(np.median(steps)) if len(steps) else 0.0

    def at(self, t_ns: int, i: int) -> Array:
        """Sample at ``t_ns``, between samples i-1 and i; held beyond the ends."""
        if i == 0:
            return self.values[0]
        if i >= len(self.t_ns) or self.t_ns[i - 1] == t_ns:
            return self.values[min(i, len(self.t_ns)) - 1]
        t0, t1 = self.t_ns[i - 1], self.t_ns[i]
        share = (t_ns - t0) / (t1 - t0)
        return (1.0 - share) * self.values[i - 1] + share * self.values[i]

    def over_gap(self, i: int, start_ns: int, end_ns: int, ends: Array) -> tuple[Array, Array] | None:
        """What to take for the readings ``ends`` (2, 6) across missing samples, and by how much (6,) they may be off;
        None where none are missing.

        A gap may be crossed in several steps, a record at the end of each. Where the sample after it has not come, the
        guess is wrong the same way in all: what its error grew to by the end of this step, less what it was at its
        start. Else each step has its share of the variance, as nobody knows where the readings went between.
        """
        last_ns = self.t_ns[i - 1] if i > 0 else start_ns
        age = [(t_ns - last_ns) * 1e-9 for t_ns in (start_ns, end_ns)]
        if age[1] < GAP_S:
            return None
        shortest = self.shortest_gap_s(i)
        if age[1] < shortest:
            return None
        begun = age[0] if age[0] >= shortest else 0.0
        is_held = i == 0 or i >= len(self.t_ns)
        length_s = age[1] if is_held else (self.t_ns[i] - last_ns) * 1e-9
        guess, missed = self._guess(i, length_s, ends, is_held)
        grown = age[1] ** 2 - begun**2 if is_held else length_s * (age[1] - begun)
        return guess, missed * math.sqrt(grown) / (age[1] - age[0])

    def _guess(self, i: int, length_s: float, ends: Array, is_held: bool) -> tuple[Array, Array]:
        """Readings (2, 6) over a gap of ``length_s`` before sample i, and the rms (6,) by which such a guess misses the
        mean reading over stretches as long of the samples nearby: the line between the samples at its ends, the last
        one held where no other came, or, where that is better, the mean of those nearby."""
        near = slice(i, i + _NEARBY) if 2 * i < len(self.t_ns) else slice(max(0, i - _NEARBY), i)
        t_s, values = (np.array(self.t_ns[near]) - self.t_ns[near.start]) * 1e-9, np.array(self.values[near])
        length_s = min(length_s, 0.5 * float(t_s[-1]))
        if length_s <= 0:
            return ends, np.abs(values).max(axis=0)
        usual, total = values.mean(axis=0), integral(values, t_s)
        later = t_s[t_s + length_s <= t_s[-1]] + length_s
        begin, end = values[: len(later)], interpolated(later, t_s, values)
        mean = (interpolated(later, t_s, total) - total[: len(later)]) / length_s
        guesses = (begin if is_held else 0.5 * (begin + end), usual)
        of_line, of_mean = (np.sqrt(np.square(mean - guess).mean(axis=0)) for guess in guesses)
        # Readings at its ends that are unlike those nearby may have changed anywhere between.
        known = ends if is_held else np.array(self.values[i - 1 : i + 1])
        of_line = np.maximum(of_line, np.abs(known[1] - known[0]) / math.sqrt(12.0))
        of_mean = np.maximum(of_mean, 0.5 * np.abs(known - usual).max(axis=0))
        return np.where(of_mean < of_line, usual, ends), np.minimum(of_mean, of_line)
