"""The only module of odometry that calls OpenCV, so that a move to another major version is one edit: its features, and
statistics of an image, by which two images are brought to equal brightness.

OpenCV 5 moved AKAZE out of the main wheel; gpvo stays on 4.x. Arrays are (N, 1, 2) float32 at this border because
both major versions accept nothing else everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Points = NDArray[np.floating[Any]]
# Lucas-Kanade compares grey values: it bears what two lenses differ by, not a tenth.
_SAME_LIGHT = 1.06
_WOVEN = 1.01  # times; 1 in nothing but noise
_NO_PICTURE = 2.0  # grey values of contrast


def as_mask(usable: NDArray[np.bool_] | None) -> Image | None:
    """Usable pixels (H, W) in the form that :func:`corners` and the descriptors take."""
    return None if usable is None else np.ascontiguousarray(usable.astype(np.uint8) * 255)


def halve(image: Image) -> Image:
    """Image of half the width and height, each pixel the mean of four: pixel i covers 2 i and 2 i + 1."""
    h, w = image.shape
    return cv2.resize(image[: h // 2 * 2, : w // 2 * 2], (w // 2, h // 2), interpolation=cv2.INTER_AREA)


def corners(image: Image, count: int, quality: float, min_distance_px: float, mask: Image | None) -> Points:
    """Shi-Tomasi corners (N, 2), strongest first."""
    found = cv2.goodFeaturesToTrack(image, count, quality, max(min_distance_px, 1.0), mask=mask)
    return np.empty((0, 2), np.float32) if found is None else found[:, 0]


def track(
    image_from: Image, image_to: Image, points: Points, guess: Points, window_px: int, levels: int
) -> tuple[Points, NDArray[np.bool_]]:
    """Pyramidal Lucas-Kanade from ``points`` (N, 2), starting at ``guess`` (N, 2): positions, and success.

    In noise it succeeds wherever it starts, and would confirm any guess.
    """
    if len(points) == 0:
        return np.empty((0, 2), np.float32), np.empty(0, bool)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        image_from,
        image_to,
        np.ascontiguousarray(points, np.float32)[:, None],
        np.ascontiguousarray(guess, np.float32)[:, None].copy(),
        winSize=(window_px, window_px),
        maxLevel=levels - 1,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW | cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,  # cheaper than the default measure
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.1),
        minEigThreshold=1e-4,
    )
    moved = moved[:, 0]
    h, w = image_to.shape
    inside = (moved[:, 0] >= 0) & (moved[:, 1] >= 0) & (moved[:, 0] <= w - 1) & (moved[:, 1] <= h - 1)
    return moved, (found[:, 0] > 0) & inside


def coarse_disparity(left: Image, right: Image, max_disparity_px: int) -> NDArray[np.float32]:
    """Block-matched disparity (H, W) of a small rectified pair [px]; negative where none was found."""
    count = int(np.ceil(max(max_disparity_px, 16) / 16)) * 16
    block_px = min(15, (min(left.shape) - 1) // 2 * 2 - 1)  # odd, and smaller than the image
    if block_px < 5:
        return np.full(left.shape, -1.0, np.float32)
    matcher = cv2.StereoBM.create(numDisparities=count, blockSize=block_px)
    matcher.setUniquenessRatio(5)
    matcher.setTextureThreshold(4)
    # The matcher leaves a strip of the width of its search on the left; extending the rows keeps those corners.
    wide = [cv2.copyMakeBorder(i, 0, 0, count, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
    return matcher.compute(*wide)[:, count:].astype(np.float32) / 16.0


def describe(image: Image, points: Points) -> tuple[Points, NDArray[np.uint8]]:
    """AKAZE descriptors at given corners: the corners that got one (N, 2), and the descriptors (N, 61).

    One octave and one layer: the bits that more would give at corners of that scale, at a quarter of the cost.
    The key point size must not be 1, which silently gives all-zero descriptors.
    """
    akaze = cv2.AKAZE.create(nOctaves=1, nOctaveLayers=1)
    keypoints = [cv2.KeyPoint(float(x), float(y), 8.0, -1, 0, 0, 0) for x, y in points]
    return _places(*akaze.compute(image, keypoints))


def features(image: Image, count: int, mask: Image | None) -> tuple[Points, NDArray[np.uint8]]:
    """The strongest AKAZE features at every scale of the image: places (N, 2) and descriptors (N, 61)."""
    # A low threshold: where there is little contrast, the strongest are still the best there is.
    return _places(*cv2.AKAZE.create(threshold=1e-4, max_points=count).detectAndCompute(image, mask))


def _places(keypoints: Sequence[Any], descriptors: Any) -> tuple[Points, NDArray[np.uint8]]:
    if descriptors is None:
        return np.empty((0, 2), np.float32), np.empty((0, 61), np.uint8)
    return np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2), descriptors


def match_mutual(a: NDArray[np.uint8], b: NDArray[np.uint8], ratio: float = 0.85) -> NDArray[np.int64]:
    """Brute-force Hamming matches (M, 2) that are each other's best and pass the ratio test."""
    if len(a) < 2 or len(b) < 2:
        return np.empty((0, 2), np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(a, b, k=2)
    backward = {m.queryIdx: m.trainIdx for m in matcher.match(b, a)}
    good = [
        (m.queryIdx, m.trainIdx)
        for m, second in (pair for pair in forward if len(pair) == 2)
        if m.distance < ratio * second.distance and backward.get(m.trainIdx) == m.queryIdx
    ]
    return np.array(good, np.int64).reshape(-1, 2)


def pose_from_points(
    points: NDArray[np.float64],
    uv: NDArray[np.float64],
    K: NDArray[np.float64],
    threshold_px: float,
    iterations: int,
    seed: int,
) -> NDArray[np.float64] | None:
    """P3P inside RANSAC: ``T_cam_points`` (4, 4), or None."""
    if len(points) < 4:
        return None
    cv2.setRNGSeed(seed)
    try:
        found, rvec, tvec, inliers = cv2.solvePnPRansac(
            np.ascontiguousarray(points, np.float64)[:, None],
            np.ascontiguousarray(uv, np.float64)[:, None],
            K,
            None,
            iterationsCount=iterations,
            reprojectionError=threshold_px,
            confidence=0.999,
            flags=cv2.SOLVEPNP_P3P,
        )
    except cv2.error:
        return None
    if not found or inliers is None or not np.isfinite(rvec).all() or not np.isfinite(tvec).all():
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rvec)[0]
    T[:3, 3] = tvec.ravel()
    return T


