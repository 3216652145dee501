"""Stereo pairs per second of the renderer and the sensor together, on two threads. CPU time over two cores."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.sim.eye import SensorModel
from gpvo.sim.render import StereoRenderer
from gpvo.sim.worlds import build_world

from bench import Rows, median_s, row

_CORES = 2
_UNIT = "pairs/s on 2 cores"
_WANTED = {"render_pinhole_vga": 20.0, "render_fisheye_848x800": None}


def _pairs_per_second(camera: CameraModel, baseline_m: float) -> float:
    world = build_world("tunnel", 0)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -baseline_m
    renderer, sensor = StereoRenderer(world, camera, camera, T_right_left), SensorModel()

    def draw(k: int) -> None:
        pose = world.start_pose.copy()
        pose[:3, :3] = pose[:3, :3] @ R_FLU_OPTICAL
        pose[:3, 3] = world.centreline[40 + 20 * k]
        left, right, _ = renderer.render(pose)
        sensor.expose(left, right, k)

    return _CORES / median_s(draw, 16, warm_up=2, clock=time.process_time)


def _gl_peer() -> tuple[str, float | None]:
    """MuJoCo's OpenGL renderer, where there is one: its name and pairs per second."""
    for way in ("egl", "osmesa"):
        words = [sys.executable, "-m", "bench.gl_peer", way]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600)
        if done.returncode == 0:
            return f"MuJoCo by {way}, untextured", float(done.stdout.split()[-1])
    return "no OpenGL on this machine", None


def run() -> Rows:
    """Measure on this machine."""
    cameras: dict[str, tuple[CameraModel, float]] = {
        "render_pinhole_vga": (PinholeRadtan(380, 380, 319.5, 239.5, 640, 480), 0.12),
        "render_fisheye_848x800": (
            KannalaBrandt(286.2, 286.3, 423.8, 400.1, 848, 800, (-0.005, 0.04, -0.038, 0.006)),
            0.064,
        ),
    }
    out = {}
    for name, (camera, baseline) in cameras.items():
        limit = _WANTED[name]
        out[name] = row(_pairs_per_second(camera, baseline), _UNIT, None if limit is None else "wanted", limit)
    ours = out["render_pinhole_vga"]["value"]
    out["render_pinhole_vga, beside OpenGL"] = row(ours, _UNIT, *_gl_peer())
    return out
