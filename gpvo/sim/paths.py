"""Smooth paths to fly or drive: position as a C4 spline of time, attitude from how the vehicle moves; and recorded
motion, flown again: a TUM or EuRoC trajectory, smoothed, scaled and put where it fits.

Every path begins with a rest, so that a filter can find its level.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from gpvo.errors import GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.geometry.se3 import path_length_m
from gpvo.sim.imu import Motion
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

_KNOTS_PER_S = 25.0
_STEP_S = 0.02  # of recordings
_UNNOTICED = 0.9


@dataclass(frozen=True)
class Path3:
    """``position`` is a spline of time [s]; ``attitude(t)`` gives ``R_world_body`` (N, 3, 3), body FLU."""

    position: BSpline
    attitude: Callable[[Array], Array]
    duration_s: float

    def motion(self, rate_hz: float) -> Motion:
        """Truth at equal steps over the whole duration."""
        t = np.arange(round(self.duration_s * rate_hz) + 1) / rate_hz
        R = self.attitude(t)
        # Central difference of the exact attitude: good to 1e-8 rad/s at this step.
        h = 5e-4
        rate = se3.so3_log(np.swapaxes(self.attitude(t - h), -1, -2) @ self.attitude(t + h)) / (2 * h)
        velocity, acceleration = self.position.derivative(1)(t), self.position.derivative(2)(t)
        return Motion(t, self.position(t), R, velocity, acceleration, rate)


RAMP_S = 2.0


def smooth_start(t_s: Array, rest_s: float) -> Array:
    """Time that stands still for ``rest_s`` and then takes :data:`RAMP_S` to run at full pace (C3)."""
    x = np.clip((np.asarray(t_s) - rest_s) / RAMP_S, 0.0, None)
    y = np.minimum(x, 1.0)
    # Integral of the smoothstep 35 y^4 - 84 y^5 + 70 y^6 - 20 y^7.
    begun = 7 * y**5 - 14 * y**6 + 10 * y**7 - 2.5 * y**8
    return RAMP_S * (begun + np.maximum(x - 1.0, 0.0))


def along_curve(
    centre: Array, duration_s: float, speed_mps: float, rng: np.random.Generator, *, sway_m: float, rest_s: float = 3.0,
    agility: float = 1.0,
) -> Path3:  # fmt: skip
    """Flight along a polyline (N, 3) [m] with lateral and vertical sway, the nose along the curve.

    The speed varies by a third around ``speed_mps``. ``agility`` multiplies how quickly it sways, turns and changes
    speed. Where the curve ends before the time does, the flight slows and hovers there.
    """
    arc = path_length_m(centre)
    curve = make_interp_spline(arc, gaussian_filter1d(centre, 3.0, axis=0, mode="nearest"), k=5)
    t = knots(duration_s)
    pace = smooth_start(t, rest_s)
    w, ph = agility * rng.uniform(0.15, 0.5, 5), rng.uniform(0, 2 * np.pi, 5)
    s = speed_mps * (pace + 0.33 / w[0] * (np.sin(w[0] * pace + ph[0]) - np.sin(ph[0])))
    room = arc[-1] - 1.0
    s = room * np.tanh(s / room * 1.0) if s[-1] > 0.8 * room else s
    start = _smoothstep(pace / 4.0)
    heading = _heading(curve.derivative(1)(s))
    offset = sway_m * (np.sin(2 * w[1] * pace + ph[1]) - np.sin(ph[1])) * start
    rise = 0.5 * sway_m * (np.sin(2 * w[2] * pace + ph[2]) - np.sin(ph[2])) * start
    position = curve(s) + level_axes(heading)[1] * offset[:, None]
    position[:, 2] += rise
    yaw = heading + 0.25 * (np.sin(1.6 * w[3] * pace + ph[3]) - np.sin(ph[3])) * start
    return _flat(t, position, yaw, duration_s)


def driving(centre: Array, duration_s: float, speed_mps: float, rng: np.random.Generator, rest_s: float = 3.0) -> Path3:
    """A drive along a polyline (N, 3) [m], level: up to ``speed_mps``, slower in between, now and then a stop."""
    arc = path_length_m(centre)
    curve = make_interp_spline(arc, gaussian_filter1d(centre, 6.0, axis=0, mode="nearest"), k=5)
    t, every_s = knots(duration_s), max(8.0, speed_mps / 2.5)
    at = np.arange(rest_s + 1.6, duration_s + 3 * every_s, every_s)  # smoothing reaches so far back
    wanted = speed_mps * rng.uniform(0.35, 1.0, len(at)) * (rng.random(len(at)) > 0.12)
    wanted[0] = 0.0
    speed = np.maximum(PchipInterpolator(at, wanted)(np.maximum(t, at[0])), 0.0)
    speed = gaussian_filter1d(speed, 0.4 * _KNOTS_PER_S, mode="nearest")
    s = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))])
    return _flat(t, curve(s), _heading(curve.derivative(1)(s)), duration_s, lean=0.0)


def wandering(
    low: Array, high: Array, duration_s: float, speed_mps: float, rng: np.random.Generator, rest_s: float = 3.0,
    agility: float = 1.0,
) -> Path3:  # fmt: skip
    """A smooth random flight within a box [m]: sums of sines, the nose turning slowly. ``agility`` makes the bends at
    the same speed tighter, and the turns of the nose quicker."""
    t = knots(duration_s)
    pace = smooth_start(t, rest_s)
    half, middle = (np.asarray(high) - low) / 2, (np.asarray(high) + low) / 2
    w = rng.uniform(0.5, 1.5, (3, 3))
    amplitude = rng.uniform(0.3, 1.0, (3, 3))
    amplitude *= half / amplitude.sum(0) / max(agility, 1.0)
    # Mean speed of the sum of sines is near its root mean square: scale the frequencies to the speed asked for.
    rms = np.sqrt(0.5 * ((amplitude * w) ** 2).sum())
    w = w * speed_mps / rms
    ph = rng.uniform(0, 2 * np.pi, (3, 3))
    angle = w[None] * pace[:, None, None] + ph[None]
    position = middle + (amplitude * np.sin(angle)).sum(1)
    turn = agility * pace
    yaw = rng.uniform(-np.pi, np.pi) + 1.2 * np.sin(0.25 * turn + ph[0, 0]) + 0.4 * np.sin(0.7 * turn + ph[1, 1])
    return _flat(t, position, yaw, duration_s)


def straight(
    start: Array, direction: Array, duration_s: float, speed_mps: float, ground: Callable[[Array], Array] | None = None,
    rest_s: float = 3.0,
) -> Path3:  # fmt: skip
    """A straight drive; ``ground(xy (N, 2)) -> z (N,)`` gives the height of the wheels' path, whose slope it
    follows."""
    t = knots(duration_s)
    s = speed_mps * smooth_start(t, rest_s)
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    position = np.asarray(start, float) + s[:, None] * unit
    yaw = np.full(len(t), np.arctan2(unit[1], unit[0]))
    if ground is None:
        return _flat(t, position, yaw, duration_s, lean=0.0)
    position[:, 2] = start[2] + ground(position[:, :2])
    side, ahead = 0.5 * np.array([-unit[1], unit[0], 0.0]), 0.6 * unit
    pitch = np.arctan2(ground((position - ahead)[:, :2]) - ground((position + ahead)[:, :2]), 1.2)
    roll = np.arctan2(ground((position + side)[:, :2]) - ground((position - side)[:, :2]), 1.0)
    angles = make_interp_spline(t, np.stack([roll, pitch, yaw], 1), k=5)

    def attitude(u: Array) -> Array:
        about_x, about_y, about_z = (se3.so3_exp(angles(u)[:, i, None] * np.eye(3)[i]) for i in range(3))
        return about_z @ about_y @ about_x

    return Path3(make_interp_spline(t, position, k=5), attitude, duration_s)


def hover(at: Array, yaw_rad: float, duration_s: float) -> Path3:
    """Standing in the air."""
    t = knots(duration_s)
    return _flat(t, np.tile(np.asarray(at, float), (len(t), 1)), np.full(len(t), yaw_rad), duration_s)


def waypoints(points: Array, duration_s: float, speed_mps: float, rest_s: float = 3.0) -> Path3:
    """Flight through points (N, 3) [m] on a cubic spline, the nose along it; it slows down and hovers at the last.

    Raises GpvoError for fewer than two points, two equal ones in a row, or a way that turns back on the spot.
    """
    corners = np.asarray(points, float).reshape(-1, 3)
    chord = path_length_m(corners)
    if len(corners) < 2 or (np.diff(chord) < 1e-3).any():
        raise GpvoError("waypoints need at least two places, none twice in a row", cure="waypoints = [[x, y, z], ...]")
    curve = make_interp_spline(chord, corners, k=min(3, len(corners) - 1))
    fine = np.linspace(0.0, chord[-1], max(2000, int(50 * chord[-1])))
    way = curve(fine)
    steps = np.diff(way, axis=0)
    if (back := (steps[1:] * steps[:-1]).sum(axis=1) <= 0).any():
        text = f"the way through the waypoints turns back on the spot at {place(way[1 + int(back.argmax())])}"
        raise GpvoError(text, cure="put another place beside the turn")
    along = path_length_m(way)
    at_arc = CubicSpline(along, fine)
    t = knots(duration_s)
    u = at_arc(soft_end(speed_mps * smooth_start(t, rest_s), along[-1], 0.5 * speed_mps))
    # A step straight up has no heading of its own: it keeps a trace of the first one.
    return _flat(t, curve(u), _heading(curve.derivative(1)(u) + 1e-3 * (corners[-1] - corners[0])), duration_s)


def place(p: Array) -> str:
    """A place in words."""
    return f"({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f}) m"


def soft_end(distance: Array, limit: float, width: float) -> Array:
    """The same distance as long as it is far from ``limit`` [m], which it approaches smoothly and never passes."""
    width = max(min(width, 0.2 * limit), 1e-9)
    left = width * np.logaddexp(0.0, (limit - np.asarray(distance)) / width)
    return np.clip(width * np.logaddexp(0.0, limit / width) - left, 0.0, limit)


def _smoothstep(x: Array) -> Array:
    """0 to 1 as x goes from 0 to 1, with three derivatives zero at both ends."""
    y = np.clip(x, 0.0, 1.0)
    return 35 * y**4 - 84 * y**5 + 70 * y**6 - 20 * y**7


def knots(duration_s: float) -> Array:
    """Times [s] of a path's support points."""
    # A margin, so that differences at the ends stay inside.
    return np.arange(-0.2, duration_s + 0.24, 1.0 / _KNOTS_PER_S)


