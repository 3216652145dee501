"""Lens masks: which pixels of a raw image show a picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import is_decodable
from gpvo.errors import CalibrationError


def read_mask(path: Path) -> NDArray[np.bool_]:
    """(H, W) bool, True where usable, from a black and white image.

    Both habits are in use, white for usable and white for masked out (OpenVINS); the middle of the image tells them
    apart, since no lens masks it.

    Raises
    ------
    CalibrationError
        Where the file is no image.
    """
    if not path.is_file():
        raise CalibrationError("no such mask image", where=path)
    raw = np.fromfile(path, dtype=np.uint8)
    image = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE) if is_decodable(raw.data) else None
    if image is None:
        raise CalibrationError("not readable as an image", where=path, cure="give the mask as PNG")
    white = image > 127
    h, w = white.shape
    middle = white[h // 2 - h // 8 : h // 2 + h // 8 + 1, w // 2 - w // 8 : w // 2 + w // 8 + 1]
    return white if middle.mean() >= 0.5 else ~white
