"""What is decided of a sequence before any image is drawn: how large its world must be, the path and the motion in it,
the episodes, and the fate of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths, vehicles
from gpvo.sim.events import Episode, draw_episodes
from gpvo.sim.imu import Motion
from gpvo.sim.paths import Path3, Recording, place, read_recording
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

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
_BARE, _RAMP_S = 0.92, 0.5  # share of the fine texture that a bare wall lacks; time it takes to come into view


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
        cure = "a shorter duration, a lower speed, or a larger world"
        raise GpvoError(f"the path leaves the world at t = {t_s[k]:.1f} s, place {place(position_m[k])}", cure=cure)


def _times(scenario: Scenario) -> Array:
    return np.arange(0.0, scenario.duration_s, 1.0 / _CHECK_HZ)


def _is_clear(scenario: Scenario, world: World, position_m: Array) -> bool:
    inside = (position_m >= world.bounds[0]) & (position_m <= world.bounds[1])
    return bool(inside.all() and world.clearance(position_m).min() > vehicles.RADIUS_M[scenario.vehicle] + _SLACK_M)


def _along(scenario: Scenario, world: World, rng: np.random.Generator) -> Path3:
    """Along the centre line, with as much of the wanted sway as the walls allow."""
    line = world.centreline
    length = float(se3.path_length_m(line)[-1])
    reach = scenario.speed_mps * (scenario.duration_s - scenario.rest_s)
    if reach > length:
        raise GpvoError(
            f"the path of {reach:.0f} m leaves the world, whose centre line is {length:.0f} m long",
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
    """The first drawn path that keeps away from all surfaces; the box it is drawn in shrinks towards the start."""
    low, high = world.bounds[0] + _MARGIN_M, world.bounds[1] - _MARGIN_M
    home = np.clip(world.start_pose[:3, 3], low, high)
    if scenario.world == "tunnel":
        # The box around a winding tunnel is mostly rock: begin with one that the tunnel can hold.
        low, high = np.maximum(low, home - [0, 2.0, 1.0]), np.minimum(high, home + [8.0, 2.0, 1.0])
    for size in np.linspace(1.0, 0.25, _DRAWS):
        path = paths.wandering(
            home + size * (low - home), home + size * (high - home), scenario.duration_s, scenario.speed_mps, rng,
            rest_s=scenario.rest_s, agility=scenario.agility,
        )  # fmt: skip
        if _is_clear(scenario, world, path.position(_times(scenario))):
            return path
    raise GpvoError(f"none of {_DRAWS} paths keeps clear of the walls", cure="another seed, or a shorter duration")


def _place_recording(scenario: Scenario, world: World, recording: Recording, rng: np.random.Generator) -> Path3:
    """The recording where, of some places and directions drawn, it fits at the largest scale, at most 1; its longest
    extent and the nose point along the line of a world that has a long one."""
    drawn = []
    for _ in range(_PLACES):
        middle, along = _draw_place(scenario, world, rng)
        heading = along + (0.0 if scenario.world == "tunnel" else rng.uniform(-np.pi, np.pi))
        yaw = float(along - recording.main_direction_rad + np.pi * rng.integers(2))
        drawn.append((_largest_scale(scenario, world, recording.turned_by(yaw), middle), middle, yaw, heading))
    scale, middle, yaw, heading = max(drawn, key=lambda one: one[0])
    if scale < _SMALLEST_SCALE:
        raise GpvoError(
            f"does not fit into this world even at a scale of {_SMALLEST_SCALE}",
            where=scenario.trajectory,
            cure="another world, a larger one, or a shorter duration",
        )
    return recording.placed(middle, yaw, scale, heading)


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

    def fits(scale: float) -> bool:
        return _is_clear(scenario, world, middle + scale * relative_m[::2])

    low, high = _SMALLEST_SCALE, 1.0
    if not fits(low):
        return 0.0
    if fits(high):
        return 1.0
    for _ in range(8):
        half = float(np.sqrt(low * high))
        low, high = (half, high) if fits(half) else (low, half)
    # A thinner sampling than the final one: keep a little distance from the limit.
    return 0.97 * low if low > _SMALLEST_SCALE else low


@dataclass(frozen=True)
class FramePlan:
    """``step``: index into the 1 kHz motion. ``fate``: shown, dropped, frozen, late or black. The rest goes to the
    image: noise on a 0..1 scale, share of the light that is left, dust as extinction [1/m], exposure [s], share of
    the fine texture that is gone."""

    step: int
    fate: str
    noise_sigma: float
    light: float
    dust: float
    exposure_s: float
    bare: float


def gravity_mps2(scenario: Scenario) -> float:
    """Gravity of the scenario's world. A vehicle that flies needs air, so only the rover feels the moon's."""
    lunar = scenario.world == "lunar" and scenario.vehicle == "rover"
    return vehicles.LUNAR_GRAVITY_MPS2 if lunar else STANDARD_GRAVITY_MPS2


def move(scenario: Scenario, path: Path3, world: World) -> Motion:
    """The vehicle's motion at 1 kHz.

    Raises GpvoError where the vehicle cannot follow the path, or there is no ground for its wheels.
    """
    if scenario.vehicle == "quadrotor":
        return vehicles.fly(path)
    if scenario.vehicle == "rover":
        if world.ground is None:
            raise GpvoError(f"the world '{scenario.world}' has no ground to drive on", cure="vehicle = quadrotor")
        return vehicles.drive(path, world.ground)
    return path.motion(vehicles.RATE_HZ)


def check_motion(scenario: Scenario, world: World, motion: Motion) -> None:
    """Refuse a flight that leaves the world or touches it. Raises GpvoError, naming time and place."""
    some = motion.thinned(round(vehicles.RATE_HZ / _CHECK_HZ))
    refuse_outside(world, some.position_m, some.t_s)
    clearance = world.clearance(some.position_m)
    touches = clearance < vehicles.RADIUS_M[scenario.vehicle]
    if touches.any():
        k = int(touches.argmax())
        raise GpvoError(
            f"the {scenario.vehicle} crashes at t = {some.t_s[k]:.1f} s, place {place(some.position_m[k])}:"
            f" {clearance[k]:.2f} m from the wall",
            cure="another seed, a lower speed, or less sway_m",
        )


def plan_episodes(scenario: Scenario, rng: np.random.Generator) -> tuple[Episode, ...]:
    """When seeing goes wrong, and why. A bare wall is imitated: the fine texture of all that is in view goes."""
    share, begin = scenario.episodes_share, scenario.rest_s + 1.0
    found = draw_episodes(scenario.duration_s, rng, share, begin, scenario.causes) if share > 0 else ()
    return (*found, Episode(*scenario.dark, "blackout")) if scenario.dark else found


def plan_frames(scenario: Scenario, episodes: tuple[Episode, ...], rng: np.random.Generator) -> list[FramePlan]:
    """The fate of every frame."""
    count = int(scenario.duration_s * scenario.rate_hz + 1e-9) + 1
    shares = (scenario.dropped, scenario.frozen, scenario.late, scenario.black)
    edges = np.cumsum(shares)
    fates = ("dropped", "frozen", "late", "black", "shown")
    draws, strength = rng.random(count), rng.random(len(episodes) + 1)
    out = []
    for k in range(count):
        t = k / scenario.rate_hz
        # The blackout, which comes last, may lie over others.
        inside = next((i for i in reversed(range(len(episodes))) if episodes[i].begin_s <= t < episodes[i].end_s), None)
        cause = "" if inside is None else episodes[inside].cause
        # A bare wall comes into view and leaves it, it does not change at once.
        edge_s = 0.0 if inside is None else min(t - episodes[inside].begin_s, episodes[inside].end_s - t)
        extra = 0.1 + 0.1 * strength[-1 if inside is None else inside] if cause == "image_noise" else 0.0
        base = scenario.noise_sigma if k % scenario.noise_every == 0 else 0.0
        fate = "shown" if k == 0 else fates[int(np.searchsorted(edges, draws[k], side="right"))]
        out.append(
            FramePlan(
                step=round(t * vehicles.RATE_HZ),
                fate=fate,
                noise_sigma=float(np.hypot(base, extra)),
                light={"darkness": 0.013, "blackout": 0.0}.get(cause, 1.0),
                dust=0.78 if cause == "dust" else 0.0,
                exposure_s=1.0 / scenario.rate_hz if cause == "motion_blur" else scenario.exposure_s,
                bare=_BARE * min(1.0, max(0.0, edge_s / _RAMP_S)) if cause == "bare_wall" else 0.0,
            )
        )
    return out


def camera_poses(motion: Motion, step: int, exposure_s: float, T_body_left: Array) -> tuple[Array, Array | None]:
    """Pose (4, 4) of the left camera at a step, and (k, 4, 4) poses over the exposure where there is one."""
    reach = round(exposure_s * vehicles.RATE_HZ / 2)
    steps = [step]
    if reach:
        steps += np.rint(np.linspace(step - reach, step + reach, 5)).astype(int).tolist()
    index = np.clip(steps, 0, len(motion.t_s) - 1)
    poses = se3.from_rt(motion.R_world_body[index], motion.position_m[index]) @ T_body_left
    return poses[0], poses[1:] if reach else None
