"""One clock alone is set in flight, VO's or the IMU's; and what only looks like it."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.propagation import P
from gpvo.filters.run import Flight, FuseOptions, begin, make_filter
from gpvo.filters.timeline import Timeline
from gpvo.geometry import se3
from gpvo.types import Status, VoRecord
from numpy.typing import NDArray
from synthetic_flights import synthetic_flight

SET_S = 3.0
SHIFTS_S = [0.1, 0.3, 1.013, 2.0, -0.1, -0.3, -1.013, -2.0]


def _timeline(flight: Flight) -> Timeline:
    start, gravity = begin(flight, FuseOptions())
    return Timeline(make_filter(flight, start, gravity, 1, FuseOptions()), flight.records[0].t_ns, LearnedPolicy())


def _fly(
    timeline: Timeline,
    flight: Flight,
    records: list[VoRecord],
    imu_ns: NDArray[np.int64],
    came: tuple[int, int] = (0, 0),
    *,
    as_stamped: bool = False,
) -> tuple[int, int]:
    """Records and samples as they come: record k at the true time of frame k, or as their stamps put them. How many
    have come then, of those that ``came`` before on."""
    imu, (k, i) = flight.imu, came
    assert imu is not None
    for told, true in zip(records[k:], flight.records[k : len(records)], strict=True):
        while i < len(imu_ns) and (not timeline.reaches(told.t_ns) if as_stamped else imu.t_ns[i] <= true.t_ns):
            timeline.add_imu(int(imu_ns[i]), imu.gyro_radps[i], imu.acc_mps2[i])
            i += 1
        timeline.add_vo(told, flight.predictions.get(true.t_ns))
    return len(records), i


@cache
def _flight(seed: int) -> tuple[Flight, NDArray[np.int64], int]:
    """With the stamps of its IMU, and that from which on something is wrong."""
    flight = synthetic_flight(seed, duration_s=10)
    assert flight.imu is not None
    return flight, flight.imu.t_ns, flight.records[0].t_ns + round(SET_S * 1e9)


@cache
def _begun(seed: int, as_stamped: bool) -> tuple[Timeline, tuple[int, int]]:
    (flight, imu_ns, begin_ns), timeline = _flight(seed), _timeline(_flight(seed)[0])
    records = [r for r in flight.records if r.t_ns < begin_ns]
    return timeline, _fly(timeline, flight, records, imu_ns, as_stamped=as_stamped)


def _until_then(seed: int, as_stamped: bool = False) -> tuple[Timeline, tuple[int, int]]:
    """The filter while nothing is wrong yet, and how many records and samples have come: the same for all that may."""
    return copy.deepcopy(_begun(seed, as_stamped))


@cache
def _usual(seed: int) -> Timeline:
    """What the filter makes of the flight as it is."""
    (flight, imu_ns, _), (timeline, came) = _flight(seed), _until_then(seed)
    _fly(timeline, flight, list(flight.records), imu_ns, came)
    return timeline


def _ends_alike(found: Timeline, usual: Timeline) -> None:
    off_m = np.linalg.norm(found.filter.x.position - usual.filter.x.position)
    assert off_m < 0.1 * np.sqrt(np.trace(usual.filter.covariance[0, P, P]))
    np.testing.assert_allclose(found.filter.covariance[0, P, P], usual.filter.covariance[0, P, P], rtol=0.05, atol=1e-7)


@pytest.mark.parametrize("as_stamped", [False, True])
@pytest.mark.parametrize("shift_s", SHIFTS_S)
@pytest.mark.parametrize("clock", ["vo", "vo, the reference by the new clock", "imu"])
def test_a_clock_that_is_set_alone_changes_nothing(clock: str, shift_s: float, as_stamped: bool) -> None:
    (flight, imu_ns, begin_ns), set_ns = _flight(5), round(shift_s * 1e9)
    records = list(flight.records)
    if clock == "imu":
        imu_ns = imu_ns + set_ns * (imu_ns >= begin_ns)
    else:
        by_new = 1 if "new" in clock else 0
        told = [(r.t_ns >= begin_ns, r.t_prev_ns >= begin_ns or (by_new and r.t_ns >= begin_ns)) for r in records]
        records = [
            replace(r, t_ns=r.t_ns + set_ns * bool(now), t_prev_ns=r.t_prev_ns + set_ns * bool(before))
            for r, (now, before) in zip(records, told, strict=True)
        ]
    found, came = _until_then(5, as_stamped)
    _fly(found, flight, records, imu_ns, came, as_stamped=as_stamped)
    assert found.counts["clock_set_ahead" if shift_s > 0 else "clock_set_back"] == 1
    _ends_alike(found, _usual(5))


@pytest.mark.parametrize(
    ("who", "silence_s"),
    [
        *product(["vo, lost", "vo, one long motion", "imu"], [0.2, 1.0, 3.0]),
        *product(["both, lost", "both, one long motion"], [0.05, 0.1, 0.2, 1.0]),
    ],
)
def test_a_silence_is_no_clock_that_was_set(who: str, silence_s: float) -> None:
    for seed in range(3):
        flight, imu_ns, begin_ns = _flight(seed)
        imu = flight.imu
        assert imu is not None
        assert flight.T_world_cam is not None
        end_ns = begin_ns + round(silence_s * 1e9)
        (timeline, (first, _)), ends = _until_then(seed), [r.t_ns for r in flight.records]
        came = np.searchsorted(imu_ns, ends, side="right")
        for k, record in enumerate(flight.records[first:], first):
            for i in range(came[k - 1], came[k]):
                if who.startswith("vo") or not begin_ns < imu_ns[i] <= end_ns:
                    timeline.add_imu(int(imu_ns[i]), imu.gyro_radps[i], imu.acc_mps2[i])
            if who != "imu" and begin_ns < record.t_ns <= end_ns:
                continue
            if who != "imu" and begin_ns < record.t_prev_ns <= end_ns:
                last = int(np.searchsorted(ends, begin_ns, side="right")) - 1
                T = se3.inverse(flight.T_world_cam[last]) @ flight.T_world_cam[k]
                status = Status.LOST if "lost" in who else Status.OK
                record = replace(record, t_prev_ns=flight.records[last].t_ns, T_prev_cur=T, status=status)
            timeline.add_vo(record, flight.predictions.get(record.t_ns))
        assert timeline.counts["clock_set_ahead"] == timeline.counts["clock_set_back"] == 0
        error = timeline.filter.x.position[0] - flight.T_world_imu[-1, :3, 3]
        assert error @ np.linalg.solve(timeline.filter.covariance[0, P, P], error) / 3 < 5.0


def test_a_record_sent_twice_or_late_starts_no_rival() -> None:
    flight = _flight(5)[0]
    assert flight.imu is not None
    timeline = _timeline(flight)
    for sample in zip(flight.imu.t_ns.tolist(), flight.imu.gyro_radps, flight.imu.acc_mps2, strict=True):
        timeline.add_imu(*sample)
    order = list(range(len(flight.records)))
    order[60:63] = [62, 60, 61]
    newest = -1
    for k in [*order[:100], 97, 98, *order[100:]]:
        before = timeline._rivals
        timeline.add_vo(flight.records[k], flight.predictions.get(flight.records[k].t_ns))
        assert k > newest or all(rival in before for rival in timeline._rivals), k
        newest = max(newest, k)
    assert timeline.counts["clock_set_back"] == 0
    assert timeline.counts["repeated"] == 2
    _ends_alike(timeline, _usual(5))


def test_late_records_by_the_clock_of_before_are_left_out() -> None:
    """All clocks are set back by eight seconds, and records come two frames after their samples: the last two by the
    clock of before, taken for ones to come, left the filter 5.3 m off after ten seconds, instead of 0.2."""
    (flight, _, begin_ns), timeline = _flight(5), _timeline(_flight(5)[0])
    imu, records, late = flight.imu, flight.records, 2
    assert imu is not None

    def stamp(t_ns: int) -> int:
        return t_ns - 8 * 10**9 * (t_ns >= begin_ns)

    came = [0, *np.searchsorted(imu.t_ns, [r.t_ns for r in records], side="right")]
    for k, (first, last) in enumerate(pairwise(came)):
        for i in range(first, last):
            timeline.add_imu(stamp(int(imu.t_ns[i])), imu.gyro_radps[i], imu.acc_mps2[i])
        if k >= late:
            r = records[k - late]
            told = replace(r, t_ns=stamp(r.t_ns), t_prev_ns=stamp(r.t_prev_ns))
            timeline.add_vo(told, flight.predictions.get(r.t_ns))
    found, usual = (np.trace(t.filter.covariance[0, P, P]) for t in (timeline, _usual(5)))
    assert found < 1.5 * usual
    assert timeline.counts["silences"] == 0
