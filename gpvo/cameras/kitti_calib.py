"""KITTI odometry's ``calib.txt``: projection matrices of rectified cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpvo.cameras.models import PinholeRadtan
from gpvo.cameras.rig import StereoRig
from gpvo.cameras.yamlfile import calibration_text
from gpvo.errors import CalibrationError
from gpvo.types import Array


def read_projections(path: Path) -> dict[str, Array]:
    """``P0`` ... ``P3`` (3, 4) of the file; raw KITTI's ``P_rect_00`` spelling is understood too."""
    found: dict[str, Array] = {}
    for number, line in enumerate(calibration_text(path).splitlines(), 1):
        key, _, rest = line.partition(":")
        key = key.strip().replace("P_rect_0", "P")
        if key not in ("P0", "P1", "P2", "P3"):
            continue
        try:
            values = np.array([float(v) for v in rest.split()])
        except ValueError:
            raise CalibrationError(f"line {number} holds something that is not a number", where=path) from None
        if values.shape != (12,) or not np.isfinite(values).all():
            raise CalibrationError(f"line {number} holds {len(values)} numbers, expected 12 finite ones", where=path)
        found[key] = values.reshape(3, 4)
    return found


def read_kitti_calib(path: Path, *, left: int, right: int, size: tuple[int, int]) -> StereoRig:
    """The rectified pair of cameras ``left`` and ``right`` (0 and 1 grey, 2 and 3 colour) with images of ``size``.

    Raises
    ------
    CalibrationError
        Where a matrix is missing, the two do not share their intrinsics, or the baseline is impossible.
    """
    P = read_projections(path)
    for camera in (left, right):
        if f"P{camera}" not in P:
            raise CalibrationError(
                f"lacks the line 'P{camera}:'", where=path, cure="12 numbers, the 3x4 matrix row by row"
            )
    P_left, P_right = P[f"P{left}"], P[f"P{right}"]
    if not np.allclose(P_left[:, :3], P_right[:, :3], rtol=1e-6, atol=1e-3):
        raise CalibrationError(f"P{left} and P{right} differ in their intrinsics: not a rectified pair", where=path)
    fx, fy, cx, cy = P_left[0, 0], P_left[1, 1], P_left[0, 2], P_left[1, 2]
    if fx <= 1:
        raise CalibrationError(f"P{left} has focal length {fx:g} px", where=path)
    _check_centre(float(cx), float(cy), size, path)
    # Both matrices place their camera relative to camera 0; K^-1 p is the translation from it.
    K = P_left[:, :3]
    try:
        t_right_left = np.linalg.solve(K, P_right[:, 3] - P_left[:, 3])
    except np.linalg.LinAlgError:
        raise CalibrationError(f"P{left} is not a projection matrix", where=path) from None
    # Colour cameras carry millimetres in y and z as well; rectified rows absorb y, and z stays a small scale error.
    T_right_left = np.eye(4)
    T_right_left[0, 3] = t_right_left[0]
    if np.abs(t_right_left[1:]).max() > 0.05 * max(abs(t_right_left[0]), 1e-9):
        raise CalibrationError(f"P{left} and P{right} do not sit side by side", where=path)
    lens = PinholeRadtan(float(fx), float(fy), float(cx), float(cy), *size)
    return StereoRig(left=lens, right=lens, T_right_left=T_right_left, where=str(path))


def _check_centre(cx: float, cy: float, size: tuple[int, int], path: Path) -> None:
    """The file does not say its resolution; a principal point far from the middle tells that it is another."""
    width, height = size
    if not (0.3 < cx / width < 0.7 and 0.3 < cy / height < 0.7):
        raise CalibrationError(
            f"its principal point ({cx:.1f}, {cy:.1f}) is far from the middle of the {width}x{height} images",
            where=path,
            cure="is it the calibration of another resolution? Scale its first two rows as the images",
        )


def left_camera_offset(path: Path, left: int) -> Array:
    """(4, 4) camera 0, of which the poses are, from camera ``left``."""
    P = read_projections(path)
    T = np.eye(4)
    if left != 0 and "P0" in P:
        K = P[f"P{left}"][:, :3]
        T[:3, 3] = -np.linalg.solve(K, P[f"P{left}"][:, 3])
    return T
