"""The moon: regolith, craters, boulders, a low sun with hard shadows, and a lane along +x that is free of rocks."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from gpvo.errors import GpvoError
from gpvo.sim.worlds.baking import Baker
from gpvo.sim.worlds.noise import fractal, lattice, spectral
from gpvo.sim.worlds.shapes import Faces, grid_faces, icosphere, vertex_normals
from gpvo.sim.worlds.textures import regolith
from gpvo.sim.worlds.world import HeightGrid, Lighting, Mesh, World
from gpvo.types import Array

_TILE_M = 2.5
_TEXTURE_PX = 2048
_CELL_M = 0.2
_LANE_M = 6.0  # half the width of the finely meshed lane
_EDGE_M = 180.0  # how far the ground goes on beside it
_BEHIND_M = 10.0
_SUN = 2.2


def build(
    seed: int,
    *,
    length: float = 260.0,
    boulders: int = 900,
    craters: int = 1600,
    sun_elevation_deg: float = 18.0,
    sun_azimuth_deg: float = 70.0,
) -> World:
    """Ground with a free lane of ``length`` [m] from the origin along +x; the sun stands in direction azimuth from +x.

    Raises
    ------
    GpvoError
        For values out of range.
    """
    for name, value, low, high in (
        ("length", length, 20, 1000), ("boulders", boulders, 0, 20000), ("craters", craters, 0, 20000),
        ("sun_elevation_deg", sun_elevation_deg, 3, 90), ("sun_azimuth_deg", sun_azimuth_deg, -360, 360),
    ):  # fmt: skip
        if not low <= value <= high:
            raise GpvoError(f"{name} = {value} is not between {low} and {high}")
    rng = np.random.default_rng([seed, 2])
    x = _spaced(-_BEHIND_M, length + _BEHIND_M, 20.0, _EDGE_M)
    y = _spaced(-_LANE_M, _LANE_M, _EDGE_M, _EDGE_M)
    z = _heights(x, y, length, craters, rng)
    mesh = _mesh(x, y, z, length, boulders, np.deg2rad([sun_elevation_deg, sun_azimuth_deg]), rng)
    fine_x = (x >= -_BEHIND_M - 1e-6) & (x <= length + _BEHIND_M + 1e-6)
    fine_y = np.abs(y) <= _LANE_M + 1e-6
    grid = HeightGrid(
        z[np.ix_(fine_y, fine_x)].astype(np.float32), float(x[fine_x][0]), float(y[fine_y][0]), _CELL_M
    )
    line_x = np.arange(0.0, length + 1e-9, 0.5)
    line = np.stack([line_x, np.zeros_like(line_x), grid(line_x, np.zeros_like(line_x)) + 0.8], axis=1)
    pose = np.eye(4)
    pose[:3, 3] = line[4]
    low, high = float(grid.z.min()), float(grid.z.max())
    return World(
        kind="lunar",
        seed=seed,
        params={"length": length, "sun_elevation_deg": sun_elevation_deg, "sun_azimuth_deg": sun_azimuth_deg},
        mesh=mesh,
        textures=(regolith(_TEXTURE_PX, rng),),
        lighting=Lighting(ambient=0.02, head_lamp=0.0),
        centreline=line,
        start_pose=pose,
        bounds=np.array([[-_BEHIND_M + 1, -_LANE_M + 0.5, low], [length + _BEHIND_M - 1, _LANE_M - 0.5, high + 6]]),
        heights=(grid,),
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


def _boulders(
    x: Array, y: Array, z: Array, length: float, count: int, rng: np.random.Generator
) -> list[tuple[Array, Faces]]:
    """Rough stones half sunk in the ground, none on the lane."""
    values = lattice(rng)
    out = []
    for _ in range(count):
        radius = min(0.05 * (rng.pareto(2.0) + 1), 0.9)
        cx, cy = rng.uniform(-5, length + 40), rng.normal(0, 14)
        if abs(cy) < 1.4 + radius:
            continue
        ball, faces = icosphere(1 if radius < 0.09 else 2 if radius < 0.3 else 3)
        bumps = 1 + 0.3 * fractal(ball * 1.3 + rng.uniform(0, 50, 3), values, 4)
        ground = z[np.abs(y - cy).argmin(), np.abs(x - cx).argmin()]
        stone = ball * np.clip(bumps, 0.4, 1.8)[:, None] * rng.uniform(0.65, 1.1, 3) * radius
        out.append((stone + [cx, cy, ground + 0.25 * radius], faces))
    return out


def _mesh(
    x: Array, y: Array, z: Array, length: float, boulders: int, sun: Array, rng: np.random.Generator
) -> Mesh:
    X, Y = np.meshgrid(x, y)
    ground = np.stack([X.ravel(), Y.ravel(), z.ravel()], axis=1)
    vertices, faces, uv = [ground], [grid_faces(len(y), len(x))], [ground[:, :2] / _TILE_M]
    count = len(ground)
    for stone, stone_faces in _boulders(x, y, z, length, boulders, rng):
        vertices.append(stone)
        faces.append(stone_faces + count)
        uv.append((stone[:, :2] + 0.7 * stone[:, 2:]) / _TILE_M)
        count += len(stone)
    V, F = np.concatenate(vertices), np.concatenate(faces).astype(np.int32)
    N = vertex_normals(V, F)
    elevation, azimuth = sun
    direction = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    light = _SUN * Baker(V, N, F).sun(direction, 4, 0.006, rng)
    albedo = np.clip(1 + 0.18 * fractal(V * 0.5, lattice(rng), 4), 0.5, 1.5)
    f32 = [a.astype(np.float32) for a in (V, N, np.concatenate(uv), light, albedo)]
    return Mesh(*f32, F, np.zeros(len(F), np.uint8))
