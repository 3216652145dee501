"""One call for a calibration file of any kind, and the kinds beside Kalibr's: OpenCV YAML with ``K1 D1 K2 D2 R T``,
as community files of the T265 come, ROS ``sensor_msgs/CameraInfo`` of a stereo pair, for raw or rectified images, and
KITTI odometry's ``calib.txt``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import calibration_text, get_numbers, make_lens, read_camchain, read_yaml
from gpvo.cameras.models import CameraModel, PinholeRadtan
from gpvo.cameras.rig import StereoRig, check_pose
from gpvo.errors import CalibrationError
from gpvo.geometry import se3
from gpvo.types import Array

_T265_SIZE = (848, 800)
SIDES = (
    ("left", "right"),
    ("cam0", "cam1"),
    ("fisheye1", "fisheye2"),
    ("infra1", "infra2"),
    ("camera0", "camera1"),
    ("camera_0", "camera_1"),
    ("cam_0", "cam_1"),
    ("camera1", "camera2"),
)
"""How drivers name the two cameras of one head."""
_ALIASES = {
    f"{other}{k}": f"{own}{k}"
    for other, own in (("M", "K"), ("cameraMatrix", "K"), ("distCoeffs", "D"))
    for k in (1, 2)
}
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
            raise CalibrationError("does not give the image size", where=path, cure="convert it to a camchain.yaml")
        return read_kitti_calib(path, 0, 1, size)
    document = read_yaml(path)
    if "cam0" in document or "cam1" in document:
        return read_camchain(path)
    if not {"K1", "M1", "cameraMatrix1"}.isdisjoint(document):
        return read_opencv_stereo(path, size=size)
    if "camera_matrix" in document:
        return _read_camera_infos(path)
    raise CalibrationError(
        "is neither a Kalibr camera chain (cam0, cam1), nor an OpenCV stereo file (K1, D1, K2, D2, R, T), nor ROS"
        " camera_info (camera_matrix, projection_matrix)",
        where=path,
    )


def find_calibration(*folders: Path) -> Path | None:
    """The calibration file in the first folder that has one; None where there is none."""
    found = (path for folder in folders for pattern in CALIBRATION_NAMES for path in sorted(folder.glob(pattern)))
    return next((path for path in found if path.is_file()), None)


def read_opencv_stereo(path: Path, *, size: tuple[int, int] | None = None) -> StereoRig:
    """The rig of an OpenCV stereo file: ``R``, ``T`` map points of the first camera to the second.

    ``K1`` and ``D1`` may be called ``M1`` or ``cameraMatrix1``, and ``distCoeffs1``. The lens is a fisheye where the
    file says ``model: fisheye``, radial-tangential where it says another or ``D1`` has five coefficients or more; four
    of no model are those of a fisheye if it is a T265's. ``size`` (width, height) where the file does not say. Raises
    CalibrationError where a key is missing, four coefficients may be either's, or the rig is impossible.
    """
    document = {_ALIASES.get(key, key): value for key, value in read_yaml(path).items()}
    R = np.reshape(get_numbers(document, "R", 9, path), (3, 3))
    T = se3.from_rt(R, np.array(get_numbers(document, "T", 3, path)))
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
        return _stated_size(document, path)
    if size is None:
        cure = "add the line 'resolution: [WIDTH, HEIGHT]' of your images"
        raise CalibrationError("does not give the image size", where=path, cure=cure)
    return size


def _stated_size(document: dict[str, Any], path: Path) -> tuple[int, int]:
    width, height = (int(get_numbers(document, key, 1, path)[0]) for key in ("image_width", "image_height"))
    return width, height


def _lens(document: dict[str, Any], index: str, size: tuple[int, int], path: Path) -> CameraModel:
    K = np.reshape(get_numbers(document, f"K{index}", 9, path), (3, 3))
    D = get_numbers(document, f"D{index}", (4, 5, 8, 12, 14), path)
    named = str(document.get("model", document.get("camera_model", document.get("distortion_model", "")))).lower()
    fisheye = any(word in named for word in ("fisheye", "equidistant", "kannala"))
    if not named and len(D) == 4 and any(D):
        # Nothing names the lens: only the T265's own size tells its fisheye from a radial-tangential lens.
        fisheye = size == _T265_SIZE
        if not fisheye:
            text = f"'D{index}' holds four coefficients, of a fisheye (cv2.fisheye) or a radial-tangential lens"
            raise CalibrationError(text, where=path, cure="add the line 'model: fisheye' or 'model: radtan'")
    model = "equidistant" if fisheye else "radtan"
    return make_lens(model, _of_matrix(K), D, size, path)


def _of_matrix(K: Array) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera or projection matrix."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


@dataclass(frozen=True)
class CameraInfo:
    """The fields of the message: ``K`` (3, 3), ``D`` (n,), ``R`` (3, 3), ``P`` (3, 4), size [px], all of the whole
    sensor; ``window``: its x, y, width and height [px] that images show, zeros for all; ``binning``: pixels of it in
    one of an image, along x and y."""

    width: int
    height: int
    distortion_model: str
    D: Array
    K: Array
    R: Array
    P: Array
    window: tuple[int, int, int, int] = (0, 0, 0, 0)
    binning: tuple[int, int] = (1, 1)

    def of_images(self, size: tuple[int, int]) -> CameraInfo:
        """That of images of ``size`` (width, height), without window and binning: as they say, unless the images are as
        large as the calibration, which some drivers state for the binned ones.

        Of a binned pixel the centre is the middle of those that it is made of, in images that were rectified after it
        as well (``sensor_msgs/CameraInfo``; image_geometry leaves out that half of a pixel).
        """
        x, y, width, height = self.window
        width, height = (
            (n or whole) // b for n, whole, b in zip((width, height), (self.width, self.height), self.binning)
        )
        whole = replace(self, window=(0, 0, 0, 0), binning=(1, 1))
        if size == (self.width, self.height):
            return whole
        bx, by = self.binning
        A = np.array([[1 / bx, 0, (0.5 - x) / bx - 0.5], [0, 1 / by, (0.5 - y) / by - 0.5], [0, 0, 1]])
        return replace(whole, width=width, height=height, K=A @ self.K, P=A @ self.P)


def _read_camera_infos(path: Path) -> StereoRig:
    """The rig of ROS camera_info YAML (``camera_calibration_parsers``) for raw images, a file per camera: ``path`` is
    either, ``left.yaml`` or ``right.yaml``, and the other lies beside it."""
    for left, right in SIDES:
        name = path.name.replace(right, left)
        if left in name:
            pair = [path.with_name(name), path.with_name(name.replace(left, right))]
            break
    else:
        cure = "name the files left.yaml and right.yaml"
        raise CalibrationError("is for one camera, and its name does not say which", where=path, cure=cure)
    for file in pair:
        if not file.is_file():
            raise CalibrationError(f"the other camera's file {file.name} is not beside it", where=path)
    return rig_from_camera_info(*(_read_camera_info(file) for file in pair), rectified=False, where=path)


def _read_camera_info(path: Path) -> CameraInfo:
    document = read_yaml(path)

    def matrix(name: str, rows: int, columns: int) -> Array:
        holder = document.get(name)
        if not isinstance(holder, dict):
            raise CalibrationError(f"lacks '{name}'", where=path, cure="give a ROS camera_info YAML")
        return np.reshape(get_numbers(holder, "data", rows * columns, path), (rows, columns))

    holder = document.get("distortion_coefficients")
    count = len(holder.get("data", ())) if isinstance(holder, dict) else 0
    return CameraInfo(
        *_stated_size(document, path),
        distortion_model=str(document.get("distortion_model", "plumb_bob")),
        D=matrix("distortion_coefficients", 1, count)[0],
        K=matrix("camera_matrix", 3, 3),
        R=matrix("rectification_matrix", 3, 3),
        P=matrix("projection_matrix", 3, 4),
    )


def rig_from_camera_info(left: CameraInfo, right: CameraInfo, *, rectified: bool, where: object = None) -> StereoRig:
    """The rig of two CameraInfo messages; ``rectified`` says that the images already are.

    The right camera's ``P[0, 3]`` is ``-fx' B``, and ``P[1, 3]`` that of one below the left one. For raw images the
    rectifying rotations ``R`` of both give their relative orientation: ``R_right_left = R_right^T R_left``. Raises
    CalibrationError where the cameras are uncalibrated (``K[0] == 0``), the baseline is absent or the rig impossible.
    """
    for name, info in (("left", left), ("right", right)):
        if 0 in (info.K[0, 0], info.P[0, 0], info.P[1, 1]):
            cure = "put a Kalibr camchain.yaml beside the bag"
            raise CalibrationError(f"the {name} CameraInfo is uncalibrated (K[0] or P[0] is 0)", where=where, cure=cure)
    places = [np.array([c.P[0, 3] / c.P[0, 0], c.P[1, 3] / c.P[1, 1], 0.0]) for c in (left, right)]
    place, text = places[1] - places[0], None if where is None else str(where)
    if rectified:
        lenses = [PinholeRadtan(*_of_matrix(c.P), c.width, c.height) for c in (left, right)]
        return StereoRig(lenses[0], lenses[1], se3.from_rt(np.eye(3), place), where=text)
    raw = [
        make_lens(c.distortion_model, _of_matrix(c.K), c.D.tolist(), (c.width, c.height), where) for c in (left, right)
    ]
    return StereoRig(raw[0], raw[1], se3.from_rt(right.R.T @ left.R, right.R.T @ place), where=text)


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


def read_kitti_calib(path: Path, left: int, right: int, size: tuple[int, int]) -> StereoRig:
    """The rectified pair of cameras ``left`` and ``right`` (0 and 1 grey, 2 and 3 colour) with images of ``size``.

    Raises CalibrationError where a matrix is missing, the two do not share their intrinsics, or the baseline is
    impossible.
    """
    P = read_projections(path)
    for camera in (left, right):
        if f"P{camera}" not in P:
            cure = "12 numbers, the 3x4 matrix row by row"
            raise CalibrationError(f"lacks the line 'P{camera}:'", where=path, cure=cure)
    P_left, P_right = P[f"P{left}"], P[f"P{right}"]
    if not np.allclose(P_left[:, :3], P_right[:, :3], rtol=1e-6, atol=1e-3):
        raise CalibrationError(f"P{left} and P{right} differ in their intrinsics: not a rectified pair", where=path)
    number = r"\s+(\d+(?:\.\d+)?(?:e\+?\d\d?)?)"
    rectified = re.search(rf"^S_rect_0{left}:{number}{number}", calibration_text(path), re.MULTILINE)
    if rectified and (stated := (round(float(rectified[1])), round(float(rectified[2])))) != size:
        text = f"is for rectified images of {stated[0]}x{stated[1]}, not {size[0]}x{size[1]}"
        raise CalibrationError(text, where=path, cure="take the drive's rectified images (_sync)")
    lens = PinholeRadtan(*_of_matrix(P_left), *size)
    if lens.fx_px <= 1:
        raise CalibrationError(f"P{left} has focal length {lens.fx_px:g} px", where=path)
    # The file does not say its resolution; a principal point far from the middle tells that it is another.
    if not (0.3 < lens.cx_px / lens.width < 0.7 and 0.3 < lens.cy_px / lens.height < 0.7):
        raise CalibrationError(
            f"its principal point ({lens.cx_px:.1f}, {lens.cy_px:.1f}) is far from the middle of the"
            f" {lens.width}x{lens.height} images",
            where=path,
            cure="is it the calibration of another resolution? Scale its first two rows like the images",
        )
    # Both matrices place their camera relative to camera 0; K^-1 p is the translation from it.
    try:
        t_right_left = np.linalg.solve(P_left[:, :3], P_right[:, 3] - P_left[:, 3])
    except np.linalg.LinAlgError:
        raise CalibrationError(f"P{left} is not a projection matrix", where=path) from None
    # Colour cameras carry millimetres in y and z as well; rectified rows absorb y, and z stays a small scale error.
    if np.abs(t_right_left[1:]).max() > 0.05 * max(abs(t_right_left[0]), 1e-9):
        raise CalibrationError(f"P{left} and P{right} do not sit side by side", where=path)
    T_right_left = se3.from_rt(np.eye(3), np.array([t_right_left[0], 0.0, 0.0]))
    return StereoRig(left=lens, right=lens, T_right_left=T_right_left, where=str(path))


def left_camera_offset(path: Path, left: int) -> Array:
    """(4, 4) camera 0, of which the poses are, from camera ``left``."""
    P = read_projections(path)
    if left == 0 or "P0" not in P:
        return np.eye(4)
    P_left = P[f"P{left}"]
    return se3.from_rt(np.eye(3), np.asarray(-np.linalg.solve(P_left[:, :3], P_left[:, 3])))
