"""A quadrotor that flies a path, and a rover on four sprung wheels that drives one, both simulated in MuJoCo.

The quadrotor is pushed by four rotors with lag, slowed by drag, and steered by a cascaded controller, so that it sways
and overshoots as real ones do. The rover's wheels carry the chassis on sprung and damped legs over a height field in
lunar gravity, push by friction, and slip; steering turns one side faster than the other. Rate and acceleration are
central differences of the 1 kHz states that MuJoCo computed: poses and IMU then agree by construction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gpvo.errors import GpvoError, MissingExtraError
from gpvo.geometry import se3
from gpvo.sim.imu import Motion
from gpvo.sim.paths import Path3
from gpvo.sim.worlds import HeightGrid
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

RATE_HZ = 1000.0
LUNAR_GRAVITY_MPS2 = 1.62
RADIUS_M = {"quadrotor": 0.25, "path": 0.2, "rover": 0.3}
_CONTROL_EVERY = 4
# Contacts of wheels chatter at the simulation's step, far above what a chassis and its mast pass on: a rover's poses
# are smoothed over 10 ms, and that smoothed motion is what truth, images and IMU all hold.
_SETTLE_S = 3.0
_STEER_EVERY = 10
_SMOOTH_S = 0.01
_MARGIN_M = 3.0
_LOST_M = 2.0
_ROLLING, _BRAKED = 0.2, 1e6  # damping of a wheel's axle [N m s]
_TIPPED = 0.5  # cosine of the largest tilt


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


@dataclass(frozen=True)
class Rover:
    """Masses [kg] of the chassis and of a wheel, half of the wheelbase and track [m], radius and half width of a wheel
    [m]; stiffness [N/m] and damping [N s/m] of a leg, its length below the chassis [m]; friction; gain [N m s/rad] and
    limit [N m] of a wheel's drive; gains of the steering on lateral [1/m^2] and heading [1/m] errors."""

    chassis_mass: float = 120.0
    wheel_mass: float = 8.0
    half_base: float = 0.6
    half_track: float = 0.5
    wheel_radius: float = 0.25
    half_width: float = 0.1
    stiffness: float = 1800.0
    damping: float = 350.0
    leg: float = 0.25
    friction: float = 0.9
    drive_gain: float = 40.0
    drive_limit: float = 60.0
    lateral_gain: float = 0.6
    heading_gain: float = 1.6

    def model_xml(self, rows: int, columns: int, size: tuple[float, float, float], middle: Array, start: Array) -> str:
        """The MuJoCo model on a height field of half lengths and height ``size`` about ``middle`` (x, y, z)."""
        wheels = drives = ""
        for name, x, y in (("fl", 1, 1), ("fr", 1, -1), ("rl", -1, 1), ("rr", -1, -1)):
            wheels += (
                f'<body name="{name}" pos="{x * self.half_base} {y * self.half_track} {-self.leg}">'
                f'<joint type="slide" axis="0 0 1" range="-.12 .12" limited="true" stiffness="{self.stiffness}"'
                f' damping="{self.damping}"/><joint name="{name}" axis="0 1 0" damping="0.2"/>'
                f'<geom type="ellipsoid" size="{self.wheel_radius} {self.half_width} {self.wheel_radius}"'
                f' mass="{self.wheel_mass}" friction="{self.friction} .02 .01" condim="3"/></body>'
            )
            drives += (
                f'<velocity joint="{name}" kv="{self.drive_gain}" forcelimited="true"'
                f' forcerange="{-self.drive_limit} {self.drive_limit}"/>'
            )
        return (
            f'<mujoco><option timestep="{1 / RATE_HZ}" gravity="0 0 -{LUNAR_GRAVITY_MPS2}" integrator="implicitfast"'
            f' cone="elliptic" impratio="20"/><asset>'
            f'<hfield name="ground" nrow="{rows}" ncol="{columns}" size="{size[0]} {size[1]} {size[2]} 1"/></asset>'
            f'<worldbody><geom type="hfield" hfield="ground" pos="{middle[0]} {middle[1]} {middle[2]}"'
            f' friction="{self.friction} .02 .01"/><body name="chassis" pos="{start[0]} {start[1]} {start[2]}"'
            f' euler="0 0 {np.rad2deg(start[3])}"><freejoint/>'
            f'<geom type="box" size=".7 .4 .12" mass="{self.chassis_mass}" contype="0" conaffinity="0"/>{wheels}'
            f"</body></worldbody><actuator>{drives}</actuator></mujoco>"
        )


