"""Truth beside a log: interpolated exactly; the error of a motion, its side, its axes, and for which motions it is
formed; and the noise of the truth itself, found beside odometry that is noisier than it, and never where there is none.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.errors import (
    estimate_truth_noise,
    interpolate_truth,
    interpolated_between,
    interpolation_sigma,
    made_from_odometry,
    motion_errors,
    outweighed_by_truth,
    steps_of_slow_truth,
    telling_distance_m,
    without_held,
)
from gpvo.dataset.misread import fixed_rotation
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.verdict import verdict
from gpvo.geometry import se3
from gpvo.io.run import write_run
from gpvo.io.run_read import Run, read_run
from gpvo.types import Status, TruthLog, VoLog, VoRecord

N, DT_NS = 12, 50_000_000
RNG = np.random.default_rng(0)
T_TRUE = se3.exp(0.3 * RNG.normal(size=(N, 6)))
XI = 1e-2 * RNG.normal(size=(N, 6))
START_NS = 1_403_636_579_763_555_584
TWIST = np.array([1.0, 0.2, -0.1, 0.0, 0.0, 0.4])
DATA = Path(__file__).parents[2] / "data"
FLIGHTS = ("tunnel-1", "tunnel-2", "tunnel-3", "tunnel-4", "unseen")
TRIALS = 15


def _case() -> tuple[VoLog, TruthLog]:
    """Motion k + 1 goes from frame k to k + 1, its error is XI[k]."""
    t = np.arange(N + 1) * DT_NS
    poses = [se3.exp(np.full(6, 0.7))]
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    for k in range(N):
        poses.append(poses[-1] @ T_TRUE[k])
        records.append(VoRecord(int(t[k + 1]), int(t[k]), Status.OK, T_TRUE[k] @ se3.exp(XI[k])))
    return VoLog(records), TruthLog(t, np.array(poses))


def test_errors_are_on_the_right_of_the_true_motion():
    log, truth = _case()
    found = motion_errors(log, truth)
    np.testing.assert_array_equal(found.index, np.arange(1, N + 1))
    np.testing.assert_allclose(found.xi, XI, atol=1e-12)
    np.testing.assert_allclose(found.T_true, T_TRUE, atol=1e-12)
    np.testing.assert_allclose(found.dt_s, 0.05)


def test_lost_frames_have_no_error_and_degraded_ones_do():
    log, truth = _case()
    records = list(log)
    records[3] = replace(records[3], status=Status.LOST)
    records[4] = replace(records[4], status=Status.DEGRADED)
    found = motion_errors(VoLog(records), truth)
    assert 3 not in found.index
    assert 4 in found.index
    assert 0 not in found.index


def test_a_motion_from_an_older_reference_is_compared_over_its_own_span():
    log, truth = _case()
    records = list(log)
    two = se3.inverse(truth.T_world_cam[2]) @ truth.T_world_cam[4]
    records[3] = replace(records[3], status=Status.LOST)
    records[4] = replace(records[4], t_prev_ns=2 * DT_NS, T_prev_cur=two @ se3.exp(XI[0]))
    found = motion_errors(VoLog(records), truth)
    row = list(found.index).index(4)
    np.testing.assert_allclose(found.xi[row], XI[0], atol=1e-12)
    assert found.dt_s[row] == 0.1


def test_motions_beyond_the_truth_are_left_out():
    log, truth = _case()
    short = TruthLog(truth.t_ns[2:7], truth.T_world_cam[2:7])
    np.testing.assert_array_equal(motion_errors(log, short).index, [3, 4, 5, 6])


def _truth(times_s: np.ndarray) -> TruthLog:
    """Straight and evenly turning: interpolation makes no error."""
    T = se3.exp(np.zeros((len(times_s), 6)))
    T[:, :3, :3] = se3.so3_exp(times_s[:, None] * TWIST[3:])
    T[:, :3, 3] = times_s[:, None] * TWIST[:3]
    return TruthLog(START_NS + np.round(times_s * 1e9).astype(np.int64), T)


def test_even_motion_is_interpolated_exactly():
    truth = _truth(np.arange(0, 2, 0.1))
    t_s = np.array([0.0, 0.033, 0.1, 1.234, 1.9])
    T, known = interpolate_truth(truth, START_NS + np.round(t_s * 1e9).astype(np.int64))
    assert known.all()
    np.testing.assert_allclose(T, _truth(t_s).T_world_cam, atol=1e-9)


def test_outside_and_in_gaps_nothing_is_known():
    truth = _truth(np.array([0.0, 0.1, 0.2, 1.0, 1.1]))
    t_s = np.array([-0.001, 0.0, 0.15, 0.2, 0.6, 1.0, 1.1, 1.101])
    T, known = interpolate_truth(truth, START_NS + np.round(t_s * 1e9).astype(np.int64))
    np.testing.assert_array_equal(known, [False, True, True, True, False, True, True, False])
    assert np.isfinite(T).all()
    assert interpolate_truth(truth, np.array([START_NS + 600_000_000]), max_gap_s=1.0)[1].all()


@pytest.mark.parametrize(("rate_hz", "within"), [(20.0, False), (10.0, False), (2.0, True)])
def test_a_drop_out_of_a_fast_truth_is_not_interpolated(rate_hz, within):
    """Beside frames of 2 Hz, 0.44 s are no hole, beside those of 10 Hz they are; a pose at the stamp is known."""
    times = np.arange(0, 10, 0.005)
    truth = _truth(times[(times < 5.0025) | (times > 5.4375)])  # 5.0 to 5.44 s
    t_s = np.concatenate([np.arange(0, 5, 1 / rate_hz), [5.0, 5.2, 5.44], np.arange(5.5, 9.9, 1 / rate_hz)])
    known = interpolate_truth(truth, START_NS + np.round(t_s * 1e9).astype(np.int64))[1]
    np.testing.assert_array_equal(known, within | (t_s != 5.2))


def test_one_pose_is_known_at_its_stamp_alone_and_none_nowhere():
    one = _truth(np.array([0.0]))
    np.testing.assert_array_equal(interpolate_truth(one, START_NS + np.array([-1, 0, 1]))[1], [False, True, False])
    none = TruthLog(np.empty(0, np.int64), np.empty((0, 4, 4)))
    T, known = interpolate_truth(none, one.t_ns)
    assert T.shape == (1, 4, 4)
    assert not known.any()


@pytest.fixture(scope="module")
def flights() -> list[Run]:
    return [read_run(DATA / name) for name in FLIGHTS]


def noisy(truth: TruthLog, seed: int, sigma_m: float, sigma_rad: float, jitter_s: float = 0.0) -> TruthLog:
    """The truth with white noise on its poses, told at stamps that are off by ``jitter_s``."""
    rng = np.random.default_rng(seed)
    late = np.rint(1e9 * jitter_s * rng.standard_normal(len(truth.t_ns))).astype(np.int64)
    T, _ = interpolate_truth(truth, np.clip(truth.t_ns + late, truth.t_ns[0], truth.t_ns[-1]))
    xi = rng.standard_normal((len(T), 6)) * np.repeat([sigma_m, sigma_rad], 3)
    return TruthLog(truth.t_ns, T @ se3.exp(xi))


def estimates(flights: list[Run], *noise: float) -> np.ndarray:
    """(TRIALS, 6) of the flights in turn."""
    found = []
    for seed in range(TRIALS):
        run = flights[seed % len(flights)]
        assert run.truth is not None
        found.append(estimate_truth_noise(motion_errors(run.log, noisy(run.truth, seed, *noise)), run.log))
    return np.array(found)


@pytest.mark.parametrize("sigma_m,sigma_rad", [(0.003, 0.0004), (0.03, 0.003)])
def test_white_noise_is_found_in_size(flights, sigma_m, sigma_rad):
    """Odometry's own errors are 2 to 14 mm per motion. Each estimate of 200 frames scatters by about 6 %."""
    relative = estimates(flights, sigma_m, sigma_rad) / np.repeat([sigma_m, sigma_rad], 3)
    assert (relative > 0).mean() > 0.9
    assert 0.9 < np.sqrt((relative[relative > 0] ** 2).mean()) < 1.1


