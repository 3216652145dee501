"""Signed distance from points to a triangle mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gpvo.types import Array

_NEIGHBOURS = 16
_CHUNK = 4096


class TriangleDistance:
    """Distance to the nearest of a mesh's triangles, found among those whose centres are near.

    Triangles of each class of size are searched apart, lest many small ones hide a large one.
    ``vertices`` (V, 3), ``faces`` (F, 3), visible from the side of positive distance.
    """

    def __init__(self, vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> None:
        self._corners = vertices[faces].astype(np.float64)
        centre = self._corners.mean(axis=1)
        size = np.linalg.norm(self._corners - centre[:, None], axis=2).max(axis=1)
        size_class = np.floor(np.log2(np.maximum(size, 1e-6)) / 1.5)
        self._members = [np.flatnonzero(size_class == k) for k in np.unique(size_class)]
        self._trees = [cKDTree(centre[members]) for members in self._members]

    def signed(self, points: Array) -> Array:
        """(N, 3) to (N,) [m], positive on the visible side."""
        parts = [self._signed(points[k : k + _CHUNK]) for k in range(0, len(points), _CHUNK)]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _signed(self, points: Array) -> Array:
        found = []
        for tree, members in zip(self._trees, self._members):
            count = min(_NEIGHBOURS, len(members))
            found.append(members[tree.query(points, k=count)[1].reshape(len(points), count)])
        index = np.concatenate(found, axis=1)
        a, b, c = np.moveaxis(self._corners[index], 2, 0)
        nearest = closest_on_triangles(points[:, None], a, b, c)
        offset = points[:, None] - nearest
        distance = np.linalg.norm(offset, axis=-1)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
        # Several triangles share an edge or a corner: the one seen most squarely says which side it is.
        side = (offset * normal).sum(axis=-1)
        best = distance.min(axis=1, keepdims=True)
        side = np.where(distance <= best + 1e-9 + 1e-6 * best, side, 0.0)
        winner = np.abs(side).argmax(axis=1)
        sign = np.where(side[np.arange(len(points)), winner] < 0, -1.0, 1.0)
        return sign * best[:, 0]


def closest_on_triangles(p: Array, a: Array, b: Array, c: Array) -> Array:
    """Nearest point of triangles ``a b c`` to ``p``, all (..., 3).

    Christer Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
    d1, d2 = (ab * ap).sum(-1), (ac * ap).sum(-1)
    d3, d4 = (ab * bp).sum(-1), (ac * bp).sum(-1)
    d5, d6 = (ab * cp).sum(-1), (ac * cp).sum(-1)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2

    def ratio(x: Array, y: Array) -> Array:
        return x / np.where(np.abs(y) > 1e-300, y, 1e-300)

    total = ratio(np.ones_like(va), va + vb + vc)
    v, w = vb * total, vc * total
    rules = (
        ((va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0), 1 - ratio(d4 - d3, d4 - d3 + d5 - d6), None),
        ((vb <= 0) & (d2 >= 0) & (d6 <= 0), 0.0, ratio(d2, d2 - d6)),
        ((d6 >= 0) & (d5 <= d6), 0.0, 1.0),
        ((vc <= 0) & (d1 >= 0) & (d3 <= 0), ratio(d1, d1 - d3), 0.0),
        ((d3 >= 0) & (d4 <= d3), 1.0, 0.0),
        ((d1 <= 0) & (d2 <= 0), 0.0, 0.0),
    )
    for where, new_v, new_w in rules:
        v = np.where(where, new_v, v)
        w = np.where(where, 1 - v if new_w is None else new_w, w)
    return a + v[..., None] * ab + w[..., None] * ac
