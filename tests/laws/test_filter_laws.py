"""Laws of the error-state filter: what must hold whatever the flight."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from gpvo.filters import measurement as me
from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.measurement import Gate
from gpvo.filters.policies import ConstantPolicy
from gpvo.filters.propagation import BA, BG, CORE, TH, Nominal, P, V, imu_step
from gpvo.filters.run import Flight, FuseOptions, ate_of_members, fuse_flight
from gpvo.filters.start import StartSigmas
from gpvo.filters.study import Constants, grid_scores
from gpvo.filters.timeline import Timeline
from gpvo.geometry import se3
from gpvo.types import ImuLog, MotionError, Status, VoRecord
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_flights import FORWARD_CAMERA, MEMS, smooth_path

ACCEPT = Gate(on_fail="accept")
GRAVITY = np.array([0.0, 0.0, -9.80665])


def _nominal(batch: int = 1, velocity: float = 0.0) -> Nominal:
    zero = np.zeros((batch, 3))
    v = zero.copy()
    v[:, 0] = velocity
    return Nominal(zero.copy(), v, np.broadcast_to(np.eye(3), (batch, 3, 3)).copy(), zero.copy(), zero.copy())


def _filter(covariance: np.ndarray) -> ErrorStateFilter:
    return ErrorStateFilter(_nominal(), covariance, imu_noise=MEMS, T_imu_cam=FORWARD_CAMERA)


def _noise(rng: np.random.Generator, scale: float = 1e-3, parts: bool = True) -> MotionError:
    def spd(size: float) -> np.ndarray:
        A = rng.standard_normal((6, 6)) * size
        return (A @ A.T + size**2 * np.eye(6))[None]

    if not parts:
        return MotionError.independent(spd(scale))
    root, tau_s = scale * np.eye(6, 12)[None], np.full(12, 5.0)
    white = spd(scale)
    return MotionError(
        mean=np.zeros((1, 6)), jitter=spd(scale), white=white, persistent_root=root, persistent_tau_s=tau_s
    )


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), log_scale=st.floats(-6, 1), dt=st.floats(1e-3, 0.1), parts=st.booleans())
def test_covariance_stays_symmetric_positive_definite(seed: int, log_scale: float, dt: float, parts: bool) -> None:
    rng = np.random.default_rng(seed)
    filter = ErrorStateFilter(
        _nominal(), np.diag(rng.uniform(1e-8, 1.0, CORE)), imu_noise=MEMS, T_imu_cam=FORWARD_CAMERA
    )
    for k in range(60):
        samples = rng.standard_normal((4, 1, 3)) * np.array([1, 10, 1, 10])[:, None, None]
        filter.propagate_imu(dt, *samples)
        if k % 5 == 4:
            T = se3.exp(rng.standard_normal(6) * 0.1)
            filter.update_motion(T, _noise(rng, 10.0**log_scale, parts), ACCEPT)
            filter.clone(measured=True) if k % 10 == 4 else filter.forget_current()
        C = filter.covariance[0]
        np.testing.assert_array_equal(C, C.T)
        np.linalg.cholesky(C)
        # The clone coincides with the state until the next sample, so the joint matrix is only semidefinite.
        joint = filter.P[0, : me.KEPT, : me.KEPT]
        d = np.sqrt(np.maximum(np.diagonal(joint), 1e-300))
        assert np.linalg.eigvalsh(joint / np.outer(d, d)).min() > -1e-8


def test_covariance_after_5000_steps() -> None:
    """Of many more: ``tests/hostile/test_long.py``."""
    rng = np.random.default_rng(1)
    filter = _filter(np.eye(CORE) * 1e-4)
    for k in range(5_000):
        gyro = np.array([[0.1 * np.sin(k / 50), 0.05, 0.2 * np.cos(k / 80)]])
        acc = np.array([[np.sin(k / 30), 0.3, 9.80665]])
        filter.propagate_imu(0.005, gyro, acc, gyro, acc)
        if k % 10 == 9:
            T_ref = filter.camera.pose(filter.clone_p, filter.clone_R)
            T_cur = filter.camera.pose(filter.x.position, filter.x.R_world_imu)
            T = (se3.inverse(T_ref) @ T_cur)[0] @ se3.exp(1e-3 * rng.standard_normal(6))
            filter.decay_bias(0.05, np.full(12, 5.0))
            filter.update_motion(T, _noise(rng), ACCEPT)
            filter.clone(measured=True)
    C = filter.covariance[0]
    np.testing.assert_array_equal(C, C.T)
    np.linalg.cholesky(C)
    R = filter.x.R_world_imu[0]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_no_measured_motion_tells_the_heading_or_the_place_of_the_whole(seed: int) -> None:
    """The information on turning and moving state and clone together is the same before and after an update."""
    rng = np.random.default_rng(seed)
    filter = _filter(np.eye(CORE) * 1e-2)
    for k in range(40):
        filter.propagate_imu(0.05, *(rng.standard_normal((4, 1, 3)) * np.array([1, 10, 1, 10])[:, None, None]))
        if k == 19:
            filter.clone()

    def information() -> np.ndarray:
        x, z = filter.x, np.array([0.0, 0.0, 1.0])
        turned = [np.cross(z, x.position[0]), np.cross(z, x.velocity[0]), x.R_world_imu[0].T @ z, np.zeros(6)]
        turned += [np.cross(z, filter.clone_p[0]), filter.clone_R[0].T @ z]
        moved = np.zeros((3, 21))
        moved[:, :3] = moved[:, 15:18] = np.eye(3)
        N = np.vstack([np.concatenate(turned), moved])
        return N @ np.linalg.solve(filter.P[0, :21, :21], N.T)

    before = information()
    ends = ((filter.clone_R, filter.clone_p), (filter.x.R_world_imu, filter.x.position))
    T_ref, T_cur = (se3.from_rt(R, p)[0] @ FORWARD_CAMERA for R, p in ends)
    T = se3.inverse(T_ref) @ T_cur @ se3.exp(0.1 * rng.standard_normal(6))
    assert filter.update_motion(T, MotionError.independent(np.eye(6)[None] * 1e-4), ACCEPT).passed.all()
    np.testing.assert_allclose(information(), before, rtol=1e-4, atol=1e-4 * np.abs(before).max())


def _own_rule_flight(seed: int, n: int = 2000, every: int = 10, with_lost: bool = False) -> tuple[Flight, Nominal]:
    """Truth integrated from smooth samples by the filter's own rule; VO exact."""
    rng = np.random.default_rng(seed)
    t = np.arange(n + 1) * 0.005
    _, acceleration, R, omega = smooth_path(t, rng)
    force = (np.swapaxes(R, 1, 2) @ (acceleration + [0, 0, 9.80665])[:, :, None])[:, :, 0]
    x, F = _nominal(velocity=2.0), np.tile(np.eye(CORE), (1, 1, 1))
    start = x.copy()
    poses = [np.eye(4)]
    for k in range(n):
        dt = 0.005
        imu_step(x, F, dt, omega[k][None], force[k][None], omega[k + 1][None], force[k + 1][None], GRAVITY)
        poses.append(se3.from_rt(x.R_world_imu[0], x.position[0]))
    t_ns = np.round(t * 1e9).astype(np.int64)
    T_cam = np.array(poses)[::every] @ FORWARD_CAMERA
    stamps = t_ns[::every]
    records = [VoRecord(int(stamps[0]), int(stamps[0]), Status.START, np.eye(4))]
    reference = 0
    for k in range(1, len(stamps)):
        lost = with_lost and 20 <= k < 40
        T = np.eye(4) if lost else se3.inverse(T_cam[reference]) @ T_cam[k]
        keyframe = not lost and (not with_lost or k % 3 == 0)
        status = Status.LOST if lost else Status.OK
        records.append(VoRecord(int(stamps[k]), int(stamps[reference]), status, T, is_reference=keyframe))
        reference = k if keyframe else reference
    flight = Flight("own rule", records, ImuLog(t_ns, omega, force, MEMS), FORWARD_CAMERA, T_cam)
    return flight, start


