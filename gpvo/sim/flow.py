"""Exact optical flow of the left camera, from depth and poses."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel
from gpvo.geometry import se3
from gpvo.types import Array

Image = NDArray[np.float32]
# A point further away than what the next picture shows there, by this share, is hidden in it.
_HIDDEN = 0.01


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
