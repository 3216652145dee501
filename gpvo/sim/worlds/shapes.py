"""Pieces of meshes, and how they are put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

Faces = NDArray[np.int32]


@dataclass
class Parts:
    """Pieces of one mesh: vertices (V, 3), texture coordinates (V, 2), faces, material, and their own glow (V,)."""

    vertices: list[Array] = field(default_factory=list)
    uv: list[Array] = field(default_factory=list)
    faces: list[Faces] = field(default_factory=list)
    material: list[NDArray[np.uint8]] = field(default_factory=list)
    glow: list[Array] = field(default_factory=list)
    count: int = 0

    def add(
        self, vertices: Array, uv: Array, faces: Faces, material: int | NDArray[np.uint8], glow: float = 0.0
    ) -> None:
        """One piece; faces count from its own first vertex."""
        self.vertices.append(vertices)
        self.uv.append(uv)
        self.faces.append((faces + self.count).astype(np.int32))
        self.material.append(np.broadcast_to(np.asarray(material, np.uint8), len(faces)))
        self.glow.append(np.full(len(vertices), glow))
        self.count += len(vertices)


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