@pytest.mark.parametrize("with_lost", [False, True])
def test_exact_inputs_keep_the_filter_on_the_truth(with_lost: bool) -> None:
    flight, start = _own_rule_flight(3, with_lost=with_lost)
    filter = ErrorStateFilter(start, np.eye(CORE) * 1e-4, imu_noise=MEMS, T_imu_cam=FORWARD_CAMERA)
    timeline = Timeline(filter, flight.records[0].t_ns, ConstantPolicy(np.full(6, 1e-6), 0.05))
    imu = flight.imu
    assert imu is not None
    for k in range(len(imu.t_ns)):
        timeline.add_imu(int(imu.t_ns[k]), imu.gyro_radps[k], imu.acc_mps2[k])
    for k, record in enumerate(flight.records):
        timeline.add_vo(record)
        truth = flight.T_world_imu[k]
        np.testing.assert_allclose(timeline.filter.x.position[0], truth[:3, 3], atol=1e-9)
        np.testing.assert_allclose(timeline.filter.x.R_world_imu[0], truth[:3, :3], atol=1e-9)
    assert timeline.counts["rejected"] == timeline.counts["no_reference"] == 0


def _integrate(rate_hz: int) -> tuple[float, float]:
    t = np.arange(0, 2 * rate_hz + 1) / rate_hz
    position, acceleration, R, omega = smooth_path(t, np.random.default_rng(5))
    force = (np.swapaxes(R, 1, 2) @ (acceleration + [0, 0, 9.80665])[:, :, None])[:, :, 0]
    fine = np.array([0.0, 1e-6])
    p0 = smooth_path(fine, np.random.default_rng(5))[0]
    x = Nominal(position[:1], np.diff(p0, axis=0) / 1e-6, R[:1], np.zeros((1, 3)), np.zeros((1, 3)))
    # The slope over a microsecond misses the velocity by half a microsecond's acceleration.
    x.velocity = x.velocity - 0.5e-6 * acceleration[:1]
    F = np.tile(np.eye(CORE), (1, 1, 1))
    for k in range(len(t) - 1):
        args = (omega[k][None], force[k][None], omega[k + 1][None], force[k + 1][None])
        imu_step(x, F, 1.0 / rate_hz, *args, GRAVITY)
    attitude = np.linalg.norm(se3.so3_log(R[-1].T @ x.R_world_imu[0]))
    return float(np.linalg.norm(x.position[0] - position[-1])), float(attitude)