@dataclass(frozen=True)
class Light:
    """Mean and standard deviation of an image's grey values, 0..255, and where they come from: the half-size image."""

    mean: float
    std: float
    half: NDArray[np.uint8]

    @classmethod
    def of(cls, half: NDArray[np.uint8]) -> Light:
        """Of a half-size image (H, W)."""
        mean, std = cv2.meanStdDev(half)
        return cls(float(mean[0, 0]), float(std[0, 0]), half)

    def ratio(self, other: Light) -> float:
        """How many times brighter or fuller of contrast the other is; below 1 where it is darker or flatter.

        1 where the two are as alike as two cameras are, or where one holds no image.
        """
        if min(self.std, other.std) < _NO_PICTURE:
            return 1.0
        ratios = other.mean / max(self.mean, 1.0), other.std / self.std
        most = max(ratios, key=lambda x: abs(math.log(x)))
        return most if abs(math.log(most)) > math.log(_SAME_LIGHT) else 1.0

    def blur(self, other: Light) -> float:
        """How many times the other is more blurred along its rows, where disparity is; below 1 where it is sharper.

        By the differences between columns, in grey values or in units of contrast, whichever differ less: the light of
        two cameras may differ too. 1 where one holds no image.
        """
        if min(self.std, other.std) < _NO_PICTURE:
            return 1.0
        fine = [max(cv2.norm(a.half[::4, 2:], a.half[::4, :-2]), 1e-3) for a in (self, other)]
        ratio = fine[0] / fine[1]
        return float(min(ratio, ratio * other.std / self.std, key=lambda x: abs(math.log(x))))


def woven(image: NDArray[np.uint8]) -> bool:
    """Whether every second row is of another moment, as in interlaced video of a moving camera: then rows differ more
    from their neighbours than from the next but one, which neither texture nor noise does. Columns of a raw colour
    mosaic do so too."""

    def comb(a: NDArray[np.uint8]) -> float:
        """One for noise, less for any texture."""
        return cv2.norm(a[1:-1], a[:-2], cv2.NORM_L1) / max(cv2.norm(a[2:], a[:-2], cv2.NORM_L1), 1.0)

    return comb(image) > _WOVEN and comb(np.ascontiguousarray(image[: len(image) // 8].T)) < 1.0


def same_rows(image: NDArray[np.uint8], before: NDArray[np.uint8]) -> tuple[bool, NDArray[np.bool_]]:
    """Whether two images (H, W) are equal, and (H,) which rows are: of images that are not, those with a picture."""
    same = (image == before).all(axis=1)
    if same.all():
        return True, same
    same[same] = image[same].std(axis=1, dtype=np.float32) > _NO_PICTURE
    return False, same


def in_light_of(image: NDArray[np.uint8], own: Light, other: Light) -> NDArray[np.uint8]:
    """The image with the other's distribution of grey values where their light differs, else the image itself.

    Histogram matching by a table of 256 values: it undoes any change that keeps the order of grey values, such as
    exposure, gain and gamma (R. Gonzalez, R. Woods, "Digital Image Processing", section 3.3).
    """
    if own.ratio(other) == 1.0:
        return image
    share, wanted = (np.cumsum(np.bincount(a.half[::2, ::2].ravel(), minlength=256)) for a in (own, other))
    grey = np.interp(share / share[-1], wanted / wanted[-1], np.arange(256.0))
    return np.asarray(cv2.LUT(image, np.rint(grey).astype(np.uint8)), np.uint8)


@dataclass(frozen=True)
class ImageStats:
    """Grey values run from 0 to 1; ``sharpness`` is log10 of the variance of the Laplacian over 0..255."""

    brightness: float
    contrast: float
    sharpness: float
    noise_level: float


def image_stats(image: NDArray[np.uint8], light: Light) -> ImageStats:
    """Statistics of one grey image (H, W) of this light.

    Noise is taken from every third strip of rows at full resolution: averaging to half size would hide it.
    """
    _, laplacian_std = cv2.meanStdDev(cv2.Laplacian(light.half, cv2.CV_16S))
    rows = image.shape[0] // 3
    # Second difference of second differences: blind to planes and straight edges (J. Immerkaer, "Fast noise variance
    # estimation", 1996, eq. 2).
    response = cv2.Sobel(image[rows : 2 * rows], cv2.CV_16S, 2, 2, ksize=3)
    noise = math.sqrt(math.pi / 2) / 6.0 * float(cv2.norm(response, cv2.NORM_L1)) / max(response.size, 1)
    sharpness = math.log10(max(float(laplacian_std[0, 0]) ** 2, 1e-3))
    return ImageStats(light.mean / 255, light.std / 255, sharpness, noise / 255)
