"""The motion measurement against numerical derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.filters import measurement as me
from gpvo.filters.eskf import ErrorStateFilter
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.propagation import (
    BA,
    BG,
    CORE,
    DEFAULT_IMU_NOISE,
    TH,
    ConstantVelocityNoise,
    Nominal,
    P,
    V,
    constant_velocity_densities,
    constant_velocity_step,
    imu_densities,
    imu_step,
    process_noise,
)
from gpvo.filters.run import FuseOptions, begin, make_filter
from gpvo.filters.timeline import Timeline
from gpvo.geometry import se3
from gpvo.types import ImuNoise, MotionError
from synthetic_flights import FORWARD_CAMERA, ErrorLaw, synthetic_flight


def _random_poses(rng: np.random.Generator) -> list[np.ndarray]:
    out: list[np.ndarray] = []
    for _ in range(2):
        out += [se3.so3_exp(rng.standard_normal((1, 3)) * 0.5), rng.standard_normal((1, 3))]
    return out


@pytest.mark.parametrize("seed", range(5))
def test_jacobian_of_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    camera = me.CameraOnImu.of(FORWARD_CAMERA @ se3.exp(rng.standard_normal(6) * 0.3))
    R0, p0, R1, p1 = _random_poses(rng)
    error = replace(MotionError.independent(np.eye(6)[None]), persistent_root=rng.standard_normal((1, 6, 12)) * 0.01)

    def motion(dx: np.ndarray) -> np.ndarray:
        """``Exp(-n_ref) T Exp(n_cur + b)`` of the perturbed state, as the measurement's law has it."""
        ref = camera.pose(p0 + dx[me.CLONE_P], R0 @ se3.so3_exp(dx[None, me.CLONE_TH]))
        cur = camera.pose(p1 + dx[P], R1 @ se3.so3_exp(dx[None, TH]))
        late = se3.exp(dx[me.JITTER_CUR] + error.persistent_root[0] @ dx[me.BIAS])
        return se3.exp(-dx[me.JITTER_REF]) @ (se3.inverse(ref) @ cur)[0] @ late

    T = motion(np.zeros(me.JOINT))
    numeric = np.empty((6, me.JOINT))
    for i in range(me.JOINT):
        step = np.zeros(me.JOINT)
        step[i] = 1e-6
        ends = [se3.log(se3.inverse(T) @ motion(s)) for s in (step, -step)]
        numeric[:, i] = (ends[0] - ends[1]) / 2e-6

    H = np.zeros((1, 6, me.JOINT))
    H[:, :, me.JITTER_CUR] = np.eye(6)
    ends = camera.pose(p0, R0), camera.pose(p1, R1)
    me.jacobian(H, camera, *ends, error)
    np.testing.assert_allclose(H[0], numeric, atol=1e-8)

    xi = rng.standard_normal(6) * 0.1
    np.testing.assert_allclose(me.residual(*ends, T @ se3.exp(xi), np.zeros((1, 6)))[0], xi, atol=1e-12)
    np.testing.assert_allclose(me.residual(*ends, T @ se3.exp(xi), xi[None])[0], np.zeros(6), atol=1e-12)


def _perturbed(x: Nominal, dx: np.ndarray) -> Nominal:
    return Nominal(
        x.position + dx[0:3],
        x.velocity + dx[3:6],
        x.R_world_imu @ se3.so3_exp(dx[None, 6:9]),
        x.acc_bias + dx[9:12],
        x.gyro_bias + dx[12:15],
    )


def _difference(a: Nominal, b: Nominal) -> np.ndarray:
    rotation = se3.so3_log(np.swapaxes(b.R_world_imu, 1, 2) @ a.R_world_imu)
    parts = (
        a.position - b.position,
        a.velocity - b.velocity,
        rotation,
        a.acc_bias - b.acc_bias,
        a.gyro_bias - b.gyro_bias,
    )
    return np.concatenate(parts, axis=1)[0]


