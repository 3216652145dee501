"""An IMU on a known motion: exact readings, then what a real sensor adds.

Noise: white with a density, and biases that walk (Kalibr's model); bias instability and temperature are not modelled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuLog, ImuNoise


@dataclass(frozen=True)
class ImuModel:
    """What a sensor adds to the truth.

    ``noise``: densities and walks. ``vibration_mps2``: amplitude of the rotors' vibration on the accelerometer at
    ``vibration_hz``. ``misalignment_rad``: standard deviation of the sensor's mounting error, drawn once per flight.
    ``bias_gyro_radps``, ``bias_acc_mps2``: standard deviations of the biases at the start. ``exact``: nothing is added
    at all; ``noise`` is then only what the calibration file says, so that filters have a number above zero.
    """

    noise: ImuNoise
    vibration_mps2: float = 0.0
    vibration_hz: float = 85.0
    misalignment_rad: float = 0.0
    bias_gyro_radps: float = 0.0
    bias_acc_mps2: float = 0.0
    exact: bool = False


# Densities: the values of Kalibr's files for the ADIS16448 of the EuRoC MAV data set and, for the T265's BMI055, of its
# data sheet (0.014 deg/s/sqrt(Hz), 150 ug/sqrt(Hz)).
PRESETS: dict[str, ImuModel] = {
    "perfect": ImuModel(ImuNoise(1e-6, 1e-6, 1e-8, 1e-8), exact=True),
    "euroc": ImuModel(ImuNoise(1.7e-4, 2.0e-3, 1.9e-5, 3.0e-3), 0.3, 85.0, 0.0, 0.005, 0.05),
    "t265": ImuModel(ImuNoise(2.4e-4, 1.5e-3, 2.0e-5, 1.0e-3), 0.5, 95.0, 0.002, 0.01, 0.1),
}


@dataclass(frozen=True)
class Motion:
    """Truth of a body at equal steps: ``t_s`` (N,), ``position_m`` (N, 3) and ``R_world_body`` (N, 3, 3) in a z-up
    world, ``velocity_mps``, ``acceleration_mps2`` (N, 3) in world axes, ``rate_radps`` (N, 3) in body axes."""

    t_s: Array
    position_m: Array
    R_world_body: Array
    velocity_mps: Array
    acceleration_mps2: Array
    rate_radps: Array

    def thinned(self, every: int) -> Motion:
        """Every n-th sample."""
        return self.at(slice(None, None, every))

    def at(self, index: NDArray[np.int64] | slice) -> Motion:
        """The samples of these indices."""
        return Motion(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def exact_imu(motion: Motion, gravity_mps2: float = STANDARD_GRAVITY_MPS2) -> tuple[Array, Array]:
    """Turn rate [rad/s] and specific force [m/s^2] in body axes, (N, 3) each, without any noise."""
    up = np.array([0.0, 0.0, gravity_mps2])
    force = np.einsum("nji,nj->ni", motion.R_world_body, motion.acceleration_mps2 + up)
    return motion.rate_radps, force


def measured_imu(
    motion: Motion,
    model: ImuModel,
    rng: np.random.Generator,
    t_start_ns: int = 0,
    gravity_mps2: float = STANDARD_GRAVITY_MPS2,
) -> tuple[ImuLog, Array, Array]:
    """The log that a sensor of this kind would give, and its true biases: gyroscope and accelerometer, (N, 3) each."""
    n, dt = len(motion.t_s), float(motion.t_s[1] - motion.t_s[0])
    noise = model.noise
    gyro, force = exact_imu(motion, gravity_mps2)
    t_ns = t_start_ns + np.rint(motion.t_s * 1e9).astype(np.int64)
    if model.exact:
        return ImuLog(t_ns, gyro, force, noise), np.zeros((n, 3)), np.zeros((n, 3))
    turn = np.eye(3) + se3.skew(model.misalignment_rad * rng.standard_normal(3))

    def walk(start: float, density: float) -> Array:
        steps = density * np.sqrt(dt) * rng.standard_normal((n, 3))
        steps[0] = start * rng.standard_normal(3)
        return np.cumsum(steps, axis=0)

    bias_gyro = walk(model.bias_gyro_radps, noise.gyro_walk_radps2_sqrthz)
    bias_acc = walk(model.bias_acc_mps2, noise.acc_walk_mps3_sqrthz)
    phase = rng.uniform(0, 2 * np.pi, 3)
    shake = model.vibration_mps2 * np.sin(2 * np.pi * model.vibration_hz * motion.t_s[:, None] + phase)
    white = 1.0 / np.sqrt(dt)
    gyro = gyro @ turn.T + bias_gyro + noise.gyro_density_radps_sqrthz * white * rng.standard_normal((n, 3))
    force = force @ turn.T + bias_acc + shake + noise.acc_density_mps2_sqrthz * white * rng.standard_normal((n, 3))
    return ImuLog(t_ns, gyro, force, noise), bias_gyro, bias_acc
