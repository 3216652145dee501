"""The stereo renderer: world, rig and pose in, linear radiance and depth out."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.errors import MissingExtraError
from gpvo.sim.render.rays import RayTable
from gpvo.sim.render.scene import Scene
from gpvo.sim.worlds.world import World
from gpvo.types import Array

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Effects:
    """What may happen to the light of one frame.

    ``lamps`` and ``head_lamp`` scale the world's fixed light and the lamp at the camera (0: switched off).
    ``dust_per_m``: extinction of the air [1/m]; its haze glows with the world's ``dust_airlight``.
    """

    lamps: float = 1.0
    head_lamp: float = 1.0
    dust_per_m: float = 0.0


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
        Number of threads; the pictures are the same to the bit for any number.
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
        max_angle_rad: float = np.deg2rad(82.0),
        far_m: float = 400.0,
    ) -> None:
        try:
            from gpvo.sim.render.draw import Drawer
        except ImportError as error:
            raise MissingExtraError("numba", "sim") from error
        scene = Scene.of(world)
        tables = [RayTable.of(model, max_angle_rad) for model in (left, right)]
        self._drawers = [Drawer(scene, table, far_m) for table in tables]
        self._T_left_right = np.linalg.inv(np.asarray(T_right_left, dtype=np.float64))
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._threads = threads
        self.mask_left, self.mask_right = (table.valid for table in tables)

    def render(
        self, T_world_left: Array, *, motion: Sequence[Array] | None = None, effects: Effects | None = None
    ) -> tuple[Image, Image, Image]:
        """Linear radiance of both cameras and the depth of the left one, (H, W) float32 each.

        ``motion``: poses ``T_world_left`` spread over the exposure, whose pictures are averaged; depth is always that
        of ``T_world_left``. Depth runs along the optical axis [m], NaN where there is nothing.
        """
        effects = effects or Effects()
        poses = [np.asarray(T_world_left, dtype=np.float64)]
        jobs = [(0, poses[0], True), (1, poses[0] @ self._T_left_right, False)]
        if motion is not None and len(motion) > 1:
            jobs = [(0, poses[0], True)]
            for T in motion:
                jobs += [(0, np.asarray(T), False), (1, np.asarray(T) @ self._T_left_right, False)]
        raise NotImplementedError
