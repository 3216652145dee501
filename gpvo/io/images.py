"""Decoding images to 8 bit grey, and sequences of image pairs that lie in files; whether left and right are swapped."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import decoded, image_size
from gpvo.cameras.models import CameraModel
from gpvo.cameras.rectify import Rectifier, read_mask
from gpvo.cameras.rig import LONG_BASELINE_M, StereoRig
from gpvo.errors import CalibrationError, SourceError
from gpvo.io.source import Depth, SourceReport
from gpvo.io.stamps import check_interval, in_order, usual_interval
from gpvo.parallel import prefetched
from gpvo.types import ImuLog, Mounting, StereoCamera, StereoFrame, TruthLog

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_TO_GREY = {True: (cv2.COLOR_BGR2GRAY, cv2.COLOR_BGRA2GRAY), False: (cv2.COLOR_RGB2GRAY, cv2.COLOR_RGBA2GRAY)}
_MAX_IMAGE_BYTES = 500_000_000
_MAX_HEAD_BYTES = 1 << 20  # Thumbnails and colour profiles stand before the size.
# Are left and right swapped? Points in front of both cameras lie further right in the left image.
_FEATURES = 600
# Exchanged images are rectified by the other lens' numbers: rows then differ by twice the pitch between the cameras.
_MAX_ROW_SHARE = 0.06
_MAX_ROW_SPREAD_PX = 3.0
_MIN_DISPARITY_PX = 1.0
_MAX_DISTANCE_BITS = 40
_MIN_MATCHES = 25
_MIN_RATIO = 5.0
_FRAMES = 5
# A mosaic of a colour filter repeats every two pixels along both axes.
_TILE_PX = 32
_ALTERNATES = 0.25
_MOSAIC = "the images are the raw mosaic of a colour filter: smoothed over it; demosaic them for sharper ones"

SWAPPED = "left and right images are swapped: matched points have negative disparity"
"""What is said of a sequence that an OrderCheck refuses."""
Image8 = NDArray[np.uint8]


def to_grey8(image: NDArray[Any], *, bgr: bool = True, depth: Depth | None = None) -> Image8 | None:
    """(H, W) uint8 from a grey or colour image of 8 or 16 bit; None for other samples, which ``depth`` is told."""
    if image.dtype not in (np.uint8, np.uint16):
        if depth is not None:
            depth.refused = f"its samples are {image.dtype}, of no known range: save the images as 8 or 16 bit"
        return None
    if image.ndim == 3:
        channels = image.shape[2]
        if channels == 1:
            image = image[:, :, 0]
        else:
            of_three, of_four = _TO_GREY[bgr]
            image = np.asarray(cv2.cvtColor(image, of_three if channels == 3 else of_four))
    if image.dtype == np.uint16:
        return (depth or Depth()).to8(image)
    return np.ascontiguousarray(image, dtype=np.uint8)


def read_grey8(path: Path, depth: Depth | None = None) -> Image8 | None:
    """An image file as (H, W) uint8; None where it is missing, damaged or no image."""
    try:
        if not 0 < path.stat().st_size <= _MAX_IMAGE_BYTES:
            return None
        raw = np.fromfile(path, dtype=np.uint8)
    except OSError:
        return None
    image = decoded(raw)
    return None if image is None else to_grey8(image, depth=depth)


@dataclass(frozen=True)
class PairFiles:
    """One stereo pair on disk: its stamp and both files."""

    t_ns: int
    left: Path
    right: Path


class ImageSource(ABC):
    """Base of all sources of images: guards the stamps, decodes ahead, rectifies and counts what is wrong.

    A subclass passes the rig and what lies beside it, and gives the raw pairs by :meth:`raw_pairs`.
    """

    kind: Literal["images", "tracks"] = "images"
    format = "images"

    def __init__(
        self,
        path: Path,
        name: str,
        rig: StereoRig,
        *,
        known: SourceReport | None = None,
        hfov_deg: float | None = None,
        size: tuple[int, int] | None = None,
        mask_left: str | Path | None = None,
        mask_right: str | Path | None = None,
        bits: int = 16,
        prefetch: bool = True,
    ) -> None:
        self.depth, self._prefetch = Depth(bits), prefetch
        if mask_left is not None or mask_right is not None:
            left, right = (None if m is None else read_mask(Path(m)) for m in (mask_left, mask_right))
            rig = rig.with_masks(left, right)
        self.path, self.name, self.rig = path, name, rig
        self.rectifier = Rectifier(rig, hfov_deg=hfov_deg, size=size)
        self.camera: StereoCamera = self.rectifier.camera
        self.mask: NDArray[np.bool_] | None = self.rectifier.mask
        self.mounting: Mounting = self.rectifier.mounting
        self.imu: ImuLog | None = None
        self.truth: TruthLog | None = None
        self.known = SourceReport() if known is None else known
        if rig.baseline_m > LONG_BASELINE_M:
            self.known.note(f"baseline {rig.baseline_m:.2f} m: are the translations in metres?")
        if rig.is_upright:
            turned = "images, and axes of motions, are turned by a quarter"
            self.known.note(f"the calibration places one camera above the other: {turned}")
        self.report = self._fresh_report()
        R_rect_left = self.rectifier.R_rect_left.tolist()
        self.calibration: dict[str, Any] | None = {**rig.describe(), "R_rect_left": R_rect_left}
        self.span_ns: tuple[int, int] = (0, 0)
        self.usual_interval_ns: float | None = None

    @abstractmethod
    def raw_pairs(self, report: SourceReport) -> Iterator[tuple[int, Image8 | None, Image8 | None]]:
        """Stamps [ns] with decoded raw images, None for an image that is not readable."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of pairs."""

    def __iter__(self) -> Iterator[StereoFrame]:
        self.report, self.depth.span = self._fresh_report(), None
        frames = self._frames(self.report)
        return prefetched(frames) if self._prefetch else frames

    def remark(self, text: str) -> None:
        """Add a remark to this and every later report."""
        self.known.note(text)
        self.report.note(text)

    def _fresh_report(self) -> SourceReport:
        """A report with what was already known when the source was opened."""
        return replace(self.known, notes=list(self.known.notes))

    def _frames(self, report: SourceReport) -> Iterator[StereoFrame]:
        order, mosaic = OrderCheck(), False
        for raw in in_order(self._readable(report), report, self.usual_interval_ns):
            report.frames += 1
            left, right = raw.left, raw.right
            mosaic = mosaic or (report.frames <= _FRAMES and is_mosaic(left))
            if mosaic:
                report.note(_MOSAIC)
                left, right = smooth_mosaic(left), smooth_mosaic(right)
            frame = StereoFrame(raw.t_ns, *self.rectifier.apply(left, right))
            if order.is_swapped(frame):
                raise SourceError(SWAPPED, where=self.path, cure="exchange the two image folders or topics")
            yield frame
        if doubt := self.depth.doubt():
            report.note(doubt)

    def _readable(self, report: SourceReport) -> Iterator[StereoFrame]:
        """The pairs that can be used, as they are. Raises SourceError at the end where there was none."""
        problem, is_any_good = "no readable image pair", False
        for t_ns, left, right in self.raw_pairs(report):
            if left is None or right is None:
                report.count("unreadable", f"unreadable image at {t_ns} ns")
            elif [left.shape, right.shape] != [(c.height, c.width) for c in (self.rig.left, self.rig.right)]:
                report.count("unreadable", f"image of another size at {t_ns} ns")
                sizes = " and ".join(f"{w}x{h}" for h, w in (left.shape, right.shape))
                problem = f"no image pair has the size of its calibration: the last is {sizes}"
            else:
                is_any_good = True
                yield StereoFrame(t_ns, left, right)
        if not is_any_good:
            raise SourceError(problem, where=self.path, cure=self.depth.refused or None)


