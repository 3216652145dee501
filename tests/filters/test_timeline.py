"""Late, repeated and out-of-order inputs, lost frames, old references, gates."""

from __future__ import annotations

import bisect
from dataclasses import replace

import numpy as np
import pytest
from gpvo.filters import metrics
from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import BIAS, JOINT, THREE_SIGMA, Gate, chi2_cdf, chi2_quantile
from gpvo.filters.plausible import Samples
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.propagation import BA, TH, P, V
from gpvo.filters.run import Flight, FuseOptions, begin, fuse_flight, make_filter
from gpvo.filters.timeline import Timeline
from gpvo.geometry import se3
from gpvo.types import ImuLog, Status, VoRecord
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flights import FORWARD_CAMERA, MEMS, ErrorLaw, Events, synthetic_flight

from motion_errors import prediction


@pytest.fixture(scope="module")
def flight() -> Flight:
    return synthetic_flight(8, duration_s=6)


def _timeline(flight: Flight, **options: object) -> Timeline:
    start, gravity = begin(flight, FuseOptions())
    filter = make_filter(flight, start, gravity, 1, FuseOptions())
    return Timeline(filter, flight.records[0].t_ns, LearnedPolicy(), **options)


def _feed_imu(timeline: Timeline, flight: Flight) -> None:
    assert flight.imu is not None
    for t, w, f in zip(flight.imu.t_ns, flight.imu.gyro_radps, flight.imu.acc_mps2, strict=True):
        timeline.add_imu(int(t), w, f)


def _feed(timeline: Timeline, flight: Flight, order: list[int]) -> None:
    for i in order:
        record = flight.records[i]
        timeline.add_vo(record, flight.predictions.get(record.t_ns))


def _with_samples(flight: Flight, rows: np.ndarray) -> Flight:
    """The flight with these samples of its IMU, in this order."""
    assert flight.imu is not None
    columns = (values[rows] for values in (flight.imu.t_ns, flight.imu.gyro_radps, flight.imu.acc_mps2))
    return replace(flight, imu=ImuLog(*columns, flight.imu.noise))


def _position_nees(timeline: Timeline, flight: Flight, k: int) -> float:
    """Of the filter against the truth of record k."""
    error = timeline.filter.x.position[0] - flight.T_world_imu[k, :3, 3]
    return float(error @ np.linalg.solve(timeline.filter.covariance[0, P, P], error) / 3)


def _same(a: ErrorStateFilter, b: ErrorStateFilter) -> None:
    np.testing.assert_allclose(a.x.position, b.x.position, atol=1e-12)
    np.testing.assert_allclose(a.P, b.P, atol=1e-14)


@pytest.mark.parametrize("swap", [(60, 61), (60, 65), (100, 119)])
def test_out_of_order_records_end_in_the_same_state(flight: Flight, swap: tuple[int, int]) -> None:
    usual = _timeline(flight)
    _feed_imu(usual, flight)
    _feed(usual, flight, list(range(120)))
    order = list(range(120))
    i, j = swap
    order.insert(j, order.pop(i))
    shuffled = _timeline(flight)
    _feed_imu(shuffled, flight)
    _feed(shuffled, flight, order)
    _same(usual.filter, shuffled.filter)
    assert shuffled.counts["reordered"] == 1


def test_records_out_of_order_are_scored_as_those_in_order(flight: Flight) -> None:
    records = list(flight.records)
    for i in range(20, len(records) - 2, 9):
        records[i], records[i + 1] = records[i + 1], records[i]
    given, swapped = (fuse_flight(f, LearnedPolicy()) for f in (flight, replace(flight, records=records)))
    assert swapped.counts["reordered"] > 5
    np.testing.assert_allclose(swapped.T_world_imu, given.T_world_imu, atol=1e-9)
    np.testing.assert_allclose(swapped.covariance, given.covariance, atol=1e-12)


