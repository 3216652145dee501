"""The filter on a clock: samples and frames as they arrive, late, twice or out of order.

IMU samples are buffered; the state is propagated to a frame's stamp when its record arrives, so the usual latency of
VO costs nothing. A record older than the newest is inserted in its place: the filter goes back to the state before
the records that follow it, and applies them again.

Where the stamps of VO or of the IMU jump, either time has passed unseen or that clock alone was set. Both are followed,
as two timelines, until the motions tell which of them is right.
"""

from __future__ import annotations

import bisect
import copy
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import Gate, Innovation, Wait
from gpvo.filters.plausible import GAP_S, LONGEST_GAP_S, ImuGuard, Samples
from gpvo.filters.policies import Policy
from gpvo.filters.rivals import RARELY_SET, Rival, Step
from gpvo.online.observer import LONGEST_STEP_S, follows
from gpvo.stats.series import Doubt
from gpvo.types import Array, MotionError, Prediction, Status, VoRecord

_GUESS_NS = 250_000_000  # longest step of a guess
_SILENCE_NS, _LONGEST_SILENCE_S = 4_000_000_000, 1e3  # without sample and record: no guess holds so long
_STEPS, _MOST_RIVALS = 5, 2  # of records, by which the usual one is told; clocks that may have been set at once
_SLOWEST_NS = 20_000_000_000  # records are no further apart, where nothing else is heard
_LONGEST_STEP_NS, _LONGEST_GAP_NS = round(LONGEST_STEP_S * 1e9), round(LONGEST_GAP_S * 1e9)


