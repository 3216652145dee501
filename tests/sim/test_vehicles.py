"""Vehicles: what they feel agrees with how they move."""

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths, vehicles
from gpvo.sim.imu import Motion, exact_imu
from gpvo.types import STANDARD_GRAVITY_MPS2

LOW, HIGH = np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])


def integrate(motion: Motion, begin: int, end: int) -> tuple[float, float]:
    """Errors of position [m] and attitude [degrees] after integrating exact readings by the trapezoid."""
    h = float(motion.t_s[1] - motion.t_s[0])
    gyro, force = exact_imu(motion)
    down = np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
    R, v, p = motion.R_world_body[begin], motion.velocity_mps[begin], motion.position_m[begin]
    for k in range(begin, end):
        R_next = R @ se3.so3_exp(0.5 * h * (gyro[k] + gyro[k + 1]))
        a = 0.5 * (R @ force[k] + R_next @ force[k + 1]) + down
        p, v, R = p + h * v + 0.5 * h * h * a, v + h * a, R_next
    turn = se3.so3_log(R.T @ motion.R_world_body[end])
    return float(np.linalg.norm(p - motion.position_m[end])), float(np.rad2deg(np.linalg.norm(turn)))


def wander(duration_s: float = 14.0, speed: float = 1.5) -> paths.Path3:
    return paths.wandering(LOW, HIGH, duration_s, speed, np.random.default_rng(3))


@pytest.mark.parametrize("kind", ["quadrotor", "path"])
def test_imu_agrees_with_motion(kind):
    if kind == "quadrotor":
        pytest.importorskip("mujoco")
    path = wander()
    motion = vehicles.fly(path) if kind == "quadrotor" else path.motion(vehicles.RATE_HZ)
    position_m, turn_deg = integrate(motion, 3500, 13500)
    assert position_m < 1e-3
    assert turn_deg < 1e-3


def test_quadrotor_rests_then_follows():
    pytest.importorskip("mujoco")
    path = wander(10.0)
    motion = vehicles.fly(path)
    assert len(motion.t_s) == 10001
    assert np.linalg.norm(motion.velocity_mps[:2900], axis=1).max() < 1e-3
    off = np.linalg.norm(motion.position_m - path.position(motion.t_s), axis=1)
    assert 1e-4 < off.max() < 0.3, "it follows, but not like a train on rails"


def test_same_flight_twice():
    pytest.importorskip("mujoco")
    first, second = vehicles.fly(wander(5.0)), vehicles.fly(wander(5.0))
    assert np.array_equal(first.position_m, second.position_m)
    assert np.array_equal(first.rate_radps, second.rate_radps)


def test_what_it_cannot_follow_is_refused():
    pytest.importorskip("mujoco")
    with pytest.raises(GpvoError, match="loses its path"):
        vehicles.fly(paths.straight(np.zeros(3), np.array([1.0, 0, 0]), 12.0, 40.0))
