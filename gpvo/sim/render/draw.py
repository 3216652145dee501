"""One camera's buffers around the compiled kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.sim.render import kernels
from gpvo.sim.render.rays import RayTable
from gpvo.sim.render.scene import CLUSTER, Scene
from gpvo.types import Array

Image = NDArray[np.float32]

_ANISOTROPY = 2
_MOST_ROWS = 400_000
_BLOCKED = 1e9


class Drawer:
    """Draws one camera's view of a scene. Not for use by two threads at once."""

    def __init__(self, scene: Scene, table: RayTable, far_m: float, head_lamp: float) -> None:
        self._scene, self._table, self._far, self._head = scene, table, float(far_m), float(head_lamp)
        H, W, padded = table.height, table.width, table.rays.shape[2]
        self._blocked = np.full((H, padded), _BLOCKED, dtype=np.float32)
        self._blocked[:, :W][table.valid] = 0
        vertices = len(scene.mesh.vertices)
        self._camera_xyz = np.zeros((vertices, 3))
        self._pixel = np.zeros((vertices, 2))
        self._lit = np.zeros(vertices, dtype=np.float32)
        self._stamp = np.zeros(vertices, dtype=np.int64)
        self._frame = 0
        self._rows = np.zeros((min(len(scene.mesh.faces), _MOST_ROWS), kernels.ROWS), dtype=np.float32)
        self._seen = np.zeros((H, padded), dtype=np.int32)
        self._inverse = np.zeros((H, padded), dtype=np.float32)
        tiles = (-(-H // kernels.TILE), -(-W // kernels.TILE))
        self._coarse = np.zeros(tiles, dtype=np.float32)

    def draw(self, T_world_cam: Array) -> tuple[Image, Image]:
        """Radiance and depth (H, W) from a pose; depth is NaN where there is nothing."""
        s, t, m = self._scene, self._table, self._scene.mesh
        self._frame += 1
        R = np.ascontiguousarray(T_world_cam[:3, :3], dtype=np.float64)
        P = np.ascontiguousarray(T_world_cam[:3, 3], dtype=np.float64)
        kernels.raster(
            m.vertices, m.normals, m.uv, m.light, m.albedo, m.faces, m.material, s.clusters, CLUSTER,
            R, P, t.rays, self._blocked, t.lens, t.coefficients, t.max_angle, t.slope_x, t.slope_y, t.px_per_rad,
            self._far, float(s.ambient), self._head, s.size, _ANISOTROPY, t.width,
            self._camera_xyz, self._pixel, self._lit, self._stamp, self._frame,
            self._rows, self._seen, self._inverse, self._coarse,
        )  # fmt: skip
        radiance = np.empty((t.height, t.width), dtype=np.float32)
        depth = np.empty_like(radiance)
        kernels.shade(
            s.texels, s.offsets, s.stride, s.size, t.rays, self._rows, self._seen, self._inverse, radiance, depth
        )
        depth[self._seen[:, : t.width] < 0] = np.nan
        return radiance, depth