@dataclass(frozen=True)
class _Entry:
    """A used record with the filter, clocks and reference as they were before it."""

    t_record_ns: int
    record: VoRecord
    noise: MotionError | None
    filter: ErrorStateFilter
    t_ns: int
    bias_ns: int
    reference_ns: int | None
    wait: Wait


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
        self._imu = Samples()
        self._imu_set_ns = self._vo_set_ns = 0  # by which each clock was set: taken off the stamps that it gives
        self._unused = 0  # samples since the last that was used
        self._steps_ns: deque[int] = deque(maxlen=_STEPS)  # of records
        self._rivals: list[Rival] = []

    # -- inputs -----------------------------------------------------------------------------------------------

    def add_imu(self, t_ns: int, gyro_radps: Array, acc_mps2: Array) -> None:
        """Take one IMU sample: (3,) each. One that cannot be (:class:`ImuGuard`) is counted and dropped: missing."""
        sample = np.concatenate([gyro_radps, acc_mps2])
        if problem := self._guard.judge(int(t_ns), sample):
            self.counts[problem] += 1
            self._unused += problem != "imu_repeated"
            return
        for rival in self._rivals:
            rival.line._take_sample(int(t_ns), sample)
        self._take_sample(int(t_ns), sample, may_be_set=True)
        self._unused = 0

    def _take_sample(self, told_ns: int, sample: Array, may_be_set: bool = False) -> None:
        t_ns, known = told_ns - self._imu_set_ns, self._imu.t_ns
        i = bisect.bisect_left(known, t_ns)
        again = known[i : i + 1] == [t_ns]
        is_back = i < len(known) and t_ns <= self._heard_ns and not self._imu.is_missing(i)
        if again and (not is_back or np.array_equal(self._imu.values[i], sample)):
            self.counts["imu_repeated"] += 1
            return
        if may_be_set and len(known) > 1 and (is_back or t_ns - max(known[-1], self._heard_ns) > 1e9 * GAP_S):
            expected_ns = self._heard_ns + round(1e9 * self._imu.usual_step_s(i)) * (self._unused + 1)
            if abs(t_ns - expected_ns) > 1e9 * self._imu.shortest_gap_s(i):
                rival = self._if_set(imu_ns=t_ns - expected_ns)
                rival._take_sample(told_ns, sample)
        if is_back:
            # The clock was set back, and no record can be put among what came before.
            self._go_on_from(t_ns)
            self._imu = Samples()
        self._imu.insert(t_ns, sample)
        self._heard_ns = t_ns

    def _go_on_from(self, t_ns: int) -> None:
        """What the filter is at the newest sample holds, by another clock, two samples before ``t_ns``: of these the
        first was in doubt."""
        self.filter = self.latest()
        self.t_ns = self._bias_ns = t_ns - 2 * int(np.diff(self._imu.t_ns[-2:]).sum())
        self._reference_ns = self._newest_ns = None
        self._wait = Wait.since(self.t_ns, self.filter.batch)
        self._history.clear()
        self._set_back_ns = t_ns
        self.counts["clock_set_back"] += 1

    def reaches(self, t_ns: int) -> bool:
        """Whether the IMU samples that a record of stamp ``t_ns`` needs have come: between them is interpolated."""
        newest_ns, needed_ns = self._newest_ns, t_ns - self._vo_set_ns
        if newest_ns is not None and needed_ns < newest_ns:
            needed_ns = newest_ns + max([0, *self._steps_ns])  # a clock set back, maybe
        others = (rival.line._imu.reach(t_ns - rival.line._vo_set_ns) for rival in self._rivals)
        return self._imu.reach(needed_ns) and all(others)

    def add_vo(self, record: VoRecord, prediction: Prediction | None = None) -> list[Step]:
        """Take one VO record; returns the steps done, more than one where later records were used again, or where a
        clock turns out to have been set: then those since. Give it once :meth:`reaches` is true: readings that have not
        come are guessed, and those that come for the time before it are not used any more."""
        self._suspect(record)
        told = [rival.line._take(record, prediction) for rival in self._rivals]
        steps = self._take(record, prediction)
        for rival, its in zip(self._rivals, told, strict=True):
            rival.hear(its, self, steps)
        if won := next((rival for rival in self._rivals if rival.has_won(self.gate)), None):
            return self._adopt(won)
        self._rivals = [rival for rival in self._rivals if rival.is_open()]
        return steps

    def _adopt(self, won: Rival) -> list[Step]:
        """Go on as the timeline that the motions speak for, and return its steps: it was copied from this one, so all
        that this one holds has its like there, and other rivals, which took its clock not to be set, end."""
        vars(self).update(vars(won.line))
        self.counts["clock_set_ahead" if won.set_ns > 0 else "clock_set_back"] += 1
        return won.steps

    def _suspect(self, record: VoRecord) -> None:
        """Follow what would be if VO's clock alone had been set, where its stamps do not go on from the newest one and
        no late record explains that."""
        t_ns, newest_ns = record.t_ns - self._vo_set_ns, self._newest_ns
        if newest_ns is None or not self._with_imu:
            return
        if t_ns < newest_ns:
            same = [e.record for e in self._history if e.t_record_ns == t_ns]
            again = any(np.array_equal(r.T_prev_cur, record.T_prev_cur) for r in same)
            goes_before = any(e.record.t_prev_ns == record.t_ns for e in self._history)
            goes_after = any(e.record.t_ns == record.t_prev_ns < record.t_ns for e in self._history)
            if again or (not same and (goes_before or goes_after)):
                return
        if len(self._steps_ns) == _STEPS:
            set_ns = self._off_ns(record)
            goes_on = record.t_prev_ns == self._reference_ns or record.t_prev_ns >= record.t_ns
            if not goes_on and self._reference_ns is not None:
                set_ns = record.t_prev_ns - self._reference_ns  # the same frame, by two clocks
            lines = [rival.line for rival in self._rivals]
            explained = any(abs(line._off_ns(record)) < 1.2e9 * GAP_S for line in lines)
            if abs(set_ns) > 1.2e9 * GAP_S and not explained:
                rival = self._if_set(vo_ns=set_ns)
                rival._reference_ns = self._reference_ns if goes_on else record.t_prev_ns
        if t_ns > newest_ns:
            self._steps_ns.append(t_ns - newest_ns)

    @property
    def guesses(self) -> int:
        """How often samples were missing."""
        return self.counts["imu_gaps"] + self.counts["silences"]

    def _off_ns(self, record: VoRecord) -> int:
        """By how much a record's stamp is not one usual step after the newest."""
        if self._newest_ns is None or not self._steps_ns:
            return 0
        return record.t_ns - self._vo_set_ns - self._newest_ns - sorted(self._steps_ns)[len(self._steps_ns) // 2]

    def _if_set(self, imu_ns: int = 0, vo_ns: int = 0) -> Timeline:
        """What goes on from here if the clock of the IMU or of VO alone was set ahead by so much just now."""
        other = copy.copy(self)
        other.filter, other.counts, other._doubt = self.filter.copy(), self.counts.copy(), copy.copy(self._doubt)
        other._history, other._imu, other._rivals = self._history.copy(), self._imu.copy(), []
        other._steps_ns = self._steps_ns.copy()
        other._imu_set_ns += imu_ns
        other._vo_set_ns += vo_ns
        rival = Rival(other, imu_ns + vo_ns, self.t_ns, (self.guesses, self.guesses))
        self._rivals = [*self._rivals[1 - _MOST_RIVALS :], rival]
        return other

    def _take(self, record: VoRecord, prediction: Prediction | None) -> list[Step]:
        t_ns = record.t_ns - self._vo_set_ns
        is_new = self._set_back_ns is not None and self._heard_ns - self._set_back_ns < _LONGEST_GAP_NS
        if is_new and t_ns - self._heard_ns > _LONGEST_GAP_NS // 2:
            self.counts["too_late"] += 1  # by the clock of before, unless such records go on coming
            return []
        self._set_back_ns = None
        known = t_ns <= self.t_ns and (t_ns == self._newest_ns or any(e.t_record_ns == t_ns for e in self._history))
        if known:
            self.counts["repeated"] += 1
            return []
        if self._jumps_ahead(t_ns):
            self.counts["stamp_ahead"] += 1
            return []
        noise = self.policy.noise(record, prediction) if record.usable else None
        if t_ns >= self.t_ns:
            return [self._step(t_ns, record, noise)]
        again = self._rewind(t_ns)
        if again is None:
            self.counts["too_late"] += 1
            return []
        self.counts["reordered"] += 1
        return [self._step(t_ns, record, noise), *(self._step(e.t_record_ns, e.record, e.noise) for e in again)]

    def _jumps_ahead(self, t_ns: int) -> bool:
        """Whether a record comes so long after the newest that its stamp is wrong, unless the next one agrees."""
        if t_ns - self.t_ns > _LONGEST_STEP_NS:
            return not self._doubt.is_settled_by(t_ns, follows)
        self._doubt.clear()
        return False

    def latest(self, t_ns: int | None = None) -> ErrorStateFilter:
        """The filter carried forward to ``t_ns`` (default: the newest IMU sample), leaving this one where it is."""
        target = t_ns if t_ns is not None else max([self.t_ns, *self._imu.t_ns[-1:]])
        ahead = self.filter.copy()
        if target > self.t_ns:
            self._propagate(ahead, self.t_ns, target, Counter(), may_be_set=False)
        return ahead

    # -- one record -------------------------------------------------------------------------------------------

    def _step(self, t_ns: int, record: VoRecord, noise: MotionError | None) -> Step:
        self._remember(t_ns, record, noise)
        unmoved = self._propagate(self.filter, self.t_ns, t_ns, self.counts)
        self.t_ns = self._newest_ns = t_ns
        if noise is not None and len(noise.persistent_tau_s):
            # Since it last did, not since the last record: VO's bias goes on changing while frames are lost.
            for filter in (self.filter, *([] if unmoved is None else [unmoved])):
                filter.decay_bias((t_ns - self._bias_ns) * 1e-9, noise.persistent_tau_s)
            self._bias_ns = t_ns
        outcome, judged = self._measure(record, noise, unmoved)
        if judged is None and unmoved is not None:
            self.filter.doubt_passage(unmoved.x)
        passed, own_fault = (True, False) if judged is None else (judged.passed, judged.own_fault)
        self._wait = self._wait.after(t_ns, passed, own_fault)
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
        recover = self._wait.over(self.t_ns, self.gate)
        innovation = self.filter.update_motion(record.T_prev_cur, noise, self.gate, recover)
        if unmoved is not None:
            other = unmoved.update_motion(record.T_prev_cur, noise, self.gate)
            if other.passed.all() and (other.surprise + RARELY_SET < innovation.surprise).all():
                self.filter, innovation = unmoved, other
                self.counts["clock_set_ahead"] += 1
        self.counts["recovered"] += int((recover & ~innovation.passed).any())
        return "used" if innovation.passed.all() else "rejected", innovation

    def _remember(self, t_ns: int, record: VoRecord, noise: MotionError | None) -> None:
        if self._history_ns <= 0:
            self._imu.drop_before(self.t_ns)
            return
        state = (self.filter.copy(), self.t_ns, self._bias_ns, self._reference_ns, self._wait)
        self._history.append(_Entry(t_ns, record, noise, *state))
        while self._history[0].t_record_ns < t_ns - self._history_ns:
            self._history.popleft()
        self._imu.drop_before(self._history[0].t_ns)

    def _rewind(self, t_ns: int) -> list[_Entry] | None:
        """Go back to before the first record later than ``t_ns``; returns those records in order."""
        later = [e for e in self._history if e.t_record_ns > t_ns]
        if not later or later[0].t_ns > t_ns:
            return None
        first = later[0]
        self.filter, self.t_ns, self._bias_ns = first.filter.copy(), first.t_ns, first.bias_ns
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
        known = self._imu.t_ns
        if not known:
            raise ValueError("no IMU sample has arrived; give the timeline with_imu=False to do without")
        i = bisect.bisect_right(known, start_ns)
        t, sample = start_ns, self._imu.at(start_ns, i)
        unmoved, resumed_ns = None, start_ns
        while t < end_ns:
            heard_ns = min([end_ns, *known[i : i + 1]])
            if heard_ns - t > _SILENCE_NS:
                self._over_silence(filter, heard_ns - t, counts)
                t, i = heard_ns, bisect.bisect_right(known, heard_ns)
                sample = self._imu.at(t, i)
                continue
            t1 = min(heard_ns, t + _GUESS_NS)
            arrived = known[i : i + 1] == [t1]
            after = self._imu.values[i] if arrived else self._imu.at(t1, i)
            dt, ends = (t1 - t) * 1e-9, np.array([sample, after])
            over = self._imu.over_gap(i, t, t1, ends)
            ends = ends if over is None else over[0]
            if may_be_set and over is not None and t >= resumed_ns:
                unmoved, resumed_ns = filter.copy(), heard_ns
            filter.propagate_imu(dt, ends[:1, :3], ends[:1, 3:], ends[1:, :3], ends[1:, 3:])
            if over is not None:
                filter.doubt_readings(over[1])
                counts["imu_gaps"] += 1
            t, sample, i = t1, after, i + arrived
        if unmoved is not None:
            # Between two samples some time has passed even so: about one usual step.
            before, step_ns = unmoved.x.copy(), round(1e9 * self._imu.usual_step_s(i))
            self._propagate(unmoved, resumed_ns - step_ns, resumed_ns, Counter(), may_be_set=False)
            unmoved.doubt_passage(before)
            self._propagate(unmoved, resumed_ns, end_ns, Counter(), may_be_set=False)
        return unmoved

    @staticmethod
    def _over_silence(filter: ErrorStateFilter, ns: int, counts: Counter[str]) -> None:
        """Readings held for so long would say anything. A clock set ahead while all runs on looks the same."""
        filter.lose_track(min(ns * 1e-9, _LONGEST_SILENCE_S))
        counts["silences"] += 1