class FileSource(ImageSource):
    """Image pairs in files, known beforehand."""

    def __init__(
        self, path: Path, name: str, rig: StereoRig, pairs: Sequence[PairFiles], known: SourceReport, **options: Any
    ) -> None:
        if not pairs:
            raise SourceError("holds no image pair with equal stamps", where=path)
        check_interval([p.t_ns for p in pairs], path, lambda _: "names and lists hold nanoseconds, times.txt seconds")
        super().__init__(path, name, rig, known=known, **options)
        self._pairs = pairs
        self.span_ns = (min(p.t_ns for p in pairs), max(p.t_ns for p in pairs))
        self.usual_interval_ns = usual_interval(p.t_ns for p in pairs)
        for side, lens in (("left", rig.left), ("right", rig.right)):
            if (first := first_size(pairs, side)) is not None:
                check_size("the image is", first[1], lens, first[0], f" ({rig.where})" if rig.where else "")

    def __len__(self) -> int:
        return len(self._pairs)

    def raw_pairs(self, report: SourceReport) -> Iterator[tuple[int, Image8 | None, Image8 | None]]:
        """Decode pair by pair; a file that is not there counts as missing."""
        for pair in self._pairs:
            absent = [p for p in (pair.left, pair.right) if not p.is_file()]
            if absent:
                report.count("missing", f"missing {absent[0].parent.name}/{absent[0].name}")
                continue
            yield pair.t_ns, read_grey8(pair.left, self.depth), read_grey8(pair.right, self.depth)


