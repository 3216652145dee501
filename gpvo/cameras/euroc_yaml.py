"""EuRoC's ``sensor.yaml``: one file per sensor, with ``T_BS`` from sensor to body."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpvo.cameras.kalibr import make_lens
from gpvo.cameras.models import CameraModel
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.cameras.yamlfile import get_numbers, read_yaml
from gpvo.errors import CalibrationError
from gpvo.geometry import se3
from gpvo.types import Array


def read_sensor_pose(path: Path) -> Array:
    """``T_BS`` (4, 4) of any sensor: sensor to body."""
    document = read_yaml(path)
    block = document.get("T_BS")
    if isinstance(block, dict):
        numbers = get_numbers(block, "data", 16, f"{path}: T_BS")
        return check_pose(np.reshape(numbers, (4, 4)), "T_BS", path)
    if block is None:
        raise CalibrationError("lacks the key 'T_BS'", where=path, cure="add the sensor's pose in the body")
    return check_pose(block, "T_BS", path)


def read_sensor_lens(path: Path) -> CameraModel:
    """The lens of one camera."""
    document = read_yaml(path)
    width, height = get_numbers(document, "resolution", 2, path)
    distortion_model = str(document.get("distortion_model", "none"))
    distortion: list[float] = []
    if distortion_model != "none":
        key = "distortion_coefficients" if "distortion_coefficients" in document else "distortion_coeffs"
        distortion = get_numbers(document, key, (4, 5), path)
    return make_lens(
        str(document.get("camera_model", "pinhole")),
        distortion_model,
        get_numbers(document, "intrinsics", 4, path),
        distortion,
        (int(width), int(height)),
        path,
    )


def read_sensor_pair(left: Path, right: Path, *, imu: Path | None = None, body_is_flu: bool = False) -> StereoRig:
    """The rig of two camera ``sensor.yaml`` files; ``imu``: that of the IMU, else the IMU is the body's origin.

    ``body_is_flu`` says that the body's axes are x forward, y left, z up, so that it can serve as ``base_link``.
    """
    T_body_left, T_body_right = read_sensor_pose(left), read_sensor_pose(right)
    T_body_imu = read_sensor_pose(imu) if imu is not None else np.eye(4)
    return StereoRig(
        left=read_sensor_lens(left),
        right=read_sensor_lens(right),
        T_right_left=se3.inverse(T_body_right) @ T_body_left,
        T_imu_left=se3.inverse(T_body_imu) @ T_body_left,
        T_body_left=T_body_left if body_is_flu else None,
        where=str(left),
    )
