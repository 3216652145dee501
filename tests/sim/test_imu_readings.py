"""The IMU's readings: at rest, and what noise adds."""

import numpy as np
import pytest
from gpvo.sim import imu, paths
from gpvo.types import STANDARD_GRAVITY_MPS2


def test_rest_reads_gravity():
    motion = paths.hover(np.zeros(3), 0.4, 2.0).motion(200.0)
    gyro, force = imu.exact_imu(motion)
    assert np.abs(gyro).max() < 1e-9
    assert np.allclose(force, [0, 0, STANDARD_GRAVITY_MPS2], atol=1e-9)


def test_lunar_gravity():
    motion = paths.hover(np.zeros(3), 0.0, 1.0).motion(100.0)
    assert np.allclose(imu.exact_imu(motion, 1.62)[1], [0, 0, 1.62], atol=1e-9)


def test_perfect_is_exact():
    motion = paths.wandering(-np.ones(3), np.ones(3), 5.0, 1.0, np.random.default_rng(0)).motion(200.0)
    log, bias_gyro, bias_acc = imu.measured_imu(motion, imu.PRESETS["perfect"], np.random.default_rng(1))
    gyro, force = imu.exact_imu(motion)
    assert np.array_equal(log.gyro_radps, gyro)
    assert np.array_equal(log.acc_mps2, force)
    assert not bias_gyro.any()
    assert not bias_acc.any()


@pytest.mark.parametrize("name", ["euroc", "t265"])
def test_white_noise_has_its_density(name):
    model = imu.PRESETS[name]
    motion = paths.hover(np.zeros(3), 0.0, 100.0).motion(200.0)
    log, bias, _ = imu.measured_imu(motion, model, np.random.default_rng(5))
    white = log.gyro_radps - bias
    expected = model.noise.gyro_density_radps_sqrthz * np.sqrt(200.0)
    assert white.std() == pytest.approx(expected, rel=0.03)
    # A walk of density s has variance s^2 t.
    steps = np.diff(bias, axis=0)
    assert steps.std() == pytest.approx(model.noise.gyro_walk_radps2_sqrthz * np.sqrt(1 / 200.0), rel=0.03)
