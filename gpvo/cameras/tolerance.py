"""How a true rig may differ from the calibrated one: data sheets in three numbers, and a rig drawn from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera


@dataclass(frozen=True)
class Tolerance:
    """Standard deviations of how the true rig differs from the written one: what a data sheet allows, drawn once per
    flight."""

    baseline: float = 0.0  # fraction
    focal: float = 0.0  # fraction
    rotation_rad: float = 0.0  # between the cameras, per axis
    distortion: float = 0.0  # absolute, of the first coefficient; a rectified pair has none


TOLERANCES: dict[str, Tolerance] = {
    "none": Tolerance(),
    # A factory calibration of a fisheye pair 64 mm apart; Intel states none: the simulator's `room-t265` is so wrong.
    "t265": Tolerance(baseline=0.01, focal=0.003, rotation_rad=5e-4),
    # Depth within 2 % at 4 m (95 mm, 640 px at 1280x720, 15 px of disparity), the limit taken as two sigma.
    "d455": Tolerance(baseline=0.003, focal=0.003, rotation_rad=2.5e-4),
    # Depth within 1 % to 3 m and 5 % to 15 m (120 mm, 530 px at 720p, 4.2 px of disparity), taken likewise.
    "zed2": Tolerance(baseline=0.003, focal=0.003, rotation_rad=2e-4),
    # Depth within 2 % below 4 m and 4 % below 7 m (75 mm, 800 px at 800p, 8.6 px of disparity), taken likewise.
    "oak-d": Tolerance(baseline=0.005, focal=0.003, rotation_rad=2e-4),
    # What twins of six drives wanted beside their own scatter (baselines of 0.54 m, calibrated anew each day).
    "kitti": Tolerance(baseline=0.002, focal=0.002, rotation_rad=3e-4),
    # Kalibr with a large target, shortly before the flight: a tenth of a millimetre in 110.
    "euroc": Tolerance(baseline=0.001, focal=0.001, rotation_rad=1e-4),
}
"""By name. Sources as noted: published depth errors, as a yaw between the cameras of 2 sigma at the far end."""


RIG_ERRORS = 5
"""Numbers by which a rig may be wrong."""


@dataclass(frozen=True)
class TrueRig:
    """The rig that makes the pixels, while ``calibrated`` is what the software believes."""

    camera: StereoCamera
    R_right_left: Array

    @classmethod
    def of(cls, calibrated: StereoCamera, tolerance: Tolerance, e: Array, offset: Tolerance | None = None) -> TrueRig:
        """The rig that is wrong by ``e`` (5,) sigma: baseline, focal length, rotation; about ``offset``, the fixed
        part of the difference."""
        offset, c = offset or Tolerance(), calibrated
        focal = 1 + offset.focal + tolerance.focal * e[1]
        baseline_m = c.baseline_m * (1 + offset.baseline + tolerance.baseline * e[0])
        camera = replace(c, baseline_m=baseline_m, fx_px=c.fx_px * focal, fy_px=c.fy_px * focal)
        return cls(camera, se3.so3_exp(tolerance.rotation_rad * e[2:] + [0.0, offset.rotation_rad, 0.0]))

    def pixels(self, points_cam: Array) -> tuple[Array, Array]:
        """Left and right pixels (N, 2) of points (N, 3) in the left camera."""
        c = self.camera
        focal, centre = np.array([c.fx_px, c.fy_px]), np.array([c.cx_px, c.cy_px])
        right_points = (points_cam - [c.baseline_m, 0, 0]) @ self.R_right_left.T
        left, right = (focal * X[:, :2] / X[:, 2:] + centre for X in (points_cam, right_points))
        return left, right