def test_integration_converges_with_the_square_of_the_step() -> None:
    errors = np.array([_integrate(rate) for rate in (25, 50, 100)])
    order = np.log2(errors[:-1] / errors[1:])
    assert np.all((order > 1.8) & (order < 2.3)), order


def test_two_updates_at_the_same_state_commute() -> None:
    rng = np.random.default_rng(0)
    base = ErrorStateFilter(
        _nominal(), np.diag(rng.uniform(1e-4, 1e-2, CORE)), imu_noise=MEMS, T_imu_cam=FORWARD_CAMERA
    )
    for _ in range(20):
        base.propagate_imu(0.01, *rng.standard_normal((4, 1, 3)))
    H = [rng.standard_normal((1, 6, me.JOINT)), rng.standard_normal((1, 6, me.JOINT))]
    for h in H:
        h[:, :, me.JITTER_CUR] = 0.0
    r = rng.standard_normal((2, 1, 6)) * 1e-2
    R = np.eye(6)[None] * 1e-4
    results = []
    for order in ((0, 1), (1, 0)):
        filter = base.copy()
        for i in order:
            filter.correct(H[i], r[i], R)
        filter.inject()
        results.append(filter)
    a, b = results
    for name in ("position", "velocity", "R_world_imu", "acc_bias", "gyro_bias"):
        np.testing.assert_allclose(getattr(a.x, name), getattr(b.x, name), atol=1e-9)
    np.testing.assert_allclose(a.P, b.P, atol=1e-9)


