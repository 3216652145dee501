"""Which path the vehicle of a scenario follows, and how large its world must be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry.se3 import path_length_m
from gpvo.sim import paths, vehicles
from gpvo.sim.paths import Path3
from gpvo.sim.recorded import Recording, read_recording
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import Array

_MARGIN_M = 0.7
_SLACK_M = 0.15
_CHECK_HZ = 50
_DRAWS = 40
_PLACES = 12
_SMALLEST_SCALE = 0.05
_CALMER = (1.0, 0.7, 0.4, 0.0)
# Length that worlds have by default, and where along it vehicles start.
_USUAL_LENGTH_M = {"tunnel": 160.0, "lunar": 260.0}
_LENGTH_STEP_M = 40.0


def world_parameters(scenario: Scenario) -> dict[str, object]:
    """The scenario's parameters of its world, with a ``length`` that suffices where none is given."""
    given = dict(scenario.world_params)
    if scenario.world not in _USUAL_LENGTH_M or "length" in given or scenario.path in ("hover", "wander"):
        return given
    needed = 1.25 * scenario.speed_mps * scenario.duration_s + 20.0
    if needed > _USUAL_LENGTH_M[scenario.world]:
        given["length"] = float(np.ceil(needed / _LENGTH_STEP_M) * _LENGTH_STEP_M)
    return given


def plan_path(scenario: Scenario, world: World, rng: np.random.Generator) -> Path3:
    """The path that the vehicle is asked to follow, clear of all surfaces.

    Raises GpvoError where the path leaves the world, or none that was drawn is clear.
    """
    duration, speed, rest = scenario.duration_s, scenario.speed_mps, scenario.rest_s
    if scenario.needs_trajectory and not scenario.trajectory:
        raise GpvoError(f"'{scenario.name}' flies a recorded path", cure="give --trajectory FILE (TUM lines, z up)")
    if scenario.trajectory:
        file = Path(scenario.trajectory)
        if not file.exists():
            raise GpvoError("no such trajectory", where=file)
        return _place_recording(scenario, world, read_recording(file, duration, rest), rng)
    start, ahead = world.start_pose[:3, 3], world.start_pose[:3, 0]
    if scenario.path == "waypoints":
        path = paths.waypoints(np.array(scenario.waypoints), duration, speed, rest_s=rest)
        refuse_outside(world, path.position(_times(scenario)), _times(scenario))
        return path
    if scenario.path == "hover":
        return paths.hover(start, float(np.arctan2(ahead[1], ahead[0])), duration)
    if scenario.path == "straight" or scenario.vehicle == "rover":
        path = paths.straight(start, ahead * [1, 1, 0], duration, speed, rest_s=rest)
        refuse_outside(world, path.position(_times(scenario)) * [1, 1, 0], _times(scenario), flat=True)
        return path
    if scenario.path == "wander" or scenario.world == "room":
        return _wander(scenario, world, rng)
    return _along(scenario, world, rng)


def refuse_outside(world: World, position_m: Array, t_s: Array, flat: bool = False) -> None:
    """Refuse places (N, 3) outside the box in which the world's paths may run; ``flat`` leaves out the height.

    Raises GpvoError, naming time and place.
    """
    axes = slice(0, 2) if flat else slice(0, 3)
    p, low, high = position_m[:, axes], world.bounds[0, axes], world.bounds[1, axes]
    outside = ((p < low) | (p > high)).any(axis=1)
    if outside.any():
        k = int(outside.argmax())
        raise GpvoError(
            f"the path leaves the world at t = {t_s[k]:.1f} s, place {place(position_m[k])}",
            cure="a shorter duration, a lower speed, or a larger world",
        )


def place(p: Array) -> str:
    """A place in words."""
    return f"({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f}) m"


def _times(scenario: Scenario) -> Array:
    return np.arange(0.0, scenario.duration_s, 1.0 / _CHECK_HZ)


def _is_clear(scenario: Scenario, world: World, position_m: Array) -> bool:
    inside = (position_m >= world.bounds[0]) & (position_m <= world.bounds[1])
    return bool(inside.all() and world.clearance(position_m).min() > vehicles.RADIUS_M[scenario.vehicle] + _SLACK_M)


