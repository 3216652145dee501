"""Rough tubes along a line, and what it takes to join them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gpvo.sim.worlds.noise import F32, fractal
from gpvo.sim.worlds.shapes import Faces, grid_faces
from gpvo.types import Array

_FLOOR = 0.62  # height of the floor under the line, in radii
_CAP = 1.2  # length of the rounded ends, in radii


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
