"""A contact sheet: a few pairs of a sequence in one picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError

_WIDTH_PX = 320


def contact_sheet(sequence: str | Path, out: str | Path, rows: int = 3, columns: int = 2) -> Path:
    """Write ``rows * columns`` pairs, left and right side by side and spread evenly over the sequence, as a PNG."""
    mav = Path(sequence) / "mav0"
    files = [sorted((mav / camera / "data").glob("*.png")) for camera in ("cam0", "cam1")]
    if not files[0]:
        raise GpvoError("holds no pictures", where=sequence)
    tiles = []
    for k in np.linspace(0, len(files[0]) - 1, rows * columns).astype(int):
        pair = [_read(side[k]) for side in files]
        small = [cv2.resize(p, (_WIDTH_PX, round(p.shape[0] * _WIDTH_PX / p.shape[1]))) for p in pair]
        tiles.append(np.pad(np.hstack(small), 2, constant_values=255))
    sheet = np.vstack([np.hstack(tiles[r * columns : (r + 1) * columns]) for r in range(rows)])
    target = Path(out)
    data = cv2.imencode(".png", sheet)[1].tobytes()
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    return target


def _read(file: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise GpvoError("is no picture", where=file)
    return np.asarray(image, np.uint8)
