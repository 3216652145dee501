"""Starts: from truth, from rest, in a world whose z is not up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.evaluation.flights import start_sigmas
from gpvo.filters.policies import GeometricPolicy, LearnedPolicy
from gpvo.filters.propagation import BA, BG, TH, V
from gpvo.filters.run import Flight, FuseOptions, begin, fuse_flight
from gpvo.filters.start import StartSigmas, from_rest, from_truth, vertical_in_world
from gpvo.geometry import se3
from gpvo.io.run import read_run, write_run
from gpvo.types import ImuLog, Status, StereoCamera, TruthLog, VoLog, VoRecord
from synthetic_flights import synthetic_flight, with_geometric


def _rest(rng: np.random.Generator, R: np.ndarray, bias: np.ndarray, n: int = 100) -> ImuLog:
    force = R.T @ np.array([0, 0, 9.80665]) + bias
    t = np.arange(n, dtype=np.int64) * 5_000_000
    gyro = np.array([0.01, -0.02, 0.005]) + 0.002 * rng.standard_normal((n, 3))
    return ImuLog(t, gyro, force + 0.02 * rng.standard_normal((n, 3)))


def test_static_start_knows_its_tilt_and_bias_together() -> None:
    rng = np.random.default_rng(0)
    sigma = StartSigmas().acc_bias_mps2
    nees, of_gyro = [], []
    for _ in range(300):
        R = se3.so3_exp(rng.standard_normal(3) * [0.5, 0.5, 1.5])
        bias = sigma * rng.standard_normal(3)
        imu = _rest(rng, R, bias)
        start = from_rest(imu, 0, T_world_imu=se3.from_rt(R, np.zeros(3)))
        error = np.concatenate([se3.so3_log(start.nominal.R_world_imu[0].T @ R), bias])
        rows = np.r_[TH, BA]
        C = start.covariance[np.ix_(rows, rows)]
        # Yaw is given here and the vertical bias is not seen: what remains is four of the six.
        nees.append(error @ np.linalg.solve(C, error))
        off = start.nominal.gyro_bias[0] - [0.01, -0.02, 0.005]
        np.testing.assert_allclose(off, 0.0, atol=1e-3)
        of_gyro.append(off @ np.linalg.solve(start.covariance[BG, BG], off))
        np.linalg.cholesky(start.covariance)
    assert 2.0 < np.mean(nees) < 6.5
    # Three axes, each seen: the mean of 900 squares scatters by sqrt(2 / 900), 5 %; four of that.
    assert 0.8 < np.mean(of_gyro) / 3 < 1.2


def test_a_start_is_as_unsure_of_heading_and_vertical_as_asked() -> None:
    R, sigmas = se3.so3_exp(np.array([0.4, -0.7, 1.0])), StartSigmas(yaw_rad=0.3, tilt_rad=0.02)
    still = from_rest(_rest(np.random.default_rng(3), R, np.zeros(3)), 0, sigmas)
    poses = np.tile(se3.from_rt(R, np.zeros(3)), (5, 1, 1))
    told = from_truth(50_000_000 * np.arange(5), poses, sigmas)
    up = R[2]  # in the axes of the body, as the error of the attitude is
    across = np.cross(up, [1.0, 0, 0]) / np.linalg.norm(np.cross(up, [1.0, 0, 0]))
    for start, tilt_rad in ((still, sigmas.acc_bias_mps2 / 9.80665), (told, 0.02)):
        C = start.covariance[TH, TH]
        assert up @ C @ up == pytest.approx(0.3**2, rel=0.01)
        assert across @ C @ across == pytest.approx(tilt_rad**2, rel=0.05)
    np.testing.assert_allclose(np.sqrt(np.diagonal(still.covariance[V, V])), 0.01)


def test_a_static_start_in_a_world_whose_z_is_not_up() -> None:
    rng, t_ns = np.random.default_rng(3), np.arange(40) * 50_000_000
    for turn in ([np.radians(3.0), 0, 0], [np.pi / 2, 0, 0], [np.pi, 0.1, 0.2]):
        R, R_world_level = (se3.so3_exp(np.array(v)) for v in ([0.2, -0.3, 2.5], turn))
        T = np.tile(se3.from_rt(R_world_level @ R, np.array([1.0, 2, 3])), (len(t_ns), 1, 1))
        records = [VoRecord(int(t), int(max(t - 50_000_000, 0)), Status.OK, np.eye(4)) for t in t_ns]
        start, gravity = begin(
            Flight("rest", records, _rest(rng, R, np.zeros(3), 400), None, T), FuseOptions(init="static")
        )
        assert gravity is not None
        np.testing.assert_allclose(gravity, R_world_level @ [0, 0, -9.80665], atol=0.05)
        np.testing.assert_allclose(start.nominal.position[0], [1, 2, 3])
        assert np.linalg.norm(se3.so3_log(start.nominal.R_world_imu[0].T @ T[0, :3, :3])) < 5e-3
        assert "gravity measured" in start.note


def test_static_start_refuses_a_moving_vehicle() -> None:
    imu = _rest(np.random.default_rng(1), np.eye(3), np.zeros(3))
    with pytest.raises(GpvoError, match=r"not at rest.*turn rate"):
        from_rest(replace(imu, gyro_radps=imu.gyro_radps + 0.5), 0)
    # Falling, or launched straight up, an IMU is as quiet as at rest; only the size of the force tells.
    for force_mps2 in (0.0, 9.0, 29.0):
        falling = replace(imu, acc_mps2=imu.acc_mps2 * force_mps2 / 9.80665)
        with pytest.raises(GpvoError, match=r"not at rest.*off gravity"):
            from_rest(falling, 0)
    with pytest.raises(GpvoError, match="10 IMU samples"):
        from_rest(imu, 10**12)


def test_truth_start_finds_velocity() -> None:
    t = np.arange(5) * 50_000_000
    s = t * 1e-9
    poses = se3.from_rt(np.tile(np.eye(3), (5, 1, 1)), np.stack([2 * s + s**2, -s, 0 * s], axis=1))
    start = from_truth(t, poses)
    np.testing.assert_allclose(start.nominal.velocity[0], [2, -1, 0], atol=1e-9)
    with pytest.raises(GpvoError, match="first two frames"):
        from_truth(t[:1], poses[:1])


def test_the_velocity_of_a_noisy_truth_is_as_unsure_as_it_says(tmp_path: Path) -> None:
    """The noise of five poses through a parabola's slope; without noise, what the start always says."""
    rng = np.random.default_rng(2)
    flight = synthetic_flight(3, duration_s=2)
    assert flight.T_world_cam is not None
    t_ns = np.array([r.t_ns for r in flight.records])
    write_run(tmp_path / "run", VoLog(flight.records), truth=TruthLog(t_ns, flight.T_world_cam))
    run = read_run(tmp_path / "run")
    assert run.truth is not None
    assert start_sigmas([run]) == StartSigmas()
    stated = start_sigmas([replace(run, truth=replace(run.truth, sigma_translation_m=0.01))])
    assert stated.position_m == 0.01
    still = np.tile(np.eye(4), (5, 1, 1))
    velocities = []
    for _ in range(2000):
        still[:, :3, 3] = 0.01 * rng.standard_normal((5, 3))
        velocities.append(from_truth(t_ns[:5], still).nominal.velocity[0])
    assert stated.velocity_mps == pytest.approx(np.std(velocities), rel=0.03)
    assert stated.velocity_mps == pytest.approx(1.1 * 0.01 / 0.05, rel=0.02)


