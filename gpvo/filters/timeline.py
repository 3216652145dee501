"""The filter on a clock: samples and frames as they arrive, late, twice or out of order.

IMU samples are buffered; the state is propagated to a frame's stamp when its record arrives, so the usual latency of
VO costs nothing. A record older than the newest is inserted in its place: the filter goes back to the state before
the records that follow it, and applies them again.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import Gate, Innovation, Wait
from gpvo.filters.plausible import LONGEST_GAP_S, ImuGuard
from gpvo.filters.policies import Policy
from gpvo.filters.propagation import Nominal
from gpvo.online.observer import LONGEST_STEP_S, follows
from gpvo.stats.series import Doubt, integral, interpolated
from gpvo.types import Array, MotionError, Prediction, Status, VoRecord

# An interval this many times the usual one, and at least this long, is a gap.
_GAP_FACTOR, _GAP_S = 5.0, 0.05
_NEARBY = 1000  # samples that tell how far a guess over a gap may be off
_GUESS_NS = 250_000_000  # longest step of a guess
_SILENCE_NS, _LONGEST_SILENCE_S = 4_000_000_000, 1e3  # without sample and record: no guess holds so long
_CLOCK_NS, _RARELY_SET = 150_000_000, 14.0  # shorter gaps no clock made; minus twice the log of one in a thousand
_SLOWEST_NS = 20_000_000_000  # records are no further apart, where nothing else is heard
_LONGEST_STEP_NS, _LONGEST_GAP_NS = round(LONGEST_STEP_S * 1e9), round(LONGEST_GAP_S * 1e9)


@dataclass(frozen=True)
class Step:
    """What one record did: ``outcome`` is ``used``, ``rejected``, ``lost``, ``start``, ``no_reference``,
    ``not_finite`` or ``no_covariance``; ``innovation`` is None where there was no measurement. ``nominal`` and
    ``covariance`` (B, 15, 15): the filter's after it."""

    t_ns: int
    outcome: str
    innovation: Innovation | None
    nominal: Nominal
    covariance: Array


@dataclass(frozen=True)
class _Entry:
    """A used record with the filter, clocks and reference as they were before it."""

    record: VoRecord
    noise: MotionError | None
    filter: ErrorStateFilter
    t_ns: int
    bias_ns: int
    reference_ns: int | None
    wait: Wait


def outcome_of(outcome: str, passed: bool) -> str:
    """Of a member that did or did not pass the gate, where the ``outcome`` is that of all members together."""
    return ("used" if passed else "rejected") if outcome in ("used", "rejected") else outcome


