"""Pieces of meshes, how they are put together, and the light on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import require
from gpvo.sim.worlds import F32, Mesh
from gpvo.types import Array

Faces = NDArray[np.int32]
_LIFT_M = 0.02


class Parts:
    """Pieces of one mesh: vertices (V, 3), texture coordinates (V, 2), faces, material, and their own glow (V,)."""

    def __init__(self) -> None:
        self.pieces: list[tuple[Array, Array, Faces, NDArray[np.uint8], Array]] = []
        self._count = 0

    def add(
        self, vertices: Array, uv: Array, faces: Faces, material: int | NDArray[np.uint8], glow: float = 0.0
    ) -> None:
        """One piece; faces count from its own first vertex."""
        materials = np.broadcast_to(np.asarray(material, np.uint8), len(faces))
        faces = (faces + self._count).astype(np.int32)
        self.pieces.append((vertices, uv, faces, materials, np.full(len(vertices), glow)))
        self._count += len(vertices)


def grid_faces(rows: int, columns: int) -> Faces:
    """Two triangles per cell of a grid of vertices in row-major order, split from (0, 1) to (1, 0).

    They run counter-clockwise seen from the side where ``d/dcolumn x d/drow`` points.
    """
    i, j = np.arange(rows - 1)[:, None] * columns, np.arange(columns - 1)[None]
    a = (i + j).ravel()
    b, c, d = a + 1, a + columns, a + columns + 1
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]).astype(np.int32)


def vertex_normals(vertices: Array, faces: Faces) -> Array:
    """Unit normals (V, 3), weighted by the area of the faces around."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    out = np.zeros((len(vertices), 3))
    for corner in range(3):
        for axis in range(3):
            out[:, axis] += np.bincount(faces[:, corner], normal[:, axis], minlength=len(vertices))
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-20)