def _linear_regime(batch: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """NEES (batch,) of the 15 states and mean NIS, of independent runs along one path at its end."""
    rng = np.random.default_rng(11)
    rate, every = 100, 10
    n = round(seconds * rate)
    t = np.arange(n + 1) / rate
    _, acceleration, R, omega = smooth_path(t, rng)
    force = (np.swapaxes(R, 1, 2) @ (acceleration + [0, 0, 9.80665])[:, :, None])[:, :, 0]
    truth, F = _nominal(velocity=2.0), np.tile(np.eye(CORE), (1, 1, 1))
    sigma = np.repeat([1e-3, 1e-3, 1e-3, 2e-2, 1e-3], 3)
    draw = rng.standard_normal((batch, CORE)) * sigma
    x = _nominal(batch)
    x.velocity = truth.velocity - draw[:, V]
    x.position = -draw[:, P]
    x.R_world_imu = se3.so3_exp(-draw[:, TH])
    ba, bg = draw[:, BA].copy(), draw[:, BG].copy()
    filter = ErrorStateFilter(x, np.diag(sigma**2), imu_noise=MEMS, T_imu_cam=FORWARD_CAMERA)
    noise = _noise(np.random.default_rng(2), 1e-3)
    white, jitter = (np.linalg.cholesky(C[0]) for C in (noise.white, 0.5 * noise.jitter))
    n_ref = rng.standard_normal((batch, 6)) @ jitter.T
    beta = rng.standard_normal((batch, 12))
    T_ref = FORWARD_CAMERA
    nis = []

    def noisy(clean: np.ndarray, bias: np.ndarray, density: float) -> np.ndarray:
        return clean + bias + density * np.sqrt(rate) * rng.standard_normal((batch, 3))

    w1, f1 = noisy(omega[0], bg, MEMS.gyro_density_radps_sqrthz), noisy(force[0], ba, MEMS.acc_density_mps2_sqrthz)
    for k in range(n):
        ends = (omega[k][None], force[k][None], omega[k + 1][None], force[k + 1][None])
        imu_step(truth, F, 1 / rate, *ends, GRAVITY)
        bg = bg + MEMS.gyro_walk_radps2_sqrthz / np.sqrt(rate) * rng.standard_normal((batch, 3))
        ba = ba + MEMS.acc_walk_mps3_sqrthz / np.sqrt(rate) * rng.standard_normal((batch, 3))
        w0, f0 = w1, f1
        w1 = noisy(omega[k + 1], bg, MEMS.gyro_density_radps_sqrthz)
        f1 = noisy(force[k + 1], ba, MEMS.acc_density_mps2_sqrthz)
        filter.propagate_imu(1 / rate, w0, f0, w1, f1)
        if (k + 1) % every == 0:
            T_cam = se3.from_rt(truth.R_world_imu[0], truth.position[0]) @ FORWARD_CAMERA
            phi = np.exp(-every / rate / 5.0)
            beta = phi * beta + np.sqrt(1 - phi**2) * rng.standard_normal((batch, 12))
            n_cur = rng.standard_normal((batch, 6)) @ jitter.T
            error = rng.standard_normal((batch, 6)) @ white.T + beta @ noise.persistent_root[0].T
            T = se3.exp(-n_ref) @ (se3.inverse(T_ref) @ T_cam) @ se3.exp(n_cur) @ se3.exp(error)
            filter.decay_bias(every / rate, noise.persistent_tau_s)
            nis.append(filter.update_motion(T, noise, ACCEPT).nis.mean())
            filter.clone(measured=True)
            n_ref, T_ref = n_cur, T_cam
    x = filter.x
    error = np.concatenate(
        [
            truth.position - x.position,
            truth.velocity - x.velocity,
            se3.so3_log(np.swapaxes(x.R_world_imu, 1, 2) @ truth.R_world_imu),
            ba - x.acc_bias,
            bg - x.gyro_bias,
        ],
        axis=1,
    )
    z = np.linalg.solve(np.linalg.cholesky(filter.covariance), error[:, :, None])[:, :, 0]
    return (z**2).sum(1), np.array(nis)


@pytest.mark.parametrize("batch, seconds", [(2000, 1.0)])
def test_nees_is_one_in_the_linear_regime(batch: int, seconds: float) -> None:
    nees, nis = _linear_regime(batch, seconds)
    assert 0.95 < nees.mean() / CORE < 1.05
    assert 0.95 < nis.mean() / 6 < 1.05


def _each_alone(flight: Flight, grid: np.ndarray, options: FuseOptions) -> list[float]:
    policies = [ConstantPolicy(np.full(6, 1e-6), 0.05, scalars[None]) for scalars in grid]
    return [fuse_flight(flight, policy, options).scores.ate_rmse_m for policy in policies]


def test_members_of_a_batch_are_independent_filters() -> None:
    flight, _ = _own_rule_flight(7, n=400)
    flight = replace(flight, truth_valid=np.ones(len(flight.records), bool))
    grid = np.array([[0.1, 1.0], [1.0, 4.0], [10.0, 0.2]])
    options = FuseOptions(sigmas=StartSigmas(), history_s=0.0)
    together = ate_of_members(flight, ConstantPolicy(np.full(6, 1e-6), 0.05, grid), options, batch=3)
    np.testing.assert_allclose(together, _each_alone(flight, grid, options), rtol=1e-6)


def test_tuning_a_constant_keeps_no_covariances() -> None:
    """The grid has 64 members: with all their states, an hour of a run would fill any memory."""
    flight, _ = _own_rule_flight(7, n=1500)
    flight = replace(flight, truth_valid=np.arange(len(flight.records)) % 7 != 3)
    grid, options = np.geomspace(0.1, 10.0, 64)[:, None] * [1.0, 2.0], FuseOptions(history_s=0.0)
    policy = ConstantPolicy(np.full(6, 1e-6), 0.05, grid)
    tracemalloc.start()
    found = grid_scores([flight], Constants(policy.mean_squares, 0.05), grid, options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.5 * len(flight.records) * len(grid) * 8 * CORE**2
    np.testing.assert_allclose(found[::21], _each_alone(flight, grid[::21], options), rtol=1e-6)
