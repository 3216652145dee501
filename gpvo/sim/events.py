"""What happens on a flight: episodes in which seeing goes wrong, and what moves besides the camera: cars, drifting
smoke, whirling dust.

Each body is rigid, or nearly so, and placed with respect to the camera's own way, so that any world may have it. Cars
hide what lies behind them; smoke and dust do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.sim.paths import level_axes
from gpvo.stats.series import interpolated
from gpvo.types import Array

LANE_M = 3.5
_CAR, _LORRY = np.array([4.2, 1.8, 1.5]), np.array([11.0, 2.5, 3.5])
CAMERA_HEIGHT_M = 1.6  # over the road


@dataclass(frozen=True)
class Episode:
    """From ``begin_s`` to ``end_s``, by a ``cause``."""

    begin_s: float
    end_s: float
    cause: str


# Factors on (pixel noise, number of tracks, outliers) where no images are drawn. Error grows with noise and falls with
# the root of the number: together they raise its standard deviation about tenfold.
CAUSES: dict[str, tuple[float, float, float]] = {
    "darkness": (2.8, 0.22, 3.0),
    "dust": (2.6, 0.20, 4.0),
    "motion_blur": (3.6, 0.35, 3.0),
    "bare_wall": (2.3, 0.15, 2.0),
    "image_noise": (3.8, 0.40, 4.0),
}


def draw_episodes(
    duration_s: float,
    rng: np.random.Generator,
    share: float = 0.2,
    rest_s: float = 4.0,
    causes: Sequence[str] = tuple(CAUSES),
) -> tuple[Episode, ...]:
    """Episodes of 2 to 5 s that fill ``share`` of the flight, none during the rest at its start, none touching
    another, each with one of the ``causes``."""
    lengths: list[float] = []
    while sum(lengths) < share * duration_s - 1.0:
        lengths.append(min(rng.uniform(2.0, 5.0), max(share * duration_s - sum(lengths), 2.0)))
    free = duration_s - rest_s - sum(lengths) - 0.5 * len(lengths)
    if free <= 0:
        return ()
    gaps = rng.dirichlet(np.ones(len(lengths) + 1)) * free
    out, t = [], rest_s
    for gap, length in zip(gaps[:-1], lengths, strict=True):
        cause = str(rng.choice(list(causes)))
        t += gap
        out.append(Episode(t, t + length, cause))
        t += length + 0.5
    return tuple(out)


@dataclass(frozen=True)
class Body:
    """``points`` (n, 3) in its own axes (forward, left, up) [m]; ``T_world_body`` (K, 4, 4), NaN where it is away;
    ``stir_m``: how far its points wander by themselves; ``solid``: hides what is behind."""

    points: Array
    T_world_body: Array
    stir_m: float = 0.0
    solid: bool = False

    def at(self, k: int, rng: np.random.Generator) -> Array:
        """(n, 3) points in the world at frame ``k``; NaN while it is away."""
        stir = self.stir_m * rng.standard_normal(self.points.shape) if self.stir_m else 0.0
        return np.asarray(se3.transform(self.T_world_body[k], self.points + stir))


def draw_movers(
    t_s: Array, T_world_cam: Array, rng: np.random.Generator, *, cars: int = 0, smoke: float = 0.0, dust: float = 0.0
) -> tuple[Body, ...]:
    """Bodies of a flight with frames at ``t_s`` (K,) and poses (K, 4, 4): so many cars, each for 5 to 20 s; smoke and
    dust over a share of the time."""
    way = _Way(t_s, T_world_cam)
    out = [_car(way, rng) for _ in range(cars)]
    for share, draw in ((smoke, _smoke), (dust, _dust)):
        out += [draw(way, e.begin_s, e.end_s, rng) for e in draw_episodes(float(t_s[-1]), rng, share)] if share else []
    return tuple(out)


def hidden(bodies: tuple[Body, ...], first: int, uv: Array, depth_m: Array) -> NDArray[np.bool_]:
    """(N,) which points lie behind a solid body: within its outline's rectangle, beyond its middle.

    ``uv`` (N, 2) [px], NaN out of sight, and ``depth_m`` (N,) of the scene's points, then, from ``first`` on, those of
    the bodies in order.
    """
    out = np.zeros(len(uv), bool)
    for body in bodies:
        own = slice(first, first + len(body.points))
        first += len(body.points)
        seen = np.isfinite(uv[own]).all(axis=1)
        if not body.solid or seen.sum() < 2:
            continue
        low, high = uv[own][seen].min(axis=0), uv[own][seen].max(axis=0)
        with np.errstate(invalid="ignore"):
            behind = ((uv > low) & (uv < high)).all(axis=1) & (depth_m > np.median(depth_m[own][seen]))
        behind[own] = False
        out |= behind
    return out


class _Way:
    """The camera's way over ground: times (K,), arc length (K,) [m], positions (K, 3), headings (K,) [rad]."""

    def __init__(self, t_s: Array, T_world_cam: Array) -> None:
        self.t_s, self.position, ahead = t_s, T_world_cam[:, :3, 3], T_world_cam[:, :3, 2]
        self.arc_m = se3.path_length_m(self.position)
        self.heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))

    def beside(self, arc_m: Array, left_m: float) -> tuple[Array, Array]:
        """Positions (K, 3) and headings (K,) at arc lengths (K,), so far to the left; straight on beyond the end."""
        moving = np.concatenate([[True], np.diff(self.arc_m) > 1e-9])
        arc, place, turn = self.arc_m[moving], self.position[moving], self.heading[moving]
        heading = np.interp(arc_m, arc, turn)
        ahead, left = level_axes(heading)
        over = np.maximum(arc_m - arc[-1], 0.0) + np.minimum(arc_m - arc[0], 0.0)
        return interpolated(arc_m, arc, place) + over[:, None] * ahead + left_m * left, heading

    def poses(self, position: Array, heading: Array, begin_s: float, end_s: float) -> Array:
        """Upright poses (K, 4, 4), NaN outside of begin and end."""
        T = se3.from_rt(se3.so3_exp(heading[:, None] * np.array([0.0, 0.0, 1.0])), position)
        T[(self.t_s < begin_s) | (self.t_s > end_s), :3] = np.nan
        return np.asarray(T)


