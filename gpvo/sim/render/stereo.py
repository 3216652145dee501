"""The stereo renderer: world, rig and pose in, linear radiance and depth out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.errors import MissingExtraError
from gpvo.sim.render import raster, shade
from gpvo.sim.render.groups import COLUMNS, SCRATCH, TAPS
from gpvo.sim.render.lanes import LANES
from gpvo.sim.render.scene import RayTable, Scene
from gpvo.sim.worlds.world import World
from gpvo.types import Array

_MOST_TAPS = 3


class Drawer:
    """Draws a scene through one lens, in horizontal bands that may run in different threads.

    ``radiance`` and ``depth`` (H, W) float32 hold the last image.
    """

    def __init__(self, scene: Scene, table: RayTable, far_m: float, bands: int) -> None:
        self._scene, self._table, self._far = scene, table, float(far_m)
        H, W, groups = table.height, table.width, table.rays.shape[1]
        edges = np.linspace(0, H, bands + 1).astype(int)
        self.bands = list(pairwise(edges.tolist()))
        self._frame = np.zeros((H, groups, 5, LANES), np.float32)
        self._radiance, self._depth = (np.zeros((H, groups * LANES), np.float32) for _ in range(2))
        self.radiance, self.depth = self._radiance[:, :W], self._depth[:, :W]
        self._index = np.zeros(len(scene.sphere), np.int32)
        self._distance = np.zeros(len(scene.sphere), np.float32)
        self._light_map = _light_map(scene)
        most = int(np.diff(scene.vertex_start).max())
        self._memory = [_Memory(most) for _ in self.bands]

    def aim(self, T_world_cam: Array) -> None:
        """Choose the clusters to draw from a pose, nearest first."""
        self._R = np.ascontiguousarray(T_world_cam[:3, :3].T)
        self._P = np.ascontiguousarray(T_world_cam[:3, 3])
        s, t = self._scene, self._table
        n = raster.cull(
            s.sphere, s.cone, self._R, self._P, t.reach, t.max_angle_rad, self._far, self._index, self._distance
        )
        order = np.argsort(self._distance[:n], kind="stable")
        self._order, self._near = self._index[order], self._distance[order]
        self._triangles = int((s.triangle_start[self._order + 1] - s.triangle_start[self._order]).sum())

    def draw(self, band: int, lights: Array) -> None:
        """Fill the rows of a band of ``radiance`` and ``depth``.

        ``lights``: ambient, head lamp.
        """
        s, t, memory = self._scene, self._table, self._memory[band]
        y0, y1 = self.bands[band]
        memory.make_room(self._triangles + 1)
        raster.clear(t.rays, t.valid, self._frame, y0, y1)
        kept = raster.visibility(
            self._order, self._near,
            (s.vertices, s.triangles, s.vertex_start, s.triangle_start, s.cluster_material),
            self._R, self._P, t.plane, t.reach, np.float32(t.bend), t.width, self._frame, y0, y1, memory.camera,
            memory.pixel, memory.rows, memory.corner,
        )  # fmt: skip
        # Marks the tables as not filled, and the blank triangle's as filled with nothing.
        memory.table[:kept, TAPS] = 0
        memory.table[0] = 0
        memory.table[0, TAPS] = 1
        shade.shade(
            self._frame, memory.rows, memory.corner, s.vertices, s.texels,
            (s.texture_size, s.level_start), self._R, self._P, lights, t.rays, t.width, t.plane, t.reach, _MOST_TAPS,
            memory.table, memory.table.view(np.int32), memory.scratch, self._radiance, self._depth, y0, y1,
        )  # fmt: skip
        if self._light_map is not None:
            shade.cast_shadows(
                self._frame, memory.corner, s.vertices, memory.table, self._light_map, self.radiance, y0, y1
            )


class _Memory:
    """What one band needs for itself, so that bands can run side by side."""

    def __init__(self, most_vertices: int) -> None:
        self.camera, self.pixel = np.zeros((3, most_vertices)), np.zeros((2, most_vertices), np.float32)
        self.scratch = np.zeros(SCRATCH, np.float32)
        self.rows: NDArray[np.float32] = np.zeros((0, 10), np.float32)

    def make_room(self, triangles: int) -> None:
        if len(self.rows) < triangles:
            size = triangles * 5 // 4
            self.rows = np.zeros((size, 10), np.float32)
            self.corner = np.zeros((size, 4), np.int32)
            self.table = np.zeros((size, COLUMNS), np.float32)


def _light_map(scene: Scene) -> tuple[NDArray[np.uint8], int, np.float32, np.float32, np.float32] | None:
    lm = scene.light_map
    if lm is None:
        return None
    u, v = np.float32(lm.origin[0]), np.float32(lm.origin[1])
    return np.ascontiguousarray(lm.image), lm.material, u, v, np.float32(1 / lm.texel)


Image = NDArray[np.float32]


class StereoRenderer:
    """Draws stereo pairs of a world.

    Parameters
    ----------
    world
        As from ``build_world``.
    left, right
        Lens models of the two cameras; they may differ.
    T_right_left
        (4, 4) maps points of the left camera to the right one (x translation is minus the baseline).
    threads
        Number of threads; the images are the same to the bit for any number.
    head_lamp
        Radiant intensity of a lamp at each camera; by default that of the world.
    max_angle_rad
        Half the field of view; pixels beyond it are black, as behind the rim of a fisheye.
    far_m
        Nothing beyond this distance is drawn.

    Raises
    ------
    MissingExtraError
        Where numba is not installed.
    """

    def __init__(
        self,
        world: World,
        left: CameraModel,
        right: CameraModel,
        T_right_left: Array,
        *,
        threads: int = 2,
        head_lamp: float | None = None,
        max_angle_rad: float = np.deg2rad(82.0),
        far_m: float = 500.0,
    ) -> None:
        try:
            from gpvo.sim.render.stereo import Drawer
        except ImportError as error:
            raise MissingExtraError("numba", "sim") from error
        scene = Scene.of(world)
        lamp = scene.lighting.head_lamp if head_lamp is None else head_lamp
        self._lights = np.array([scene.lighting.ambient, lamp])
        tables = [RayTable.of(model, max_angle_rad) for model in (left, right)]
        bands = max(1, (threads + 1) // 2)
        self._left, self._right = (Drawer(scene, table, far_m, bands) for table in tables)
        self._T_left_right = np.linalg.inv(np.asarray(T_right_left, dtype=np.float64))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self.mask_left, self.mask_right = (table.valid for table in tables)

    def render(
        self, T_world_left: Array, *, motion: Array | Sequence[Array] | None = None
    ) -> tuple[Image, Image, Image]:
        """Linear radiance of both cameras and the depth of the left one, (H, W) float32 each, yours to keep.

        ``motion``: (k, 4, 4) poses ``T_world_left`` spread over the exposure, whose images are averaged; depth is
        always that of ``T_world_left``. Depth runs along the optical axis [m], NaN where there is nothing; that of the
        right camera is kept in ``depth_right`` until the next call.
        """
        pose = np.asarray(T_world_left, dtype=np.float64)
        left = right = None
        if motion is not None and len(motion) > 1:
            left, right = np.zeros_like(self._left.radiance), np.zeros_like(self._right.radiance)
            for T in motion:
                self._draw(np.asarray(T, dtype=np.float64))
                left += self._left.radiance
                right += self._right.radiance
            left /= np.float32(len(motion))
            right /= np.float32(len(motion))
        self._draw(pose)
        if left is None or right is None:
            left, right = self._left.radiance.copy(), self._right.radiance.copy()
        return left, right, self._left.depth.copy()

    @property
    def depth_right(self) -> Image:
        """Depth of the right camera at the last pose (H, W) [m], NaN where there is nothing."""
        return self._right.depth.copy()

    def _draw(self, T_world_left: Array) -> None:
        views = ((self._left, T_world_left), (self._right, T_world_left @ self._T_left_right))
        aims = [(drawer.aim, (pose,)) for drawer, pose in views]
        draws = [(drawer.draw, (band, self._lights)) for drawer, _ in views for band in range(len(drawer.bands))]
        for jobs in (aims, draws):
            if self._pool is None:
                for function, arguments in jobs:
                    function(*arguments)
            else:
                for future in [self._pool.submit(function, *arguments) for function, arguments in jobs]:
                    future.result()