def test_a_world_whose_z_is_not_up() -> None:
    flight = synthetic_flight(3, duration_s=10)
    tilted = se3.from_rt(se3.so3_exp(np.array([np.pi / 2, 0, 0])), np.zeros(3))
    assert flight.T_world_cam is not None
    turned = replace(flight, T_world_cam=tilted @ flight.T_world_cam)
    start, gravity = begin(turned, FuseOptions())
    assert gravity is not None
    np.testing.assert_allclose(gravity, tilted[:3, :3] @ [0, 0, -9.80665], atol=0.2)
    assert "gravity measured" in start.note
    run = fuse_flight(turned, LearnedPolicy())
    assert run.scores is not None
    assert run.scores.final_error_m < 1.0


def _verticals(rate_hz: float, duration_s: float) -> tuple[float, float, float]:
    """Of 24 flights: squared error over stated variance; rms error and median sigma [rad]."""
    squares, off_rad, sigmas_rad = [], [], []
    for seed in range(24):
        flight = synthetic_flight(seed, duration_s=duration_s, rate_hz=rate_hz, turn_on=(0.05, 5e-3))
        assert flight.imu is not None
        t_ns = np.array([r.t_ns for r in flight.records])
        up, C = vertical_in_world(flight.imu, t_ns, flight.T_world_imu, 0.05)
        off = np.cross([0.0, 0.0, 1.0], up)[:2]
        squares.append(off @ np.linalg.solve(C[:2, :2], off) / 2)
        off_rad.append(off)
        sigmas_rad.append(np.sqrt(np.trace(C[:2, :2]) / 2))
    return float(np.mean(squares)), float(np.sqrt(np.square(off_rad).mean())), float(np.median(sigmas_rad))