@cache
def icosphere(divisions: int) -> tuple[Array, Faces]:
    """Unit sphere of 20 * 4^divisions triangles, seen from outside."""
    g = (1 + 5**0.5) / 2
    base = [(-1, g), (1, g), (-1, -g), (1, -g)]
    V = np.array([(x, y, 0) for x, y in base] + [(0, x, y) for x, y in base] + [(y, 0, x) for x, y in base], float)
    F = np.array([(a, b, c) for a in range(12) for b in range(12) for c in range(12) if _is_face(V, a, b, c)])
    V /= np.linalg.norm(V, axis=1, keepdims=True)
    for _ in range(divisions):
        edges = np.sort(np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]]), axis=1)
        unique, back = np.unique(edges, axis=0, return_inverse=True)
        middle = V[unique].mean(axis=1)
        ab, bc, ca = (back.ravel().reshape(3, -1) + len(V)).tolist()
        a, b, c = F.T.tolist()
        V = np.concatenate([V, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        F = np.concatenate([np.stack(f, axis=1) for f in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return V, F.astype(np.int32)


def _is_face(V: Array, a: int, b: int, c: int) -> bool:
    near = all(abs(np.linalg.norm(V[p] - V[q]) - 2) < 1e-6 for p, q in ((a, b), (b, c), (c, a)))
    return a < b and a < c and near and float(np.linalg.det(V[[a, b, c]])) > 0


def rectangle(
    corner: Array | Sequence[float], u: Array | Sequence[float], v: Array | Sequence[float], edge: float
) -> tuple[Array, Array, Faces]:
    """A rectangle from ``corner`` along ``u`` and ``v`` [m], cut into triangles with legs of at most ``edge``.

    Seen from the side of ``u x v``. Returns vertices (V, 3), coordinates along u and v [m] (V, 2), faces.
    """
    lengths = np.linalg.norm(u), np.linalg.norm(v)
    nu, nv = (max(int(np.ceil(length / edge)), 1) + 1 for length in lengths)
    s, t = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, nu), np.linspace(0, 1, nv)))
    vertices = np.asarray(corner, float) + s[:, None] * np.asarray(u, float) + t[:, None] * np.asarray(v, float)
    return vertices, np.stack([s * lengths[0], t * lengths[1]], axis=1), grid_faces(nv, nu)


def add_stone(parts: Parts, stone: Array, faces: Faces, place: Array, material: int, tile_m: float) -> None:
    """A stone with sharp edges: every face has its own corners, and the texture plane that it faces most."""
    corners = stone[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    axis = np.abs(normal).argmax(axis=1)
    first = np.where(axis == 0, 1, 0)
    second = np.where(axis == 2, 1, 2)
    plane = np.stack([np.take_along_axis(corners, k[:, None, None], axis=2)[..., 0] for k in (first, second)], axis=2)
    uv = plane.reshape(-1, 2) / tile_m + place[:2] / tile_m
    parts.add(corners.reshape(-1, 3) + place, uv, np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3), material)


class Baker:
    """Light that does not move, per vertex of finished parts, by rays of Embree: lamps and sun with shadows, ambient
    occlusion. ``vertices``, ``normals`` (V, 3), ``glow`` (V,); ``smooth`` may improve the normals. Raises
    MissingExtraError where Embree is not installed.
    """

    def __init__(self, parts: Parts, smooth: Callable[[Array], Array] = lambda normals: normals) -> None:
        require("embreex")
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self._scene: Any = rtcore_scene.EmbreeScene()
        self.vertices, self._uv, self._faces, self._material, self.glow = map(np.concatenate, zip(*parts.pieces))
        TriangleMesh(self._scene, np.ascontiguousarray(self.vertices[self._faces], dtype=np.float32))
        self.normals = smooth(vertex_normals(self.vertices, self._faces))
        self._origins = (self.vertices + _LIFT_M * self.normals).astype(np.float32)

    def mesh(self, light: Array, albedo: Array) -> Mesh:
        """The parts in a light (V,) and with an albedo (V,)."""
        return Mesh.of(self.vertices, self.normals, self._uv, light, albedo, self._faces, self._material)

    def _reach(self, index: NDArray[np.int64], directions: Array, limit_m: Array | float) -> Array:
        """Distance [m] from vertices along unit directions (N, 3) to what is hit, at most ``limit_m``."""
        origins = np.ascontiguousarray(self._origins[index])
        rays = np.ascontiguousarray(directions, dtype=np.float32)
        limits = np.full(len(origins), limit_m, dtype=np.float32)
        found = np.asarray(self._scene.run(origins, rays, dists=limits, query="DISTANCE"), dtype=np.float64)
        return np.minimum(found, limit_m)

    def reaches(self, origins: Array | F32, direction: Array) -> NDArray[np.bool_]:
        """Whether light from a unit direction (3,) far away reaches points (N, 3)."""
        rays = np.broadcast_to(direction.astype(np.float32), (len(origins), 3))
        points = np.ascontiguousarray(origins, dtype=np.float32)
        return np.asarray(self._scene.run(points, np.ascontiguousarray(rays), query="DISTANCE")) > 1e6

    def lamps(self, positions: Array, powers: Array, reach_m: float, size_m: float = 0.8) -> Array:
        """Irradiance (V,) of lamps at (L, 3); ``size_m`` softens the peak beside a lamp."""
        out = np.zeros(len(self._origins))
        for position, power in zip(positions, powers, strict=True):
            to_lamp = position - self._origins
            square = (to_lamp**2).sum(axis=1)
            cosine = (to_lamp * self.normals).sum(axis=1) / np.sqrt(np.maximum(square, 1e-12))
            index = np.flatnonzero((square < reach_m**2) & (cosine > 0))
            if len(index) == 0:
                continue
            distance = np.sqrt(square[index])
            free = self._reach(index, to_lamp[index] / distance[:, None], distance) > distance - 0.05
            fade = np.clip(2 * (1 - distance / reach_m), 0, 1)
            out[index] += np.where(free, power * fade * cosine[index] / (size_m**2 + square[index]), 0)
        return out

    def sun(self, direction: Array, samples: int, spread: float, rng: np.random.Generator) -> Array:
        """Irradiance (V,) of a sun in a unit direction, 1 where it stands overhead and nothing is in its way."""
        out = np.zeros(len(self._origins))
        lit = np.flatnonzero(self.normals @ direction > 0)
        for _ in range(samples):
            ray = direction + spread * rng.standard_normal(3)
            ray /= np.linalg.norm(ray)
            free = self.reaches(self._origins[lit], ray)
            out[lit] += free * np.maximum(self.normals[lit] @ ray, 0) / samples
        return out

    def openness(self, samples: int, reach_m: float, rng: np.random.Generator) -> Array:
        """How free each vertex is (V,), 0..1: mean distance along rays about the normal, cut at ``reach_m``."""
        everywhere, out = np.arange(len(self._origins)), np.zeros(len(self._origins))
        for _ in range(samples):
            ray = rng.standard_normal((len(everywhere), 3))
            ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) + self.normals
            ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
            out += self._reach(everywhere, ray, reach_m) / (reach_m * samples)
        return self._smoothed(self._smoothed(out))

    def _smoothed(self, x: Array) -> Array:
        total, count = np.zeros_like(x), np.zeros_like(x)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            total += np.bincount(self._faces[:, a], x[self._faces[:, b]], minlength=len(x))
            count += np.bincount(self._faces[:, a], minlength=len(x))
        return np.where(count > 0, 0.5 * x + 0.5 * total / np.maximum(count, 1), x)
