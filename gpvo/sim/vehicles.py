"""A quadrotor that flies a path, and a rover on four sprung wheels that drives one, both simulated in MuJoCo.

The quadrotor is pushed by four rotors with lag, slowed by drag, and steered by a cascaded controller, so that it sways
and overshoots as real ones do. The rover's wheels carry the chassis on sprung and damped legs over a height field in
lunar gravity, push by friction, and slip; steering turns one side faster than the other. Rate and acceleration are
central differences of the 1 kHz states that MuJoCo computed: poses and IMU then agree by construction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gpvo.errors import GpvoError, require
from gpvo.geometry import se3
from gpvo.sim.imu import Motion
from gpvo.sim.paths import Path3, rotations
from gpvo.sim.worlds import HeightGrid
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

RATE_HZ = 1000.0
LUNAR_GRAVITY_MPS2 = 1.62
RADIUS_M = {"quadrotor": 0.25, "path": 0.2, "rover": 0.3}
_LOST_M = 2.0
_CONTROL_EVERY = 4
# Of the quadrotor: drag [N s/m], gains of position, velocity, attitude and rate.
_DRAG, _POSITION_GAIN, _VELOCITY_GAIN = 0.25, 6.0, 4.5
_ATTITUDE_GAIN, _RATE_GAIN = np.array([2.2, 2.2, 0.9]), np.array([0.32, 0.32, 0.22])
# Contacts of wheels chatter at the simulation's step, far above what a chassis and its mast pass on: a rover's poses
# are smoothed over 10 ms, and that smoothed motion is what truth, images and IMU all hold.
_SETTLE_S = 3.0
_STEER_EVERY = 10
_SMOOTH_S = 0.01
_MARGIN_M = 3.0
_ROLLING, _BRAKED = 0.2, 1e6  # damping of a wheel's axle [N m s]
_TIPPED = 0.5  # cosine of the largest tilt
# Of the rover [m], as in its model; gains of the steering on lateral [1/m^2] and heading [1/m] errors.
_LEG_M, _WHEEL_M, _HALF_TRACK_M = 0.25, 0.25, 0.5
_LATERAL_GAIN, _HEADING_GAIN = 0.6, 1.6


def _model(name: str, **values: object) -> tuple[Any, Any, Any]:
    """MuJoCo, a vehicle's model, and its state."""
    require("mujoco")
    import mujoco

    text = (Path(__file__).parent / "models" / f"{name}.xml").read_text(encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(text.format(**values))
    return mujoco, model, mujoco.MjData(model)


def fly(path: Path3) -> Motion:
    """Fly a path with the quadrotor, beginning in steady hover at its start.

    Raises MissingExtraError without MuJoCo (extra ``sim``); GpvoError where the flight cannot be followed: the vehicle
    loses its path by more than 2 m.
    """
    mujoco, model, data = _model("quadrotor")
    # Two more steps at the end and two before the start leave room for differences.
    steps = round(path.duration_s * RATE_HZ) + 3
    t = np.arange(0, steps, _CONTROL_EVERY) / RATE_HZ
    place = path.position
    wanted = (place(t), place.derivative(1)(t), place.derivative(2)(t), path.attitude(t))
    data.qpos[:3] = wanted[0][0]
    data.qpos[3:7] = np.roll(se3.rotation_to_quaternion_xyzw(wanted[3][:1])[0], 1)
    data.act[:] = model.body_mass[1] * STANDARD_GRAVITY_MPS2 / 4
    mujoco.mj_forward(model, data)
    x, y, spin = model.site_pos[:, 0], model.site_pos[:, 1], model.actuator_gear[:, 5]
    unmix = np.linalg.inv(np.stack([np.ones(4), y, -x, spin]))
    states = np.empty((steps, 7))
    for k in range(steps):
        states[k] = data.qpos
        if k % _CONTROL_EVERY == 0:
            wrench = _thrust_and_torque(model, data, *(w[k // _CONTROL_EVERY] for w in wanted))
            data.ctrl[:] = np.clip(unmix @ wrench, 0.0, model.actuator_ctrlrange[0, 1])
        data.xfrc_applied[1, :3] = -_DRAG * data.qvel[:3]
        mujoco.mj_step(model, data)
    return differentiate(states[:, :3], rotations(np.roll(states[:, 3:], -1, 1)))


def _thrust_and_torque(
    model: Any, data: Any, position: Array, velocity: Array, acceleration: Array, attitude: Array
) -> Array:
    """Thrust and torques (4,) from what is wanted: T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a
    quadrotor UAV on SE(3)", 2010, equations 10, 11, 15 and 16, without the terms of the desired rate."""
    off = position - data.qpos[:3]
    if off @ off > _LOST_M**2:
        raise GpvoError(f"the quadrotor loses its path after {data.time:.1f} s", cure="a slower or smoother path")
    pull = _POSITION_GAIN * off + _VELOCITY_GAIN * (velocity - data.qvel[:3])
    force = model.body_mass[1] * (pull + acceleration + [0, 0, STANDARD_GRAVITY_MPS2]) + _DRAG * velocity
    R = _attitude(data)
    z = force / np.linalg.norm(force)
    y = np.cross(z, attitude[:, 0])
    y /= np.linalg.norm(y)
    wanted = np.stack([np.cross(y, z), y, z], axis=1)
    E = 0.5 * (wanted.T @ R - R.T @ wanted)
    rate = data.qvel[3:6]
    torque = -_ATTITUDE_GAIN * [E[2, 1], E[0, 2], E[1, 0]] - _RATE_GAIN * rate
    torque += np.cross(rate, model.body_inertia[1] * rate)
    return np.concatenate([[force @ R[:, 2]], torque])


def _attitude(data: Any) -> Array:
    return rotations(np.roll(data.qpos[3:7], -1)[None])[0]


def differentiate(position: Array, R_world_body: Array) -> Motion:
    """Motion at 1 kHz from one pose (N, 3), (N, 3, 3) per step: central differences, so N - 2 samples."""
    p = np.concatenate([position[:1], position])
    R = np.concatenate([R_world_body[:1], R_world_body])
    velocity = (p[2:] - p[:-2]) * RATE_HZ / 2
    acceleration = (p[2:] - 2 * p[1:-1] + p[:-2]) * RATE_HZ**2
    rate = se3.so3_log(np.swapaxes(R[:-2], 1, 2) @ R[2:]) * RATE_HZ / 2
    n = len(p) - 3
    return Motion(np.arange(n) / RATE_HZ, p[1 : n + 1], R[1 : n + 1], velocity[:n], acceleration[:n], rate[:n])


def drive(path: Path3, ground: HeightGrid) -> Motion:
    """Drive a path, whose height does not matter, beginning settled on its springs.

    Raises MissingExtraError without MuJoCo (extra ``sim``); GpvoError where the rover tips over, or loses its path by
    more than 2 m.
    """
    steps = round(path.duration_s * RATE_HZ) + 3
    t = np.arange(0, steps, _STEER_EVERY) / RATE_HZ
    target, pace = path.position(t)[:, :2], path.position.derivative(1)(t)[:, :2]
    forward = path.attitude(t)[:, :2, 0]
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    mujoco, model, data = _on_ground(ground, target, float(heading[0]))
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
            data.ctrl[:] = speeds = _wheel_speeds(data, target[i], pace[i], float(heading[i]))
            model.dof_damping[wheels] = _ROLLING if speeds.any() else _BRAKED
        mujoco.mj_step(model, data)
    width = _SMOOTH_S * RATE_HZ
    smooth = gaussian_filter1d(states, width, axis=0, mode="nearest")[settle : settle + steps]
    return differentiate(smooth[:, :3], rotations(np.roll(smooth[:, 3:], -1, 1)))


def _on_ground(ground: HeightGrid, target: Array, heading: float) -> tuple[Any, Any, Any]:
    """The rover's model at its start, with the part of the ground that the path needs."""
    low, high = target.min(0) - _MARGIN_M, target.max(0) + _MARGIN_M
    rows, columns = ground.z.shape
    x = np.arange(columns) * ground.cell + ground.x0
    y = np.arange(rows) * ground.cell + ground.y0
    keep_x, keep_y = (x >= low[0]) & (x <= high[0]), (y >= low[1]) & (y <= high[1])
    z = ground.z[np.ix_(keep_y, keep_x)].astype(np.float64)
    floor, relief = float(z.min()), float(np.ptp(z)) + 1e-3
    height = float(ground(target[:1, 0], target[:1, 1])[0]) + _LEG_M + _WHEEL_M + 0.05
    mujoco, model, data = _model(
        "rover", rows=z.shape[0], columns=z.shape[1], heading_deg=np.rad2deg(heading),
        size=f"{np.ptp(x[keep_x]) / 2} {np.ptp(y[keep_y]) / 2} {relief}",
        middle=f"{x[keep_x].mean()} {y[keep_y].mean()} {floor}", place=f"{target[0, 0]} {target[0, 1]} {height}",
    )  # fmt: skip
    model.hfield_data[:] = ((z - floor) / relief).ravel()
    return mujoco, model, data


def _wheel_speeds(data: Any, target: Array, pace: Array, heading: float) -> Array:
    """Wanted speeds [rad/s] of the wheels fl fr rl rr, which bring the rover back to its path."""
    R = _attitude(data)
    off = target - data.qpos[:2]
    if off @ off > _LOST_M**2 or R[2, 2] < _TIPPED:
        what = "tips over" if R[2, 2] < _TIPPED else "loses its path"
        cure = "a lower speed, or another --seed"
        raise GpvoError(f"the rover {what} after {data.time - _SETTLE_S:.1f} s", cure=cure)
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    turn = heading - np.arctan2(R[1, 0], R[0, 0])
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    wanted = float(pace @ along)
    if wanted < 1e-3:
        return np.zeros(4)
    speed = wanted + 0.5 * float(off @ along) * min(1.0, wanted)
    bend = wanted * (_LATERAL_GAIN * float(off @ left) + _HEADING_GAIN * turn)
    side = bend * _HALF_TRACK_M
    return np.array([speed - side, speed + side, speed - side, speed + side]) / _WHEEL_M
