"""Which of several motions is the scene's: belief goes on, gives way to lasting evidence, and never takes all."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from gpvo.dataset.errors import motion_errors
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.runner import steps
from gpvo.sim.points import simulate_points
from gpvo.types import Status, VoLog
from gpvo.vo.config import make_config
from gpvo.vo.motion import Motion
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.rivals import Expected, Horizon, Leaps, Standing, choose
from gpvo.vo.state import Jitter, State
from hypothesis import given
from hypothesis import strategies as st


def moving(z_m: float, sigma_m: float = 0.003) -> Motion:
    """A motion along z that its points tell to ``sigma_m``."""
    T = se3.exp(np.array([0.0, 0.0, z_m, 0.0, 0.0, 0.0]))
    nothing = np.zeros((0, 3))
    return Motion(T, np.ones(9, bool), 1.0, nothing, nothing, np.eye(6) / sigma_m**2, True, 0.0)


def expecting(z_m: float, odds: float) -> Expected:
    return Expected(moving(z_m).T_prev_cur, 0.1, 0.02, odds)


def test_what_goes_on_is_taken_against_a_larger_rival_and_its_covariance_reaches_the_rival():
    choice = choose([moving(0.0), moving(2.0)], (30, 12), expecting(1.98, 3.0))
    assert choice.index == 1
    assert choice.plausible
    assert 0.2 < np.sqrt(choice.otherwise[2, 2]) < 2.0  # five sigma reach over the two metres
    assert 0 < choice.odds < 3.0


def test_the_larger_part_of_the_picture_wins_in_the_end():
    odds, frames = 3.0, 0
    while True:
        choice = choose([moving(0.0), moving(2.0)], (30, 12), expecting(2.0, odds))
        if choice.index == 0:
            break
        odds, frames = choice.odds, frames + 1
    assert 3 <= frames <= 20


def test_a_second_bad_motion_is_not_believed_because_the_first_was():
    odds = 3.0
    for _ in range(5):
        choice = choose([moving(0.0)], (1,), expecting(2.0, odds))
        assert not choice.plausible
        assert np.sqrt(choice.otherwise[2, 2]) > 1.0
        odds = choice.odds


def test_a_velocity_that_is_not_seen_is_known_no_better_in_its_turn():
    """Beside a lorry that fills the image, a vehicle may turn unseen."""
    turn = np.diag([1e-6, 4e-4, 1e-6])
    choice = choose([moving(0.0)], (1,), replace(expecting(2.0, 3.0), C_turn=turn))
    assert choice.otherwise[4, 4] > 0.9 * turn[1, 1]
    state, twist = State.begin(0, 100, None), np.array([0.0, 0.0, 5.0, 0.0, 0.1, 0.0])
    state.leaps.step(8 * 10**9, twist, 0.0 * twist, 79 * 10**8, 1.0)
    otherwise = state.otherwise(81 * 10**8, np.eye(4), 12.0)
    assert otherwise is not None
    assert otherwise[4, 4] > 0.5 * (0.1 * 8.1) ** 2 * 0.9  # as one of which no turn is known may turn


def test_beside_a_rival_a_velocity_that_was_refused_may_be_the_scene_s():
    """A lorry's velocity is believed; the street came back for one frame, and no vehicle could have reached it."""
    seconds, street = 10**9, np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    state = State.begin(0, 100, None)
    state.odds, state.refused, state.t_refused_ns = 3.0, street, 8 * seconds
    state.t_ref_ns = state.t_believed_ns = 82 * seconds // 10
    assert not state.follow(83 * seconds // 10, np.eye(4), 0.9, None, 12.0, goes_on=True).any()
    state.rivalry = 1.5
    C = state.follow(83 * seconds // 10, np.eye(4), 0.9, None, 12.0, goes_on=True)
    error = np.array([0.0, 0.02, -1.8, 0.0, 0.006, 0.0])  # the street's velocity now, which is not quite that of then
    assert error[:3] @ np.linalg.solve(C[:3, :3], error[:3]) < 25.0
    assert np.sqrt(C[4, 4]) > 0.2 * 0.1 * 0.1
    state.place_imu(np.eye(4))
    state.felt.wrong = np.array([0.0, 1.0])  # it has felt every change of velocity rightly, and confirms this one
    confirmed = replace(expecting(0.0, 3.0), felt=True)
    felt = state.follow(83 * seconds // 10, np.eye(4), 0.9, confirmed, 12.0, goes_on=True)
    assert felt[2, 2] < 0.1 * C[2, 2]


def test_a_leap_is_in_doubt_until_one_leads_back_or_it_has_lasted_as_long():
    """From 15 m/s on to a lorry's 0.5 m/s after 8 s, and off it again by a car of 12 m/s^2."""
    seconds, before, lorry = 10**9, np.array([0, 0, 15.0, 0, 0, 0]), np.array([0, 0, 0.5, 0, 0, 0])
    leaps = Leaps(began_ns=0)
    assert leaps.doubted(8 * seconds) is None
    leaps.step(8 * seconds, lorry, before, 79 * seconds // 10, 1.2)
    assert leaps.doubted(15 * seconds) is before
    leaps.step(15 * seconds, before + 4.0, lorry, 149 * seconds // 10, 12.0 * 7.1)
    assert leaps.doubted(15 * seconds) is None
    leaps = Leaps(began_ns=0)
    leaps.step(8 * seconds, lorry, before, 8 * seconds, 0.0)
    leaps.step(9 * seconds, before + 40.0, lorry, 9 * seconds, 12.0)  # no car has come there
    assert leaps.doubted(15 * seconds) is before
    assert leaps.doubted(17 * seconds) is None


def test_what_is_nearer_than_the_scene_usually_is_may_hide_it():
    horizon = Horizon()
    assert not horizon.hidden(50.0)  # before there is a scene
    for far_px in (4.0, 5.0, 6.0):
        horizon.see(far_px)
    assert not horizon.hidden(1.0)
    assert not horizon.hidden(6.0)
    assert horizon.hidden(10.0)


def test_a_leap_stays_in_doubt_while_the_scene_may_be_hidden_but_not_for_ever():
    leaps, still, fast = Leaps(0), np.zeros(6), np.array([0.0, 0.0, 9.0, 0.0, 0.0, 0.0])
    leaps.step(2 * 10**9, still, fast, 2 * 10**9 - 1, 0.1)
    assert leaps.doubted(5 * 10**9, hidden=True) is fast
    assert replace(leaps).doubted(5 * 10**9) is None
    assert leaps.doubted(33 * 10**9, hidden=True) is None


def test_a_rival_is_remembered_while_the_scene_may_be_hidden_but_not_for_ever():
    state = State.begin(0, 100, None)
    state.horizon.see(5.0)
    for k in range(5):
        state.meet(k * 10**8, 5.0, rival=True)
    for k in range(5, 300):
        state.meet(k * 10**8, 20.0, rival=False)
        assert state.remembers_rival
    again = replace(state)
    again.meet(30 * 10**9, 5.0, rival=False)
    assert not again.remembers_rival
    state.meet(31 * 10**9, 20.0, rival=False)
    assert not state.remembers_rival


def test_a_velocity_that_cannot_be_told_from_the_one_seen_ends_no_doubt():
    """The IMU contradicts 7 m/s, which are seen instead of 15; so long after that 15 +- 10 may be either."""
    seconds, left, seen, car = 10**9, *(np.array([0, 0, v, 0, 0, 0]) for v in (15.0, 7.0, 5.5))
    leaps = Leaps(began_ns=0)
    leaps.step(8 * seconds, seen, left, 8 * seconds, 1.0)
    leaps.contradicted = True
    leaps.step(15 * seconds, car, seen, 149 * seconds // 10, 10.0)
    assert leaps.doubted(15 * seconds) is seen
    leaps.step(16 * seconds, seen + 0.1, car, 159 * seconds // 10, 1.0)
    assert leaps.doubted(16 * seconds) is None


def test_alone_and_as_expected_it_is_sure_of_itself():
    choice = choose([moving(2.0)], (1,), expecting(1.99, 0.5))
    assert choice.plausible
    assert not choice.otherwise.any()
    assert choice.odds > 0.5
    assert not choose([moving(2.0)], (1,), None).otherwise.any()


def test_a_refused_motion_is_the_same_thing_s_however_far_the_vehicle_may_have_come():
    after_a_second = Expected(moving(2.0).T_prev_cur, 5.0, 1.0, 3.0, T_refused=moving(0.1).T_prev_cur)
    assert not choose([moving(0.0)], (1,), after_a_second).goes_on
    assert choose([moving(1.2)], (1,), after_a_second).goes_on
    assert choose([moving(0.0)], (1,), Expected(moving(2.0).T_prev_cur, 5.0, 1.0, 3.0)).goes_on


def test_what_an_imu_felt_is_not_outvoted_by_the_image():
    odds = 0.2
    for _ in range(50):
        choice = choose(
            [moving(0.0), moving(2.0)], (60, 2), Expected(moving(2.05).T_prev_cur, 0.1, 0.02, odds, felt=True)
        )
        assert (choice.index, choice.plausible, choice.goes_on) == (1, True, True)
        odds = choice.odds
    assert odds == 3.0
    for _ in range(50):
        choice = choose([moving(0.0)], (1,), Expected(moving(2.05).T_prev_cur, 0.1, 0.02, odds, felt=True))
        assert not choice.plausible
        odds = choice.odds


def test_the_unseen_motion_is_only_as_sure_as_what_it_was_expected_from():
    for sigma_m in (0.1, 1.0):
        choice = choose([moving(0.0)], (1,), Expected(moving(2.0).T_prev_cur, 0.5, sigma_m, 3.0))
        assert np.sqrt(choice.otherwise[0, 0]) == pytest.approx(sigma_m, rel=0.1)


@pytest.mark.parametrize("wrong", [0.01, 0.3])
def test_however_likely_a_motion_is_the_covariance_counts_with_its_being_wrong(wrong: float):
    choice = choose([moving(0.0), moving(2.0, sigma_m=0.2)], (30, 2), expecting(0.0, 3.0), lambda i, on: wrong)
    share = max(wrong, 1 / (1 + 15**0.5 * np.exp(3.0)))
    assert choice.otherwise[2, 2] == pytest.approx(share * (2.0**2 + 0.2**2))
    assert choice.otherwise[0, 0] == pytest.approx(share * 0.2**2)  # what the other one is not sure of counts too


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_more_of_the_image_a_motion_explains_the_surer_it_is(first: float, second: float):
    standing = Standing()
    for share in (first, second):
        standing.follow(share, np.zeros(6), 0.1, goes_on=True)
    few, many = (standing.wrong(s, goes_on=True, felt=0.0) for s in sorted((first, second)))
    assert 0.0 < many <= few < 1.0
    assert standing.wrong(first, goes_on=True, felt=1.0) < standing.wrong(first, goes_on=True, felt=0.5)


def test_half_of_the_image_tells_nothing_and_what_was_explained_before_is_remembered():
    assert Standing().wrong(0.5, goes_on=True, felt=0.0) == pytest.approx(0.5)
    standing = Standing()
    for _ in range(50):
        standing.follow(0.95, np.zeros(6), 0.1, goes_on=True)
    assert standing.wrong(0.5, goes_on=True, felt=0.0) < 0.1
    assert standing.wrong(0.5, goes_on=False, felt=0.0) == pytest.approx(0.5)  # another motion begins anew
    for _ in range(200):
        standing.follow(0.4, np.zeros(6), 0.1, goes_on=True)
    assert standing.wrong(0.4, goes_on=True, felt=0.0) > 0.6


def test_what_was_not_seen_has_any_velocity_that_the_vehicle_had():
    velocities = np.random.default_rng(1).normal([0, 0, 20, 0, 0, 0], [0.1, 0.1, 3, 0.01, 0.1, 0.01], (5000, 6))
    standing = Standing()
    for v in velocities:
        standing.follow(0.9, v, 0.1, goes_on=True)
    usual, at_rest = standing.unseen(velocities.mean(axis=0)), standing.unseen(np.zeros(6))
    assert np.sqrt(usual[2, 2]) == pytest.approx(3.0, rel=0.1)
    assert np.sqrt(at_rest[2, 2]) == pytest.approx(20.2, rel=0.02)
    assert np.linalg.eigvalsh(at_rest)[0] > 0


def wrong_and_ok(log: VoLog, truth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each motion with truth: its error [m], whether it is ``ok``, and its stated sigma [m], over all axes."""
    errors = motion_errors(log, truth)
    records = [log.records[i] for i in errors.index]
    sigma_m = [np.sqrt(np.trace(r.covariances["pointing_matching"][:3, :3])) for r in records]
    ok = [r.status is Status.OK for r in records]
    return np.linalg.norm(errors.xi[:, :3], axis=1), np.array(ok), np.array(sigma_m)


@pytest.mark.parametrize("with_imu", [True, False], ids=["with an IMU", "without"])
@pytest.mark.parametrize("seed", [0, 1])
def test_traffic_is_never_called_ok_and_is_covered(tmp_path, seed, with_imu):
    source = open_source(simulate_points("street-traffic", seed, duration_s=25.0, cars=3).save(tmp_path / "a.npz"))
    if not with_imu:
        source.imu = None
    log = VoLog([step.record for step in steps(source, make_config())], source.camera)
    wrong_m, ok, sigma_m = wrong_and_ok(log, source.truth)
    locked = wrong_m > 0.3
    assert ok.sum() > (40 if with_imu else 50)  # nine of seed 1 are of a car that creeps, which an IMU tells
    assert (locked & ok).sum() <= (0.0 if with_imu else 0.005) * ok.sum()
    assert (locked & (wrong_m > 6 * sigma_m)).sum() <= 0.05 * locked.sum()


def test_a_street_is_not_forgotten_while_a_car_may_hide_it(tmp_path):
    """A car alongside fills more and more of the image, until the street is no motion of its own."""
    path = simulate_points("street-traffic", 420, duration_s=40.0).save(tmp_path / "a.npz")
    source, config = open_source(path), make_config(max_acceleration_mps2=12.0, max_turn_radps2=20.0)
    source.imu = None
    log = VoLog([step.record for step in islice(steps(source, config), 315)], source.camera)
    wrong_m, ok, _ = wrong_and_ok(log, source.truth)
    assert ok.sum() > 100
    assert (wrong_m > 0.3).sum() > 40
    assert not (ok & (wrong_m > 0.3)).any()


@pytest.mark.parametrize(("seed", "least_ok"), [(32, 30), (205, 50), (220, 50)])
def test_an_imu_tells_a_car_that_sets_off_with_the_vehicle(tmp_path, seed, least_ok):
    """The first acceleration that the IMU ever feels; the image follows the other car without a leap, or for longer
    than the velocity before it had lasted. On the first flight the IMU takes it for gravity, and proves nothing."""
    path = simulate_points("street-traffic", seed, duration_s=40.0).save(tmp_path / "a.npz")
    source, config = open_source(path), make_config(max_acceleration_mps2=12.0, max_turn_radps2=20.0)
    log = VoLog([step.record for step in steps(source, config)], source.camera)
    wrong_m, ok, sigma_m = wrong_and_ok(log, source.truth)
    locked = wrong_m > 0.3
    assert ok.sum() > least_ok
    assert locked.sum() > 20
    assert not (locked & ok).any()
    assert not any("moved against one another" in record.reason for record in log)  # they did not
    assert (locked & (wrong_m > 6 * sigma_m)).sum() <= 0.15 * locked.sum()


def test_the_jitter_of_stamps_is_found_by_motions_too_long_and_too_short_in_turn():
    rng, found = np.random.default_rng(2), []
    for _ in range(200):
        n, jitter = rng.normal(0.0, 1e-3, 203), Jitter()
        for late_s in n[2:] - 2 * n[1:-1] + n[:-2]:
            jitter.see(late_s)
        found.append(jitter.variance_s2)
    assert np.sqrt(np.mean(found)) == pytest.approx(1e-3, rel=0.1)


def test_a_steady_acceleration_is_no_jitter():
    jitter = Jitter()
    for _ in range(100):
        jitter.see(2e-3)
    assert jitter.reach_s == 0.0


def test_a_vehicle_whose_stamps_jitter_does_not_leap(tmp_path):
    """At 22 m/s and 30 Hz, 3 ms make 5 m/s of difference between two motions, and a car brakes by 0.4."""
    source = open_source(
        simulate_points("street", 1, rate_hz=30.0, duration_s=12.0, rest_s=0.0).save(tmp_path / "a.npz")
    )
    odometry = StereoOdometry(source.camera, make_config(max_acceleration_mps2=12.0, max_turn_radps2=20.0))
    late_ns = iter(np.random.default_rng(3).normal(0.0, 3e6, 400).astype(int).tolist())
    records = [odometry.step(replace(frame, t_ns=frame.t_ns + next(late_ns))) for frame in source]
    assert sum(r.status is Status.OK for r in records[1:]) > 0.9 * len(records[1:])


def test_a_frozen_image_leaves_no_doubt_of_what_follows(tmp_path):
    """Standing still is another motion than expected, but nobody believed it: its odds say nothing of the next ones.

    A second after an image that froze for one, a street's sigmas had been 500 times what they were before.
    """
    source = open_source(simulate_points("street", 2, duration_s=10.0, frozen=(7.0, 8.0)).save(tmp_path / "f.npz"))
    odometry = StereoOdometry(source.camera)
    records = [odometry.step(frame) for frame in source]
    assert all(r.status is Status.LOST for r in records[70:80])
    assert all(r.status is Status.OK for r in records[80:])
    before, after = (
        max(np.sqrt(np.trace(r.covariances["triangulation"][:3, :3])) for r in records[part])
        for part in (slice(60, 70), slice(81, 100))
    )
    assert after < 2 * before


@pytest.mark.parametrize(
    ("name", "with_imu", "limits", "doubted"),
    [
        ("tunnel-clean", True, {}, 1),  # over three seconds, a third of the usual points stay near enough to agree
        ("street", False, {"max_acceleration_mps2": 12.0, "max_turn_radps2": 20.0}, 0),
    ],
)
def test_after_three_frozen_seconds_motions_are_good(tmp_path, name, with_imu, limits, doubted):
    """All 81 (tunnel) and 15 (street) were doubtful: as if the vehicle had stood, then leapt; or, against its mean
    velocity over the three seconds, as if it had leapt now."""
    flight = simulate_points(name, 0, duration_s=14.0, frozen=(7.0, 10.0), rate_hz=20.0)
    source = open_source(flight.save(tmp_path / "a.npz"))
    if not with_imu:
        source.imu = None
    records = [step.record for step in steps(source, make_config(**limits))]
    assert all(r.status is Status.LOST for r in records[141:200])
    assert records[200].usable
    assert all(r.status is Status.OK for r in records[200 + doubted :])
