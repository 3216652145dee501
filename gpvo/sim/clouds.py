"""Landmarks without surfaces: where a tunnel, a moon, a hall or a street would have texture, and a path among them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths
from gpvo.sim.events import CAMERA_HEIGHT_M
from gpvo.sim.paths import Path3, Recording
from gpvo.sim.points_scenario import PointsScenario
from gpvo.stats.series import interpolated
from gpvo.types import Array

PATHS = ("along", "wander", "straight", "hover", "waypoints")
_STEP_M = 0.5  # between the points of a centre line
_BEYOND_M = 80.0


def make(chosen: PointsScenario, rng: np.random.Generator) -> tuple[Path3, Array]:
    """A path and the landmarks (N, 3) [m] around it. A recorded path is scaled to fit the world, but a street is laid
    along it; waypoints are flown as they are."""
    world, path, duration_s, speed_mps, rest_s = (
        chosen.world, chosen.path, chosen.duration_s, chosen.speed_mps, chosen.rest_s,
    )  # fmt: skip
    if world not in _KINDS:
        raise GpvoError(f"unknown world '{world}'", cure=f"choose from {', '.join(_KINDS)}")
    reach = duration_s * speed_mps + 25.0
    bend = 0.0 if path == "straight" else 1.0
    centre = _tunnel_line(reach, rng, bend, scale=12.0 if world == "street" else 1.0)
    if world == "street" and path not in PATHS:
        return _street_along(_recording(path, duration_s, rest_s), rng)
    landmarks, low, high = _KINDS[world]
    cloud = landmarks(centre, rng)
    if path == "hover":
        flown = paths.hover((low + high) / 2, 0.0, duration_s)
    elif path == "waypoints":
        flown = paths.waypoints(np.array(chosen.waypoints), duration_s, speed_mps, rest_s)
    elif path == "straight":
        height, ground = (1.1, ground_height) if world == "lunar" else (0.0, None)
        flown = paths.straight(
            np.array([0.0, 0.0, height]), np.array([1.0, 0, 0]), duration_s, speed_mps, ground, rest_s
        )
    elif path == "wander" or (path == "along" and world == "room"):
        flown = paths.wandering(low, high, duration_s, speed_mps, rng, rest_s)
    elif path == "along" and world == "street":
        flown = paths.driving(centre + [0, 0, CAMERA_HEIGHT_M], duration_s, speed_mps, rng, rest_s)
    elif path == "along":
        line = centre * [1, 1, 0] + [0, 0, 1.5] if world == "lunar" else centre
        flown = paths.along_curve(line, duration_s, speed_mps, rng, sway_m=0.35, rest_s=rest_s)
    else:
        flown = _recording(path, duration_s, rest_s).fitted(low, high, rng)
    return flown, cloud


def _recording(path: str, duration_s: float, rest_s: float) -> Recording:
    if not Path(path).exists():
        raise GpvoError(f"'{path}' is neither a kind of path nor a file", cure=f"{', '.join(PATHS)}, or a file")
    return paths.read_recording(Path(path), duration_s, rest_s)


def _street_along(recording: Recording, rng: np.random.Generator) -> tuple[Path3, Array]:
    """The recording as it is, and a street below it that goes on straight beyond both of its ends."""
    path = recording.placed(np.zeros(3), 0.0, 1.0, 0.0)
    at = path.position(np.arange(0.0, path.duration_s, 0.05)) - [0, 0, CAMERA_HEIGHT_M]
    steps = np.linalg.norm(np.diff(at, axis=0), axis=1)
    at = at[np.concatenate([[True], steps > 1e-3])]
    ahead = path.attitude(np.array([0.0, path.duration_s]))[:, :, 0] * [1, 1, 0]
    at = np.concatenate([at[:1] - _BEYOND_M * ahead[0], at, at[-1:] + _BEYOND_M * ahead[1]])
    arc = se3.path_length_m(at)
    even = np.arange(0.0, arc[-1], _STEP_M)
    return path, _street(interpolated(even, arc, at), rng)


def _tunnel_line(length_m: float, rng: np.random.Generator, bend: float, scale: float = 1.0) -> Array:
    """A winding line (N, 3), half a metre between its points; ``scale`` stretches its bends."""
    s = np.arange(0.0, length_m, 0.5)
    k, ph = rng.uniform(0.03, 0.12, 4) / scale, rng.uniform(0, 2 * np.pi, 4)
    heading = bend * 0.5 * sum(np.sin(k[i] * s + ph[i]) - np.sin(ph[i]) for i in range(2))
    climb = bend * 0.06 * (np.sin(k[2] * s + ph[2]) - np.sin(ph[2]))
    step = 0.5 * np.stack([np.cos(heading), np.sin(heading), climb], 1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)[:-1]])


def _along(centre: Array, per_m: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random places (n, 3) on the line, so many per metre, and its left (n, 3) there."""
    n = int(len(centre) * 0.5 * per_m)
    i = rng.uniform(0, len(centre) - 1.001, n)
    j = i.astype(int)
    along = centre[j + 1] - centre[j]
    left = np.stack([-along[:, 1], along[:, 0], np.zeros(n)], 1)
    return centre[j] + (i - j)[:, None] * along, left / np.linalg.norm(left, axis=1, keepdims=True)