class Timeline:
    """Feeds one filter in time order, whatever order its inputs arrive in.

    Parameters
    ----------
    filter : started at ``t_ns``.
    policy : gives each record's noise.
    with_imu : False propagates by the filter's constant-velocity model.
    history_s : how far back a late record can still be put in its place; 0 keeps nothing.
    """

    def __init__(
        self,
        filter: ErrorStateFilter,
        t_ns: int,
        policy: Policy,
        *,
        gate: Gate | None = None,
        with_imu: bool = True,
        history_s: float = 2.0,
    ) -> None:
        self.filter, self.t_ns, self.policy = filter, int(t_ns), policy
        self.gate = gate or Gate()
        self.counts: Counter[str] = Counter()
        self._with_imu = with_imu
        self._history_ns = round(history_s * 1e9)
        self._history: deque[_Entry] = deque()
        self._bias_ns = self.t_ns
        self._reference_ns: int | None = self.t_ns
        self._wait = Wait.since(self.t_ns, filter.batch)
        self._newest_ns: int | None = None
        self._guard = ImuGuard()
        self._doubt: Doubt[int] = Doubt()
        self._set_back_ns: int | None = None  # first stamp of a new clock, while records of the old one may come
        self._heard_ns = self.t_ns  # stamp of the sample that came last
        self._imu_t: list[int] = []
        self._imu: list[Array] = []

    # -- inputs -----------------------------------------------------------------------------------------------

    def add_imu(self, t_ns: int, gyro_radps: Array, acc_mps2: Array) -> None:
        """Take one IMU sample: (3,) each. One that cannot be (:class:`ImuGuard`) is counted and dropped: missing."""
        sample = np.concatenate([gyro_radps, acc_mps2])
        if problem := self._guard.judge(int(t_ns), sample):
            self.counts[problem] += 1
            return
        i = bisect.bisect_left(self._imu_t, t_ns)
        again = self._imu_t[i : i + 1] == [t_ns]
        is_back = i < len(self._imu_t) and t_ns <= self._heard_ns and not self._is_missing(i)
        if again and (not is_back or np.array_equal(self._imu[i], sample)):
            self.counts["imu_repeated"] += 1
            return
        if is_back:
            # The clock was set back, and no record can be put among what came before.
            self._go_on_from(int(t_ns))
            del self._imu_t[:], self._imu[:]
            i = 0
        self._imu_t.insert(i, int(t_ns))
        self._imu.insert(i, sample)
        self._heard_ns = int(t_ns)

    def _is_missing(self, i: int) -> bool:
        """Whether there is a gap before sample i, which samples that come late may fill."""
        return i > 0 and self._imu_t[i] - self._imu_t[i - 1] > 2.5e9 * self._usual_step_s(i)  # two came to show it

    def _usual_step_s(self, i: int) -> float:
        steps = np.diff(self._imu_t[max(0, i - 100) : i + 100])
        return 1e-9 * float(np.median(steps)) if len(steps) else 0.0

    def _go_on_from(self, t_ns: int) -> None:
        """What the filter is at the newest sample holds, by another clock, two samples before ``t_ns``: of these the
        first was in doubt."""
        self.filter = self.latest()
        self.t_ns = self._bias_ns = t_ns - 2 * int(np.diff(self._imu_t[-2:]).sum())
        self._reference_ns = self._newest_ns = None
        self._wait = Wait.since(self.t_ns, self.filter.batch)
        self._history.clear()
        self._set_back_ns = t_ns
        self.counts["clock_set_back"] += 1

    def reaches(self, t_ns: int) -> bool:
        """Whether an IMU sample at or past ``t_ns`` was taken: what comes before can be interpolated."""
        return bool(self._imu_t) and self._imu_t[-1] >= t_ns

    def add_vo(self, record: VoRecord, prediction: Prediction | None = None) -> list[Step]:
        """Take one VO record; returns the steps done, more than one where later records were used again."""
        is_new = self._set_back_ns is not None and self._heard_ns - self._set_back_ns < _LONGEST_GAP_NS
        if is_new and record.t_ns - self._heard_ns > _LONGEST_GAP_NS // 2:
            self.counts["too_late"] += 1  # by the clock of before, unless such records go on coming
            return []
        self._set_back_ns = None
        if record.t_ns <= self.t_ns and self._already_seen(record.t_ns):
            self.counts["repeated"] += 1
            return []
        if self._jumps_ahead(record.t_ns):
            self.counts["stamp_ahead"] += 1
            return []
        noise = self.policy.noise(record, prediction) if record.usable else None
        if record.t_ns >= self.t_ns:
            return [self._step(record, noise)]
        again = self._rewind(record.t_ns)
        if again is None:
            self.counts["too_late"] += 1
            return []
        self.counts["reordered"] += 1
        return [self._step(record, noise), *(self._step(e.record, e.noise) for e in again)]

    def _jumps_ahead(self, t_ns: int) -> bool:
        """Whether a record comes so long after the newest that its stamp is wrong, unless the next one agrees."""
        if t_ns - self.t_ns > _LONGEST_STEP_NS:
            return not self._doubt.is_settled_by(t_ns, follows)
        self._doubt.clear()
        return False

    def _already_seen(self, t_ns: int) -> bool:
        return t_ns == self._newest_ns or any(e.record.t_ns == t_ns for e in self._history)

    def latest(self, t_ns: int | None = None) -> ErrorStateFilter:
        """The filter carried forward to ``t_ns`` (default: the newest IMU sample), leaving this one where it is."""
        target = t_ns if t_ns is not None else (self._imu_t[-1] if self._imu_t else self.t_ns)
        ahead = self.filter.copy()
        if target > self.t_ns:
            self._propagate(ahead, self.t_ns, target, Counter(), may_be_set=False)
        return ahead

    # -- one record -------------------------------------------------------------------------------------------

    def _step(self, record: VoRecord, noise: MotionError | None) -> Step:
        self._remember(record, noise)
        unmoved = self._propagate(self.filter, self.t_ns, record.t_ns, self.counts)
        self.t_ns = self._newest_ns = record.t_ns
        if noise is not None and len(noise.persistent_tau_s):
            # Since it last did, not since the last record: VO's bias goes on changing while frames are lost.
            for filter in (self.filter, *([] if unmoved is None else [unmoved])):
                filter.decay_bias((record.t_ns - self._bias_ns) * 1e-9, noise.persistent_tau_s)
            self._bias_ns = record.t_ns
        outcome, judged = self._measure(record, noise, unmoved)
        if judged is None and unmoved is not None:
            self.filter.doubt_passage(unmoved.x)
        passed, own_fault = (True, False) if judged is None else (judged.passed, judged.own_fault)
        self._wait = self._wait.after(record.t_ns, passed, own_fault)
        self.counts[outcome] += 1
        if record.is_reference:
            self.filter.clone(measured=judged is not None and noise is not None and not noise.lost)
            self._reference_ns = record.t_ns
        else:
            self.filter.forget_current()
        return Step(record.t_ns, outcome, judged, self.filter.x.copy(), self.filter.covariance.copy())

    def _measure(
        self, record: VoRecord, noise: MotionError | None, unmoved: ErrorStateFilter | None
    ) -> tuple[str, Innovation | None]:
        """``unmoved``: the filter if no time has passed; a motion that is by far likelier of that one is of a clock
        that was set."""
        if record.status in (Status.START, Status.LOST):
            return record.status.value, None
        if record.t_prev_ns != self._reference_ns:
            return "no_reference", None
        if not np.isfinite(record.T_prev_cur).all():
            return "not_finite", None
        if noise is None:
            return "no_covariance", None
        recover = self._wait.over(record.t_ns, self.gate)
        innovation = self.filter.update_motion(record.T_prev_cur, noise, self.gate, recover)
        if unmoved is not None:
            other = unmoved.update_motion(record.T_prev_cur, noise, self.gate)
            if other.passed.all() and (other.surprise + _RARELY_SET < innovation.surprise).all():
                self.filter, innovation = unmoved, other
                self.counts["clock_set_ahead"] += 1
        self.counts["recovered"] += int((recover & ~innovation.passed).any())
        return outcome_of("used", bool(innovation.passed.all())), innovation

    def _remember(self, record: VoRecord, noise: MotionError | None) -> None:
        if self._history_ns <= 0:
            self._drop_imu_before(self.t_ns)
            return
        state = (self.filter.copy(), self.t_ns, self._bias_ns, self._reference_ns, self._wait)
        self._history.append(_Entry(record, noise, *state))
        while self._history[0].record.t_ns < record.t_ns - self._history_ns:
            self._history.popleft()
        self._drop_imu_before(self._history[0].t_ns)

    def _rewind(self, t_ns: int) -> list[_Entry] | None:
        """Go back to before the first record later than ``t_ns``; returns those records in order."""
        later = [e for e in self._history if e.record.t_ns > t_ns]
        if not later or later[0].t_ns > t_ns:
            return None
        first = later[0]
        self.filter, self.t_ns, self._bias_ns = first.filter, first.t_ns, first.bias_ns
        self._reference_ns, self._wait = first.reference_ns, first.wait
        for entry in later:
            self._history.remove(entry)
        return later

    # -- time ---------------------------------------------------------------------------------------------------

    def _propagate(
        self, filter: ErrorStateFilter, start_ns: int, end_ns: int, counts: Counter[str], may_be_set: bool = True
    ) -> ErrorStateFilter | None:
        """Move the filter; where nothing was heard for a while, returns what it is if that was a clock set ahead, which
        ``may_be_set`` looks for."""
        if end_ns <= start_ns:
            return None
        if not self._with_imu:
            if end_ns - start_ns > _SLOWEST_NS:
                self._over_silence(filter, end_ns - start_ns, counts)
            else:
                filter.propagate_constant_velocity((end_ns - start_ns) * 1e-9)
            return None
        if not self._imu_t:
            raise ValueError("no IMU sample has arrived; give the timeline with_imu=False to do without")
        i = bisect.bisect_right(self._imu_t, start_ns)
        t, sample = start_ns, self._at(start_ns, i)
        unmoved, resumed_ns = None, start_ns
        while t < end_ns:
            heard_ns = min([end_ns, *self._imu_t[i : i + 1]])
            if heard_ns - t > _SILENCE_NS:
                self._over_silence(filter, heard_ns - t, counts)
                t, i = heard_ns, bisect.bisect_right(self._imu_t, heard_ns)
                sample = self._at(t, i)
                continue
            t1 = min(heard_ns, t + _GUESS_NS)
            arrived = self._imu_t[i : i + 1] == [t1]
            after = self._imu[i] if arrived else self._at(t1, i)
            dt, ends = (t1 - t) * 1e-9, np.array([sample, after])
            over = self._over_gap(i, t, t1, ends)
            ends = ends if over is None else over[0]
            if may_be_set and over is not None and t >= resumed_ns and heard_ns - t > _CLOCK_NS:
                unmoved, resumed_ns = filter.copy(), heard_ns
            filter.propagate_imu(dt, ends[:1, :3], ends[:1, 3:], ends[1:, :3], ends[1:, 3:])
            if over is not None:
                filter.doubt_readings(over[1])
                counts["imu_gaps"] += 1
            t, sample, i = t1, after, i + arrived
        if unmoved is not None:
            # Between two samples some time has passed even so: about one usual step.
            before, step_ns = unmoved.x.copy(), round(1e9 * self._usual_step_s(i))
            self._propagate(unmoved, resumed_ns - step_ns, resumed_ns, Counter(), may_be_set=False)
            unmoved.doubt_passage(before)
            self._propagate(unmoved, resumed_ns, end_ns, Counter(), may_be_set=False)
        return unmoved

    @staticmethod
    def _over_silence(filter: ErrorStateFilter, ns: int, counts: Counter[str]) -> None:
        """Readings held for so long would say anything. A clock set ahead while all runs on looks the same."""
        filter.lose_track(min(ns * 1e-9, _LONGEST_SILENCE_S))
        counts["silences"] += 1

    def _at(self, t_ns: int, i: int) -> Array:
        """Sample at ``t_ns``, between samples i-1 and i; held beyond the ends."""
        if i == 0:
            return self._imu[0]
        if i >= len(self._imu_t) or self._imu_t[i - 1] == t_ns:
            return self._imu[min(i, len(self._imu_t)) - 1]
        t0, t1 = self._imu_t[i - 1], self._imu_t[i]
        share = (t_ns - t0) / (t1 - t0)
        return (1.0 - share) * self._imu[i - 1] + share * self._imu[i]

    def _over_gap(self, i: int, start_ns: int, end_ns: int, ends: Array) -> tuple[Array, Array] | None:
        """What to take for the readings ``ends`` (2, 6) across missing samples, and by how much (6,) they may be off;
        None where none are missing.

        A gap may be crossed in several steps, a record at the end of each. Where the sample after it has not come, the
        guess is wrong the same way in all: what its error grew to by the end of this step, less what it was at its
        start. Else each step has its share of the variance, as nobody knows where the readings went between.
        """
        last_ns = self._imu_t[i - 1] if i > 0 else start_ns
        age = [(t_ns - last_ns) * 1e-9 for t_ns in (start_ns, end_ns)]
        if age[1] < _GAP_S:
            return None
        shortest = max(_GAP_S, _GAP_FACTOR * self._usual_step_s(i))
        if age[1] < shortest:
            return None
        begun = age[0] if age[0] >= shortest else 0.0
        is_held = i == 0 or i >= len(self._imu_t)
        length_s = age[1] if is_held else (self._imu_t[i] - last_ns) * 1e-9
        guess, missed = self._guess(i, length_s, ends, is_held)
        grown = age[1] ** 2 - begun**2 if is_held else length_s * (age[1] - begun)
        return guess, missed * math.sqrt(grown) / (age[1] - age[0])

    def _guess(self, i: int, length_s: float, ends: Array, is_held: bool) -> tuple[Array, Array]:
        """Readings (2, 6) over a gap of ``length_s`` before sample i, and the rms (6,) by which such a guess misses the
        mean reading over stretches as long of the samples nearby: the line between the samples at its ends, the last
        one held where no other came, or, where that is better, the mean of those nearby."""
        near = slice(i, i + _NEARBY) if 2 * i < len(self._imu_t) else slice(max(0, i - _NEARBY), i)
        t_s, values = (np.array(self._imu_t[near]) - self._imu_t[near.start]) * 1e-9, np.array(self._imu[near])
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
        known = ends if is_held else np.array(self._imu[i - 1 : i + 1])
        of_line = np.maximum(of_line, np.abs(known[1] - known[0]) / math.sqrt(12.0))
        of_mean = np.maximum(of_mean, 0.5 * np.abs(known - usual).max(axis=0))
        return np.where(of_mean < of_line, usual, ends), np.minimum(of_mean, of_line)

    def _drop_imu_before(self, t_ns: int) -> None:
        keep = bisect.bisect_right(self._imu_t, t_ns) - 1
        if keep > 1000:
            del self._imu_t[:keep], self._imu[:keep]
