"""Stretches in which the truth is in doubt, found where they are and nowhere else: a truth that moves while the vehicle
stands, and one that differs from odometry far more than elsewhere.
"""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset import doubtful
from gpvo.dataset.build import build
from gpvo.dataset.doubtful import in_waits, jumps, odd_stretches, wandering_waits
from gpvo.errors import GpvoError
from gpvo.evaluation.document import document
from gpvo.evaluation.evaluate import EvaluateOptions, evaluate_run
from gpvo.evaluation.score import score_sequence, write_statements
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.io.trajectory import read_tum
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import fit_model
from gpvo.learning.train import estimate_set
from gpvo.runner import run, steps
from gpvo.sim.points import simulate_points
from gpvo.stats.consistency import nll_per_dim
from gpvo.types import ImuMoments, Mounting, Status, StereoCamera, TruthLog, VoLog, VoRecord
from gpvo.vo.config import make_config
from scipy.ndimage import percentile_filter
from synthetic_runs import make_run

# Simulated flights begin at rest.
AT_REST_S = 2.8
CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def fly(tmp_path, seed, scenario="tunnel-clean", duration_s=8.0):
    source = open_source(simulate_points(scenario, seed, duration_s=duration_s).save(tmp_path / f"{seed}.npz"))
    return VoLog([step.record for step in steps(source, make_config())], source.camera), source.truth


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return fly(tmp_path_factory.mktemp("flight"), 3)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The same flight, as a run that is read from its folder."""
    folder = tmp_path_factory.mktemp("flown")
    run(open_source(simulate_points("tunnel-clean", 3, duration_s=8.0).save(folder / "flight.npz")), folder / "run")
    return read_run(folder / "run")


def seconds(log):
    return (log.t_ns - log.t_ns[0]) * 1e-9


def wandering(truth: TruthLog, offset_m: float, start_s: float, end_s: float, period_s: float = 1.5) -> TruthLog:
    """The truth with an offset that comes and goes over a stretch of time."""
    s = (truth.t_ns - truth.t_ns[0]) * 1e-9
    T = truth.T_world_cam.copy()
    during = (s >= start_s) & (s <= end_s)
    T[during, 1, 3] += offset_m * np.sin(np.pi * (s[during] - start_s) / period_s) ** 2
    return replace(truth, T_world_cam=T)


def test_a_truth_that_wanders_at_rest_is_found(flight):
    log, truth = flight
    waits = wandering_waits(log, wandering(truth, 0.2, 0.3, AT_REST_S))
    assert len(waits) == 1
    hit, s = in_waits(log, waits), seconds(log)
    assert hit[(s > 0.3) & (s < AT_REST_S)].all()
    assert not hit[s > AT_REST_S + 1.0].any()


def test_many_waits_are_those_of_each_pair_and_fill_no_memory():
    """Waits of one run lie apart, its odd stretches may overlap; one that a motion only touches is none of its."""
    t, rng = np.arange(0, 60_000, 3), np.random.default_rng(3)
    records = [VoRecord(int(b), int(a), Status.OK, np.eye(4)) for a, b in zip([0, *t[:-1]], t)]
    first = 3 * rng.integers(0, 20_000, 1000)
    waits = np.column_stack([first, first + rng.integers(1, 9, 1000)])
    tracemalloc.start()
    hit = in_waits(VoLog(records), waits)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert hit.tolist() == [bool(((r.t_prev_ns < waits[:, 1]) & (r.t_ns > waits[:, 0])).any()) for r in records]
    assert 0.05 < hit.mean() < 0.5
    assert peak < len(records) * 200 < len(records) * len(waits)


def test_a_vehicle_that_creeps_is_found_to_move_without_a_search_from_each_frame(monkeypatch):
    """At 100 Hz, it moves by a pixel in two thirds of a second."""
    log, truth = make_run(3, n=1500, rate_hz=100.0)
    none, calm = np.zeros(3), np.full(3, 1e-3)
    imu = {"imu_gyro_mean_radps": none, "imu_acc_mean_mps2": none}
    imu |= {"imu_gyro_std_radps": calm, "imu_acc_std_mps2": calm, "spread_u": 0.4, "spread_v": 0.3}
    T = se3.from_rt(np.eye(3), np.array([1.5e-4 * CAMERA.baseline_m, 0.0, 0.0]))
    log = replace(log, camera=CAMERA, records=[replace(r, T_prev_cur=T, disparity_p90_px=100.0, **imu) for r in log])
    looks, later = [0], ImuMoments.with_later

    def counted(self, other):
        looks[0] += 1
        return later(self, other)

    monkeypatch.setattr(ImuMoments, "with_later", counted)
    assert len(wandering_waits(log, truth)) == 0
    assert looks[0] < len(log)
    slower = [replace(r, T_prev_cur=se3.from_rt(np.eye(3), 0.1 * T[:3, 3])) for r in log]
    assert len(wandering_waits(replace(log, records=slower), truth)) > 0


def test_an_exact_truth_is_believed(tmp_path):
    for seed, scenario in enumerate(("tunnel-clean", "tunnel-bursts", "tunnel-noise", "lunar-straight", "room-t265")):
        log, truth = fly(tmp_path, seed, scenario)
        assert len(wandering_waits(log, truth)) == 0, scenario


def test_what_the_picture_would_not_show_is_no_contradiction(flight):
    log, truth = flight
    assert len(wandering_waits(log, wandering(truth, 0.0005, 0.3, AT_REST_S))) == 0


def test_a_truth_that_wanders_while_the_vehicle_moves_is_not_told(flight):
    log, truth = flight
    assert len(wandering_waits(log, wandering(truth, 0.2, 4.0, 7.0))) == 0


def without_imu(r):
    none = dict.fromkeys(("imu_gyro_mean_radps", "imu_gyro_std_radps", "imu_acc_mean_mps2", "imu_acc_std_mps2"))
    return replace(r, **none)


def test_odometry_that_sees_no_motion_needs_the_gyroscope_for_a_witness(flight):
    """A lorry ahead that fills the image: odometry stands still, truth moves, and so does the gyroscope."""
    log, truth = flight
    moved = wandering(truth, 0.2, 0.3, AT_REST_S)
    rng = np.random.default_rng(0)
    shaken = [
        r if r.imu_gyro_mean_radps is None else replace(r, imu_gyro_mean_radps=0.01 * rng.standard_normal(3))
        for r in log.records
    ]
    for records in ([without_imu(r) for r in log.records], shaken):
        assert len(wandering_waits(VoLog(records, log.camera), moved)) == 0
    assert len(wandering_waits(VoLog(log.records, None), moved)) == 0


def test_rows_of_such_waits_are_left_out_and_counted(flight):
    log, truth = flight
    moved = wandering(truth, 0.2, 0.3, AT_REST_S)
    dropped, kept, exact = (
        build(log, t, name="a", waits=w) for t, w in ((moved, "drop"), (moved, "keep"), (truth, "drop"))
    )
    assert dropped.counts["truth_moves_at_rest"] == len(kept) - len(dropped) > 30
    assert kept.counts["truth_moves_at_rest"] == exact.counts["truth_moves_at_rest"] == 0
    assert dropped.counts["without_truth"] == exact.counts["without_truth"]
    at = np.isin(exact.t_ns, dropped.t_ns)
    np.testing.assert_allclose(dropped.Y, exact.Y[at], atol=1e-12)
    np.testing.assert_array_equal(dropped.X, exact.X[at])


def test_windows_that_reach_into_such_a_wait_are_left_out(flight):
    log, truth = flight
    moved = wandering(truth, 0.2, 0.3, AT_REST_S)
    s = build(log, moved, name="a", target="window:0.5s")
    exact = build(log, truth, name="a", target="window:0.5s")
    at = np.isin(exact.t_ns, s.t_ns)
    assert 0 < at.sum() < len(exact)
    np.testing.assert_allclose(s.Y, exact.Y[at], atol=1e-12)


def test_another_word_for_waits_is_refused(flight):
    with pytest.raises(GpvoError, match="drop or keep"):
        build(*flight, name="a", waits="leave")


def test_consistency_is_not_judged_by_such_a_truth_but_the_path_is(flown, tmp_path):
    moved = replace(flown, truth=wandering(flown.truth, 0.2, 0.3, AT_REST_S))
    evaluations = [evaluate_run(r, options=EvaluateOptions(truth_sigma=(0.0, 0.0))) for r in (flown, moved)]
    exact, judged = document(evaluations)["runs"]
    assert exact["truth_moves_at_rest"] == 0 < judged["truth_moves_at_rest"]
    nees = [d["methods"]["triangulation"]["nees_dof"]["joint"] for d in (exact, judged)]
    assert 0.5 < nees[1] / nees[0] < 2.0
    assert judged["ate_rmse_m"] > 2.0 * exact["ate_rmse_m"]
    # Nor by its file: gpvo score, which knows of no IMU, gives the same.
    write_statements(evaluations[1], tmp_path / "stated", "flight")
    of_files = score_sequence(*(tmp_path / "stated" / of / "flight.txt" for of in ("triangulation", "truth")))
    assert of_files["nees_dof"] == pytest.approx(nees[1], rel=1e-3)


def test_a_motion_over_the_whole_wait_is_not_scored_by_its_file_either(flown, tmp_path):
    truth = wandering(flown.truth, 0.2, 0.3, AT_REST_S)
    ((first, last),) = wandering_waits(flown.log, truth)
    records = [replace(r, t_prev_ns=int(first)) if r.t_ns == last else r for r in flown.log.records]
    evaluation = evaluate_run(replace(flown, log=replace(flown.log, records=records), truth=truth))
    write_statements(evaluation, tmp_path / "stated", "flight")
    T_true = read_tum(tmp_path / "stated" / "truth" / "flight.txt")
    assert first in T_true.t_ns
    assert last not in T_true.t_ns


@pytest.mark.slow
def test_waits_with_a_wandering_truth_spoil_a_model_that_learns_from_them(tmp_path):
    """Six flights of 16 s teach, three of exact truth judge; the truth of the six wanders by 0.1 m at rest."""
    flights = [fly(tmp_path, seed, duration_s=16.0) for seed in range(20, 29)]
    tests = [build(*f, name=str(i)) for i, f in enumerate(flights[6:])]

    def nll(waits):
        moved = [(log, wandering(truth, 0.1, 0.3, AT_REST_S)) for log, truth in flights[:6]]
        learned = fit_model([build(*f, name=str(i), waits=waits) for i, f in enumerate(moved)], TrainConfig())
        said = [estimate_set(learned.model, s) for s in tests]
        return np.mean([nll_per_dim(s.Y - e.mean, e.covariance).mean() for s, e in zip(tests, said, strict=True)])

    assert nll("drop") < nll("keep") - 0.05


@pytest.mark.parametrize("seed", range(4))
def test_good_data_has_none(seed):
    assert odd_stretches(*make_run(seed)) == []


def test_the_bundled_flights_have_none():
    data = Path(__file__).parents[2] / "data"
    runs = [read_run(p.parent) for p in sorted(data.glob("*/run.json"))]
    assert len(runs) >= 2
    assert all(odd_stretches(r.log, r.truth) == [] for r in runs if r.truth is not None)


def test_the_head_of_a_log_that_shows_half_the_motion():
    log, truth = make_run(1)
    halved = [se3.from_rt(r.T_prev_cur[:3, :3], 0.5 * r.T_prev_cur[:3, 3]) for r in log]
    log = replace(
        log, records=[replace(r, T_prev_cur=T) if 2 <= k <= 7 else r for k, (r, T) in enumerate(zip(log, halved))]
    )
    (found,) = odd_stretches(log, truth)
    assert (found.first, found.last) == (2, 7)
    assert found.what.startswith(("odometry shows 0.4", "odometry shows 0.5"))
    kept, dropped = (build(log, truth, name="a", odd=way) for way in ("keep", "drop"))
    assert kept.counts["odd"] == dropped.counts["odd"] == len(kept) - len(dropped) == 6
    with pytest.raises(GpvoError, match="unknown treatment of odd stretches: 'guess'"):
        build(log, truth, name="a", odd="guess")


def test_a_truth_that_climbs_while_the_vehicle_does_not():
    log, truth = make_run(2, n=800)
    T = truth.T_world_cam.copy()
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    # By 6 % of the way along the camera's own vertical, between two times.
    start, end = truth.t_ns[[len(T) // 4, 3 * len(T) // 8]]
    inside = (truth.t_ns >= start) & (truth.t_ns <= end)
    step = 0.06 * np.where(inside, np.gradient(path_m), 0.0)
    T[:, :3, 3] += np.cumsum(step[:, None] * T[:, :3, 1], axis=0)
    found = odd_stretches(log, replace(truth, T_world_cam=T))
    assert len(found) == 1
    assert "vertically" in found[0].what
    covered = min(found[0].t_ns[1], end) - max(found[0].t_ns[0], start)
    assert covered > 0.8 * (end - start)


def white_noise_run(seed: int, rate_hz: int, stepped: bool, speed_mps: float = 1.0, depth: float = 1.0):
    """40 s with a random walk of 1 cm after a second; where it is stepped, a half or four times that, by 10 s.

    ``depth``: so many times as much in depth; then the vehicle moves across the line of sight too.
    """
    rng, n = np.random.default_rng(seed), 40 * rate_hz
    t_s = np.arange(n) / rate_hz
    twist = np.zeros((n, 6))
    twist[:, 2] = speed_mps * (1.0 + 0.5 * np.sin(0.4 * t_s + seed))
    twist[:, 4] = 0.3 * np.sin(0.3 * t_s)
    size = np.repeat(rng.choice([0.5, 1.0, 4.0], 4), 10 * rate_hz) if stepped else np.ones(n)
    twist[:, 0] = 0.0 if depth == 1.0 else twist[:, 2]
    sigma = np.outer(size, [0.01, 0.01, 0.01 * depth, 0.003, 0.003, 0.003]) / np.sqrt(rate_hz)
    T_true = se3.exp(twist / rate_hz)
    T_est = T_true @ se3.exp(sigma * rng.standard_normal((n, 6)))
    t_ns = np.arange(n + 1) * (10**9 // rate_hz)
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    records += [VoRecord(int(b), int(a), Status.OK, T) for a, b, T in zip(t_ns, t_ns[1:], T_est)]
    poses = list(accumulate(T_true, np.matmul, initial=np.eye(4)))
    return VoLog(records, None), TruthLog(t_ns, np.array(poses))


@pytest.mark.parametrize(("n", "count"), [(100, 50), (101, 50), (333, 77), (2500, 501)])
def test_noise_is_told_by_scipys_percentile_around_each_motion(n, count):
    rng = np.random.default_rng(n)
    errors, stated = rng.standard_normal((n, 4)), rng.uniform(0.1, 1.0, n)
    steps = np.abs(np.diff(errors / stated[:, None], axis=0))
    quartile = percentile_filter(np.concatenate([steps, steps[-1:]]), 75, size=(count, 1))
    # The upper quartile of the size of a Gaussian is 1.1503 standard deviations; a step has two of noise.
    expected = quartile / (1.1503 * np.sqrt(2)) * stated[:, None]
    np.testing.assert_array_equal(doubtful._white_noise(errors, stated, count), expected)


def test_honest_white_noise_raises_no_alarm_at_any_rate():
    found = [odd_stretches(*white_noise_run(seed, (10, 50, 200)[seed % 3], seed % 2 == 1)) for seed in range(40)]
    assert sum(bool(f) for f in found) <= 2, found


def test_noise_that_is_larger_in_depth_raises_no_alarm_either():
    found = [odd_stretches(*white_noise_run(seed, 20, False, depth=4.0)) for seed in range(40)]
    assert sum(bool(f) for f in found) <= 2, found


def test_a_log_of_impossible_rate_is_too_short_to_have_any():
    log, truth = white_noise_run(0, 10, stepped=False)
    faster = [replace(r, t_ns=r.t_ns // 1000, t_prev_ns=r.t_prev_ns // 1000) for r in log.records]
    assert odd_stretches(VoLog(faster, None), replace(truth, t_ns=truth.t_ns // 1000)) == []


@pytest.mark.parametrize("rate_hz", [10, 50, 200])
def test_a_climb_is_one_stretch_at_any_rate(rate_hz):
    log, truth = white_noise_run(1, rate_hz, stepped=False)
    T, climbs = truth.T_world_cam.copy(), slice(12 * rate_hz, 18 * rate_hz)
    T[:, 1, 3] += 0.1 * np.cumsum(np.isin(np.arange(len(T)), np.arange(len(T))[climbs])) / rate_hz
    (found,) = odd_stretches(log, replace(truth, T_world_cam=T))
    assert "vertically" in found.what
    assert found.first < 13 * rate_hz
    assert found.last > 17 * rate_hz


@pytest.mark.parametrize("rate_hz", [10, 50])
def test_a_slip_is_no_stretch(rate_hz):
    """One motion 0.5 m off, sideways: a slip of the odometry or a jump of the truth, and nothing around it is odd."""
    log, truth = white_noise_run(1, rate_hz, stepped=False)
    T = truth.T_world_cam.copy()
    T[12 * rate_hz :, 0, 3] += 0.5
    assert odd_stretches(log, replace(truth, T_world_cam=T)) == []


@pytest.mark.parametrize("size", [0.3, 5.0])
def test_a_slip_askew_is_no_odd_stretch_either(size):
    """A closed loop, or another map: what it makes of a window is partly along other axes than its own."""
    for seed in range(8):
        log, truth = white_noise_run(seed, 10, stepped=False)
        slip = se3.exp(size * np.random.default_rng(seed).standard_normal(6) * [1, 1, 1, 0.2, 0.2, 0.2])
        records = [replace(r, T_prev_cur=r.T_prev_cur @ slip) if k == 150 else r for k, r in enumerate(log.records)]
        assert odd_stretches(VoLog(records, None), truth) == []


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rate_hz", [10, 200])
def test_a_log_at_rest_has_none_and_no_warnings(rate_hz):
    log, truth = white_noise_run(0, rate_hz, stepped=False)
    still = replace(truth, T_world_cam=np.broadcast_to(np.eye(4), truth.T_world_cam.shape))
    resting = [replace(r, T_prev_cur=np.eye(4)) for r in log.records]
    for records in (white_noise_run(0, rate_hz, False, speed_mps=0.0)[0].records, resting):
        assert odd_stretches(VoLog(records, None), still) == []


ELSEWHERE = se3.exp(np.array([3.0, -2.0, 1.0, 0.0, 0.0, 0.5]))


@pytest.mark.parametrize("rate_hz", [10, 50])
@pytest.mark.parametrize("lasts", [3, None])
def test_a_jump_of_the_truth_is_its_own_and_not_learned_from(rate_hz, lasts):
    """Two pieces with different origins; and markers that are confused for a moment, with what lies between."""
    log, truth = white_noise_run(1, rate_hz, stepped=False)
    assert jumps(log, truth) == []
    k, T = 12 * rate_hz, truth.T_world_cam.copy()
    end = len(T) if lasts is None else k + lasts
    T[k:end] = ELSEWHERE @ T[k:end]
    moved = replace(truth, T_world_cam=T)
    (found,) = jumps(log, moved)
    assert (found.first, found.last) == (k, k if lasts is None else end)
    assert "truth jumps" in found.what
    kept, dropped = (build(log, moved, name="a", waits=way) for way in ("keep", "drop"))
    assert len(kept) - len(dropped) == dropped.counts["truth_moves_at_rest"] == found.last - found.first + 1
    assert np.abs(kept.Y[:, :3]).max() > 1.0
    assert np.abs(dropped.Y[:, :3]).max() < 0.1


def test_a_jump_of_the_odometry_or_of_both_is_none_of_the_truth():
    log, truth = white_noise_run(1, 20, stepped=False)
    k, T = 240, truth.T_world_cam.copy()
    T[k:] = ELSEWHERE @ T[k:]
    far = se3.inverse(T[k - 1]) @ T[k]
    slipped = replace(log, records=[replace(r, T_prev_cur=far) if i == k else r for i, r in enumerate(log.records)])
    assert jumps(slipped, truth) == []
    assert jumps(slipped, replace(truth, T_world_cam=T)) == []


def test_no_noise_of_the_truth_looks_like_a_jump():
    log, truth = white_noise_run(1, 50, stepped=False)
    for sigma_m in (0.001, 0.01, 0.1):
        noise = np.random.default_rng(0).standard_normal((len(truth.t_ns), 6)) * ([sigma_m] * 3 + [0.1 * sigma_m] * 3)
        assert jumps(log, replace(truth, T_world_cam=truth.T_world_cam @ se3.exp(noise))) == []


@pytest.mark.parametrize("seed", range(4))
def test_markers_that_are_confused_between_frames_are_seen_at_the_rate_of_the_truth(seed):
    """Motion capture at 100 Hz turns by a quarter for 20 ms to 8 s. Between frames at 10 Hz, a vehicle may turn so."""
    fast, truth = white_noise_run(seed, 100, stepped=False)
    T_est, rng = fast.trajectory()[::10], np.random.default_rng(seed)
    motions = se3.inverse(T_est[:-1]) @ T_est[1:]
    t = fast.t_ns[::10].tolist()
    records = [VoRecord(b, a, Status.OK, M) for (a, b), M in zip(pairwise(t), motions, strict=True)]
    log = VoLog([VoRecord(t[0], t[0], Status.START, np.eye(4)), *records])
    assert jumps(log, truth) == []
    T, wrong = truth.T_world_cam.copy(), np.zeros(len(log), dtype=bool)
    for first, lasts in zip((320, 560, 820), (rng.integers(2, 90), rng.integers(90, 110), 800), strict=True):
        confused = slice(first, first + lasts)
        T[confused] = T[confused] @ se3.exp(np.array([0.03, -0.02, 0.01, 0.0, np.pi / 2, 0.0]))
        off = np.isin(np.arange(len(log)) * 10, np.arange(len(T))[confused])
        wrong |= off | np.append(False, off[:-1])
    turned = replace(truth, T_world_cam=T)
    found = jumps(log, turned)
    np.testing.assert_array_equal(in_waits(log, [s.t_ns for s in found]), wrong)
    run = Run(Path("mocap"), "mocap", log, turned, None, Mounting(), [])
    assert np.rad2deg(evaluate_run(run).trajectory.rpe_frame.rotation_rad.max) < 5.0


def test_the_noise_around_each_motion_fills_no_memory():
    """Each block's quartiles were views that kept its windows: 8 kB a motion, so that a million took 8 GB."""
    errors = np.random.default_rng(0).standard_normal((20_000, 6))
    tracemalloc.start()
    sigma = doubtful._white_noise(errors, np.ones(len(errors)), 166)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6
    assert np.abs(sigma - 1.0).mean() < 0.1
