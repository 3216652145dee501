"""A bumpy box seen from inside: a world small enough for tests."""

from __future__ import annotations

import numpy as np
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan
from gpvo.sim.worlds import Lighting, Mesh, World
from gpvo.sim.worlds.shapes import grid_faces, icosphere, vertex_normals

PINHOLE = PinholeRadtan(120.0, 120.0, 79.5, 59.5, 160, 120)
RADTAN = PinholeRadtan(118.0, 121.0, 80.2, 58.8, 160, 120, (-0.28, 0.07, 1e-4, -2e-4, 0.0))
FISHEYE = KannalaBrandt(57.0, 57.2, 84.0, 80.0, 170, 160, (-0.005, 0.04, -0.038, 0.006))


def small_world(size: int = 256) -> World:
    """A rough ball of 3 m about the origin and a plate in front of it, with a texture of soft noise."""
    rng = np.random.default_rng(1)
    ball, faces = icosphere(4)
    V = ball * (3.0 + 0.25 * np.sin(4 * ball[:, :1]) * np.cos(5 * ball[:, 1:2] + 2 * ball[:, 2:]))
    s, t = (a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 6), np.linspace(-0.4, 0.4, 6)))
    plate = np.stack([np.full_like(s, 1.6), -s, t], axis=1)
    plate_uv = np.stack([s, t], axis=1) * 0.8
    V, F = np.concatenate([V, plate]), np.concatenate([faces[:, ::-1], grid_faces(6, 6) + len(V)])
    N = vertex_normals(V, F)
    angle = np.stack([np.arctan2(ball[:, 1], ball[:, 0]) / 2, ball[:, 2]], axis=1) * 1.5
    wave = np.fft.rfft2(rng.standard_normal((size, size)))
    f = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]) * size
    noise = np.fft.irfft2(wave * np.exp(-((f / 40) ** 2)) * (f > 2))
    texture = np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)
    uv = np.concatenate([angle, plate_uv])
    mesh = Mesh.of(V, N, uv, np.full(len(V), 0.5), np.ones(len(V)), F, np.zeros(len(F), int))
    line = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    bounds = np.array([[-1.0, -1, -1], [1, 1, 1]])
    return World(mesh, (texture,), Lighting(0.05, 0.5), line, np.eye(4), bounds)


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """``T_world_cam`` of a camera that looks along +x, turned by ``yaw`` [rad]."""
    T = np.eye(4)
    c, s = np.cos(yaw), np.sin(yaw)
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = x, y, 0.1
    return T


def right_of(baseline_m: float) -> np.ndarray:
    """``T_right_left`` of a rectified pair."""
    T = np.eye(4)
    T[0, 3] = -baseline_m
    return T