def drive(path: Path3, ground: HeightGrid, vehicle: Rover | None = None) -> Motion:
    """Drive a path, whose height does not matter, beginning settled on its springs.

    Raises MissingExtraError without MuJoCo (extra ``sim``); GpvoError where the rover tips over, or loses its path by
    more than 2 m.
    """
    try:
        import mujoco
    except ImportError as error:
        raise MissingExtraError("mujoco", "sim") from error
    rover = vehicle or Rover()
    steps = round(path.duration_s * RATE_HZ) + 3
    t = np.arange(0, steps, _STEER_EVERY) / RATE_HZ
    target, pace = path.position(t)[:, :2], path.position.derivative(1)(t)[:, :2]
    forward = path.attitude(t)[:, :2, 0]
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    model = _model(mujoco, rover, ground, target, float(heading[0]))
    data = mujoco.MjData(model)
    wheels = [model.joint(name).dofadr[0] for name in ("fl", "fr", "rl", "rr")]
    model.dof_damping[wheels] = _BRAKED
    settle = round(_SETTLE_S * RATE_HZ)
    # Beyond the end, so that smoothing does not bring the motion to a halt there.
    tail = round(6 * _SMOOTH_S * RATE_HZ)
    states = np.empty((settle + steps + tail, 7))
    for k in range(len(states)):
        states[k] = data.qpos[:7]
        if k >= settle and (k - settle) % _STEER_EVERY == 0:
            i = min((k - settle) // _STEER_EVERY, len(t) - 1)
            data.ctrl[:] = speeds = _wheel_speeds(rover, data, target[i], pace[i], float(heading[i]))
            model.dof_damping[wheels] = _ROLLING if speeds.any() else _BRAKED
        mujoco.mj_step(model, data)
    width = _SMOOTH_S * RATE_HZ
    smooth = gaussian_filter1d(states, width, axis=0, mode="nearest")[settle : settle + steps]
    position, turned = smooth[:, :3], smooth[:, 3:]
    return differentiate(position, se3.from_quaternion(position, np.roll(turned, -1, 1))[:, :3, :3])


def _model(mujoco: Any, rover: Rover, ground: HeightGrid, target: Array, heading: float) -> Any:
    """The model with the part of the ground that the path needs."""
    low, high = target.min(0) - _MARGIN_M, target.max(0) + _MARGIN_M
    rows, columns = ground.z.shape
    x = np.arange(columns) * ground.cell + ground.x0
    y = np.arange(rows) * ground.cell + ground.y0
    keep_x, keep_y = (x >= low[0]) & (x <= high[0]), (y >= low[1]) & (y <= high[1])
    z = ground.z[np.ix_(keep_y, keep_x)].astype(np.float64)
    floor, relief = float(z.min()), float(np.ptp(z)) + 1e-3
    half = (float(np.ptp(x[keep_x])) / 2, float(np.ptp(y[keep_y])) / 2, relief)
    middle = np.array([x[keep_x].mean(), y[keep_y].mean(), floor])
    height = float(ground(target[:1, 0], target[:1, 1])[0])
    start = np.array([*target[0], height + rover.leg + rover.wheel_radius + 0.05, heading])
    nrow, ncol = z.shape
    model = mujoco.MjModel.from_xml_string(rover.model_xml(nrow, ncol, half, middle, start))
    model.hfield_data[:] = ((z - floor) / relief).ravel()
    return model


def _wheel_speeds(rover: Rover, data: Any, target: Array, pace: Array, heading: float) -> Array:
    """Wanted speeds [rad/s] of the wheels fl fr rl rr, which bring the rover back to its path."""
    R = se3.from_quaternion(np.zeros((1, 3)), np.roll(data.qpos[3:7], -1)[None])[0, :3, :3]
    off = target - data.qpos[:2]
    if off @ off > _LOST_M**2 or R[2, 2] < _TIPPED:
        what = "tips over" if R[2, 2] < _TIPPED else "loses its path"
        raise GpvoError(
            f"the rover {what} after {data.time - _SETTLE_S:.1f} s", cure="a lower speed, or another --seed"
        )
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    turn = heading - np.arctan2(R[1, 0], R[0, 0])
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    wanted = float(pace @ along)
    if wanted < 1e-3:
        return np.zeros(4)
    speed = wanted + 0.5 * float(off @ along) * min(1.0, wanted)
    bend = wanted * (rover.lateral_gain * float(off @ left) + rover.heading_gain * turn)
    side = bend * rover.half_track
    return np.array([speed - side, speed + side, speed - side, speed + side]) / rover.wheel_radius
