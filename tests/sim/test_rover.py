"""The rover: it rests, drives its line, and its IMU agrees with how it moves."""

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths, vehicles
from gpvo.sim.imu import exact_imu
from gpvo.sim.vehicles import LUNAR_GRAVITY_MPS2
from gpvo.sim.worlds import HeightGrid

pytest.importorskip("mujoco")
CELL = 0.2


def ground(relief_m: float = 0.08, length_m: float = 40.0) -> HeightGrid:
    x, y = np.arange(-5.0, length_m, CELL), np.arange(-6.0, 6.0 + 1e-9, CELL)
    X, Y = np.meshgrid(x, y)
    return HeightGrid((relief_m * np.sin(0.9 * X) * np.cos(0.7 * Y)).astype(np.float32), float(x[0]), float(y[0]), CELL)


def line(duration_s: float = 14.0, speed: float = 1.0) -> paths.Path3:
    return paths.straight(np.zeros(3), np.array([1.0, 0.0, 0.0]), duration_s, speed)


@pytest.fixture(scope="module")
def driven():
    return vehicles.drive(line(), ground())


def test_it_rests_then_drives(driven):
    assert np.linalg.norm(driven.velocity_mps[:2900], axis=1).max() < 1e-3
    assert np.linalg.norm(driven.rate_radps[:2900], axis=1).max() < 1e-3
    wanted = line().position(driven.t_s)[:, :2]
    assert np.abs(driven.position_m[:, :2] - wanted).max() < 0.3
    assert np.linalg.norm(driven.velocity_mps[8000:], axis=1).mean() == pytest.approx(1.0, rel=0.05)


def test_it_feels_the_ground(driven):
    height = driven.position_m[:, 2] - ground()(driven.position_m[:, 0], driven.position_m[:, 1])
    assert 0.3 < height.min() < height.max() < 0.7
    assert driven.rate_radps[6000:, 1].std() > 0.01
    assert np.abs(driven.acceleration_mps2).max() < 20.0


def test_its_weight_is_that_of_the_moon(driven):
    _, force = exact_imu(driven, LUNAR_GRAVITY_MPS2)
    assert np.linalg.norm(force[:2900], axis=1) == pytest.approx(LUNAR_GRAVITY_MPS2, abs=1e-2)


def test_imu_agrees_with_motion(driven):
    gyro, force = exact_imu(driven, LUNAR_GRAVITY_MPS2)
    down, h, k0, k1 = np.array([0.0, 0.0, -LUNAR_GRAVITY_MPS2]), 1e-3, 3500, 13500
    R, v, p = driven.R_world_body[k0], driven.velocity_mps[k0], driven.position_m[k0]
    for k in range(k0, k1):
        R_next = R @ se3.so3_exp(0.5 * h * (gyro[k] + gyro[k + 1]))
        a = 0.5 * (R @ force[k] + R_next @ force[k + 1]) + down
        p, v, R = p + h * v + 0.5 * h * h * a, v + h * a, R_next
    assert np.linalg.norm(p - driven.position_m[k1]) < 1e-3
    assert np.rad2deg(np.linalg.norm(se3.so3_log(R.T @ driven.R_world_body[k1]))) < 1e-3


def test_same_drive_twice():
    first, second = (vehicles.drive(line(4.0), ground()) for _ in range(2))
    assert np.array_equal(first.position_m, second.position_m)


def test_what_it_cannot_drive_is_refused():
    with pytest.raises(GpvoError, match="the rover (tips over|loses its path)"):
        vehicles.drive(line(8.0, 4.0), ground(relief_m=1.5))