@pytest.mark.parametrize(("rate_hz", "duration_s"), [(2.0, 8.0), (2.0, 15.0), (20.0, 3.0), (20.0, 15.0)])
def test_the_vertical_is_as_unsure_as_stated(rate_hz: float, duration_s: float) -> None:
    """Turning tells an accelerometer's bias from gravity."""
    squares, _, sigma_rad = _verticals(rate_hz, duration_s)
    assert 0.4 < squares < 1.6
    if duration_s > 5.0:
        assert sigma_rad < 0.4 * 0.05 / 9.80665  # what the bias alone would leave of a straight flight


def test_sparse_poses_tell_the_vertical_as_well_as_dense_ones() -> None:
    """Of a truth without noise; slopes of a path seen twice a second would be wrong by how it bends."""
    assert _verticals(2.0, 15.0)[1] < 1.5 * _verticals(20.0, 15.0)[1]


def test_a_recording_that_paused_tells_the_vertical_as_one_that_did_not() -> None:
    """All stamps jump by minutes, twice, while nothing moves."""
    flight = synthetic_flight(5, duration_s=20)
    assert flight.imu is not None
    t_ns = np.array([r.t_ns for r in flight.records])

    def paused(stamps: np.ndarray) -> np.ndarray:
        return stamps + sum(np.where(stamps > t_ns[k], pause, 0) for k, pause in ((90, 180 * 10**9), (230, 4 * 10**11)))

    (up, C), (later, _) = (
        vertical_in_world(replace(flight.imu, t_ns=of(flight.imu.t_ns)), of(t_ns), flight.T_world_imu, 0.05)
        for of in (np.asarray, paused)
    )
    assert np.linalg.norm(np.cross(up, later)) < np.sqrt(np.trace(C))


@pytest.mark.parametrize("tilt_deg", [0.8, 3.0, 45.0])
def test_a_truth_that_is_not_level_is_judged_as_one_that_is(tilt_deg: float) -> None:
    tilted = se3.from_rt(se3.so3_exp(np.radians([tilt_deg, 0, 0])), np.zeros(3))
    scores = []
    for seed in range(8):
        flight = synthetic_flight(seed, duration_s=15, turn_on=(0.05, 5e-3))  # as the filter expects
        assert flight.T_world_cam is not None
        turned = replace(flight, T_world_cam=tilted @ flight.T_world_cam)
        scores.append(fuse_flight(turned, LearnedPolicy()).scores)
    # Errors of eight flights of 15 s: the position's have some ten independent ones. At first, the tilt counts twice:
    # in the filter's covariance, and in how far the truth's vertical may be from its own.
    assert 0.3 < np.mean([s.nees_position for s in scores]) < 2.0
    assert 0.3 < np.mean([s.nees_attitude for s in scores]) < 2.0


