"""Light that does not move, computed per vertex with Embree: lamps and sun with shadows, ambient occlusion."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import MissingExtraError
from gpvo.types import Array

F32 = NDArray[np.float32]
_LIFT_M = 0.02


class Baker:
    """Rays against a finished mesh.

    Raises
    ------
    MissingExtraError
        Where Embree is not installed.
    """

    def __init__(self, vertices: Array, normals: Array, faces: NDArray[np.int32]) -> None:
        try:
            from embreex import rtcore_scene
            from embreex.mesh_construction import TriangleMesh
        except ImportError as error:
            raise MissingExtraError("embreex", "sim") from error
        self._scene: Any = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, np.ascontiguousarray(vertices[faces], dtype=np.float32))
        self._normals = normals
        self._origins = (vertices + _LIFT_M * normals).astype(np.float32)
        self._faces = faces

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
            cosine = (to_lamp * self._normals).sum(axis=1) / np.sqrt(np.maximum(square, 1e-12))
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
        lit = np.flatnonzero(self._normals @ direction > 0)
        for _ in range(samples):
            ray = direction + spread * rng.standard_normal(3)
            ray /= np.linalg.norm(ray)
            free = self.reaches(self._origins[lit], ray)
            out[lit] += free * np.maximum(self._normals[lit] @ ray, 0) / samples
        return out

    def openness(self, samples: int, reach_m: float, rng: np.random.Generator) -> Array:
        """How free each vertex is (V,), 0..1: mean distance along rays about the normal, cut at ``reach_m``."""
        everywhere = np.arange(len(self._origins))
        out = np.zeros(len(self._origins))
        for _ in range(samples):
            ray = rng.standard_normal((len(everywhere), 3))
            ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) + self._normals
            ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
            out += self._reach(everywhere, ray, reach_m) / (reach_m * samples)
        return self._smoothed(self._smoothed(out))

    def _smoothed(self, x: Array) -> Array:
        total, count = np.zeros_like(x), np.zeros_like(x)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            total += np.bincount(self._faces[:, a], x[self._faces[:, b]], minlength=len(x))
            count += np.bincount(self._faces[:, a], minlength=len(x))
        return np.where(count > 0, 0.5 * x + 0.5 * total / np.maximum(count, 1), x)
