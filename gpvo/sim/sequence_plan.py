"""What happens in a sequence before any picture is drawn: the motion, its check, and the fate of each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths, vehicles
from gpvo.sim.episodes import CAUSES, Episode, draw_episodes
from gpvo.sim.imu import GRAVITY_MPS2, Motion
from gpvo.sim.paths import Path3
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import Array

_MARGIN_M = 0.7
_ROVER_HEIGHT_M = 0.9
_CHECK_HZ = 50
_DRAWS = 40
_SLACK_M = 0.15


@dataclass(frozen=True)
class FramePlan:
    """``step``: index into the 1 kHz motion. ``fate``: shown, dropped, frozen, late or black. The rest goes to the
    sensor: noise on a 0..1 scale, share of the light that is left, dust as extinction [1/m], exposure [s]."""

    step: int
    fate: str
    noise_sigma: float
    light: float
    dust: float
    exposure_s: float


def gravity_mps2(scenario: Scenario) -> float:
    """Gravity of the scenario's world. A vehicle that flies needs air, so only the rover feels the moon's."""
    lunar = scenario.world == "lunar" and scenario.vehicle == "rover"
    return vehicles.LUNAR_GRAVITY_MPS2 if lunar else GRAVITY_MPS2


def plan_path(scenario: Scenario, world: World, rng: np.random.Generator) -> Path3:
    """The path that the vehicle is asked to follow."""
    duration, speed, rest = scenario.duration_s, scenario.speed_mps, scenario.rest_s
    if scenario.needs_trajectory and not scenario.trajectory:
        raise GpvoError(f"'{scenario.name}' flies a recorded path", cure="give --trajectory FILE (TUM lines, z up)")
    if scenario.trajectory:
        file = Path(scenario.trajectory)
        if not file.is_file():
            raise GpvoError("no such trajectory", where=file)
        return _clear_of_walls(scenario, world, lambda a, b: paths.flown(file, a, b, duration, rng, rest_s=rest))
    start, ahead = world.start_pose[:3, 3], world.start_pose[:3, 0]
    if scenario.vehicle == "rover":
        if not world.heights:
            raise GpvoError(f"the world '{scenario.world}' has no ground to drive on", cure="vehicle = quadrotor")
        flat = np.array([start[0], start[1], _ROVER_HEIGHT_M])
        ground = vehicles.footprint(world.height)
        return paths.straight(flat, ahead * [1, 1, 0], duration, speed, ground, rest_s=rest)
    if scenario.path == "hover":
        return paths.hover(start, float(np.arctan2(ahead[1], ahead[0])), duration)
    if scenario.path == "straight":
        return paths.straight(start, ahead * [1, 1, 0], duration, speed, rest_s=rest)
    if scenario.path == "wander":
        return _clear_of_walls(scenario, world, lambda a, b: paths.wandering(a, b, duration, speed, rng, rest_s=rest))
    return paths.along_curve(world.centreline, duration, speed, rng, sway_m=scenario.sway_m, rest_s=rest)


def _clear_of_walls(scenario: Scenario, world: World, draw: Callable[[Array, Array], Path3]) -> Path3:
    """The first drawn path that keeps away from all surfaces; the box it is drawn in shrinks towards the start."""
    low, high = world.bounds[0] + _MARGIN_M, world.bounds[1] - _MARGIN_M
    home = np.clip(world.start_pose[:3, 3], low, high)
    for size in np.linspace(1.0, 0.25, _DRAWS):
        path = draw(home + size * (low - home), home + size * (high - home))
        places = path.position(np.arange(0.0, scenario.duration_s, 1.0 / _CHECK_HZ))
        if world.clearance(places).min() > vehicles.RADIUS_M[scenario.vehicle] + _SLACK_M:
            return path
    raise GpvoError(f"no path of {_DRAWS} drawn keeps clear of the walls", cure="another seed, or a shorter duration")


def move(scenario: Scenario, path: Path3) -> Motion:
    """The vehicle's motion at 1 kHz."""
    if scenario.vehicle == "quadrotor":
        return vehicles.fly(path)
    return path.motion(vehicles.RATE_HZ)


def check_motion(scenario: Scenario, world: World, motion: Motion) -> None:
    """Refuse a flight that leaves the world or touches it.

    Raises
    ------
    GpvoError
        Naming time and place.
    """
    some = motion.thinned(round(vehicles.RATE_HZ / _CHECK_HZ))
    outside = ((some.position_m < world.bounds[0]) | (some.position_m > world.bounds[1])).any(axis=1)
    if outside.any():
        k = int(outside.argmax())
        raise GpvoError(
            f"the path leaves the world at t = {some.t_s[k]:.1f} s, place {_place(some.position_m[k])}",
            cure="a shorter duration, a lower speed, or a larger world",
        )
    clearance = world.clearance(some.position_m)
    if (clearance < vehicles.RADIUS_M[scenario.vehicle]).any():
        k = int((clearance < vehicles.RADIUS_M[scenario.vehicle]).argmax())
        raise GpvoError(
            f"the {scenario.vehicle} crashes at t = {some.t_s[k]:.1f} s, place {_place(some.position_m[k])}:"
            f" {clearance[k]:.2f} m from the wall",
            cure="another seed, a lower speed, or less sway_m",
        )


def plan_episodes(scenario: Scenario, rng: np.random.Generator) -> tuple[Episode, ...]:
    """When seeing goes wrong, and why. A bare wall is part of the world, not of the pictures: dust takes its place."""
    found: list[Episode] = []
    if scenario.episodes_share > 0:
        for e in draw_episodes(scenario.duration_s, rng, scenario.episodes_share, scenario.rest_s + 1.0):
            cause = "dust" if e.cause == "bare_wall" else e.cause
            found.append(Episode(e.begin_s, e.end_s, cause, *CAUSES[cause]))
    if scenario.dark:
        found.append(Episode(*scenario.dark, "blackout"))
    return tuple(found)


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
        inside = next((i for i, e in enumerate(episodes) if e.begin_s <= t < e.end_s), None)
        cause = "" if inside is None else episodes[inside].cause
        extra = 0.1 + 0.1 * strength[-1 if inside is None else inside] if cause == "image_noise" else 0.0
        base = scenario.noise_sigma if k % scenario.noise_every == 0 else 0.0
        fate = "shown" if k == 0 else fates[int(np.searchsorted(edges, draws[k], side="right"))]
        out.append(
            FramePlan(
                step=round(t * vehicles.RATE_HZ),
                fate=fate,
                noise_sigma=float(np.hypot(base, extra)),
                light={"darkness": 0.015, "blackout": 0.0}.get(cause, 1.0),
                dust=0.8 if cause == "dust" else 0.0,
                exposure_s=0.6 / scenario.rate_hz if cause == "motion_blur" else scenario.exposure_s,
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


def _place(p: Array) -> str:
    return f"({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f}) m"
