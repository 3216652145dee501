"""The stereo renderer: world, rig and pose in, linear radiance and depth out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.errors import MissingExtraError
from gpvo.sim.render.rays import RayTable
from gpvo.sim.render.scene import Scene
from gpvo.sim.worlds.world import World
from gpvo.types import Array

Image = NDArray[np.float32]


class StereoRenderer:
    """Draws stereo pairs of a world.

    Parameters
    ----------
    world
        As from ``build_world``.
    left_model, right_model
        Lens models of the two cameras; they may differ.
    T_right_left
        (4, 4) maps points of the left camera to the right one (x translation is minus the baseline).
    threads
        1 or 2; the pictures are the same to the bit.
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
        left_model: CameraModel,
        right_model: CameraModel,
        T_right_left: Array,
        *,
        threads: int = 2,
        head_lamp: float | None = None,
        max_angle_rad: float = np.deg2rad(81.5),
        far_m: float = 500.0,
    ) -> None:
        try:
            from gpvo.sim.render.draw import Drawer
        except ImportError as error:
            raise MissingExtraError("numba", "sim") from error
        scene = Scene.of(world)
        lamp = scene.head_lamp if head_lamp is None else head_lamp
        tables = [RayTable.of(model, max_angle_rad) for model in (left_model, right_model)]
        self._drawers = [Drawer(scene, table, far_m, lamp) for table in tables]
        self._T_left_right = np.linalg.inv(np.asarray(T_right_left, dtype=np.float64))
        self._pool = ThreadPoolExecutor(2) if threads > 1 else None
        self.mask_left, self.mask_right = (table.valid for table in tables)
        self.depth_right: Image | None = None

    def render(
        self, T_world_left: Array, *, motion: Array | Sequence[Array] | None = None
    ) -> tuple[Image, Image, Image]:
        """Linear radiance of both cameras and the depth of the left one, (H, W) float32 each.

        ``motion``: (k, 4, 4) poses ``T_world_left`` spread over the exposure, whose pictures are averaged; depth is
        always that of ``T_world_left``. Depth runs along the optical axis [m], NaN where there is nothing; that of the
        right camera is kept in ``depth_right`` until the next call.
        """
        pose = np.asarray(T_world_left, dtype=np.float64)
        exposure = [] if motion is None else [np.asarray(T, dtype=np.float64) for T in motion]
        if self._pool is None:
            views = [self._view(side, pose, exposure) for side in (0, 1)]
        else:
            views = list(self._pool.map(lambda side: self._view(side, pose, exposure), (0, 1)))
        (left, depth), (right, self.depth_right) = views
        return left, right, depth

    def _view(self, side: int, pose: Array, exposure: list[Array]) -> tuple[Image, Image]:
        shift = np.eye(4) if side == 0 else self._T_left_right
        radiance, depth = self._drawers[side].draw(pose @ shift)
        if exposure:
            radiance = np.zeros_like(radiance)
            for T in exposure:
                radiance += self._drawers[side].draw(T @ shift)[0]
            radiance /= np.float32(len(exposure))
        return radiance, depth
