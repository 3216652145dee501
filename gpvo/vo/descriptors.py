"""The thesis' front end: corners, AKAZE descriptors, brute-force matching left to right and to the previous frame."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, StereoCamera, StereoFrame, TrackFrame
from gpvo.vo import opencv
from gpvo.vo.config import VoConfig
from gpvo.vo.frontend import EMPTY, Matches, Observation
from gpvo.vo.image import image_stats
from gpvo.vo.rig_error import RigError


@dataclass(frozen=True)
class _Features:
    """Stereo-matched corners of one frame: ``uvd`` (N, 3), ``row_error`` (N,), ``bits`` (N, 61) of the left
    descriptors."""

    uvd: Array
    row_error: Array
    bits: NDArray[np.uint8]


class DescriptorFrontend:
    """Every frame is detected, described and matched afresh (D. Ross, thesis, chapter 2)."""

    def __init__(
        self, camera: StereoCamera, rig_error: RigError, config: VoConfig, mask: NDArray[np.bool_] | None = None
    ) -> None:
        self._camera = camera
        self._rig_error = rig_error
        self._config = config
        self._mask = None if mask is None else np.ascontiguousarray(mask.astype(np.uint8) * 255)
        self._reference: _Features | None = None
        self._current: _Features | None = None
        self._images: tuple[opencv.Image, opencv.Image] | None = None
        self._detected = 0
        self._pool = ThreadPoolExecutor(1)

    def observe(self, frame: StereoFrame | TrackFrame) -> Observation:
        """Detect, describe and match left to right."""
        assert isinstance(frame, StereoFrame)
        before, self._images = self._images, (frame.left, frame.right)
        right = self._pool.submit(self._features, frame.right)
        uv_left, bits_left = self._features(frame.left)
        uv_right, bits_right = right.result()
        pairs = opencv.match_mutual(bits_left, bits_right)
        left, bits = uv_left[pairs[:, 0]].astype(np.float64), bits_left[pairs[:, 0]]
        matched = uv_right[pairs[:, 1]].astype(np.float64)
        row_error = matched[:, 1] - left[:, 1]
        uvd = np.column_stack([left[:, 0], 0.5 * (left[:, 1] + matched[:, 1]), left[:, 0] - matched[:, 0]])
        config = self._config
        limit = config.max_disparity_share * self._camera.width
        good = self._rig_error.allows(uvd, row_error, config.min_disparity_px, limit, 2 * config.max_row_error_px)
        self._current = _Features(uvd[good], row_error[good], bits[good])
        self._detected = len(uv_left)
        left_same, right_same = (before is not None and np.array_equal(before[k], self._images[k]) for k in range(2))
        stats = image_stats(frame.left, opencv.halve(frame.left))
        return Observation(stats, left_same and right_same, right_same and not left_same)

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Match descriptors to the frame before; the guess is not used."""
        if self._reference is None or self._current is None:
            return EMPTY
        pairs = opencv.match_mutual(self._reference.bits, self._current.bits)
        i, j = pairs.T
        return Matches(self._reference.uvd[i], self._current.uvd[j], self._current.row_error[j], len(pairs))

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """See :class:`gpvo.vo.frontend.Frontend`."""
        assert self._current is not None
        if len(self._current.uvd) >= at_least:
            self._reference = self._current
        return self._detected, len(self._current.uvd)

    def _features(self, image: opencv.Image) -> tuple[opencv.Points, NDArray[np.uint8]]:
        config = self._config
        uv = opencv.corners(image, config.max_features, config.corner_quality, config.min_distance_px, self._mask)
        return opencv.describe(image, uv)