def _car(way: _Way, rng: np.random.Generator) -> Body:
    """One that leads, one that is overtaken or overtakes, or one that comes towards the camera."""
    duration_s = rng.uniform(5.0, 20.0)
    begin_s = rng.uniform(3.0, max(way.t_s[-1] - duration_s, 3.1))
    since_s = way.t_s - begin_s
    kind = rng.choice(["leads", "beside", "oncoming"], p=[0.4, 0.4, 0.2])
    if kind == "leads":
        sway = rng.uniform(0.5, 2.0) * np.sin(rng.uniform(0.2, 0.6) * since_s + rng.uniform(0, 6.0))
        arc, left_m = way.arc_m + rng.uniform(8.0, 20.0) + sway, rng.normal(0.0, 0.3)
    elif kind == "beside":
        relative_mps = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 4.0)
        arc = way.arc_m + rng.uniform(2.0, 12.0) + relative_mps * (since_s - 0.5 * duration_s)
        left_m = rng.choice([-1.0, 1.0]) * LANE_M
    else:
        arc = np.interp(begin_s, way.t_s, way.arc_m) + 80.0 - rng.uniform(8.0, 20.0) * since_s
        left_m = LANE_M
    position, heading = way.beside(arc, left_m)
    size = _LORRY if rng.random() < 0.4 else _CAR
    heading = heading + np.pi * (kind == "oncoming")
    points = _box(size, int(10 ** rng.uniform(1.8, 3.3)), rng) - [0.0, 0.0, CAMERA_HEIGHT_M]
    return Body(points, way.poses(position, heading, begin_s, begin_s + duration_s), solid=True)


def _smoke(way: _Way, begin_s: float, end_s: float, rng: np.random.Generator) -> Body:
    """A plume ahead that drifts at about the camera's speed, turning slowly."""
    since_s, middle = way.t_s - begin_s, np.searchsorted(way.t_s, 0.5 * (begin_s + end_s))
    pace = rng.uniform(0.5, 1.1) * np.gradient(way.position, way.t_s, axis=0)[middle] + rng.normal(0, 0.2, 3)
    ahead = level_axes(way.heading)[0][middle]
    centre = way.position[middle] + rng.uniform(2.5, 5.0) * ahead
    position = centre + (way.t_s - way.t_s[middle])[:, None] * pace
    points = rng.normal(0.0, [1.2, 1.2, 0.8], (int(rng.uniform(100, 600)), 3))
    heading = rng.uniform(-0.3, 0.3) * since_s
    return Body(points, way.poses(position, heading, begin_s, end_s), stir_m=0.004)


def _dust(way: _Way, begin_s: float, end_s: float, rng: np.random.Generator) -> Body:
    """Whirled up by the vehicle: stays with it and turns about it."""
    points = rng.normal(0.0, 1.0, (int(rng.uniform(200, 1200)), 3))
    points *= rng.uniform(0.8, 3.5, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    heading = way.heading + rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 1.5) * (way.t_s - begin_s)
    return Body(points, way.poses(way.position, heading, begin_s, end_s), stir_m=0.004)


def _box(size_m: Array, n: int, rng: np.random.Generator) -> Array:
    """(n, 3) points on the faces of a box that stands on the ground at the origin."""
    p = rng.uniform(-0.5, 0.5, (n, 3))
    area = np.array([size_m[1] * size_m[2], size_m[0] * size_m[2], size_m[0] * size_m[1] / 2])
    axis = rng.choice(3, n, p=area / area.sum())
    p[np.arange(n), axis] = np.where(axis == 2, 0.5, rng.choice([-0.5, 0.5], n))
    return np.asarray(p * size_m + [0.0, 0.0, size_m[2] / 2])
