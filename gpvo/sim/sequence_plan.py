"""What happens in a sequence before any image is drawn: the motion, its check, and the fate of each frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import vehicles
from gpvo.sim.episodes import Episode, draw_episodes
from gpvo.sim.imu import Motion
from gpvo.sim.paths import Path3
from gpvo.sim.routes import place, refuse_outside
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import STANDARD_GRAVITY_MPS2, Array

_CHECK_HZ = 50
_BARE, _RAMP_S = 0.92, 0.5  # share of the fine texture that a bare wall lacks; time it takes to come into view


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
    if (clearance < vehicles.RADIUS_M[scenario.vehicle]).any():
        k = int((clearance < vehicles.RADIUS_M[scenario.vehicle]).argmax())
        raise GpvoError(
            f"the {scenario.vehicle} crashes at t = {some.t_s[k]:.1f} s, place {place(some.position_m[k])}:"
            f" {clearance[k]:.2f} m from the wall",
            cure="another seed, a lower speed, or less sway_m",
        )


def plan_episodes(scenario: Scenario, rng: np.random.Generator) -> tuple[Episode, ...]:
    """When seeing goes wrong, and why. A bare wall is imitated: the fine texture of all that is in view goes."""
    found: list[Episode] = []
    if scenario.episodes_share > 0:
        begin = scenario.rest_s + 1.0
        found += draw_episodes(scenario.duration_s, rng, scenario.episodes_share, begin, scenario.causes)
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
                light={"darkness": 0.013, "blackout": 0.0}.get(cause, 1.0),
                dust=0.78 if cause == "dust" else 0.0,
                exposure_s=1.0 / scenario.rate_hz if cause == "motion_blur" else scenario.exposure_s,
                bare=_BARE * _ramp(t, episodes[inside]) if inside is not None and cause == "bare_wall" else 0.0,
            )
        )
    return out


def _ramp(t_s: float, episode: Episode) -> float:
    """0 to 1 and back: a wall comes into view and leaves it, it does not change at once."""
    return min(1.0, max(0.0, min(t_s - episode.begin_s, episode.end_s - t_s) / _RAMP_S))


def camera_poses(motion: Motion, step: int, exposure_s: float, T_body_left: Array) -> tuple[Array, Array | None]:
    """Pose (4, 4) of the left camera at a step, and (k, 4, 4) poses over the exposure where there is one."""
    reach = round(exposure_s * vehicles.RATE_HZ / 2)
    steps = [step]
    if reach:
        steps += np.rint(np.linspace(step - reach, step + reach, 5)).astype(int).tolist()
    index = np.clip(steps, 0, len(motion.t_s) - 1)
    poses = se3.from_rt(motion.R_world_body[index], motion.position_m[index]) @ T_body_left
    return poses[0], poses[1:] if reach else None
