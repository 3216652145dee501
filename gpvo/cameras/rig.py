"""A stereo rig as calibrated: two lenses, their poses to each other and on the vehicle; and how a true one may
differ from it: data sheets in three numbers, and a rig drawn from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import is_plausible
from gpvo.cameras.models import CameraModel, PinholeRadtan
from gpvo.errors import CalibrationError
from gpvo.files import plain
from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.types.sensors import MAX_BASELINE_M

MIN_BASELINE_M = 1e-3
LONG_BASELINE_M = 1.5  # from which on centimetres or decimetres are more likely than a rig of that length
MAX_ROTATION_RAD = np.deg2rad(30.0)
MAX_FOCAL_RATIO = 1.5
_LARGEST = 1e6


@dataclass(frozen=True)
class StereoRig:
    """Two cameras and their places.

    ``T_right_left`` (4, 4) maps points of the left camera to the right one, so that its x translation is minus the
    baseline. ``T_imu_left`` and ``T_body_left`` (4, 4) are None where unknown; ``body`` is FLU ``base_link``.
    ``timeshift_cam_imu_s``: ``t_imu = t_cam + shift``. ``mask_left``, ``mask_right``: (H, W) bool, True where the raw
    image is usable, None for everywhere. ``where``: the file the rig comes from, for messages.
    """

    left: CameraModel
    right: CameraModel
    T_right_left: Array
    T_imu_left: Array | None = None
    T_body_left: Array | None = None
    timeshift_cam_imu_s: float = 0.0
    mask_left: NDArray[np.bool_] | None = None
    mask_right: NDArray[np.bool_] | None = None
    where: str | None = None

    def __post_init__(self) -> None:
        """Raise CalibrationError for a rig that cannot exist: baseline absent, too long, pointing the wrong way or
        along the view; cameras turned apart; lenses that do not belong together; intrinsics outside the image."""
        for name, lens, mask in (("left", self.left, self.mask_left), ("right", self.right, self.mask_right)):
            _check_lens(lens, name, self.where)
            if mask is not None and mask.shape != (lens.height, lens.width):
                text = f"the {name} mask is {mask.shape[1]}x{mask.shape[0]}, the camera {lens.width}x{lens.height}"
                raise CalibrationError(text, where=self.where)
        check_pose(self.T_right_left, "T_right_left", self.where)
        _check_baseline(self)
        a, b = self.left.fx_px, self.right.fx_px * self.resolution
        if max(a, b) / min(a, b) > MAX_FOCAL_RATIO:
            focal = f"{self.left.fx_px:.1f} px and {self.right.fx_px:.1f} px"
            text = f"focal lengths of {focal} do not make a stereo pair"
            cure = "are these two cameras of one rig, calibrated at one resolution?"
            raise CalibrationError(text, where=self.where, cure=cure)

    @property
    def baseline_m(self) -> float:
        """Distance of the optical centres [m]."""
        return float(np.linalg.norm(self.T_right_left[:3, 3]))

    @property
    def resolution(self) -> float:
        """Pixels of the left camera per pixel of the right one: of one view that sensors of other resolution see, that
        of their widths; 1 where the focal lengths in pixels are nearer to each other, as where an image is a part."""
        ratio, of_focal = self.left.width / self.right.width, self.left.fx_px / self.right.fx_px
        return ratio if abs(np.log(of_focal / ratio)) < abs(np.log(of_focal)) else 1.0

    @property
    def is_upright(self) -> bool:
        """Whether one camera sits above the other, in image axes, so that rectified images lie on their side."""
        x, y, _ = mean_view(self.T_right_left)[1]
        return bool(abs(y) > abs(x))

    @property
    def is_rectified(self) -> bool:
        """Whether the images are already a rectified pair: no distortion, no rotation, equal intrinsics."""
        if not all(isinstance(c, PinholeRadtan) and not any(c.distortion) for c in (self.left, self.right)):
            return False
        along_x = se3.from_rt(np.eye(3), self.T_right_left[:3, 3] * [1, 0, 0])
        return bool(
            np.allclose(self.left.intrinsics_px, self.right.intrinsics_px, atol=1e-6)
            and np.allclose(self.T_right_left, along_x, atol=1e-9)
        )

    def with_masks(self, left: NDArray[np.bool_] | None, right: NDArray[np.bool_] | None) -> StereoRig:
        """The same rig with masks of the raw images."""
        return replace(self, mask_left=left, mask_right=right)

    def describe(self) -> dict[str, object]:
        """Plain numbers for ``rig.json``."""

        def lens(model: CameraModel) -> dict[str, object]:
            return {
                "model": model.kind,
                "intrinsics_px": model.intrinsics_px,
                "distortion": [float(k) for k in model.distortion],
                "resolution_px": [model.width, model.height],
            }

        places = ("T_right_left", "T_imu_left", "T_body_left", "timeshift_cam_imu_s")
        known: dict[str, object] = {name: plain(getattr(self, name)) for name in places}
        return {"left": lens(self.left), "right": lens(self.right), **known}


def check_pose(T: object, name: str, where: object = None) -> Array:
    """``T`` as a (4, 4) pose whose rotation is a rotation, cleaned of rounding.

    Raises CalibrationError where it is not 4x4, not finite, or its upper left block is not a rotation to 1e-3.
    """
    try:
        M = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"{name} is not a matrix of numbers", where=where) from None
    if M.shape != (4, 4):
        raise CalibrationError(f"{name} has shape {M.shape}, expected (4, 4)", where=where)
    # Comparisons with NaN are false.
    if not np.abs(M).max() < _LARGEST:
        raise CalibrationError(f"{name} holds a number that is not finite, or beyond a million", where=where)
    R = M[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0 or not np.allclose(M[3], [0, 0, 0, 1]):
        raise CalibrationError(f"{name} is not a rigid transform: its rotation block is not a rotation", where=where)
    return M if np.abs(R @ R.T - np.eye(3)).max() < 1e-15 else se3.orthonormalise(M)


def mean_view(T_right_left: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) of left camera axes into the mean orientation of both, and there the direction (3,) from the left
    camera to the right one."""
    half = se3.so3_exp(0.5 * se3.so3_log(T_right_left[:3, :3]))
    right = half @ (-T_right_left[:3, :3].T @ T_right_left[:3, 3])
    return half, right / np.linalg.norm(right)


