"""OpenCV YAML with ``K1 D1 K2 D2 R T``, as community files of the T265 come, and librealsense's own numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import make_lens
from gpvo.cameras.models import CameraModel, KannalaBrandt
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.cameras.yamlfile import get_numbers, read_yaml
from gpvo.errors import CalibrationError
from gpvo.geometry import se3

_T265_SIZE = (848, 800)


def read_opencv_stereo(path: Path, *, size: tuple[int, int] | None = None) -> StereoRig:
    """The rig of an OpenCV stereo file: ``R``, ``T`` map points of the first camera to the second.

    The lens is a fisheye where ``D1`` has exactly four coefficients and the file says ``model: fisheye`` (or names
    no model and is of a T265), else radial-tangential. ``size`` (width, height) where the file does not say.

    Raises
    ------
    CalibrationError
        Where a key is missing or the rig impossible.
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


def rig_from_librealsense(
    left: dict[str, Any], right: dict[str, Any], rotation: list[float], translation: list[float]
) -> StereoRig:
    """The rig from librealsense's structures of a T265.

    ``left``, ``right``: ``fx fy ppx ppy coeffs width height``; ``rotation`` 9 numbers **column-major** and
    ``translation`` [m] of ``left.get_extrinsics_to(right)``.
    """
    lenses = []
    for c in (left, right):
        k1, k2, k3, k4 = (float(v) for v in list(c["coeffs"])[:4])
        lenses.append(
            KannalaBrandt(
                float(c["fx"]), float(c["fy"]), float(c["ppx"]), float(c["ppy"]),
                int(c.get("width", _T265_SIZE[0])), int(c.get("height", _T265_SIZE[1])), (k1, k2, k3, k4),
            )
        )  # fmt: skip
    T = se3.from_rt(np.reshape(rotation, (3, 3)).T, np.asarray(translation, dtype=np.float64))
    return StereoRig(left=lenses[0], right=lenses[1], T_right_left=check_pose(T, "extrinsics"))


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
