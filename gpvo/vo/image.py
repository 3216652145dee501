"""Statistics of an image: brightness, contrast, sharpness, noise; and two images brought to equal brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Second difference of second differences: blind to planes and straight edges (J. Immerkaer, "Fast noise variance
# estimation", 1996, eq. 2).
_IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
# Lucas-Kanade compares grey values: it bears what two lenses differ by, not a tenth.
_SAME_LIGHT = 1.06
_NO_PICTURE = 2.0  # grey values of contrast


@dataclass(frozen=True)
class ImageStats:
    """Grey values run from 0 to 1; ``sharpness`` is log10 of the variance of the Laplacian over 0..255."""

    brightness: float
    contrast: float
    sharpness: float
    noise_level: float


def image_stats(image: NDArray[np.uint8], half: NDArray[np.uint8]) -> ImageStats:
    """Statistics of one grey image (H, W) and its half-size version.

    Noise is taken from every third strip of rows at full resolution: averaging to half size would hide it.
    """
    mean, std = cv2.meanStdDev(half)
    _, laplacian_std = cv2.meanStdDev(cv2.Laplacian(half, cv2.CV_16S))
    rows = image.shape[0] // 3
    response = cv2.filter2D(image[rows : 2 * rows], cv2.CV_16S, _IMMERKAER)
    noise = math.sqrt(math.pi / 2) / 6.0 * float(cv2.norm(response, cv2.NORM_L1)) / max(response.size, 1)
    return ImageStats(
        float(mean[0, 0]) / 255,
        float(std[0, 0]) / 255,
        math.log10(max(float(laplacian_std[0, 0]) ** 2, 1e-3)),
        noise / 255,
    )


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