def test_a_record_far_ahead_is_left_out_until_the_next_agrees(flight: Flight) -> None:
    """Used, it would be taken back by every later one, and the time up to it gone through anew."""
    usual, hurt = _timeline(flight), _timeline(flight)
    for timeline in (usual, hurt):
        _feed_imu(timeline, flight)
        _feed(timeline, flight, list(range(40)))
    ahead = replace(flight.records[40], t_ns=flight.records[40].t_ns + 10**12)
    assert hurt.add_vo(ahead) == []
    for timeline in (usual, hurt):
        _feed(timeline, flight, list(range(40, 60)))
    _same(usual.filter, hurt.filter)
    assert hurt.counts["stamp_ahead"] == 1
    assert hurt.counts["reordered"] == 0


def test_repeated_and_too_late_records_are_counted_and_change_nothing(flight: Flight) -> None:
    timeline = _timeline(flight, history_s=1.0)
    _feed_imu(timeline, flight)
    _feed(timeline, flight, [i for i in range(110) if i != 20])
    before = timeline.filter.copy()
    _feed(timeline, flight, [109, 105, 20])
    assert timeline.counts["repeated"] == 2
    assert timeline.counts["too_late"] == 1
    _same(before, timeline.filter)


def test_latency_costs_nothing(flight: Flight) -> None:
    """Records that arrive long after the samples of their time give the same states."""
    assert flight.imu is not None
    prompt, late = _timeline(flight), _timeline(flight)
    _feed_imu(prompt, flight)
    _feed(prompt, flight, list(range(50)))
    for k in range(600):
        late.add_imu(int(flight.imu.t_ns[k]), flight.imu.gyro_radps[k], flight.imu.acc_mps2[k])
        if k % 10 == 0 and 8 <= k // 10 < 58:
            late.latest()
            _feed(late, flight, [k // 10 - 8])
    _same(prompt.filter, late.filter)


def test_latest_carries_the_state_to_the_newest_sample(flight: Flight) -> None:
    assert flight.imu is not None
    timeline = _timeline(flight)
    _feed_imu(timeline, flight)
    _feed(timeline, flight, list(range(40)))
    ahead = timeline.latest(flight.records[45].t_ns)
    truth = flight.T_world_imu
    assert np.linalg.norm(ahead.x.position[0] - truth[45, :3, 3]) < 0.1
    assert np.trace(ahead.covariance[0, :3, :3]) > np.trace(timeline.filter.covariance[0, :3, :3])
    assert timeline.t_ns == flight.records[39].t_ns


def test_bad_imu_samples_are_dropped_and_counted(flight: Flight) -> None:
    timeline = _timeline(flight)
    _feed_imu(timeline, flight)
    assert flight.imu is not None
    last = int(flight.imu.t_ns[-1])
    timeline.add_imu(last, np.zeros(3), np.zeros(3))
    timeline.add_imu(last - 10**6, np.zeros(3), np.zeros(3))
    timeline.add_imu(last + 10**6, np.full(3, np.nan), np.zeros(3))
    assert (timeline.counts["imu_repeated"], timeline.counts["imu_out_of_order"]) == (1, 1)
    assert timeline.counts["imu_not_finite"] == 1


def test_a_gap_in_the_imu_widens_the_state(flight: Flight) -> None:
    assert flight.imu is not None
    keep = np.ones(len(flight.imu.t_ns), bool)
    keep[500:600] = False
    imu = flight.imu
    gappy = ImuLog(imu.t_ns[keep], imu.gyro_radps[keep], imu.acc_mps2[keep], imu.noise)
    whole = fuse_flight(flight, LearnedPolicy())
    broken = fuse_flight(replace(flight, imu=gappy), LearnedPolicy())
    assert broken.counts["imu_gaps"] > 0
    assert broken.scores is not None
    assert not broken.scores.diverged
    assert np.trace(broken.covariance[55, 3:6, 3:6]) > 2 * np.trace(whole.covariance[55, 3:6, 3:6])


@pytest.mark.parametrize(("silence_s", "least", "most"), [(1.0, 0.2, 2.0), (3.0, 0.3, 4.0)])
def test_a_silence_of_camera_and_imu_is_as_uncertain_as_it_is(silence_s: float, least: float, most: float) -> None:
    """NEES of eight flights at the first frame after it, and six seconds later."""
    after, later = [], []
    for seed in range(8):
        flight = synthetic_flight(seed, duration_s=6 + silence_s + 6, imu_hz=100)
        imu, t_ns = flight.imu, np.array([r.t_ns for r in flight.records])
        assert imu is not None
        assert flight.T_world_cam is not None
        first, last = (t_ns[0] + round(s * 1e9) for s in (6.0, 6.0 + silence_s))
        heard, seen = ((t <= first) | (t >= last) for t in (imu.t_ns, t_ns))
        reference = int(t_ns[t_ns <= first][-1])
        gap = VoRecord(int(last), reference, Status.LOST, np.eye(4), reason="gap")
        flight = replace(
            flight,
            records=[gap if r.t_ns == last else r for r, s in zip(flight.records, seen, strict=True) if s],
            imu=ImuLog(imu.t_ns[heard], imu.gyro_radps[heard], imu.acc_mps2[heard], imu.noise),
            T_world_cam=flight.T_world_cam[seen],
            truth_valid=np.ones(seen.sum(), bool),
        )
        run = fuse_flight(flight, LearnedPolicy())
        k = int(np.searchsorted(run.t_ns, last))
        truth, C = flight.T_world_imu, run.covariance
        p = metrics.position_nees(run.T_world_imu[:, :3, 3], truth[:, :3, 3], C[:, :3, :3])
        a = metrics.attitude_nees(run.T_world_imu[:, :3, :3], truth[:, :3, :3], C[:, 6:9, 6:9])
        after.append((p[k], a[k]))
        later.append((p[-1], a[-1]))
    assert least < np.mean(after, axis=0).min()
    assert np.mean(after, axis=0).max() < most
    assert np.median(later, axis=0).max() < 3 * most


@pytest.mark.parametrize("back_s", [0.1, 0.6, 1.2, 3.0, 3600.0, -0.05, -0.1, -0.5, -2.0, -3.9, -5.0, -30.0, -3600.0])
@pytest.mark.parametrize("late", [0, 2])
def test_the_filter_goes_on_when_the_clock_is_set_back_or_ahead(flight: Flight, back_s: float, late: int) -> None:
    """``late``: records that are on their way then."""
    imu, begin_ns = flight.imu, flight.records[0].t_ns
    assert imu is not None

    def told(t_ns: int) -> int:
        return int(t_ns) - (round(back_s * 1e9) if t_ns >= begin_ns + 2 * 10**9 else 0)

    timeline = _timeline(flight)
    for k in range(100 + late):
        for i in range(max(0, 10 * k - 9), 10 * k + 1):
            timeline.add_imu(told(imu.t_ns[i]), imu.gyro_radps[i], imu.acc_mps2[i])
        if k >= late:
            r = flight.records[k - late]
            again = replace(r, t_ns=told(r.t_ns), t_prev_ns=told(r.t_prev_ns))
            timeline.add_vo(again, flight.predictions.get(r.t_ns))
    assert timeline.t_ns == told(flight.records[99].t_ns)
    assert timeline.counts["clock_set_back" if back_s > 0 else "clock_set_ahead" if back_s > -4.0 else "silences"] == 1
    assert timeline.counts["used"] >= 96 - late
    assert _position_nees(timeline, flight, 99) < 3.0


@pytest.mark.parametrize("back_s", [0.3, 0.9])
def test_motions_go_on_where_the_clock_of_the_imu_alone_is_set_back(flight: Flight, back_s: float) -> None:
    imu, n = flight.imu, 100
    assert imu is not None
    told = imu.t_ns - round(back_s * 1e9) * (imu.t_ns >= flight.records[40].t_ns)
    timeline = _timeline(flight)
    for k in range(n):
        for i in range(max(0, 10 * k - 9), 10 * k + 1):
            timeline.add_imu(told[i], imu.gyro_radps[i], imu.acc_mps2[i])
        timeline.add_vo(flight.records[k], flight.predictions.get(flight.records[k].t_ns))
    assert timeline.counts["clock_set_back"] == 1
    assert timeline.t_ns == flight.records[n - 1].t_ns
    assert timeline.counts["used"] >= 70
    assert _position_nees(timeline, flight, n - 1) < 3.0


def test_a_gap_of_a_slow_imu_is_crossed(flight: Flight) -> None:
    imu = flight.imu
    assert imu is not None
    t = imu.t_ns[::40]  # 5 Hz
    kept = np.flatnonzero((t <= t[0] + 2 * 10**9) | (t >= t[0] + 4 * 10**9)) * 40
    slow = _with_samples(flight, kept)
    timeline = _timeline(slow)
    _feed_imu(timeline, slow)
    _feed(timeline, slow, [*range(41), *range(90, 110)])
    assert timeline.t_ns == flight.records[109].t_ns
    np.linalg.cholesky(timeline.filter.covariance)


def test_a_batch_of_samples_that_is_sent_twice_is_no_clock_set_back(flight: Flight) -> None:
    imu = flight.imu
    assert imu is not None
    usual, twice = _timeline(flight), _timeline(flight)
    again = np.concatenate([np.arange(500), np.arange(460, 480), np.arange(500, len(imu.t_ns))])
    _feed_imu(usual, flight)
    _feed_imu(twice, _with_samples(flight, again))
    for timeline in (usual, twice):
        _feed(timeline, flight, list(range(110)))
    assert twice.counts["clock_set_back"] == 0
    _same(usual.filter, twice.filter)


@pytest.mark.parametrize("ahead_s", [0.5, 2.0])
def test_where_no_motion_tells_whether_time_has_passed_the_filter_doubts_it(ahead_s: float) -> None:
    nees = []
    for seed in range(6):
        flight = synthetic_flight(seed, duration_s=4)
        imu, ahead_ns = flight.imu, round(ahead_s * 1e9)
        assert imu is not None
        told = imu.t_ns + ahead_ns * (imu.t_ns >= flight.records[60].t_ns)
        timeline = _timeline(flight)
        _feed_imu(timeline, replace(flight, imu=replace(imu, t_ns=told)))
        _feed(timeline, flight, list(range(60)))
        r = flight.records[60]
        timeline.add_vo(replace(r, t_ns=r.t_ns + ahead_ns, status=Status.LOST))
        nees.append(_position_nees(timeline, flight, 60))
    assert 0.1 < np.mean(nees) < 2.0


def test_of_a_silence_anything_may_be_that_a_vehicle_does() -> None:
    """It has gone on as fast as before or stopped, and turned by a radian about the vertical, little about others."""
    flight = synthetic_flight(3, duration_s=2)
    filter = _timeline(flight).filter
    filter.x.velocity[:] = [3.0, 0.0, 4.0]
    filter.x.R_world_imu[:] = R = se3.so3_exp(np.array([0.4, -0.2, 1.0]))
    before = filter.covariance.copy()
    filter.lose_track(0.5)
    added = (filter.covariance - before)[0]
    in_world = R @ added[TH, TH] @ R.T
    np.testing.assert_allclose(in_world, np.diag([0.2**2, 0.2**2, 1.0]), atol=1e-12)
    np.testing.assert_allclose(added[P, P], 2.5**2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(added[V, V], 5.0**2 * np.eye(3), atol=1e-12)
    filter.x.velocity[:] = 0.1
    before = filter.covariance.copy()
    filter.lose_track(0.5)
    np.testing.assert_allclose((filter.covariance - before)[0, V, V], np.eye(3), atol=1e-12)


def test_a_bias_that_forgets_is_as_unsure_in_the_end_as_before_it_was_measured() -> None:
    filter = _timeline(synthetic_flight(3, duration_s=2)).filter
    A = np.random.default_rng(0).standard_normal((JOINT, JOINT))
    filter.P[:] = A @ A.T
    tau_s = np.array([0.5, 1.0, 2.0, 4.0, 8.0, np.inf])
    before, phi = filter.P[0].copy(), np.append(np.exp(-0.7 / tau_s), np.ones(6))
    filter.decay_bias(0.7, tau_s)
    np.testing.assert_allclose(filter.P[0, BIAS, BIAS], np.outer(phi, phi) * before[BIAS, BIAS] + np.diag(1 - phi**2))
    np.testing.assert_allclose(filter.P[0, :15, BIAS], before[:15, BIAS] * phi)
    filter.decay_bias(1e6, tau_s)
    np.testing.assert_allclose(filter.P[0, BIAS, BIAS][:5, :5], np.eye(5), atol=1e-12)


def test_a_reading_between_two_samples_lies_on_the_line_between_them() -> None:
    """Frames need not fall on samples; beyond the ends, the last one holds."""
    samples, slope = Samples(), np.arange(1.0, 7.0)
    for t_ns in (30, 10, 20, 45):
        samples.insert(t_ns, slope * t_ns)
    for t_ns, expected_ns in ((5, 10), (10, 10), (13, 13), (20, 20), (41, 41), (45, 45), (60, 45)):
        found = samples.at(t_ns, bisect.bisect_right(samples.t_ns, t_ns))
        np.testing.assert_allclose(found, slope * expected_ns, rtol=1e-12)


@pytest.mark.parametrize("n", [3, 10])
def test_samples_that_come_late_fill_their_gap(flight: Flight, n: int) -> None:
    """Two datagrams of n samples change places: no clock was set."""
    imu = flight.imu
    assert imu is not None
    order = np.arange(len(imu.t_ns))
    order[500 : 500 + 2 * n] = np.roll(order[500 : 500 + 2 * n], n)
    usual, swapped = _timeline(flight), _timeline(flight)
    _feed_imu(usual, flight)
    _feed_imu(swapped, _with_samples(flight, order))
    for timeline in (usual, swapped):
        _feed(timeline, flight, list(range(120)))
    assert swapped.counts["imu_out_of_order"] == 1
    assert swapped.counts["clock_set_back"] == swapped.counts["imu_gaps"] == 0
    off_m = np.linalg.norm(usual.filter.x.position - swapped.filter.x.position)
    assert off_m < 0.2 * np.sqrt(np.trace(usual.filter.covariance[0, P, P]))


def test_one_sample_of_an_imu_is_enough_to_go_on(flight: Flight) -> None:
    imu = flight.imu
    assert imu is not None
    timeline = _timeline(flight)
    timeline.add_imu(int(imu.t_ns[0]), imu.gyro_radps[0], imu.acc_mps2[0])
    _feed(timeline, flight, [0, 10])
    assert np.isfinite(timeline.filter.covariance).all()


def test_after_a_long_silence_the_filter_is_as_unsure_as_it_is_wrong() -> None:
    """Ten seconds without a sample or record; the vehicle flew on."""
    for seed in range(3):
        flight = synthetic_flight(seed, duration_s=16)
        imu, begin_ns = flight.imu, flight.records[0].t_ns
        assert imu is not None
        heard, seen = (
            [not 3 * 10**9 < t - begin_ns < 13 * 10**9 for t in stamps]
            for stamps in (imu.t_ns.tolist(), [r.t_ns for r in flight.records])
        )
        timeline = _timeline(flight)
        for t, w, f in zip(imu.t_ns[heard], imu.gyro_radps[heard], imu.acc_mps2[heard]):
            timeline.add_imu(int(t), w, f)
        _feed(timeline, flight, np.flatnonzero(seen).tolist())
        error = timeline.filter.x.position[0] - flight.T_world_imu[len(seen) - 1, :3, 3]
        assert error @ np.linalg.solve(timeline.filter.covariance[0, P, P], error) / 3 < 3.0
        assert timeline.counts["silences"] == 1
        assert timeline.counts["used"] > 100


@pytest.mark.parametrize("ahead_s", [30, 3600])
def test_without_an_imu_a_clock_set_ahead_turns_nothing_over(ahead_s: int) -> None:
    for seed in range(3):
        flight = replace(synthetic_flight(seed, duration_s=6), imu=None, T_imu_cam=None)
        timeline, begin_ns = _timeline(flight, with_imu=False), flight.records[0].t_ns
        for r in flight.records:
            late, before = (t + ahead_s * 10**9 * (t - begin_ns > 3 * 10**9) for t in (r.t_ns, r.t_prev_ns))
            timeline.add_vo(replace(r, t_ns=late, t_prev_ns=before), flight.predictions.get(r.t_ns))
        error = timeline.filter.x.position[0] - flight.T_world_imu[-1, :3, 3]
        assert np.linalg.norm(error) < 3.0 * np.sqrt(np.trace(timeline.filter.covariance[0, P, P]))
        assert timeline.counts["used"] > len(flight.records) - 4


def test_the_jitter_of_a_slow_imus_stamps_is_no_gap() -> None:
    flight = synthetic_flight(4, duration_s=20, rate_hz=5, imu_hz=20)
    assert flight.imu is not None
    t_ns = flight.imu.t_ns.copy()
    t_ns[1:-1:7] += 42_000_000
    steps = np.diff(t_ns)
    assert steps.min() == 8_000_000
    run = fuse_flight(replace(flight, imu=replace(flight.imu, t_ns=t_ns)), LearnedPolicy())
    assert "imu_gaps" not in run.counts


def test_darkness_frozen_frames_and_bursts_do_not_diverge() -> None:
    law = ErrorLaw(burst_factor=15.0)
    for seed in range(3):
        flight = synthetic_flight(seed, duration_s=12, law=law, events=Events(dark=(3.0, 5.0), frozen=(7.0, 8.0)))
        run = fuse_flight(flight, LearnedPolicy())
        assert run.counts["lost"] == 40
        assert run.counts.get("no_reference", 0) == 0
        assert run.scores is not None
        assert not run.scores.diverged
        assert run.scores.final_error_m < 2.0


@pytest.mark.parametrize("late", [False, True])
def test_the_bias_of_vo_is_forgotten_over_lost_frames(late: bool) -> None:
    """What the filter's biases share with VO's falls by exp(-t / tau), however many of the frames were measured."""
    dark = synthetic_flight(8, duration_s=6, law=ErrorLaw(bias_tau_s=2.0), events=Events(dark=(0.3, 5.0)))
    timeline = _timeline(dark, history_s=10.0)
    _feed_imu(timeline, dark)
    _feed(timeline, dark, list(range(6)))
    before = timeline.filter.P[0, BIAS, BA].copy()
    after = replace(dark.records[100], T_prev_cur=np.full((4, 4), np.nan))  # one that moves nothing
    lost = list(range(6, 100))
    _feed(timeline, dark, [] if late else lost)
    timeline.add_vo(after, dark.predictions[after.t_ns])
    _feed(timeline, dark, lost if late else [])
    assert np.abs(before).max() > 0
    np.testing.assert_allclose(timeline.filter.P[0, BIAS, BA], np.exp(-4.75 / 2.0) * before, rtol=1e-9)


def test_a_record_from_an_unknown_reference_is_skipped_and_counted(flight: Flight) -> None:
    timeline = _timeline(flight)
    _feed_imu(timeline, flight)
    _feed(timeline, flight, [0, 1, 2])
    stranger = replace(flight.records[5], t_prev_ns=flight.records[4].t_ns + 1)
    (step,) = timeline.add_vo(stranger, flight.predictions[stranger.t_ns])
    assert step.outcome == "no_reference"
    # It becomes the reference of the next, which is used again.
    (step,) = timeline.add_vo(flight.records[6], flight.predictions[flight.records[6].t_ns])
    assert step.outcome == "used"


def test_a_motion_that_is_not_finite_is_skipped(flight: Flight) -> None:
    timeline = _timeline(flight)
    _feed_imu(timeline, flight)
    _feed(timeline, flight, [0, 1])
    broken = replace(flight.records[2], T_prev_cur=np.full((4, 4), np.nan))
    assert timeline.add_vo(broken, flight.predictions[broken.t_ns])[0].outcome == "not_finite"
    assert np.isfinite(timeline.filter.P).all()


@pytest.mark.parametrize("on_fail", ["discard", "inflate", "accept"])
def test_gate(flight: Flight, on_fail: str) -> None:
    timeline = _timeline(flight, gate=Gate(on_fail=on_fail))
    _feed_imu(timeline, flight)
    _feed(timeline, flight, list(range(40)))
    before = timeline.filter.x.position.copy()
    record = flight.records[40]
    wrong = replace(record, T_prev_cur=record.T_prev_cur @ se3.exp(np.array([3.0, 0, 0, 0, 0, 0])))
    (step,) = timeline.add_vo(wrong, flight.predictions[record.t_ns])
    assert step.outcome == "rejected"
    assert step.innovation is not None
    assert step.innovation.nis[0] > Gate().threshold(6)
    moved = np.linalg.norm(timeline.filter.x.position - before)
    usual = np.linalg.norm(flight.T_world_imu[40, :3, 3] - flight.T_world_imu[39, :3, 3])
    assert {"discard": moved < 1.2 * usual, "inflate": moved < 10 * usual, "accept": moved > usual}[on_fail]
    np.linalg.cholesky(timeline.filter.covariance)


def _astray(speed_mps: float) -> tuple[Timeline, Flight]:
    """A filter whose velocity has become wrong after 60 records, by the same on every axis."""
    flight = synthetic_flight(9, duration_s=20)
    timeline = _timeline(flight)
    _feed_imu(timeline, flight)
    _feed(timeline, flight, list(range(60)))
    timeline.filter.x.velocity = timeline.filter.x.velocity + speed_mps
    return timeline, flight


def _is_right_again(timeline: Timeline, flight: Flight) -> bool:
    speed = np.linalg.norm(np.diff(flight.T_world_imu[-2:, :3, 3], axis=0)) * 20
    np.linalg.cholesky(timeline.filter.covariance)
    return bool(abs(np.linalg.norm(timeline.filter.x.velocity) - speed) < 0.2)


def _recovers_after(timeline: Timeline, flight: Flight, shut_out: int) -> None:
    """So many records are rejected; of the rest a few are let in against the gate, and then all is well."""
    _feed(timeline, flight, list(range(60, 60 + shut_out)))
    assert timeline.counts["rejected"] == shut_out
    assert timeline.counts["recovered"] == 0
    _feed(timeline, flight, list(range(60 + shut_out, 400)))
    assert 0 < timeline.counts["recovered"] < 10
    assert _is_right_again(timeline, flight)


def test_a_filter_that_is_wrong_recovers() -> None:
    """A wrong velocity shuts good measurements out; after five seconds of that they are let in again."""
    timeline, long = _astray(3.0)
    timeline.gate = Gate(doubt_after_s=np.inf)
    _recovers_after(timeline, long, 95)


def test_a_filter_that_knows_less_than_vo_recovers_sooner() -> None:
    """Where the filter itself admits more error than VO does, one second of failures is enough."""
    timeline, long = _astray(3.0)
    timeline.filter.P[:, 3:6, 3:6] += 0.4**2 * np.eye(3)
    _recovers_after(timeline, long, 20)


def test_a_filter_that_knows_more_than_vo_holds_out() -> None:
    """Three seconds of motions that are wrong by far more than VO says move a sure filter nowhere."""
    timeline, long = _astray(0.0)
    for i in range(60, 120):
        record = long.records[i]
        slipped = replace(record, T_prev_cur=record.T_prev_cur @ se3.exp(np.array([0.2, 0, 0, 0, 0, 0])))
        timeline.add_vo(slipped, long.predictions[record.t_ns])
    assert timeline.counts["rejected"] == 60
    assert timeline.counts["recovered"] == 0
    _feed(timeline, long, list(range(120, 400)))
    assert _is_right_again(timeline, long)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.floats(-2.0, 2.0))
def test_whose_fault_a_failure_is(flight: Flight, seed: int, log_ratio: float) -> None:
    """Of the two likeliest parts of a failure, each over its own covariance, the greater one is to blame."""
    rng = np.random.default_rng(seed)
    start, gravity = begin(flight, FuseOptions())
    filter = make_filter(flight, start, gravity, 1, FuseOptions())
    A, B = rng.standard_normal((2, 21, 21))
    filter.P[0, :21, :21] = A @ A.T
    H = np.zeros((1, 6, JOINT))
    H[0, :, :21] = B[:6]
    N = 10.0**log_ratio * np.einsum("ij,kj->ik", A[:6], A[:6])
    r = rng.standard_normal((1, 6))
    P_r = H[0] @ filter.P[0] @ H[0].T
    r *= 5.0 / np.sqrt(r[0] @ np.linalg.solve(P_r + N, r[0]))  # NIS 25, over the gate's 20
    of_filter, of_vo = (C @ np.linalg.solve(P_r + N, r[0]) for C in (P_r, N))
    parts = [e @ np.linalg.solve(C, e) for e, C in ((of_filter, P_r), (of_vo, N))]
    assert sum(parts) == pytest.approx(25.0, rel=1e-6)
    innovation = filter.correct(H, r, N[None], Gate())
    assert not innovation.used[0]
    assert innovation.own_fault[0] == (parts[0] > parts[1])


def test_standing_still_against_one_reference_does_not_grow(flight: Flight) -> None:
    """Frames that do not become the reference tie the state to the old one: no drift while at rest."""
    n = 2000
    rng = np.random.default_rng(0)
    t_ns = np.arange(n + 1, dtype=np.int64) * 5_000_000
    gyro = 2e-4 * np.sqrt(200) * rng.standard_normal((n + 1, 3))
    acc = np.array([0, 0, 9.80665]) + 2e-3 * np.sqrt(200) * rng.standard_normal((n + 1, 3))
    predictions, records = {}, [VoRecord(0, 0, Status.START, np.eye(4))]
    template, zero = next(iter(flight.predictions.values())), np.zeros((6, 6))
    for k in range(10, n + 1, 10):
        t = int(t_ns[k])
        error = rng.standard_normal(6) * np.sqrt(np.diagonal(template.covariance))
        records.append(VoRecord(t, 0, Status.OK, se3.exp(error), is_reference=False))
        predictions[t] = prediction(t, zero, template.covariance, zero)
    poses = np.tile(FORWARD_CAMERA, (len(records), 1, 1))
    still = Flight("still", records, ImuLog(t_ns, gyro, acc, MEMS), FORWARD_CAMERA, poses, None, predictions)
    run = fuse_flight(still, LearnedPolicy())
    sigma = np.sqrt(np.trace(run.covariance[:, :3, :3], axis1=1, axis2=2))
    assert sigma[-1] < 1.5 * sigma[50]
    assert np.linalg.norm(run.T_world_imu[-1, :3, 3]) < 0.01


def test_chi_square_against_scipy() -> None:
    stats = pytest.importorskip("scipy.stats")
    for dof in (1, 3, 6, 60, 300):
        for p in (0.025, 0.5, 0.975, THREE_SIGMA):
            assert chi2_quantile(p, dof) == pytest.approx(stats.chi2.ppf(p, dof), rel=1e-9)
        assert chi2_cdf(dof * 1.3, dof) == pytest.approx(stats.chi2.cdf(dof * 1.3, dof), rel=1e-12)
    with pytest.raises(ValueError, match="must lie"):
        chi2_quantile(1.5, 6)
