"""What men put into a tunnel: lamps, an air duct, cables, rock bolts; and the rubble they leave."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from gpvo.sim.worlds.noise import F32, fractal
from gpvo.sim.worlds.shapes import Parts, add_stone, grid_faces, icosphere
from gpvo.sim.worlds.tubes import Tube
from gpvo.types import Array

_GLOW = 12.0  # irradiance that makes a lamp's glass white
_BOX = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FAN = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)  # of a rectangle whose corners are in order
_BOX_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def _box(
    parts: Parts, centre: Array, axes: Array, size: Array, material: int, tile_m: float, glow: float = 0.0
) -> None:
    """A box with edges along the rows of ``axes``; each side with its own corners."""
    for side in _BOX_SIDES:
        local = _BOX[list(side)] * size
        a, b = local[1] - local[0], local[3] - local[0]
        uv = np.stack([(local - local[0]) @ e / max(np.linalg.norm(e), 1e-9) for e in (a, b)], axis=1) / tile_m
        parts.add(centre + local @ axes, uv + centre[:2] / tile_m, _FAN, material, glow)


def lamps(parts: Parts, positions: Array, tube: Tube, material: int) -> None:
    """A shining fixture just above each lamp, along the tunnel."""
    for position in positions:
        k = int(np.argmin(((tube.line.points - position) ** 2).sum(axis=1)))
        axes = np.stack([tube.line.tangent[k], tube.line.left[k], tube.line.up[k]])
        _box(parts, position + 0.07 * axes[2], axes, np.array([0.5, 0.13, 0.08]), material, 0.5, _GLOW)
        _box(parts, position + 0.13 * axes[2], axes, np.array([0.6, 0.2, 0.04]), material, 0.5)


def pipe(
    parts: Parts, tube: Tube, rows: NDArray[np.int64], angle: float, inset_m: float, radius_m: float, sides: int,
    sag_m: float, material: int, tile_m: float,
) -> None:  # fmt: skip
    """A pipe or cable along the wall at an angle about the line (0 left, pi/2 up), hung every three metres."""
    if len(rows) < 3:
        return
    line = tube.line
    column = round(angle / (2 * np.pi) * (tube.radius.shape[1] - 1))
    reach = gaussian_filter1d(tube.radius[:, column], 4.0)[rows] - inset_m
    hang = sag_m * (2 * np.abs((line.s[rows] / 3.0) % 1.0 - 0.5)) ** 2
    out = np.cos(angle) * line.left[rows] + np.sin(angle) * line.up[rows]
    centre = line.points[rows] + reach[:, None] * out + (hang - sag_m)[:, None] * line.up[rows]
    turn = np.linspace(0, 2 * np.pi, sides + 1)
    ring = np.cos(turn)[None, :, None] * line.left[rows][:, None] + np.sin(turn)[None, :, None] * line.up[rows][:, None]
    swell = radius_m * (1 + 0.04 * np.cos(2 * np.pi * line.s[rows] / 0.9))
    vertices = centre[:, None] + swell[:, None, None] * ring
    u = np.broadcast_to(turn / (2 * np.pi) * max(round(2 * np.pi * radius_m / tile_m), 1), vertices.shape[:2])
    v = np.broadcast_to((line.s[rows] / tile_m)[:, None], vertices.shape[:2])
    uv = np.stack([u, v], axis=2).reshape(-1, 2)
    parts.add(vertices.reshape(-1, 3), uv, grid_faces(len(rows), sides + 1), material)


def bolts(parts: Parts, tube: Tube, rows: NDArray[np.int64], material: int, rng: np.random.Generator) -> None:
    """Plates of rock bolts on roof and shoulders."""
    columns = tube.radius.shape[1] - 1
    for row in rows:
        for angle in np.deg2rad([25, 60, 95, 130, 160]) + rng.normal(0, 0.06, 5):
            column = round(angle / (2 * np.pi) * columns)
            i, j = min(max(row, 1), len(tube.radius) - 2), min(max(column, 1), columns - 1)
            point = tube.vertices[i, j]
            along, round_ = tube.vertices[i + 1, j] - point, tube.vertices[i, j + 1] - point
            axes = np.stack([along, round_, np.cross(round_, along)])
            axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
            axes[1] = np.cross(axes[2], axes[0])
            _box(parts, point + 0.02 * axes[2], axes, np.array([0.17, 0.17, 0.025]), material, 0.5)
            _box(parts, point + 0.06 * axes[2], axes, np.array([0.035, 0.035, 0.09]), material, 0.5)


def rubble(
    parts: Parts, tube: Tube, rows: NDArray[np.int64], spread: float, largest_m: float, count: int, values: F32,
    material: int, tile_m: float, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Broken stones on the floor, more of them towards the walls. ``spread`` (0..1): how far into the middle."""
    line = tube.line
    angles = np.linspace(0, 2 * np.pi, tube.radius.shape[1])
    for _ in range(count if len(rows) else 0):
        row = rng.choice(rows)
        side = rng.choice([-1, 1]) * (1 - spread * rng.random() ** 1.5)
        # The floor begins where the wall meets it, about 35 degrees below the line.
        angle = 1.5 * np.pi + side * np.deg2rad(52)
        column = int(np.abs(angles - angle).argmin())
        radius = min(0.04 * (rng.pareto(1.6) + 1), largest_m)
        ball, faces = icosphere(1 if radius < 0.12 else 2)
        lumps = np.clip(1 + 0.45 * fractal(ball * 1.1 + rng.uniform(0, 50, 3), values, 3), 0.45, 1.7)
        stone = ball * lumps[:, None] * rng.uniform(0.55, 1.1, 3) * radius
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        stone = stone @ turn
        place = tube.vertices[row, column] + 0.35 * radius * line.up[row]
        add_stone(parts, stone, faces, place, material, tile_m)