@pytest.mark.parametrize("with_imu", [True, False])
def test_transition_of_the_error_state(with_imu: bool) -> None:
    rng = np.random.default_rng(4)
    R, _, _, _ = _random_poses(rng)
    x = Nominal(*rng.standard_normal((2, 1, 3)), R, *(0.3 * rng.standard_normal((2, 1, 3))))
    samples = rng.standard_normal((4, 1, 3)) * np.array([1.0, 10.0, 1.0, 10.0])[:, None, None]

    def moved(state: Nominal) -> tuple[Nominal, np.ndarray]:
        state, F = state.copy(), np.eye(CORE)[None].copy()
        if with_imu:
            imu_step(state, F, 0.02, *samples, np.array([0.0, 0.0, -9.8]))
        else:
            constant_velocity_step(state, F, 0.1)
        return state, F[0]

    end, F = moved(x)
    numeric = np.empty((CORE, CORE))
    for i in range(CORE):
        step = np.zeros(CORE)
        step[i] = 1e-6
        ends = [_difference(moved(_perturbed(x, s))[0], end) for s in (step, -step)]
        numeric[:, i] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(F, numeric, atol=2e-7)


@pytest.mark.parametrize("with_imu", [True, False])
def test_the_noise_of_two_intervals_is_that_of_one_twice_as_long(with_imu: bool) -> None:
    of_imu = ImuNoise(
        gyro_density_radps_sqrthz=2.0,
        acc_density_mps2_sqrthz=3.0,
        gyro_walk_radps2_sqrthz=5.0,
        acc_walk_mps3_sqrthz=7.0,
    )
    of_motion = ConstantVelocityNoise(acceleration=3.0, angular_acceleration=5.0)
    density = imu_densities(of_imu) if with_imu else constant_velocity_densities(of_motion)
    driven = ((V, 3.0), (TH, 2.0), (BA, 7.0), (BG, 5.0)) if with_imu else ((V, 3.0), (BG, 5.0))
    one, two = (process_noise(density, dt, with_imu) for dt in (0.5, 1.0))
    for block, root in driven:
        np.testing.assert_allclose(two[block, block], root**2 * np.eye(3))
    F = np.eye(CORE)
    for slow, fast in ((P, V),) if with_imu else ((P, V), (TH, BG)):
        F[slow, fast] = 0.5 * np.eye(3)
    np.testing.assert_allclose(two, F @ one @ F.T + one, atol=1e-12)


def test_a_considered_bias_counts_but_is_not_estimated() -> None:
    """It stays as uncertain as it was stated, and the position as uncertain as such a bias makes it."""
    laws = [ErrorLaw(bias=np.array([b] * 3 + [1e-9] * 3)) for b in (1e-9, 5e-3)]
    flights = [synthetic_flight(2, duration_s=6, imu_hz=50, law=law) for law in laws]
    filters = []
    for flight in flights:
        flight = replace(flight, imu=None, T_imu_cam=None)
        start, gravity = begin(flight, FuseOptions())
        filter = make_filter(flight, start, gravity, 1, FuseOptions())
        timeline = Timeline(filter, flight.records[0].t_ns, LearnedPolicy(), with_imu=False)
        for record in flight.records:
            timeline.add_vo(record, flight.predictions.get(record.t_ns))
        filters.append(timeline.filter)
    sure, unsure = filters
    for filter in filters:
        np.testing.assert_allclose(filter.P[0, me.BIAS, me.BIAS], np.eye(12), atol=1e-9)
    seconds = flights[0].records[-1].t_ns * 1e-9 - flights[0].records[0].t_ns * 1e-9
    # Six seconds of a bias that lasts ten: what is stated per motion adds up nearly as it stands.
    added = 5e-3 * 20.0 * seconds
    sigma = np.sqrt(unsure.P[0, :3, :3].trace() / 3.0 - sure.P[0, :3, :3].trace() / 3.0)
    assert 0.5 * added < sigma < 1.25 * added


