"""A quadrotor that flies a path, simulated in MuJoCo.

The quadrotor is pushed by four rotors with lag, slowed by drag, and steered by a cascaded controller, so that it sways
and overshoots as real ones do. Its rate and acceleration are central differences of the 1 kHz states that MuJoCo
computed: poses and IMU then agree by construction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpvo.errors import GpvoError, MissingExtraError
from gpvo.geometry import se3
from gpvo.sim.imu import Motion
from gpvo.sim.paths import Path3
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

RATE_HZ = 1000.0
LUNAR_GRAVITY_MPS2 = 1.62
RADIUS_M = {"quadrotor": 0.25, "path": 0.2, "rover": 0.3}
_CONTROL_EVERY = 4


@dataclass(frozen=True)
class Quadrotor:
    """Mass [kg], inertia [kg m^2], arm [m] to each rotor along both axes, lag of the motors [s], largest thrust of a
    rotor [N], torque per thrust [m], linear drag [N s/m]; gains of position, velocity, attitude and rate."""

    mass: float = 1.5
    inertia: tuple[float, float, float] = (0.013, 0.013, 0.022)
    arm: float = 0.16
    motor_lag_s: float = 0.03
    max_thrust: float = 9.0
    torque_ratio: float = 0.016
    drag: float = 0.25
    position_gain: float = 6.0
    velocity_gain: float = 4.5
    attitude_gain: tuple[float, float, float] = (2.2, 2.2, 0.9)
    rate_gain: tuple[float, float, float] = (0.32, 0.32, 0.22)

    def mixer(self) -> Array:
        """(4, 4): total thrust and torques about x, y, z from the thrusts of the rotors."""
        a, k = self.arm, self.torque_ratio
        x, y, spin = (np.array(s, float) for s in ((1, -1, 1, -1), (-1, 1, 1, -1), (1, 1, -1, -1)))
        return np.stack([np.ones(4), a * y, -a * x, k * spin])

    def model_xml(self) -> str:
        """The MuJoCo model."""
        x, y, spin = (1, -1, 1, -1), (-1, 1, 1, -1), (1, 1, -1, -1)
        sites = "".join(f'<site name="r{i}" pos="{x[i] * self.arm} {y[i] * self.arm} 0"/>' for i in range(4))
        rotors = "".join(
            f'<general site="r{i}" gear="0 0 1 0 0 {spin[i] * self.torque_ratio}" ctrllimited="true"'
            f' ctrlrange="0 {self.max_thrust}" dyntype="filterexact" dynprm="{self.motor_lag_s}"/>'
            for i in range(4)
        )
        return (
            f'<mujoco><option timestep="{1 / RATE_HZ}" integrator="implicitfast"'
            f' gravity="0 0 -{STANDARD_GRAVITY_MPS2}"/>'
            f'<worldbody><body name="body"><freejoint/><inertial pos="0 0 0" mass="{self.mass}"'
            f' diaginertia="{" ".join(map(str, self.inertia))}"/>{sites}</body></worldbody>'
            f"<actuator>{rotors}</actuator></mujoco>"
        )


def fly(path: Path3, vehicle: Quadrotor | None = None) -> Motion:
    """Fly a path with the quadrotor, beginning in steady hover at its start.

    Raises MissingExtraError without MuJoCo (extra ``sim``); GpvoError where the flight cannot be followed: the vehicle
    loses its path by more than 2 m.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError("mujoco", "sim") from error
    quad = vehicle or Quadrotor()
    model = mujoco.MjModel.from_xml_string(quad.model_xml())
    data = mujoco.MjData(model)
    # Two more steps at the end and two before the start leave room for differences.
    steps = round(path.duration_s * RATE_HZ) + 3
    t_control = np.arange(0, steps, _CONTROL_EVERY) / RATE_HZ
    reference = _Reference.of(path, t_control)
    data.qpos[:3] = reference.position[0]
    data.qpos[3:7] = np.roll(se3.rotation_to_quaternion_xyzw(reference.attitude[:1])[0], 1)
    data.act[:] = quad.mass * STANDARD_GRAVITY_MPS2 / 4
    mujoco.mj_forward(model, data)
    controller = _Controller(quad, reference)
    states = np.empty((steps, 7))
    for k in range(steps):
        states[k] = data.qpos
        if k % _CONTROL_EVERY == 0:
            data.ctrl[:] = controller.thrusts(k // _CONTROL_EVERY, data)
        data.xfrc_applied[1, :3] = -quad.drag * data.qvel[:3]
        mujoco.mj_step(model, data)
    return differentiate(states[:, :3], se3.from_quaternion(states[:, :3], np.roll(states[:, 3:], -1, 1))[:, :3, :3])


def differentiate(position: Array, R_world_body: Array) -> Motion:
    """Motion at 1 kHz from one pose (N, 3), (N, 3, 3) per step: central differences, so N - 2 samples."""
    p = np.concatenate([position[:1], position])
    R = np.concatenate([R_world_body[:1], R_world_body])
    velocity = (p[2:] - p[:-2]) * RATE_HZ / 2
    acceleration = (p[2:] - 2 * p[1:-1] + p[:-2]) * RATE_HZ**2
    rate = se3.so3_log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) * RATE_HZ / 2
    n = len(p) - 3
    return Motion(np.arange(n) / RATE_HZ, p[1 : n + 1], R[1 : n + 1], velocity[:n], acceleration[:n], rate[:n])


@dataclass(frozen=True)
class _Reference:
    position: Array
    velocity: Array
    acceleration: Array
    attitude: Array

    @classmethod
    def of(cls, path: Path3, t_s: Array) -> _Reference:
        place = path.position
        return cls(place(t_s), place.derivative(1)(t_s), place.derivative(2)(t_s), path.attitude(t_s))


class _Controller:
    """Position to thrust vector to attitude to torques: T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control
    of a quadrotor UAV on SE(3)", 2010, equations 10, 11, 15 and 16, without the terms of the desired rate."""

    def __init__(self, quad: Quadrotor, reference: _Reference) -> None:
        self._quad, self._reference = quad, reference
        self._unmix = np.linalg.inv(quad.mixer())
        self._inertia = np.array(quad.inertia)
        self._attitude_gain, self._rate_gain = np.array(quad.attitude_gain), np.array(quad.rate_gain)

    def thrusts(self, k: int, data: Any) -> Array:
        ref, quad = self._reference, self._quad
        off = ref.position[k] - data.qpos[:3]
        if off @ off > 4.0:
            raise GpvoError(f"the quadrotor loses its path after {data.time:.1f} s", cure="a slower or smoother path")
        pull = quad.position_gain * off + quad.velocity_gain * (ref.velocity[k] - data.qvel[:3])
        force = quad.mass * (pull + ref.acceleration[k] + [0, 0, STANDARD_GRAVITY_MPS2]) + quad.drag * ref.velocity[k]
        R = se3.from_quaternion(np.zeros((1, 3)), np.roll(data.qpos[3:7], -1)[None])[0, :3, :3]
        z = force / np.linalg.norm(force)
        y = np.cross(z, ref.attitude[k][:, 0])
        y /= np.linalg.norm(y)
        wanted = np.stack([np.cross(y, z), y, z], axis=1)
        E = 0.5 * (wanted.T @ R - R.T @ wanted)
        rate = data.qvel[3:6]
        torque = -self._attitude_gain * [E[2, 1], E[0, 2], E[1, 0]] - self._rate_gain * rate
        torque += np.cross(rate, self._inertia * rate)
        return np.clip(self._unmix @ np.concatenate([[force @ R[:, 2]], torque]), 0.0, quad.max_thrust)
