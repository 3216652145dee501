"""Stereo pairs per second of the renderer and the sensor together, on two threads. CPU time over two cores."""

from __future__ import annotations

import subprocess
import sys
import time
from typing import Any

import numpy as np
from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.sim.eye import SensorModel
from gpvo.sim.render import StereoRenderer
from gpvo.sim.worlds import build_world

_CORES = 2
_WANTED = {"render_pinhole_vga": 20.0, "render_fisheye_848x800": None}


def _pairs_per_second(camera: CameraModel, baseline_m: float, count: int = 16) -> float:
    world = build_world("tunnel", 0)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -baseline_m
    renderer, sensor = StereoRenderer(world, camera, camera, T_right_left), SensorModel()
    costs = []
    for k in range(count + 2):
        pose = world.start_pose.copy()
        pose[:3, :3] = pose[:3, :3] @ R_FLU_OPTICAL
        pose[:3, 3] = world.centreline[40 + 20 * k]
        begin = time.process_time()
        left, right, _ = renderer.render(pose)
        sensor.expose(left, right, k)
        costs.append(time.process_time() - begin)
    return _CORES / float(np.median(costs[2:]))


def _gl_peer() -> tuple[str, float | None]:
    """MuJoCo's OpenGL renderer, where there is one: its name and pairs per second."""
    for way in ("egl", "osmesa"):
        words = [sys.executable, "-m", "bench.gl_peer", way]
        done = subprocess.run(words, capture_output=True, text=True, timeout=600)
        if done.returncode == 0:
            return f"MuJoCo by {way}, untextured", float(done.stdout.split()[-1])
    return "no OpenGL on this machine", None


def run() -> dict[str, dict]:
    """Measure on this machine."""
    cameras: dict[str, tuple[CameraModel, float]] = {
        "render_pinhole_vga": (PinholeRadtan(380, 380, 319.5, 239.5, 640, 480), 0.12),
        "render_fisheye_848x800": (
            KannalaBrandt(286.2, 286.3, 423.8, 400.1, 848, 800, (-0.005, 0.04, -0.038, 0.006)),
            0.064,
        ),
    }
    out: dict[str, dict[str, Any]] = {}
    for name, (camera, baseline) in cameras.items():
        value, limit = _pairs_per_second(camera, baseline), _WANTED[name]
        out[name] = {
            "value": value,
            "unit": "pairs/s on 2 cores",
            "peer": None if limit is None else "wanted",
            "peer_value": limit,
            "ratio": None if limit is None else value / limit,
        }
    (peer, theirs), ours = _gl_peer(), out["render_pinhole_vga"]["value"]
    out["render_pinhole_vga, beside OpenGL"] = {
        "value": ours,
        "unit": "pairs/s on 2 cores",
        "peer": peer,
        "peer_value": theirs,
        "ratio": None if theirs is None else ours / theirs,
    }
    return out