def _heading(tangent: Array) -> Array:
    """Directions (N,) [rad] of vectors (N, 3), without jumps."""
    return np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))


def level_axes(heading: Array) -> tuple[Array, Array]:
    """Unit vectors (N, 3) ahead and to the left, level, of headings (N,) [rad]."""
    c, s, zero = np.cos(heading), np.sin(heading), np.zeros_like(heading)
    return np.stack([c, s, zero], 1), np.stack([-s, c, zero], 1)


def rotations(q_xyzw: Array) -> Array:
    """Rotations (N, 3, 3) of quaternions (N, 4) of any length."""
    return se3.from_quaternion(np.zeros((len(q_xyzw), 3)), q_xyzw)[:, :3, :3]


def _flat(t: Array, position: Array, yaw: Array, duration_s: float, lean: float = 1.0) -> Path3:
    """Attitude of a multirotor: its thrust points along acceleration plus gravity (D. Mellinger, V. Kumar, "Minimum
    snap trajectory generation and control for quadrotors", 2011, section III). ``lean`` scales the tilt; 0 stays
    level."""
    place, turn = make_interp_spline(t, position, k=5), make_interp_spline(t, yaw, k=5)
    pull = place.derivative(2)

    def attitude(u: Array) -> Array:
        z = lean * pull(u) + np.array([0, 0, STANDARD_GRAVITY_MPS2])
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
        y = np.cross(z, level_axes(turn(u))[0])
        y = y / np.linalg.norm(y, axis=1, keepdims=True)
        return np.stack([np.cross(y, z), y, z], axis=2)

    return Path3(place, attitude, duration_s)


