"""One camera's images: working memory and the order in which the kernels run."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gpvo.sim.render import raster, shade
from gpvo.sim.render.scene import RayTable, Scene
from gpvo.types import Array

_MOST_TAPS = 3
_FAR_M = 500.0  # nothing beyond is drawn


class Drawer:
    """Draws a scene through one lens, in horizontal bands that may run in different threads.

    ``radiance`` and ``depth`` (H, W) float32 hold the last image.
    """

    def __init__(self, scene: Scene, table: RayTable, bands: int) -> None:
        self._scene, self._table = scene, table
        H, W = table.valid.shape
        edges = np.linspace(0, H, bands + 1).astype(int)
        self.bands = list(pairwise(edges.tolist()))
        # Inverse distances of an empty image: infinite where there is no ray, so that nothing covers it.
        self._blank = np.where(table.rays.any(axis=1), np.float32(0), np.float32(np.inf))
        self._inverse, self._owner = np.zeros_like(self._blank), np.zeros(self._blank.shape, np.int32)
        self.radiance, self.depth = (np.zeros((H, W), np.float32) for _ in range(2))
        self._index = np.zeros(len(scene.sphere), np.int32)
        self._distance = np.zeros(len(scene.sphere), np.float32)
        most = int(np.diff(scene.vertex_start).max())
        self._memory = [_Memory(most) for _ in self.bands]

    def aim(self, T_world_cam: Array) -> None:
        """Choose the clusters to draw from a pose, nearest first."""
        self._R = np.ascontiguousarray(T_world_cam[:3, :3].T)
        self._P = np.ascontiguousarray(T_world_cam[:3, 3])
        s, t = self._scene, self._table
        n = raster.cull(
            s.sphere, s.cone, self._R, self._P, t.reach, t.max_angle_rad, _FAR_M, self._index, self._distance
        )
        order = np.argsort(self._distance[:n], kind="stable")
        self._order, self._near = self._index[order], self._distance[order]
        self._triangles = int((s.triangle_start[self._order + 1] - s.triangle_start[self._order]).sum())

    def draw(self, band: int, lights: Array) -> None:
        """Fill the rows of a band of ``radiance`` and ``depth``.

        ``lights``: ambient, head lamp.
        """
        s, t, memory = self._scene, self._table, self._memory[band]
        (y0, y1), width = self.bands[band], t.valid.shape[1]
        memory.make_room(self._triangles + 1)
        self._inverse[y0:y1], self._owner[y0:y1] = self._blank[y0:y1], 0
        kept = raster.visibility(
            self._order, self._near,
            (s.vertices, s.triangles, s.vertex_start, s.triangle_start, s.cluster_material),
            self._R, self._P, t.plane, t.reach, np.float32(t.bend), width, t.rays, self._inverse, self._owner,
            y0, y1, memory.camera, memory.pixel, memory.rows, memory.corner,
        )  # fmt: skip
        memory.table[:kept, shade.TAPS] = 0  # not filled yet
        shade.shade(
            self._inverse, self._owner, memory.rows, memory.corner, s.vertices, s.texels,
            (s.texture_size, s.level_start), self._R, self._P, lights, t.rays, width, t.plane, t.reach, _MOST_TAPS,
            memory.table, memory.table.view(np.int32), self.radiance, self.depth, y0, y1,
        )  # fmt: skip
        if (shadows := s.light_map) is not None:
            u, v, scale = (np.float32(value) for value in (*shadows.origin, 1 / shadows.texel))
            shade.cast_shadows(
                t.rays, self._inverse, self._owner, memory.corner, s.vertices, memory.table,
                (shadows.image, shadows.material, u, v, scale), self.radiance, y0, y1,
            )  # fmt: skip


class _Memory:
    """What one band needs for itself, so that bands can run side by side."""

    def __init__(self, most_vertices: int) -> None:
        self.camera, self.pixel = np.zeros((3, most_vertices)), np.zeros((2, most_vertices), np.float32)
        self.rows: NDArray[np.float32] = np.zeros((0, 10), np.float32)

    def make_room(self, triangles: int) -> None:
        if len(self.rows) < triangles:
            size = triangles * 5 // 4
            self.rows = np.zeros((size, 10), np.float32)
            self.corner = np.zeros((size, 4), np.int32)
            self.table = np.zeros((size, shade.COLUMNS), np.float32)