def _along(scenario: Scenario, world: World, rng: np.random.Generator) -> Path3:
    """Along the centre line, with as much of the wanted sway as the walls allow."""
    line = world.centreline
    length = float(path_length_m(line)[-1])
    reach = scenario.speed_mps * (scenario.duration_s - scenario.rest_s)
    if reach > length:
        raise GpvoError(
            f"the path of {reach:.0f} m leaves the world, whose line is {length:.0f} m long",
            cure="a shorter duration, a lower speed, or a larger world_params.length",
        )
    state = rng.bit_generator.state
    for share in _CALMER:
        rng.bit_generator.state = state
        path = paths.along_curve(
            line, scenario.duration_s, scenario.speed_mps, rng, sway_m=share * scenario.sway_m, rest_s=scenario.rest_s,
            agility=scenario.agility,
        )  # fmt: skip
        if _is_clear(scenario, world, path.position(_times(scenario))):
            return path
    raise GpvoError("the centre line of this world comes too near its walls", cure="another --seed")


def _wander(scenario: Scenario, world: World, rng: np.random.Generator) -> Path3:
    duration, speed, rest = scenario.duration_s, scenario.speed_mps, scenario.rest_s

    def draw(a: Array, b: Array) -> Path3:
        return paths.wandering(a, b, duration, speed, rng, rest_s=rest, agility=scenario.agility)

    return _clear_of_walls(scenario, world, draw)


def _clear_of_walls(scenario: Scenario, world: World, draw: Callable[[Array, Array], Path3]) -> Path3:
    """The first drawn path that keeps away from all surfaces; the box it is drawn in shrinks towards the start."""
    low, high = world.bounds[0] + _MARGIN_M, world.bounds[1] - _MARGIN_M
    home = np.clip(world.start_pose[:3, 3], low, high)
    if scenario.world == "tunnel":
        # The box around a winding tunnel is mostly rock: begin with one that the tunnel can hold.
        low, high = np.maximum(low, home - [0, 2.0, 1.0]), np.minimum(high, home + [8.0, 2.0, 1.0])
    for size in np.linspace(1.0, 0.25, _DRAWS):
        path = draw(home + size * (low - home), home + size * (high - home))
        if _is_clear(scenario, world, path.position(_times(scenario))):
            return path
    raise GpvoError(f"no path of {_DRAWS} drawn keeps clear of the walls", cure="another seed, or a shorter duration")


def _place_recording(scenario: Scenario, world: World, recording: Recording, rng: np.random.Generator) -> Path3:
    """The recording where, of some places and directions drawn, it fits at the largest scale, at most 1.

    In a world with a long line its longest extent and the nose point along the line.
    """
    best: tuple[float, Array, float, float] | None = None
    for _ in range(_PLACES):
        middle, along = _draw_place(scenario, world, rng)
        heading = along + (0.0 if scenario.world == "tunnel" else rng.uniform(-np.pi, np.pi))
        yaw = float(along - recording.main_direction_rad + np.pi * rng.integers(2))
        scale = _largest_scale(scenario, world, recording.turned_by(yaw), middle)
        if best is None or scale > best[0]:
            best = (scale, middle, yaw, heading)
    assert best is not None
    scale, middle, yaw, heading = best
    if scale < _SMALLEST_SCALE:
        raise GpvoError(
            f"does not fit into this world even at a scale of {_SMALLEST_SCALE}",
            where=scenario.trajectory,
            cure="another world, a larger one, or a shorter duration",
        )
    return recording.placed(middle, yaw, scale, heading, scenario.duration_s, scenario.rest_s)


def _draw_place(scenario: Scenario, world: World, rng: np.random.Generator) -> tuple[Array, float]:
    """Where a recording's middle may lie, and a direction with room [rad]."""
    if scenario.world == "room":
        low, high = world.bounds
        return low + (0.5 + rng.uniform(-0.1, 0.1, 3)) * (high - low), float(rng.uniform(-np.pi, np.pi))
    line = world.centreline
    k = int(rng.integers(len(line) // 10, 9 * len(line) // 10))
    ahead = line[min(k + 4, len(line) - 1)] - line[k]
    lift = 1.5 if scenario.world == "lunar" else 0.0
    return line[k] + [0, 0, lift], float(np.arctan2(ahead[1], ahead[0]))


def _largest_scale(scenario: Scenario, world: World, relative_m: Array, middle: Array) -> float:
    """Largest scale up to 1 at which the places (N, 3) about ``middle`` are clear; 0 where even the smallest is not."""
    some = relative_m[::2]
    if not _is_clear(scenario, world, middle + _SMALLEST_SCALE * some):
        return 0.0
    if _is_clear(scenario, world, middle + some):
        return 1.0
    low, high = _SMALLEST_SCALE, 1.0
    for _ in range(8):
        half = float(np.sqrt(low * high))
        low, high = (half, high) if _is_clear(scenario, world, middle + half * some) else (low, half)
    # A thinner sampling than the final one: keep a little distance from the limit.
    return 0.97 * low if low > _SMALLEST_SCALE else low