def _tunnel(centre: Array, rng: np.random.Generator) -> Array:
    """Points on the rough wall of a tunnel of 2 m radius with a flattened floor, about 70 per metre."""
    at, left = _along(centre, 70, rng)
    n = len(at)
    angle = rng.uniform(0, 2 * np.pi, n)
    radius = 2.0 + 0.25 * rng.standard_normal(n)
    wall = at + (radius * np.cos(angle))[:, None] * left
    wall[:, 2] += np.maximum(radius * np.sin(angle), -1.3 + 0.05 * rng.standard_normal(n))
    return wall


def _street(centre: Array, rng: np.random.Generator) -> Array:
    """A road with little texture between kerbs, trees and the fronts of houses with gaps."""
    ground, left = _along(centre, 6, rng)
    road = ground + rng.uniform(-7.0, 7.0, (len(ground), 1)) * left
    at, left = _along(centre, 14, rng)
    n = len(at)
    side = rng.choice([-1.0, 1.0], n)
    # Houses of 25 m each stand back by as much as they like, and every third plot is empty.
    plot = (np.floor(at[:, 0] / 25.0) + 1000 * (side > 0)).astype(int)
    back_m, there = rng.uniform(9.0, 16.0, 4096), rng.random(4096) < 0.67
    at = at + (side * back_m[plot % 4096] + 0.1 * rng.standard_normal(n))[:, None] * left
    at[:, 2] += rng.uniform(0.0, 9.0, n)
    trunks, left = _along(centre, 0.08, rng)
    trunks = trunks + (rng.choice([-1.0, 1.0], len(trunks)) * rng.uniform(5.0, 8.0, len(trunks)))[:, None] * left
    crown = np.repeat(trunks, 60, axis=0)
    crown = crown + np.clip(rng.standard_normal(crown.shape), -2, 2) * [0.9, 0.9, 1.0] + [0, 0, 3.5]
    return np.concatenate([road, at[there[plot % 4096]], crown])


def ground_height(xy: Array) -> Array:
    """Height [m] of the rolling lunar plain at (N, 2) places: the same everywhere, so that wheels and points agree."""
    x, y = np.asarray(xy).T
    rolling = 0.25 * np.sin(0.11 * x + 0.7) * np.cos(0.09 * y)
    return rolling + 0.05 * np.sin(0.6 * x + 0.3 * y) + 0.015 * np.sin(1.9 * x - 1.1 * y)


def _lunar(centre: Array, rng: np.random.Generator) -> Array:
    """Texture of the ground, denser near the track, and boulders that stand out of it."""
    length = float(np.ptp(centre[:, 0])) + 30.0
    n = int(60 * length)
    x = rng.uniform(-5.0, length, n)
    y = 12.0 * rng.standard_normal(n) * rng.uniform(0.1, 1.0, n)
    up = np.where(rng.random(n) < 0.15, rng.exponential(0.25, n), 0.02 * np.abs(rng.standard_normal(n)))
    return np.stack([x, y, ground_height(np.stack([x, y], 1)) + up], 1)


def _room(centre: Array, rng: np.random.Generator) -> Array:
    """Walls, floor and ceiling of a hall of 12 x 12 x 5 m; one wall is blank."""
    n = 5200
    p = rng.uniform([-6, -6, 0], [6, 6, 5], (n, 3))
    face = rng.choice(6, n, p=[0.2, 0.2, 0.2, 0.03, 0.27, 0.1])
    for f, (axis, value) in enumerate(((0, -6.0), (0, 6.0), (1, -6.0), (1, 6.0), (2, 0.0), (2, 5.0))):
        p[face == f, axis] = value
    return p


# Of each world: its landmarks, and the box in which its paths stay [m].
_KINDS: dict[str, tuple[Callable[[Array, np.random.Generator], Array], Array, Array]] = {
    "tunnel": (_tunnel, np.array([4.0, -0.6, -0.4]), np.array([6.0, 0.6, 0.5])),
    "lunar": (_lunar, np.array([-40.0, -20.0, 2.0]), np.array([40.0, 20.0, 4.0])),
    "room": (_room, np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])),
    "street": (_street, np.array([4.0, -1.0, 1.4]), np.array([40.0, 1.0, 1.8])),
}