@pytest.mark.parametrize("precise", [1.0, 0.01])
@pytest.mark.parametrize("sigma_m", [1e3, 1e4, 1e5, 1e6, 1e7, 1e8])
def test_motions_are_used_wherever_the_vehicle_may_be(sigma_m: float, precise: float) -> None:
    """As after an hour by the IMU alone: motions go on telling how it moves, as well as rounding lets them."""
    usual = ErrorLaw()
    law = ErrorLaw(precise * usual.jitter, precise * usual.white, precise * usual.bias)
    flight = synthetic_flight(3, duration_s=6, law=law)
    assert flight.imu is not None
    start, gravity = begin(flight, FuseOptions())
    filter = make_filter(flight, start, gravity, 1, FuseOptions())
    filter.P[:, P, P] += sigma_m**2 * np.eye(3)
    filter.clone()
    timeline = Timeline(filter, flight.records[0].t_ns, LearnedPolicy())
    for sample in zip(flight.imu.t_ns.tolist(), flight.imu.gyro_radps, flight.imu.acc_mps2, strict=True):
        timeline.add_imu(*sample)
    for record in flight.records:
        timeline.add_vo(record, flight.predictions.get(record.t_ns))
    assert timeline.counts["used"] >= len(flight.records) - 4
    variance = np.diagonal(timeline.filter.covariance[0])
    assert (variance > 0).all()
    turn = se3.so3_log(timeline.filter.x.R_world_imu[0].T @ flight.T_world_imu[-1, :3, :3])
    assert (np.abs(turn) < 4.0 * np.sqrt(variance[TH])).all()
    assert np.linalg.norm(timeline.filter.x.position[0] - flight.T_world_imu[-1, :3, 3]) < 2.0


@pytest.mark.parametrize("passed", [(True, True, True), (True, False, True)])
def test_what_is_not_carried_or_moved_is_what_a_whole_transition_leaves(passed: tuple[bool, ...]) -> None:
    """Of three members, against the products of whole matrices, of which most are nothing."""
    rng = np.random.default_rng(4)
    R = se3.so3_exp(rng.standard_normal((3, 3)))
    x = Nominal(*rng.standard_normal((2, 3, 3)), R, *0.1 * rng.standard_normal((2, 3, 3)))
    filter = ErrorStateFilter(x, np.eye(CORE), imu_noise=DEFAULT_IMU_NOISE)
    A = rng.standard_normal((3, me.JOINT, me.JOINT))
    A[:, me.JITTER_CUR] = 0.0  # as between two records
    filter.P[:] = A @ A.swapaxes(1, 2)
    before = filter.P.copy()
    filter.propagate_imu(0.01, *rng.standard_normal((4, 3, 3)))
    F = np.tile(np.eye(me.JOINT), (3, 1, 1))
    F[:, :CORE, :CORE] = filter._F
    Q = process_noise(imu_densities(DEFAULT_IMU_NOISE), 0.01, True)
    before = F @ before @ F.swapaxes(1, 2)
    before[:, :CORE, :CORE] += Q
    np.testing.assert_allclose(filter.P, before, rtol=1e-9, atol=1e-12)

    dx = filter.dx[:] = 0.1 * rng.standard_normal(filter.dx.shape)
    G = np.tile(np.eye(me.JOINT), (3, 1, 1))
    attitudes = (TH, filter.x.R_world_imu, (P, V)), (me.CLONE_TH, filter.clone_R, (me.CLONE_P,))
    for k, (turned, R, moved) in ((k, of) for k in range(3) for of in attitudes):
        turn, jacobian = se3.so3_exp_and_right_jacobian(dx[k, turned])
        G[k, turned, turned] = turn.T if passed[k] else jacobian
        for block in moved if passed[k] else ():
            G[k, block, turned] = -se3.skew(dx[k, block]) @ R[k]
    filter.inject(np.array(passed))
    np.testing.assert_allclose(filter.P, G @ before @ G.swapaxes(1, 2), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(filter.P, filter.P.swapaxes(1, 2))