@dataclass(frozen=True)
class Recording:
    """Motion relative to its start: ``position_m`` (N, 3) about the middle of its extent, every 0.02 s, z up;
    ``turned_xyzw`` (N, 4) how far the body has turned since the start, in world axes; for a flight of ``duration_s``
    that rests at first."""

    position_m: Array
    turned_xyzw: Array
    duration_s: float
    rest_s: float

    @property
    def main_direction_rad(self) -> float:
        """Heading of the longest horizontal extent [rad]."""
        xy = self.position_m[:, :2] - self.position_m[:, :2].mean(0)
        x, y = np.linalg.svd(xy, full_matrices=False)[2][0]
        return float(np.arctan2(y, x))

    def turned_by(self, yaw_rad: float) -> Array:
        """Positions (N, 3) of the recording turned about the vertical."""
        return self.position_m @ _about_z(yaw_rad).T

    def placed(self, middle: Array, yaw_rad: float, scale: float, heading_rad: float) -> Path3:
        """The recording as a path: turned by ``yaw_rad``, scaled, its extent about ``middle`` (3,), the body level at
        the start with the nose at ``heading_rad``. Warns where it is made smaller: the speeds are, too."""
        if scale < _UNNOTICED:
            warnings.warn(f"the path is flown at {scale:.2g} of its size and speed, to fit the world", stacklevel=2)
        turn = _about_z(yaw_rad)
        grid = np.arange(len(self.position_m)) * _STEP_S
        place = make_interp_spline(grid, self.turned_by(yaw_rad) * scale + middle, k=5)
        pose = make_interp_spline(grid, self.turned_xyzw, k=5)
        t = knots(self.duration_s)

        def attitude(u: Array) -> Array:
            return turn @ rotations(pose(smooth_start(u, self.rest_s))) @ turn.T @ _about_z(heading_rad)

        return Path3(make_interp_spline(t, place(smooth_start(t, self.rest_s)), k=5), attitude, self.duration_s)

    def fitted(self, low: Array, high: Array, rng: np.random.Generator) -> Path3:
        """The recording scaled down to fit a box [m], looking in a random direction at its start."""
        scale = min(1.0, float(((high - low) / np.maximum(np.ptp(self.position_m, axis=0), 1e-6)).min()))
        return self.placed((high + low) / 2, 0.0, scale, rng.uniform(-np.pi, np.pi))