def test_jitter_of_stamps_shows_along_the_way(flights):
    """20 ms at about 1 m/s; the camera looks ahead."""
    found = estimates(flights, 0.0, 0.0, 0.02)
    assert (found[:, 2] > 0).mean() > 0.9
    assert 0.015 < np.median(found[:, 2]) < 0.03
    assert np.median(found[:, 2]) > 5 * np.median(found[:, 1])


def test_no_noise_is_found_where_there_is_none(flights):
    for run in flights:
        assert run.truth is not None
        assert not estimate_truth_noise(motion_errors(run.log, run.truth), run.log).any()


@pytest.mark.parametrize("what", ["jitter", "scale"])
def test_errors_of_odometry_are_not_blamed_on_the_truth(flights, what):
    """Noise that two motions share, which looks like the truth's in the errors alone; motions 10 % too long."""
    false_alarms = 0
    for seed, run in enumerate(flights * 2):
        rng, T = np.random.default_rng(seed), run.log.T_prev_cur
        jitter = se3.exp(rng.standard_normal((len(T) + 1, 6)) * np.repeat([0.02, 0.002], 3))
        wrong = se3.inverse(jitter[:-1]) @ T @ jitter[1:] if what == "jitter" else se3.exp(1.1 * se3.log(T))
        log = VoLog([replace(r, T_prev_cur=t) for r, t in zip(run.log, wrong)], run.log.camera)
        false_alarms += int((estimate_truth_noise(motion_errors(log, run.truth), log) > 0).sum())
    assert false_alarms <= 2  # of 60 axes


