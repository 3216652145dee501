"""From two raw lenses to a virtual pinhole pair with aligned rows; and masks of the pixels that show anything."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import decoded, is_plausible
from gpvo.cameras.models import CameraModel, KannalaBrandt
from gpvo.cameras.rig import StereoRig, mean_view
from gpvo.errors import CalibrationError
from gpvo.geometry import se3
from gpvo.types import Array, Mounting, StereoCamera

# A flat image stretches a fisheye's border by 1 / cos^2: three times at 55 degrees, four at 60.
MAX_DEFAULT_HALF_ANGLE_RAD = np.deg2rad(57.0)
# Bilinear sampling needs a whole neighbour; the outermost pixel of a lens image is often blank.
_BORDER_PX = 1.5
_BLOCK_PX = 1 << 21  # Maps are made of so many pixels at once: the arithmetic takes a hundred bytes for each.

_Map = tuple[NDArray[np.int16], NDArray[np.uint16]]


class Rectifier:
    """Maps raw stereo pairs to the virtual pair :attr:`camera`.

    Raises CalibrationError where the asked field of view or size is not possible, or shows almost nothing.

    Parameters
    ----------
    rig : the calibrated rig.
    hfov_deg : horizontal field of view of the virtual camera [deg]; by default the focal length is that of the
        lens, so that pixels keep their density at the centre, and the size that of the image, for a fisheye at most
        114 degrees wide and high.
    size : (width, height) of the virtual images [px]; by default that of the raw left ones, turned with them where one
        camera sits above the other.

    Attributes
    ----------
    camera : StereoCamera of the rectified pair.
    mask : (H, W) bool, True where the rectified left image holds pixels of the raw one; None where it does everywhere.
    mask_right : the same of the right image.
    R_rect_left : (3, 3), left camera axes to rectified axes.
    mounting : where the rectified left camera sits.
    """

    def __init__(self, rig: StereoRig, *, hfov_deg: float | None = None, size: tuple[int, int] | None = None) -> None:
        self.rig = rig
        self.is_identity = rig.is_rectified and hfov_deg is None and size is None
        if self.is_identity:
            self.R_rect_left = self.R_rect_right = np.eye(3)
            a = rig.left
            self.camera = StereoCamera(a.fx_px, a.fy_px, a.cx_px, a.cy_px, rig.baseline_m, a.width, a.height)
            self._maps: list[_Map] = []
            seen = [rig.mask_left, rig.mask_right]
        else:
            self.R_rect_left, self.R_rect_right = rectifying_rotations(rig.T_right_left)
            self.camera = self._virtual_camera(hfov_deg, size)
            self._maps, seen = self._make_maps()
        self.mounting = Mounting(T_body_cam=self._place(rig.T_body_left), T_imu_cam=self._place(rig.T_imu_left))
        self.mask, self.mask_right = (self._mask_or_none(m) for m in seen)

    @property
    def T_left_cam(self) -> Array:
        """(4, 4) rectified left camera to raw left camera: a pure rotation."""
        return se3.from_rt(self.R_rect_left.T, np.zeros(3))

    def apply(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Rectify one pair of (H, W) uint8 images."""
        if self.is_identity:
            return left, right
        left, right = (
            np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT), dtype=np.uint8)
            for image, maps in zip((left, right), self._maps)
        )
        return left, right

    def _place(self, T_x_left: Array | None) -> Array | None:
        return None if T_x_left is None else T_x_left @ self.T_left_cam

    def _virtual_camera(self, hfov_deg: float | None, size: tuple[int, int] | None) -> StereoCamera:
        lenses = (self.rig.left, self.rig.right)
        left = self.rig.left
        f = float(np.mean([[c.fx_px, c.fy_px] for c in lenses] * np.array([[1.0], [self.rig.resolution]])))
        width, height = (left.height, left.width) if self.rig.is_upright else (left.width, left.height)
        width, height = size or (width, height)
        if min(width, height) < 16 or not is_plausible((width, height)):
            raise CalibrationError(f"rectified size {width}x{height} is not possible", where=self.rig.where)
        if hfov_deg is not None:
            if not 5.0 <= hfov_deg <= 160.0:
                cure = "choose a field of view from 5 to 160 degrees, 90 to 115 for a fisheye"
                text = f"a pinhole image of {hfov_deg:g} degrees is not possible"
                raise CalibrationError(text, where=self.rig.where, cure=cure)
            f = 0.5 * width / np.tan(0.5 * np.deg2rad(hfov_deg))
        elif size is None and isinstance(left, KannalaBrandt):
            limit = 2 * int(f * np.tan(MAX_DEFAULT_HALF_ANGLE_RAD))
            width, height = min(width, limit), min(height, limit)
        cx, cy = self._principal_point(f, width, height)
        return StereoCamera(f, f, cx, cy, self.rig.baseline_m, width, height)

    def _principal_point(self, f: float, width: int, height: int) -> tuple[float, float]:
        """Where the optical axis goes so that the middles of both raw images meet the middle of the virtual one."""
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        offsets = []
        for lens, R in ((self.rig.left, self.R_rect_left), (self.rig.right, self.R_rect_right)):
            ray = R @ lens.unproject(np.array([[(lens.width - 1) / 2, (lens.height - 1) / 2]]))[0]
            if np.isfinite(ray).all() and ray[2] > 0.2:
                offsets.append(f * ray[:2] / ray[2])
        shift = np.mean(offsets, axis=0) if offsets else np.zeros(2)
        cx, cy = centre - shift
        return float(cx), float(cy)

    def _make_maps(self) -> tuple[list[_Map], list[NDArray[np.bool_] | None]]:
        maps: list[_Map] = []
        seen: list[NDArray[np.bool_] | None] = []
        step = max(_BLOCK_PX // self.camera.width, 1)
        for lens, R, mask in (
            (self.rig.left, self.R_rect_left, self.rig.mask_left),
            (self.rig.right, self.R_rect_right, self.rig.mask_right),
        ):
            blocks = (slice(top, top + step) for top in range(0, self.camera.height, step))
            xy, fraction, inside = zip(*(self._map_of(lens, R, mask, rows) for rows in blocks))
            maps.append((np.concatenate(xy), np.concatenate(fraction)))
            seen.append(np.concatenate(inside))
        return maps, seen

    def _map_of(
        self, lens: CameraModel, R: Array, mask: NDArray[np.bool_] | None, rows: slice
    ) -> tuple[NDArray[np.int16], NDArray[np.uint16], NDArray[np.bool_]]:
        """The map of some rows, and which of their pixels show anything."""
        c = self.camera
        u, v = np.meshgrid(np.arange(c.width), np.arange(c.height)[rows])
        rays = np.stack([(u - c.cx_px) / c.fx_px, (v - c.cy_px) / c.fy_px, np.ones(u.shape)], axis=-1)
        uv, valid = lens.project(rays.reshape(-1, 3) @ R)
        uv = np.where(valid[:, None], uv, -10.0).reshape(*u.shape, 2)
        x, y = uv[..., 0], uv[..., 1]
        inside = (x >= _BORDER_PX) & (x <= lens.width - 1 - _BORDER_PX)
        inside &= (y >= _BORDER_PX) & (y <= lens.height - 1 - _BORDER_PX)
        if mask is not None:
            nearest = np.rint(np.where(inside[..., None], uv, 0.0)).astype(np.intp)
            inside &= mask[nearest[..., 1], nearest[..., 0]]
        # 16-bit fixed point: 1/32 px steps, half the memory traffic of floats.
        clipped = np.clip(uv, -100.0, 32000.0).astype(np.float32)
        xy, fraction = cv2.convertMaps(clipped[..., 0], clipped[..., 1], cv2.CV_16SC2)
        return np.asarray(xy, np.int16), np.asarray(fraction, np.uint16), inside

    def _mask_or_none(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        if mask is not None and mask.mean() < 0.02:
            raise CalibrationError("almost no raw pixel falls into the rectified images", where=self.rig.where)
        return None if mask is None or mask.all() else mask


def rectifying_rotations(T_right_left: Array) -> tuple[Array, Array]:
    """Rotations (3, 3) of left and right camera axes into common axes with x along the baseline.

    The common orientation is the mean of the two; only its yaw and roll are then turned onto the baseline, so that
    the view changes as little as possible (A. Fusiello et al., 2000, with the mean in place of the old left axis).
    """
    half, x = mean_view(T_right_left)
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    R_rect_mean = np.stack([x, y, np.cross(x, y)])
    return R_rect_mean @ half, R_rect_mean @ half.T


def read_size(text: str) -> tuple[int, int]:
    """Width and height [px] of a text such as 640x480. Raises CalibrationError if it is something else."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise CalibrationError(f"the size is '{text}'", cure="give WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) bool, True where usable, from a black and white image.

    Both habits are in use, white for usable and white for masked out (OpenVINS); the middle of the image tells them
    apart, since no lens masks it. Raises CalibrationError where the file is no image.
    """
    if not path.is_file():
        raise CalibrationError("no such mask image", where=path)
    raw = np.fromfile(path, dtype=np.uint8)
    image = decoded(raw, grey=True)
    if image is None:
        raise CalibrationError("not readable as an image", where=path, cure="give the mask as PNG")
    white = image > 127
    h, w = white.shape
    middle = white[h // 2 - h // 8 : h // 2 + h // 8 + 1, w // 2 - w // 8 : w // 2 + w // 8 + 1]
    return white if middle.mean() >= 0.5 else ~white