def test_the_velocity_of_sparse_truth_is_as_unsure_as_its_path_bends() -> None:
    rng, squares = np.random.default_rng(4), []
    for _ in range(200):
        phase, amplitude = rng.uniform(0, 2 * np.pi, 3), rng.uniform(1.0, 4.0, 3)
        t = np.arange(5) * 1.0
        swing = 2 * np.pi * 0.1 * t[:, None] + phase
        poses = se3.from_rt(np.tile(np.eye(3), (5, 1, 1)), amplitude * np.sin(swing))
        start = from_truth(np.round(t * 1e9).astype(np.int64), poses)
        error = start.nominal.velocity[0] - 2 * np.pi * 0.1 * amplitude * np.cos(phase)
        squares.append(error**2 / np.diagonal(start.covariance)[3:6])
    # The fourth derivative adds what jerk does not tell: cautious or bold by a factor of two in sigma at most.
    assert 0.25 < np.mean(squares) < 4.0
    assert np.median(squares) < 2.0


def test_missing_inputs_are_one_line() -> None:
    flight = synthetic_flight(3, duration_s=2)
    blind = replace(flight, T_world_cam=None, truth_valid=None)
    with pytest.raises(GpvoError, match="ground truth.*gpvo import RUN --truth .*--twins .*nor does --init static"):
        begin(blind, FuseOptions())
    with pytest.raises(GpvoError, match="needs an IMU.*use --init truth"):
        begin(replace(flight, imu=None), FuseOptions(init="static"))
    # Without truth, each start would send to the other, as it would with truth of one frame.
    one = replace(flight, truth_valid=np.arange(len(flight.records)) == 0)
    for moving in (blind, one):
        with pytest.raises(GpvoError, match="not at rest.*gpvo import RUN --truth .*--twins .*begins at rest") as told:
            begin(moving, FuseOptions(init="static"))
        assert "--init truth" not in str(told.value)
    with pytest.raises(GpvoError, match="not at rest.*use --init truth"):
        begin(flight, FuseOptions(init="static"))
    for init in ("truth", "static"):
        with pytest.raises(GpvoError, match=r"gpvo import RUN --truth .*--twins needs none, for a run with tracks\)"):
            begin(replace(blind, imu=None), FuseOptions(init=init))


def test_a_tiny_rig_is_filtered_as_any_other(tmp_path: Path) -> None:
    """All lengths a thousandth, as of an endoscope: a start, or a walk of the velocity, of fixed size drowned its
    errors."""
    camera, C = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.25, 640, 480), np.diag([1e-6] * 3 + [1e-8] * 3)
    flight, scores = replace(synthetic_flight(3, duration_s=10), imu=None, T_imu_cam=None), []
    assert flight.T_world_cam is not None
    for scale in (1.0, 1e-3):
        S = np.diag([scale] * 3 + [1.0] * 3)
        records, T = with_geometric(flight, S @ C @ S).records, flight.T_world_cam.copy()
        records = [replace(r, T_prev_cur=_scaled(r.T_prev_cur, scale)) for r in records]
        truth = TruthLog(np.array([r.t_ns for r in records]), _scaled(T, scale))
        log = VoLog(records, replace(camera, baseline_m=scale * camera.baseline_m))
        write_run(tmp_path / f"{scale:g}", log, truth=truth)
        options = FuseOptions(sigmas=start_sigmas([read_run(tmp_path / f"{scale:g}")]))
        tiny = replace(flight, records=records, T_world_cam=truth.T_world_cam, predictions={})
        scores.append(fuse_flight(tiny, GeometricPolicy("triangulation"), options).scores)
    assert scores[1].ate_rmse_m == pytest.approx(1e-3 * scores[0].ate_rmse_m, rel=0.01)
    for block, nees in scores[0].nees_dof.items():
        assert scores[1].nees_dof[block] == pytest.approx(nees, rel=0.02)


def _scaled(T: np.ndarray, scale: float) -> np.ndarray:
    return se3.from_rt(T[..., :3, :3], scale * T[..., :3, 3])
