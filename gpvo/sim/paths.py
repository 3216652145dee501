"""Smooth paths to fly or drive: position as a C4 spline of time, attitude from how the vehicle moves.

Every path begins with a rest, so that a filter can find its level.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.se3 import path_length_m
from gpvo.sim.imu import Motion
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

_KNOTS_PER_S = 25.0


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
