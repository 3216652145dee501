"""What an image says about itself: brightness, contrast, sharpness, noise."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

# Second difference of second differences: blind to planes and straight edges (J. Immerkaer, "Fast noise variance
# estimation", 1996, eq. 2).
_IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


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
