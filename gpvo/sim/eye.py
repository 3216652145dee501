"""World to pictures, by the renderer and the sensor of one flight's true rig; and the flow between two pictures."""

from __future__ import annotations

from dataclasses import fields

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import sequence_plan
from gpvo.sim.imu import Motion
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World
from gpvo.types import Array

Image = NDArray[np.float32]

_BARE_SIGMA_PX = 16.0
# A point further away than what the next picture shows there, by this share, is hidden in it.
_HIDDEN = 0.01


class Eye:
    """Draws what a rig sees on a motion.

    Raises GpvoError for an unknown value of the scenario's ``sensor``; MissingExtraError without numba.
    """

    def __init__(
        self, scenario: Scenario, seed: int, world: World, rig: StereoRig, motion: Motion, threads: int
    ) -> None:
        from gpvo.sim.render import StereoRenderer
        from gpvo.sim.sensor import SensorModel, SensorParams

        known = [f.name for f in fields(SensorParams)]
        if unknown := sorted(set(scenario.sensor) - set(known)):
            raise GpvoError(f"unknown value 'sensor.{unknown[0]}'", cure=f"known: {', '.join(known)}")
        assert rig.T_body_left is not None
        self._renderer = StereoRenderer(world, rig.left, rig.right, rig.T_right_left, threads=threads)
        self._sensor = SensorModel(SensorParams(**scenario.sensor), seed, threads=threads)
        self._motion, self._T_body_left, self._right_light = motion, rig.T_body_left, scenario.right_light
        self.model, self.T_world_cam = rig.left, np.eye(4)
        self.depth_m: NDArray[np.float32] | None = None

    def see(self, index: int, plan: sequence_plan.FramePlan) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Left and right picture (H, W). ``depth_m`` then holds the left camera's depth, NaN where there is nothing;
        ``T_world_cam`` its pose."""
        pose, blur = sequence_plan.camera_poses(self._motion, plan.step, plan.exposure_s, self._T_body_left)
        left, right, depth = self._renderer.render(pose, motion=blur)
        self.depth_m, self.T_world_cam = depth, pose
        if plan.bare:
            left, right = without_texture(left, plan.bare), without_texture(right, plan.bare)
        if self._right_light != 1.0:
            right = right * np.float32(self._right_light)
        depths = [depth, self._renderer.depth_right] if plan.dust else None
        pair = self._sensor.expose(
            left, right, index, depth=depths, darkness=plan.light, dust=plan.dust, noise_sigma=plan.noise_sigma
        )
        return (np.zeros_like(pair[0]), np.zeros_like(pair[1])) if plan.fate == "black" else pair


def without_texture(linear: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    """Radiance (H, W) with ``share`` of its detail finer than about 40 px gone, as on a plastered wall."""
    seen = (linear > 0).astype(np.float32)
    weight = cv2.GaussianBlur(seen, (0, 0), _BARE_SIGMA_PX)
    smooth = cv2.GaussianBlur(linear, (0, 0), _BARE_SIGMA_PX) / np.maximum(weight, np.float32(1e-6))
    return np.asarray(seen * (np.float32(share) * smooth + np.float32(1 - share) * linear), np.float32)


def optical_flow(
    model: CameraModel, depth_m: Image, depth_next_m: Image, T_world_cam: Array, T_world_next: Array
) -> Image:
    """Where each pixel is in the next picture, less where it is now: (H, W, 2) [px].

    ``depth_m``, ``depth_next_m`` (H, W): along the optical axis, NaN where there is nothing; poses (4, 4) of the two
    pictures. NaN where nothing is seen, where it leaves the picture, and where something nearer hides it.
    """
    height, width = depth_m.shape
    v, u = np.mgrid[:height, :width]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    rays = model.unproject(uv)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = rays * (depth_m.reshape(-1, 1) / rays[:, 2:])
    known = np.isfinite(points[:, 2])
    moved = se3.transform(se3.inverse(T_world_next) @ T_world_cam, np.where(known[:, None], points, 1.0))
    there, valid = model.project(moved)
    inside = (there[:, 0] >= 0) & (there[:, 1] >= 0) & (there[:, 0] <= width - 1) & (there[:, 1] <= height - 1)
    good: NDArray[np.bool_] = known & valid & inside
    at = np.where(good[:, None], there, 0.0).astype(np.float32)
    # The farthest of the neighbours: on a slope the point itself lies between them.
    around = cv2.dilate(np.nan_to_num(depth_next_m, nan=0.0), np.ones((3, 3), np.uint8))
    seen = cv2.remap(around, at[:, 0].reshape(height, width), at[:, 1].reshape(height, width), cv2.INTER_NEAREST)
    good &= moved[:, 2] <= (1 + _HIDDEN) * seen.ravel()
    return np.where(good[:, None], there - uv, np.nan).astype(np.float32).reshape(height, width, 2)
