"""One call for a calibration file of any known kind; and OpenCV YAML with ``K1 D1 K2 D2 R T``, as community files of
the T265 come."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import make_lens, read_camchain
from gpvo.cameras.models import CameraModel
from gpvo.cameras.projections import read_camera_infos, read_kitti_calib
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.cameras.yamlfile import get_numbers, read_yaml
from gpvo.errors import CalibrationError

_T265_SIZE = (848, 800)
# Names under which a calibration lies beside images or a bag, the most telling first.
CALIBRATION_NAMES = (
    "camchain-imucam.yaml",
    "camchain.yaml",
    "kalibr_imucam_chain.yaml",
    "dso/camchain.yaml",
    "*camchain*.yaml",
    "*camchain*.yml",
    "*imucam*.yaml",
    "stereo*.yaml",
    "stereo*.yml",
    "calib*.yaml",
    "calib*.yml",
)


def read_stereo_yaml(path: Path, *, size: tuple[int, int] | None = None) -> StereoRig:
    """A Kalibr camera chain, an OpenCV stereo file, ROS camera_info YAML or KITTI's ``calib.txt``, told apart by keys.

    ``size`` (width, height) of the images, for files that do not state it. Raises CalibrationError where it is none of
    them.
    """
    if path.suffix.lower() == ".txt":
        if size is None:
            raise CalibrationError("states no size of the images", where=path, cure="convert it to a camchain.yaml")
        return read_kitti_calib(path, left=0, right=1, size=size)
    document = read_yaml(path)
    if "cam0" in document or "cam1" in document:
        return read_camchain(path)
    if "K1" in document:
        return read_opencv_stereo(path, size=size)
    if "camera_matrix" in document:
        return read_camera_infos(path)
    raise CalibrationError(
        "is neither a Kalibr camera chain (cam0, cam1), nor an OpenCV stereo file (K1, D1, K2, D2, R, T), nor ROS"
        " camera_info (camera_matrix, projection_matrix)",
        where=path,
    )


def find_calibration(folder: Path) -> Path | None:
    """The calibration file in a folder, None where there is none."""
    for pattern in CALIBRATION_NAMES:
        for path in sorted(folder.glob(pattern)):
            if path.is_file():
                return path
    return None


def read_opencv_stereo(path: Path, *, size: tuple[int, int] | None = None) -> StereoRig:
    """The rig of an OpenCV stereo file: ``R``, ``T`` map points of the first camera to the second.

    The lens is a fisheye where ``D1`` has exactly four coefficients and the file says ``model: fisheye`` (or names
    no model and is of a T265), else radial-tangential. ``size`` (width, height) where the file does not say. Raises
    CalibrationError where a key is missing or the rig impossible.
    """
    document = read_yaml(path)
    T = np.eye(4)
    T[:3, :3] = np.reshape(get_numbers(document, "R", 9, path), (3, 3))
    T[:3, 3] = get_numbers(document, "T", 3, path)
    resolution = _size(document, size, path)
    return StereoRig(
        left=_lens(document, "1", resolution, path),
        right=_lens(document, "2", resolution, path),
        T_right_left=check_pose(T, "R, T", path),
        where=str(path),
    )


def _size(document: dict[str, Any], size: tuple[int, int] | None, path: Path) -> tuple[int, int]:
    for key in ("resolution", "image_size", "size"):
        if key in document:
            width, height = get_numbers(document, key, 2, path)
            return int(width), int(height)
    if "image_width" in document and "image_height" in document:
        width, height = (get_numbers(document, key, 1, path)[0] for key in ("image_width", "image_height"))
        return int(width), int(height)
    if size is None:
        raise CalibrationError("does not give the image size", where=path, cure="add the line 'resolution: [848, 800]'")
    return size


def _lens(document: dict[str, Any], index: str, size: tuple[int, int], path: Path) -> CameraModel:
    K = np.reshape(get_numbers(document, f"K{index}", 9, path), (3, 3))
    D = get_numbers(document, f"D{index}", (4, 5, 8, 12, 14), path)
    named = str(document.get("model", document.get("camera_model", document.get("distortion_model", "")))).lower()
    fisheye = any(word in named for word in ("fisheye", "equidistant", "kannala"))
    if not named:
        # Nothing names the lens: only the T265's own size tells its fisheye from a radial-tangential lens.
        fisheye = len(D) == 4 and size == _T265_SIZE
    model = "equidistant" if fisheye else "radtan"
    return make_lens("pinhole", model, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], D, size, path)