def first_size(pairs: Sequence[PairFiles], side: str) -> tuple[Path, tuple[int, int]] | None:
    """File and (width, height) of the first readable image of a camera, ``left`` or ``right``, by its header."""
    for path in (getattr(pair, side) for pair in pairs):
        with suppress(OSError), path.open("rb") as file:
            if (size := image_size(file.read(_MAX_HEAD_BYTES))) is not None:
                return path, size
    return None


def check_size(images: str, size: tuple[int, int], lens: CameraModel, where: object, source: str = "") -> None:
    """Refuse a lens calibrated at another (width, height) than that of ``images``; ``source``: of the calibration.

    Raises CalibrationError, naming both resolutions.
    """
    if size != (lens.width, lens.height):
        text = f"{images} {size[0]}x{size[1]}, the calibration is for {lens.width}x{lens.height}{source}"
        cure = "use the calibration of this resolution, or scale its intrinsics"
        raise CalibrationError(text, where=where, cure=cure)


class OrderCheck:
    """Whether left and right are swapped, by the first frames: one that shows the right order settles it, and so does
    the second whose points lie behind the cameras."""

    def __init__(self) -> None:
        self._unclear, self._swapped = _FRAMES, 0

    def is_swapped(self, frame: StereoFrame) -> bool:
        """Judge the next frame; True from where it is settled that they are."""
        if self._unclear and self._swapped < 2:
            sign = disparity_sign(frame)
            self._unclear = 0 if sign > 0 else self._unclear - 1
            self._swapped += sign < 0
        return self._swapped >= 2


def is_mosaic(image: Image8) -> bool:
    """Whether grey values (H, W) alternate from pixel to pixel along rows and columns in most parts of the image, as in
    the raw mosaic of a colour filter: green lies on every second pixel. Hardly any texture, and no noise, does so.

    That component is what second differences along both axes have in common with a chequerboard.
    """
    h, w = (n // _TILE_PX * _TILE_PX for n in image.shape)
    if min(h, w) == 0:
        return False
    second = np.array([1.0, -2.0, 1.0], np.float32) / 4
    rough = cv2.sepFilter2D(image[:h, :w], cv2.CV_32F, second, second)
    rough[::2, 1::2] *= -1
    rough[1::2, ::2] *= -1
    tiles = cv2.resize(rough, (w // _TILE_PX, h // _TILE_PX), interpolation=cv2.INTER_AREA)
    return bool(np.median(np.abs(tiles)) > _ALTERNATES * max(cv2.norm(rough) / np.sqrt(rough.size), 4.0))


def smooth_mosaic(image: Image8) -> Image8:
    """The image (H, W) without what repeats every two pixels, whatever the pattern of the filter."""
    mean = np.array([1.0, 2.0, 1.0], np.float32) / 4
    return np.asarray(cv2.sepFilter2D(image, -1, mean, mean), np.uint8)


def disparity_sign(frame: StereoFrame) -> int:
    """+1 or -1 where nearly all matches of a rectified frame have a disparity of that sign, else 0."""
    orb = cv2.ORB.create(nfeatures=_FEATURES)
    key_l, des_l = orb.detectAndCompute(frame.left, None)
    key_r, des_r = orb.detectAndCompute(frame.right, None)
    if des_l is None or des_r is None or len(key_l) < _MIN_MATCHES or len(key_r) < _MIN_MATCHES:
        return 0
    uv_l, uv_r = (np.array([k.pt for k in keys]) for keys in (key_l, key_r))
    bits_l, bits_r = (np.unpackbits(d, axis=1).astype(np.float32) for d in (des_l, des_r))
    # Hamming distance of bit vectors as inner products; other rows are out of reach.
    distance = bits_l.sum(1)[:, None] + bits_r.sum(1)[None, :] - 2.0 * bits_l @ bits_r.T
    distance[np.abs(uv_l[:, None, 1] - uv_r[None, :, 1]) > _MAX_ROW_SHARE * frame.left.shape[0]] = np.inf
    best_r, best_l = distance.argmin(axis=1), distance.argmin(axis=0)
    own = np.arange(len(uv_l))
    mutual = (best_l[best_r] == own) & (distance[own, best_r] < _MAX_DISTANCE_BITS)
    shift = uv_l[mutual] - uv_r[best_r[mutual]]
    if len(shift) < _MIN_MATCHES:
        return 0
    d = shift[np.abs(shift[:, 1] - np.median(shift[:, 1])) < _MAX_ROW_SPREAD_PX, 0]
    front, behind = int((d > _MIN_DISPARITY_PX).sum()), int((d < -_MIN_DISPARITY_PX).sum())
    if front >= _MIN_MATCHES and front > _MIN_RATIO * behind:
        return 1
    if behind >= _MIN_MATCHES and behind > _MIN_RATIO * front:
        return -1
    return 0
