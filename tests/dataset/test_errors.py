"""Truth beside a log: interpolated exactly; the error of a motion, its side, its axes, and for which motions it is
formed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.errors import (
    interpolate_truth,
    interpolated_between,
    interpolation_sigma,
    motion_errors,
    steps_of_slow_truth,
    without_held,
)
from gpvo.dataset.misread import fixed_rotation
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.verdict import verdict
from gpvo.geometry import se3
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
