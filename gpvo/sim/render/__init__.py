"""Stereo images of a world: world, rig and pose in, linear radiance and depth out; exact for any lens, in numba."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.errors import require
from gpvo.sim.render.scene import RayTable, Scene
from gpvo.sim.worlds import World
from gpvo.types import Array

Image = NDArray[np.float32]


class StereoRenderer:
    """Draws stereo pairs of a world.

    Parameters
    ----------
    left, right : lens models of the two cameras; they may differ.
    T_right_left : (4, 4) maps points of the left camera to the right one (x translation is minus the baseline).
    threads : how many; the images are the same to the bit for any number.
    max_angle_rad : half the field of view; pixels beyond it are black, as behind the rim of a fisheye.

    Raises MissingExtraError where numba is not installed.
    """

    def __init__(
        self,
        world: World,
        left: CameraModel,
        right: CameraModel,
        T_right_left: Array,
        *,
        threads: int = 2,
        max_angle_rad: float = np.deg2rad(82.0),
    ) -> None:
        require("numba")
        from gpvo.sim.render.draw import Drawer

        scene = Scene.of(world)
        self._lights = np.array([world.lighting.ambient, world.lighting.head_lamp])
        tables = [RayTable.of(model, max_angle_rad) for model in (left, right)]
        bands = max(1, (threads + 1) // 2)
        self._left, self._right = (Drawer(scene, table, bands) for table in tables)
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
        poses = [T_world_left] if motion is None or len(motion) < 2 else motion
        left, right = (np.zeros_like(drawer.radiance) for drawer in (self._left, self._right))
        for T in poses:
            self._draw(np.asarray(T, dtype=np.float64))
            left += self._left.radiance
            right += self._right.radiance
        if len(poses) > 1:  # for the depth alone
            self._draw(np.asarray(T_world_left, dtype=np.float64))
        count = np.float32(len(poses))
        return left / count, right / count, self._left.depth.copy()

    @property
    def depth_right(self) -> Image:
        """Depth of the right camera at the last pose (H, W) [m], NaN where there is nothing."""
        return self._right.depth.copy()

    def _draw(self, T_world_left: Array) -> None:
        views = ((self._left, T_world_left), (self._right, T_world_left @ self._T_left_right))
        aims = [(drawer.aim, (pose,)) for drawer, pose in views]
        draws = [(drawer.draw, (band, self._lights)) for drawer, _ in views for band in range(len(drawer.bands))]
        run = map if self._pool is None else self._pool.map
        for jobs in (aims, draws):
            list(run(lambda job: job[0](*job[1]), jobs))
