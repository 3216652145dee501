"""A short rendered clip in memory: for tests and benchmarks that need images, not files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from gpvo.cameras.models import PinholeRadtan
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.sim.eye import SensorModel, SensorParams
from gpvo.sim.paths import wandering
from gpvo.sim.render import StereoRenderer
from gpvo.sim.worlds import build_world
from gpvo.types import Array, StereoCamera, StereoFrame


@dataclass(frozen=True)
class Clip:
    """Rectified frames of one camera, with the true poses ``T_world_cam`` (N, 4, 4)."""

    camera: StereoCamera
    frames: list[StereoFrame]
    T_world_cam: Array


def pinhole(width: int, height: int, baseline_m: float = 0.12) -> StereoCamera:
    """A rectified pair with a horizontal field of view of 80 degrees."""
    f = 0.6 * width
    return StereoCamera(f, f, (width - 1) / 2, (height - 1) / 2, baseline_m, width, height)


def render_clip(
    camera: StereoCamera,
    T_world_cam: Array,
    *,
    world: str = "room",
    seed: int = 0,
    rate_hz: float = 20.0,
    sensor: SensorParams | None = None,
    noise_sigma: float = 0.0,
) -> Clip:
    """Draw a pair at each pose (N, 4, 4).

    Raises
    ------
    MissingExtraError
        Where the extra ``sim`` is not installed.
    """
    lens = PinholeRadtan(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width, camera.height)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -camera.baseline_m
    renderer = StereoRenderer(build_world(world, seed), lens, lens, T_right_left)
    eye = SensorModel(sensor, seed)
    frames = []
    for k, T in enumerate(T_world_cam):
        left, right, _ = renderer.render(T)
        grey = eye.expose(left, right, k, noise_sigma=noise_sigma)
        frames.append(StereoFrame(round((k + 1) * 1e9 / rate_hz), *grey))
    return Clip(camera, frames, np.asarray(T_world_cam))


def wander(count: int, rate_hz: float = 20.0, speed_mps: float = 0.8, seed: int = 0) -> Array:
    """(count, 4, 4) poses ``T_world_cam`` of a flight within the hall, already under way."""
    rng = np.random.default_rng(seed)
    low, high = np.array([-3.0, -3.0, 1.0]), np.array([3.0, 3.0, 3.0])
    motion = wandering(low, high, 4 + count / rate_hz, speed_mps, rng, 0.0).motion(rate_hz)
    T_world_body = se3.from_rt(motion.R_world_body, motion.position_m)[-count:]
    return T_world_body @ se3.from_rt(R_FLU_OPTICAL, np.zeros(3))


def write_pairs(path: Path, count: int) -> Path:
    """A file of ``count`` pairs of EuRoC's size, for ``bench.live_peers pictures``."""
    camera = pinhole(752, 480, 0.11)
    pairs = np.array([[f.left, f.right] for f in render_clip(camera, wander(count)).frames], dtype=np.uint8)
    np.savez(path, pairs=pairs, f=camera.fx_px, cx=camera.cx_px, cy=camera.cy_px, baseline_m=camera.baseline_m)
    return path
