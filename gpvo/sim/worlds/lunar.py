"""The moon: regolith, craters, boulders, a low sun with hard shadows, and a lane along +x that is free of rocks."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from gpvo.sim.worlds import HeightGrid, Lighting, LightMap, Mesh, World
from gpvo.sim.worlds.shapes import Baker, Parts, add_stone, grid_faces, icosphere
from gpvo.sim.worlds.textures import fractal, lattice, regolith, rock, spectral
from gpvo.types import Array, within

_TILE_M = 2.5
_TEXTURE_PX = 2048
_CELL_M = 0.2
_LANE_M = 6.0  # half the width of the finely meshed lane
_EDGE_M = 180.0  # how far the ground goes on beside it
_BEHIND_M = 10.0
_SUN = 2.2
_AMBIENT = 0.02
_SHADOW_TEXEL_M = 0.04
_SHADOW_WIDTH_M = 9.0  # half the width of the strip with sharp shadows
_GROUND, _ROCK = range(2)


@dataclass(frozen=True)
class Params:
    """What the ground is like, and where the sun stands."""

    length: float = within(260.0, 20, 1000)  # of the lane [m]
    boulders: int = within(1200, 0, 20000)
    craters: int = within(1600, 0, 20000)
    sun_elevation_deg: float = within(18.0, 3, 90)
    sun_azimuth_deg: float = within(70.0, -360, 360)  # from +x


def build(seed: int, params: Params) -> World:
    """Ground with a free lane from the origin along +x."""
    length = params.length
    rng = np.random.default_rng([seed, 2])
    x = _spaced(-_BEHIND_M, length + _BEHIND_M, 20.0, _EDGE_M)
    y = _spaced(-_LANE_M, _LANE_M, _EDGE_M, _EDGE_M)
    z = _heights(x, y, length, params.craters, rng)
    elevation, azimuth = np.deg2rad([params.sun_elevation_deg, params.sun_azimuth_deg])
    sun = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    with ThreadPoolExecutor(2) as pool:
        soil = pool.submit(regolith, _TEXTURE_PX, np.random.default_rng([seed, 2, 1]), sun, _TILE_M)
        stone = pool.submit(rock, _TEXTURE_PX, np.random.default_rng([seed, 2, 2]))
        mesh, light_map = _mesh(x, y, z, length, params.boulders, sun, rng)
    fine_x = (x >= -_BEHIND_M - 1e-6) & (x <= length + _BEHIND_M + 1e-6)
    fine_y = np.abs(y) <= _LANE_M + 1e-6
    grid = HeightGrid(z[np.ix_(fine_y, fine_x)].astype(np.float32), float(x[fine_x][0]), float(y[fine_y][0]), _CELL_M)
    line_x = np.arange(0.0, length + 1e-9, 0.5)
    line = np.stack([line_x, np.zeros_like(line_x), grid(line_x, np.zeros_like(line_x)) + 0.8], axis=1)
    pose = np.eye(4)
    pose[:3, 3] = line[4]
    deepest, highest = float(grid.z.min()), float(grid.z.max())
    return World(
        mesh=mesh,
        textures=(soil.result(), stone.result()),
        lighting=Lighting(ambient=_AMBIENT, head_lamp=0.0),
        centreline=line,
        start_pose=pose,
        bounds=np.array(
            [[-_BEHIND_M + 1, -_LANE_M + 0.5, deepest], [length + _BEHIND_M - 1, _LANE_M - 0.5, highest + 6]]
        ),
        ground=grid,
        light_map=light_map,
    )


def _spaced(low: float, high: float, before: float, after: float) -> Array:
    """Coordinates in even steps from ``low`` to ``high``, in growing steps on both sides."""
    even = low + _CELL_M * np.arange(round((high - low) / _CELL_M) + 1)
    steps = np.cumsum(_CELL_M * 1.18 ** np.arange(1, 60))
    return np.concatenate([low - steps[steps <= before][::-1], even, even[-1] + steps[steps <= after]])


def _sample(tile: np.ndarray, tile_m: float, x: Array, y: Array) -> Array:
    """A tileable height map, repeated every ``tile_m``, at the grid of y (rows) and x (columns)."""
    n = len(tile)
    rows, columns = np.meshgrid((y / tile_m * n) % n, (x / tile_m * n) % n, indexing="ij")
    return map_coordinates(tile, [rows, columns], order=1, mode="grid-wrap")


def _heights(x: Array, y: Array, length: float, craters: int, rng: np.random.Generator) -> Array:
    wide = spectral(1024, rng, 2.4, 2, 200)
    near = spectral(1024, rng, 1.7, 6, 400)
    z = 0.8 * _sample(wide, 409.6, x, y) + 0.025 * _sample(near, 61.44, x, y)
    away = np.clip((np.abs(y) - 25) / 100, 0, 1)[:, None]
    z = z + 5.0 * away**2 * (1 + 0.8 * _sample(wide, 260.0, x + 77, y + 31))  # hills on the horizon
    for _ in range(craters):
        diameter = min(0.45 * rng.pareto(1.8) + 0.45, 16.0)
        cx, cy = rng.uniform(-20, length + 60), rng.normal(0, 22)
        # Craters in the lane stay shallow enough to drive through.
        in_lane = abs(cy) < 2.5 + diameter / 2
        if in_lane and diameter > 1.6:
            continue
        _crater(z, x, y, cx, cy, diameter / 2, rng.uniform(0.25, 0.5 if in_lane else 1.0))
    return np.asarray(z)


def _crater(z: Array, x: Array, y: Array, cx: float, cy: float, radius: float, freshness: float) -> None:
    """Bowl and rim of a crater, 0.2 diameters deep when fresh (R. Pike, 1977), fading out at 2.2 radii."""
    reach = 2.2 * radius
    i0, i1 = np.searchsorted(y, [cy - reach, cy + reach])
    j0, j1 = np.searchsorted(x, [cx - reach, cx + reach])
    if i1 <= i0 or j1 <= j0:
        return
    q = np.hypot(y[i0:i1, None] - cy, x[None, j0:j1] - cx) / radius
    depth, rim = 0.4 * radius * freshness, 0.08 * radius * freshness
    profile = np.where(q < 1, (depth + rim) * q**2.2 - depth, rim * np.maximum(q, 1e-3) ** -3.2)
    z[i0:i1, j0:j1] += profile * np.clip((2.2 - q) / 0.8, 0, 1)


def _boulders(parts: Parts, x: Array, y: Array, z: Array, length: float, count: int, rng: np.random.Generator) -> None:
    """Rough stones half sunk in the ground, none on the lane."""
    values = lattice(rng)
    for _ in range(count):
        radius = min(0.05 * (rng.pareto(2.0) + 1), 0.9)
        cx, cy = rng.uniform(-5, length + 40), rng.normal(0, rng.choice([5, 16]))
        if abs(cy) < 1.4 + radius:
            continue
        ball, faces = icosphere(1 if radius < 0.09 else 2 if radius < 0.3 else 3)
        bumps = 1 + 0.3 * fractal(ball * 1.3 + rng.uniform(0, 50, 3), values, 4)
        ground = z[np.abs(y - cy).argmin(), np.abs(x - cx).argmin()]
        stone = ball * np.clip(bumps, 0.4, 1.8)[:, None] * rng.uniform(0.65, 1.1, 3) * radius
        add_stone(parts, stone, faces, np.array([cx, cy, ground + 0.25 * radius]), _ROCK, _TILE_M)


def _mesh(
    x: Array, y: Array, z: Array, length: float, boulders: int, sun: Array, rng: np.random.Generator
) -> tuple[Mesh, LightMap]:
    X, Y = np.meshgrid(x, y)
    ground = np.stack([X.ravel(), Y.ravel(), z.ravel()], axis=1)
    parts = Parts()
    parts.add(ground, ground[:, :2] / _TILE_M, grid_faces(len(y), len(x)), _GROUND)
    _boulders(parts, x, y, z, length, boulders, rng)
    baker = Baker(parts)
    V = baker.vertices
    light = _SUN * baker.sun(sun, 4, 0.006, rng)
    shadows, strip = _shadows(baker, x, y, z, length, sun)
    # Where the fine map holds the shadows, vertices only say how steeply the light falls.
    inside = (np.arange(len(V)) < len(ground)) & (np.abs(V[:, 1]) < _SHADOW_WIDTH_M) & strip(V[:, 0])
    light = np.where(inside, _SUN * np.maximum(baker.normals @ sun, 0), light)
    albedo = np.clip(1 + 0.18 * fractal(V * 0.5, lattice(rng), 4), 0.5, 1.5)
    return baker.mesh(light, albedo), shadows


def _shadows(
    baker: Baker, x: Array, y: Array, z: Array, length: float, sun: Array
) -> tuple[LightMap, Callable[[Array], NDArray[np.bool_]]]:
    """Sharp shadows on the ground of the lane, and whether an x coordinate lies in their strip."""
    low, high = -_BEHIND_M, length + _BEHIND_M
    columns, rows = (round(d / _SHADOW_TEXEL_M) for d in (high - low, 2 * _SHADOW_WIDTH_M))
    px = low + (np.arange(columns) + 0.5) * _SHADOW_TEXEL_M
    py = -_SHADOW_WIDTH_M + (np.arange(rows) + 0.5) * _SHADOW_TEXEL_M
    row, column = np.interp(py, y, np.arange(len(y))), np.interp(px, x, np.arange(len(x)))
    image = np.zeros((rows, columns), np.float32)
    for k in range(rows):
        height = map_coordinates(z, [np.full(columns, row[k]), column], order=1, mode="nearest")
        origins = np.stack([px, np.full(columns, py[k]), height + 0.015], axis=1)
        image[k] = baker.reaches(origins, sun)
    # The light that comes from everywhere else stays.
    floor = _AMBIENT / (_AMBIENT + _SUN * max(float(sun[2]), 0.1))
    image = np.clip(floor + (1 - floor) * cv2.GaussianBlur(image, (0, 0), 0.6), 0, 1)
    texel = _SHADOW_TEXEL_M / _TILE_M
    origin = np.array([low, -_SHADOW_WIDTH_M]) / _TILE_M
    light_map = LightMap((image * 255 + 0.5).astype(np.uint8), origin, texel, _GROUND)
    return light_map, lambda at: (at > low) & (at < high)