def test_the_truth_tells_over_a_distance(flights):
    run = flights[4]
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    distances = [telling_distance_m(run.log, T_true, known, np.repeat([s, 0.0], 3)) for s in (0.0, 1e-4, 0.008, 10.0)]
    assert distances[:2] == [0.0, 0.0]
    assert 0.1 < distances[2] < 30.0
    assert np.isinf(distances[3])


@pytest.mark.parametrize("every", [5, 10])
def test_a_truth_that_was_interpolated_is_named(flights, every):
    """On straight lines between every n-th pose, written with six digits; what was measured is not, nor is rest."""
    for run in flights:
        truth = run.truth
        assert interpolated_between(truth) is None
        t_s, p = truth.t_ns * 1e-9, truth.T_world_cam[:, :3, 3]
        kept = slice(None, None, every)
        T = truth.T_world_cam[: (len(p) - 1) // every * every + 1].copy()
        lines = [np.interp(t_s[: len(T)], t_s[kept], axis[kept]) for axis in p.T]
        T[:, :3, 3] = np.round(np.stack(lines, axis=1), 6)
        straight = TruthLog(truth.t_ns[: len(T)], T)
        assert interpolated_between(straight) == every
        told = " ".join(verdict(evaluate_run(replace(run, truth=straight))).lines)
        assert f"straight pieces of {every} poses" in told
    assert interpolated_between(TruthLog(truth.t_ns, np.tile(np.eye(4), (len(p), 1, 1)))) is None


def test_noise_of_the_truth_that_outweighs_motions_is_known_before_training(flights):
    for k, run in enumerate(flights):
        assert not outweighed_by_truth(run.log, run.truth)
        assert outweighed_by_truth(run.log, noisy(run.truth, k, 0.05, 0.005))


def test_evaluate_says_so_and_counts_it_in(flights):
    run = replace(flights[4], truth=noisy(flights[4].truth, 1, 0.03, 0.0))
    found = evaluate_run(run)
    assert 0.025 < found.truth_sigma[:3].mean() < 0.035
    lines = " ".join(verdict(found).lines)
    assert "The truth itself has an estimated noise of 3" in lines
    assert "on its worst axis" in lines  # the table gives the mean of the axes
    assert "its source states none" in lines
    assert "outweighs the odometry's errors on this run" in lines
    c, clean = (evaluate_run(r).consistency["triangulation"] for r in (run, flights[4]))
    assert c.nees_dof["translation"].mean > 3 * clean.nees_dof["translation"].mean
    # What the truth adds outweighs what is stated, and counted in it is no surprise.
    assert 0.7 < c.nees_dof_truth_noise["translation"] < 1.3


def test_a_fixed_rotation_is_reported_where_it_matters(flights):
    turn = se3.exp(np.array([0, 0, 0, 0.02, -0.01, 0.015]))
    for run in flights:
        assert fixed_rotation(run.log, run.truth) is None
    run = flights[4]
    turned = replace(run, truth=replace(run.truth, T_world_cam=run.truth.T_world_cam @ turn))
    found = fixed_rotation(turned.log, turned.truth)
    assert found is not None
    assert found.angle_deg == pytest.approx(np.rad2deg(np.linalg.norm([0.02, 0.01, 0.015])), rel=0.25)
    assert found.error_change < -0.2
    assert any("fixed rotation of 1." in line for line in verdict(evaluate_run(turned)).lines)


def measured(truth: TruthLog, seed: int, sigma_mps: float, *, where: str) -> TruthLog:
    """The truth with its velocities, where positions or velocities err by ``sigma_mps`` for about two seconds."""
    rng, t_s = np.random.default_rng(seed), (truth.t_ns - truth.t_ns[0]) * 1e-9
    decay = np.exp(-np.median(np.diff(t_s)) / 2.0)
    wrong = np.zeros((len(t_s), 3))
    wrong[0] = rng.standard_normal(3)
    for k in range(1, len(t_s)):
        wrong[k] = decay * wrong[k - 1] + np.sqrt(1 - decay**2) * rng.standard_normal(3)
    v_world = np.gradient(truth.T_world_cam[:, :3, 3], t_s, axis=0)
    if where == "velocities":
        return replace(truth, v_world_mps=v_world + sigma_mps * wrong)
    T = truth.T_world_cam.copy()
    T[:, :3, 3] += np.cumsum(sigma_mps * wrong * np.gradient(t_s)[:, None], axis=0)
    return replace(truth, T_world_cam=T, v_world_mps=v_world)


def test_positions_that_drift_are_told_by_the_velocities_beside_them(flights, tmp_path):
    drift, z2, innocent = [], [], []
    for seed, run in enumerate(flights):
        drifting = replace(run, truth=measured(run.truth, seed, 0.1, where="positions"))
        found = evaluate_run(drifting).consistency["triangulation"].one_second
        drift.append(found.truth_drift_m)
        z2.append(found.z2_truth_noise[:3])
        alone = replace(drifting.truth, v_world_mps=None)
        unknown = evaluate_run(replace(run, truth=alone)).consistency["triangulation"].one_second
        assert unknown.truth_drift_m == (0.0, 0.0, 0.0)
        assert max(unknown.z2_truth_noise[:3]) > 5 * max(found.z2_truth_noise[:3])
        for draw in range(4):
            wrong = replace(run, truth=measured(run.truth, 100 * draw + seed, 0.1, where="velocities"))
            innocent += evaluate_run(wrong).consistency["triangulation"].one_second.truth_drift_m
    # Over a second an error of 0.1 m/s that lasts for two makes 0.09 m.
    assert np.sqrt(np.mean(np.square(drift))) == pytest.approx(0.09, rel=0.3)
    assert 0.4 < np.mean(z2) < 1.5
    # One of fifteen at most, over five flights, three axes and four draws each; of 180 such values it is 7 %.
    assert np.count_nonzero(innocent) <= len(innocent) / 15
    write_run(tmp_path / "run", run.log, truth=drifting.truth)
    np.testing.assert_array_equal(read_run(tmp_path / "run").truth.v_world_mps, drifting.truth.v_world_mps)


def _wound(times_s: np.ndarray, least: float = 0.0) -> TruthLog:
    """From rest, with long stops, at a pace that changes; by ``least`` m/s faster, without any."""
    s = np.cumsum(np.clip(np.sin(0.5 * times_s), 0, None) ** 2 + least) * 0.05
    return TruthLog(START_NS + np.round(times_s * 1e9).astype(np.int64), se3.exp(s[:, None] * TWIST))


def test_a_pose_at_true_rest_counts_and_one_that_is_held_while_the_vehicle_moves_does_not():
    times = np.arange(0, 30, 0.05)
    truth = _wound(times)
    assert (np.diff(truth.T_world_cam[:, 0, 3]) == 0).sum() > 100
    assert len(without_held(truth).t_ns) == len(times)
    stalled = truth.T_world_cam.copy()
    stalled[50:70], stalled[300:301] = stalled[50], stalled[299]
    stalled = TruthLog(truth.t_ns, stalled)
    np.testing.assert_array_equal(
        np.flatnonzero(~np.isin(truth.t_ns, without_held(stalled).t_ns)), [*range(51, 70), 300]
    )
    known = interpolate_truth(stalled, truth.t_ns)[1]
    np.testing.assert_array_equal(np.flatnonzero(~known), range(51, 70))  # a single pose is interpolated


@pytest.mark.parametrize("times", [2, 4, 10])
def test_slow_poses_logged_at_a_higher_rate_are_the_slow_truth_that_they_are(times):
    fast = _wound(np.arange(0, 30, 0.05), least=0.01)
    slow = TruthLog(fast.t_ns[::times], fast.T_world_cam[::times])
    held = TruthLog(fast.t_ns, np.repeat(slow.T_world_cam, times, axis=0))
    np.testing.assert_array_equal(without_held(held).t_ns, slow.t_ns)
    assert steps_of_slow_truth(held, fast.t_ns) == pytest.approx((0.05 * times, 0.05))
    np.testing.assert_array_equal(interpolation_sigma(held, fast.t_ns), interpolation_sigma(slow, fast.t_ns))


@pytest.mark.parametrize(("step_s", "frame_s", "first_s"), [(0.1, 0.05, 0.011), (0.2, 0.033, 0.0), (0.5, 0.25, 0.0)])
def test_interpolated_poses_are_as_wrong_as_is_said(step_s, frame_s, first_s):
    """Everywhere between the truth's poses, or at every second of them and midway."""
    stated, true = [], []
    for seed in range(5):
        rng, s = np.random.default_rng(seed), np.arange(0, 60, 0.001)
        waves = np.sin(2 * np.pi * rng.uniform(0.02, 0.15, (6, 1, 1)) * s[:, None] + rng.uniform(0, 7, (6, 1, 6)))
        T = se3.exp((waves * rng.uniform(0.1, 0.5, (6, 1, 6))).sum(axis=0))
        every = TruthLog(np.rint(s * 1e9).astype(np.int64), T)
        truth = TruthLog(every.t_ns[:: round(1e3 * step_s)], T[:: round(1e3 * step_s)])
        frames = slice(round(1e3 * first_s), 59_000, round(1e3 * frame_s))
        found, known = interpolate_truth(truth, every.t_ns[frames])
        true.append((se3.log(se3.inverse(found) @ T[frames])[known] ** 2).mean(axis=0))
        stated.append(interpolation_sigma(truth, every.t_ns[frames]) ** 2)
    np.testing.assert_allclose(np.sqrt(np.mean(stated, axis=0) / np.mean(true, axis=0)), 1.0, atol=0.06)


def test_a_source_that_dies_holds_its_last_pose_to_the_end():
    truth = _wound(np.arange(0, 30, 0.05))
    dead = truth.T_world_cam.copy()
    dead[320:] = dead[320]
    np.testing.assert_array_equal(without_held(TruthLog(truth.t_ns, dead)).t_ns, truth.t_ns[:321])


@pytest.mark.parametrize("digits", [5, 9])
def test_a_truth_that_is_the_odometry_with_its_drift_taken_out_judges_nothing(flights, digits):
    """As a graph of poses does that closes a loop: the drift, 3 % of the path here, is spread over the motions."""
    run, drift = flights[0], se3.exp(np.array([3e-4, -1e-4, 3e-3, 2e-5, 1e-4, -2e-5]))
    poses = np.array([np.linalg.matrix_power(drift, k) for k in range(len(run.log))]) @ run.log.trajectory()
    poses[:, :3, 3] = np.round(poses[:, :3, 3], digits)
    assert not any(made_from_odometry(motion_errors(r.log, r.truth), r.log) for r in flights)
    bent = replace(run, truth=TruthLog(run.log.t_ns, poses))
    assert made_from_odometry(motion_errors(bent.log, bent.truth), bent.log)
    found = verdict(evaluate_run(bent))
    assert not found.judged
    assert "was the truth made from odometry" in found.headline