def read_recording(file: Path, duration_s: float, rest_s: float = 3.0) -> Recording:
    """The part of a trajectory that a flight of ``duration_s`` needs.

    Of a file, ``.csv`` in EuRoC's layout, else TUM lines, or of a run folder, whose first camera pose is taken as
    level.

    Laser and motion capture jitter by millimetres: the motion is smoothed over a tenth of a second. Raises SourceError
    where the file is no trajectory, or is shorter than the flight.
    """
    clock, T_world_body = _read(file)
    needed = float(smooth_start(np.array([duration_s]), rest_s)[0])
    if clock[-1] < needed:
        cure = f"a duration of at most {longest_flight_s(clock[-1], rest_s):g} s"
        raise SourceError(f"lasts {clock[-1]:.1f} s, the flight needs {needed:.1f} s of it", where=file, cure=cure)
    grid = np.arange(0.0, needed + 0.3, _STEP_S)
    poses = _resample(clock, T_world_body, np.minimum(grid, clock[-1]))
    p, turned = _smoothed(poses[:, :3, 3], poses[:, :3, :3] @ poses[0, :3, :3].T)
    return Recording(p - (p.max(0) + p.min(0)) / 2, turned, duration_s, rest_s)


def _read(path: Path) -> tuple[Array, Array]:
    """Times (N,) [s] from 0 and poses (N, 4, 4) of a body (forward, left, up) in a world whose z points up."""
    from gpvo.io.run_read import is_run, read_run
    from gpvo.io.trajectory import read_euroc_csv, read_tum

    if is_run(path):
        log = read_run(path).log
        return (log.t_ns - log.t_ns[0]) * 1e-9, se3.T_FLU_OPTICAL @ log.trajectory() @ se3.T_FLU_OPTICAL.T
    recorded = read_euroc_csv(path) if path.suffix.lower() == ".csv" else read_tum(path)
    return (recorded.t_ns - recorded.t_ns[0]) * 1e-9, recorded.T_world_body


def smooth_path(t_s: Array, T_world_body: Array) -> Path3:
    """A path near poses (N, 4, 4) at times ``t_s`` (N,) from 0 on that a vehicle can fly: smoothed likewise."""
    grid = np.arange(0.0, t_s[-1] + 0.3, _STEP_S)
    poses = _resample(t_s, T_world_body, np.minimum(grid, t_s[-1]))
    place, turn = (make_interp_spline(grid, v, k=5) for v in _smoothed(poses[:, :3, 3], poses[:, :3, :3]))
    return Path3(place, lambda u: rotations(turn(u)), float(t_s[-1]))


def longest_flight_s(length_s: float, rest_s: float = 3.0) -> float:
    """Duration [s] of the longest flight that a trajectory of a length in time allows, in tenths."""
    return float(np.floor(10 * (length_s + rest_s + RAMP_S / 2)) / 10)


def _about_z(angle_rad: float) -> Array:
    return se3.so3_exp(np.array([0.0, 0.0, angle_rad]))


def _resample(clock: Array, T: Array, at: Array) -> Array:
    j = np.clip(np.searchsorted(clock, at), 1, len(clock) - 1)
    share = (at - clock[j - 1]) / np.maximum(clock[j] - clock[j - 1], 1e-9)
    return se3.interpolate(T[j - 1], T[j], np.clip(share, 0, 1))


def _smoothed(position: Array, R: Array) -> tuple[Array, Array]:
    """Positions (N, 3) and quaternions (N, 4), x y z w, of poses every 0.02 s, without jitter."""
    q = se3.rotation_to_quaternion_xyzw(R)
    # q and -q are equal: signs must not jump.
    flips = np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)
    q = q * np.cumprod(np.concatenate([[1.0], flips]))[:, None]
    smooth = (gaussian_filter1d(v, 0.1 / _STEP_S, axis=0, mode="nearest") for v in (position, q))
    return next(smooth), next(smooth)
