"""Rough tubes along a line, and what miners put into a tunnel: lamps, an air duct, cables, rock bolts; and rubble."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from gpvo.sim.worlds.shapes import Faces, Parts, add_stone, grid_faces, icosphere
from gpvo.sim.worlds.textures import F32, fractal
from gpvo.types import Array

_FLOOR = 0.62  # height of the floor under the line, in radii
_CAP = 1.2  # length of the rounded ends, in radii
_GLOW = 12.0  # irradiance that makes a lamp's glass white
_BOX = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FAN = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)  # of a rectangle whose corners are in order
_BOX_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


@dataclass(frozen=True)
class Line:
    """A smooth line (n, 3) with its frame: ``s`` (n,) arc length, ``tangent``, ``left``, ``up`` (n, 3)."""

    points: Array
    s: Array
    tangent: Array
    left: Array
    up: Array

    @classmethod
    def through(cls, s: Array, yaw: Array, pitch: Array, start: Array) -> Line:
        """Integrate heading and climb [rad] over the arc length [m]."""
        tangent = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
        step = 0.5 * (tangent[1:] + tangent[:-1]) * np.diff(s)[:, None]
        points = np.concatenate([[start], start + np.cumsum(step, axis=0)])
        left = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=1)
        return cls(points, s, tangent, left, np.cross(tangent, left))


@dataclass(frozen=True)
class Tube:
    """``vertices`` (n, m + 1, 3), first and last column equal; ``radius`` (n, m + 1) distance from the line;
    ``profile`` (n, m + 1, 3) the vertices before the rock was roughened; ``floor`` (n, m + 1) where one can walk.
    """

    line: Line
    vertices: Array
    radius: Array
    profile: Array
    floor: NDArray[np.bool_]

    @property
    def faces(self) -> Faces:
        """Seen from inside."""
        rows, columns = self.vertices.shape[:2]
        return grid_faces(rows, columns)[:, [0, 2, 1]]

    def uv(self, tile_m: float) -> Array:
        """Texture coordinates (n, m + 1, 2) by arc length round and along, whole tiles round so that no seam shows.

        They follow the smooth profile: lengths along rough rock differ from row to row and would shear the texture.
        """
        round_ = np.linalg.norm(np.diff(self.profile, axis=1), axis=2)
        u = np.concatenate([np.zeros((len(round_), 1)), np.cumsum(round_, axis=1)], axis=1)
        tiles = max(round(float(np.median(u[:, -1])) / tile_m), 1)
        along = np.linalg.norm(np.diff(self.profile, axis=0), axis=2).mean(axis=1)
        v = np.concatenate([[0.0], np.cumsum(along)]) / tile_m
        return np.stack([u / u[:, -1:] * tiles, np.broadcast_to(v[:, None], u.shape)], axis=2)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) lie inside the tube."""
        near = cKDTree(self.line.points).query(points)[1]
        d = points - self.line.points[near]
        y, z = (d * self.line.left[near]).sum(axis=1), (d * self.line.up[near]).sum(axis=1)
        along = np.abs((d * self.line.tangent[near]).sum(axis=1))
        wall_y = ((self.vertices - self.line.points[:, None]) * self.line.left[:, None]).sum(axis=2)
        wall_z = ((self.vertices - self.line.points[:, None]) * self.line.up[:, None]).sum(axis=2)
        angle, wall = np.arctan2(z, y), np.arctan2(wall_z, wall_y)[near]
        nearest = np.abs(np.angle(np.exp(1j * (wall - angle[:, None])))).argmin(axis=1)
        return (np.hypot(y, z) < self.radius[near, nearest]) & (along < 1.0)


def facets(points: Array, width_m: float, slope: float, step: float, rng: np.random.Generator) -> Array:
    """Heights (N,) [m] of a surface broken into tilted facets about ``width_m`` wide, with steps between them."""
    count = max(int(1.3 * len(points) * 0.02 / width_m**2), 8)
    centres = points[rng.integers(0, len(points), count)] + rng.normal(0, 0.3 * width_m, (count, 3))
    owner = cKDTree(centres).query(points)[1]
    tilt = slope * rng.standard_normal((count, 3))
    return ((points - centres[owner]) * tilt[owner]).sum(axis=1) + step * rng.standard_normal(count)[owner]


def rough_tube(
    line: Line, radius: Array, roughness: Array, columns: int, values: F32, rng: np.random.Generator
) -> Tube:
    """A tube of ``radius`` (n,) [m] about a line with a flattened floor, closed ends and rock of ``roughness`` (n,)."""
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    r = radius[:, None] * (1 + 0.08 * np.cos(2 * angle))
    y, z = r * np.cos(angle), r * np.sin(angle)
    floor = -_FLOOR * radius[:, None]
    flat = z < floor
    z = np.where(flat, floor + (z - floor) * 0.12, z)
    cap = _CAP * float(radius.mean())
    from_end = np.minimum(line.s - line.s[0], line.s[-1] - line.s)
    close = np.sqrt(np.maximum(1 - (1 - np.minimum(from_end / cap, 1)) ** 2, 1e-4))[:, None]
    y, z = y * close, z * close
    outward = y[..., None] * line.left[:, None] + z[..., None] * line.up[:, None]
    profile = line.points[:, None] + outward
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    points = profile.reshape(-1, 3)
    coarse = fractal(points * 0.55, values, 5, 0.55)
    ridges = 1 - np.abs(fractal(points * 0.9 + 31.0, values, 4, 0.5))
    broken = facets(points, 1.1, 0.30, 0.10, rng) + facets(points, 0.45, 0.30, 0.05, rng)
    shape = (0.42 * coarse + 0.30 * (ridges - 0.5) + 1.6 * np.clip(broken, -0.45, 0.45)).reshape(r.shape)
    bump = roughness[:, None] * close * shape * np.where(flat, 0.22, 1.0)
    vertices = profile - bump[..., None] * outward
    vertices[:, -1] = vertices[:, 0]
    return Tube(line, vertices, np.linalg.norm(vertices - line.points[:, None], axis=2), profile, flat)


def _box(
    parts: Parts, centre: Array, axes: Array, size: Array, material: int, tile_m: float, glow: float = 0.0
) -> None:
    """A box with edges along the rows of ``axes``; each side with its own corners."""
    for side in _BOX_SIDES:
        local = _BOX[list(side)] * size
        a, b = local[1] - local[0], local[3] - local[0]
        uv = np.stack([(local - local[0]) @ e / max(np.linalg.norm(e), 1e-9) for e in (a, b)], axis=1) / tile_m
        parts.add(centre + local @ axes, uv + centre[:2] / tile_m, _FAN, material, glow)


def lamp_fixtures(parts: Parts, positions: Array, tube: Tube, material: int) -> None:
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
