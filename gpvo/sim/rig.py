"""Stereo rigs by name, and what separates the rig that draws the images from the calibration that is written."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.cameras.readers import read_projections, read_stereo_yaml
from gpvo.cameras.rig import StereoRig, Tolerance
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.io.run_read import is_run, read_run
from gpvo.sim.points import T_BODY_CAM

# Where the left camera sits on a vehicle, in body axes [m]; the IMU is the body's origin. A rover carries it on a mast.
PLACE_M = {"quadrotor": (0.12, 0.0, 0.02), "path": (0.12, 0.0, 0.02), "rover": (0.35, 0.0, 0.75)}
_PINHOLE = PinholeRadtan(380.0, 380.0, 319.5, 239.5, 640, 480)
# Left and right lens, baseline [m], rotation of the right camera [rad].
_PRESETS: dict[str, tuple[CameraModel, CameraModel, float, tuple[float, float, float]]] = {
    "pinhole": (_PINHOLE, _PINHOLE, 0.12, (0.0, 0.0, 0.0)),
    "euroc": (
        PinholeRadtan(458.0, 457.0, 367.0, 248.0, 752, 480, (-0.28, 0.074, 2e-4, 1e-5)),
        PinholeRadtan(457.5, 456.0, 380.0, 255.0, 752, 480, (-0.28, 0.074, -1e-4, -3e-5)),
        0.11,
        (0.014, -0.004, 0.002),
    ),
    "t265": (
        KannalaBrandt(286.0, 286.0, 421.0, 399.0, 848, 800, (-0.005, 0.04, -0.038, 0.006)),
        KannalaBrandt(285.5, 285.5, 419.0, 403.0, 848, 800, (-0.004, 0.039, -0.037, 0.006)),
        0.064,
        (0.001, 0.0046, -0.002),
    ),
}
CAMERAS = tuple(_PRESETS)


def camera_rig(name: str) -> StereoRig:
    """The nominal rig of a preset (``pinhole``, ``euroc`` or ``t265``) or of a calibration file: Kalibr, OpenCV, ROS
    camera_info, or KITTI's ``calib.txt``, which states no size: then the principal point is in the middle; or the
    rectified one of a run folder.

    Raises GpvoError for any other name, or a file that is no calibration.
    """
    if name in _PRESETS:
        return _pair(*_PRESETS[name])
    if is_run(name):
        if (c := read_run(Path(name)).log.camera) is None:
            raise GpvoError("the run does not know its camera", where=name, cure="give a calibration file")
        lens = PinholeRadtan(c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.width, c.height)
        return _pair(lens, lens, c.baseline_m)
    if not Path(name).is_file():
        raise GpvoError(f"unknown camera '{name}'", cure=f"choose from {', '.join(CAMERAS)}, or a calibration file")
    path, size = Path(name), None
    if path.suffix.lower() == ".txt" and (P := read_projections(path).get("P0")) is not None:
        size = round(2 * P[0, 2]) + 1, round(2 * P[1, 2]) + 1
    return replace(read_stereo_yaml(path, size=size), T_imu_left=T_BODY_CAM, T_body_left=T_BODY_CAM)


def mounted(rig: StereoRig, vehicle: str, pitch_deg: float) -> StereoRig:
    """The rig on a vehicle, looking ``pitch_deg`` below straight ahead."""
    down = se3.so3_exp(np.array([0.0, np.deg2rad(pitch_deg), 0.0]))
    T = se3.from_rt(down @ R_FLU_OPTICAL, np.array(PLACE_M[vehicle]))
    return replace(rig, T_body_left=T, T_imu_left=T)


@dataclass(frozen=True)
class RigError:
    """By how much the true rig differs from the written one: fractions of baseline and focal length, turn (3,) of the
    right camera [rad], change of the first distortion coefficient of both lenses."""

    baseline: float
    focal: float
    rotation_rad: tuple[float, float, float]
    distortion: tuple[float, float]

    @classmethod
    def draw(cls, tolerance: Tolerance, rng: np.random.Generator, offset: Tolerance | None = None) -> RigError:
        """Normal within the tolerance, about a fixed ``offset``, whose turn is about the vertical axis of the image."""
        e, fixed = rng.standard_normal(7), offset or Tolerance()
        x, y, z = (tolerance.rotation_rad * e[1:4] + [0.0, fixed.rotation_rad, 0.0]).tolist()
        left, right = (fixed.distortion + tolerance.distortion * e[5:]).tolist()
        return cls(
            baseline=float(fixed.baseline + tolerance.baseline * e[0]),
            focal=float(fixed.focal + tolerance.focal * e[4]),
            rotation_rad=(x, y, z),
            distortion=(left, right),
        )


def true_rig(written: StereoRig, error: RigError) -> StereoRig:
    """The rig that draws the images, given what its calibration says.

    Raises CalibrationError where the error makes a rig that cannot exist.
    """
    T = written.T_right_left.copy()
    T[:3, 3] *= 1 + error.baseline
    T[:3] = se3.so3_exp(np.array(error.rotation_rad)) @ T[:3]
    left = _altered(written.left, 1 + error.focal, error.distortion[0])
    right = _altered(written.right, 1 + error.focal, error.distortion[1])
    return replace(written, left=left, right=right, T_right_left=T)


def _altered(lens: CameraModel, focal: float, k1: float) -> CameraModel:
    first, *rest = lens.distortion
    assert isinstance(lens, (PinholeRadtan, KannalaBrandt))
    return replace(lens, fx_px=lens.fx_px * focal, fy_px=lens.fy_px * focal, distortion=(first + k1, *rest))


def _pair(
    left: CameraModel, right: CameraModel, baseline_m: float, turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> StereoRig:
    R_right_left = se3.so3_exp(np.array(turn_rad))
    T_right_left = se3.from_rt(R_right_left, R_right_left @ np.array([-baseline_m, 0.0, 0.0]))
    return StereoRig(left, right, T_right_left, T_imu_left=T_BODY_CAM, T_body_left=T_BODY_CAM)