def _check_lens(lens: CameraModel, name: str, where: str | None) -> None:
    numbers = np.array([*lens.intrinsics_px, *lens.distortion], dtype=np.float64)
    if not np.abs(numbers).max() < _LARGEST:
        told = "that is not finite, or beyond a million"
        raise CalibrationError(f"the {name} camera has an intrinsic {told}", where=where)
    if not (lens.width > 0 < lens.height and is_plausible((lens.width, lens.height))):
        raise CalibrationError(f"the {name} camera has resolution {lens.width}x{lens.height}", where=where)
    if lens.fx_px <= 1 or lens.fy_px <= 1 or not 0.5 < lens.fx_px / lens.fy_px < 2:
        raise CalibrationError(f"the {name} camera has focal lengths {lens.fx_px:g}, {lens.fy_px:g} px", where=where)
    inside_x = -0.25 * lens.width < lens.cx_px < 1.25 * lens.width
    inside_y = -0.25 * lens.height < lens.cy_px < 1.25 * lens.height
    if not (inside_x and inside_y):
        raise CalibrationError(
            f"the {name} camera's principal point ({lens.cx_px:.1f}, {lens.cy_px:.1f}) lies far outside its"
            f" {lens.width}x{lens.height} image",
            where=where,
            cure="was it calibrated at another resolution?",
        )


def _check_baseline(rig: StereoRig) -> None:
    T, where = rig.T_right_left, rig.where
    length = rig.baseline_m
    if length < MIN_BASELINE_M:
        text = f"the baseline is {length * 1e3:.3g} mm: both cameras in one place"
        raise CalibrationError(text, where=where, cure="give the transform between left and right camera in metres")
    if length > MAX_BASELINE_M:
        text = f"the baseline is {length:.3g} m, more than {MAX_BASELINE_M:g} m"
        raise CalibrationError(text, where=where, cure="are the translations in metres?")
    angle = float(np.linalg.norm(se3.so3_log(T[:3, :3])))
    if angle > MAX_ROTATION_RAD:
        text = f"the cameras are rotated by {np.rad2deg(angle):.0f} degrees to each other, too far for stereo"
        raise CalibrationError(text, where=where, cure="check the order and the direction of the chained transforms")
    x, y, z = mean_view(T)[1]
    if np.hypot(x, y) < 0.7:
        text = f"the right camera sits in front of or behind the left one, direction ({x:.2f}, {y:.2f}, {z:.2f})"
        cure = "the pair must sit side by side, or one above the other, in image axes; check the chained transforms"
        raise CalibrationError(text, where=where, cure=cure)
    if x < 0 and abs(x) >= abs(y):
        text = f"the right camera sits {length * 1e3:.0f} mm to the left of the left one: left and right are swapped"
        raise CalibrationError(text, where=where, cure="swap the two cameras, or invert the transform between them")


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
