"""Are left and right swapped? Points in front of both cameras lie further right in the left image."""

from __future__ import annotations

import cv2
import numpy as np

from gpvo.errors import SourceError
from gpvo.types import StereoFrame

_FEATURES = 600
# Exchanged images are rectified by the other lens' numbers: rows then differ by twice the pitch between the cameras.
_MAX_ROW_SHARE = 0.06
_MAX_ROW_SPREAD_PX = 3.0
_MIN_DISPARITY_PX = 1.0
_MAX_DISTANCE_BITS = 40
_MIN_MATCHES = 25
_MIN_RATIO = 5.0
_FRAMES = 5


class OrderCheck:
    """Looks at the first frames of a sequence until one shows the right order, or two show the wrong one.

    ``where``: the sequence, for the message.
    """

    def __init__(self, where: object) -> None:
        self._where = where
        self._left = _FRAMES
        self._swapped = 0

    def see(self, frame: StereoFrame) -> None:
        """Take the next rectified frame. Raises SourceError at the second frame whose points lie behind the cameras."""
        if self._left == 0:
            return
        self._left -= 1
        sign = disparity_sign(frame)
        if sign > 0:
            self._left = 0
        elif sign < 0:
            self._swapped += 1
        if self._swapped >= 2:
            raise SourceError(
                "left and right images are swapped: matched points have negative disparity",
                where=self._where,
                cure="exchange the two image folders or topics",
            )


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
