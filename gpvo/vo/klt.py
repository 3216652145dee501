"""The fast front end: corners at half resolution, followed and matched left to right by Lucas-Kanade.

Whole-pixel corners dominate the error of a descriptor pipeline; here a corner only says which patch to follow, and
every position that enters the motion is the sub-pixel result of aligning that patch. Descriptors are the fallback
when the motion cannot be guessed.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, StereoCamera, StereoFrame, TrackFrame
from gpvo.vo import opencv
from gpvo.vo.config import VoConfig
from gpvo.vo.frontend import EMPTY, Matches, Observation
from gpvo.vo.image import image_stats
from gpvo.vo.motion import transfer
from gpvo.vo.opencv import Image, Points


@dataclass
class _View:
    """One observed pair and what was found in it."""

    left: Image
    right: Image
    half_left: Image
    half_right: Image
    survey: Future[tuple[Points, NDArray[np.float32]]]  # corners (N, 2) of the half image, disparity of a quarter one
    uvd: Array  # (N, 3) points usable as reference
    left_uv: Points  # (N, 2) their positions in the left image, the templates' centres


@dataclass(frozen=True)
class _New:
    """New corners of the current frame: how many were found, and those (N, 2) with their measurement (N, 3)."""

    detected: int
    left_uv: Points
    uvd: Array


_NO_POINTS: Points = np.empty((0, 2), np.float32)
_NONE_NEW = _New(0, _NO_POINTS, np.empty((0, 3)))


class KltFrontend:
    """See the module's text. One instance per run; not for use from several threads at once."""

    def __init__(self, camera: StereoCamera, config: VoConfig, mask: NDArray[np.bool_] | None = None) -> None:
        self._camera = camera
        self._config = config
        half = None if mask is None else mask[: camera.height // 2 * 2 : 2, : camera.width // 2 * 2 : 2]
        self._half_mask = None if half is None else np.ascontiguousarray(half.astype(np.uint8) * 255)
        self._reference: _View | None = None
        self._current: _View | None = None
        self._new = _NONE_NEW
        self._matched_left = _NO_POINTS
        self._matched_uvd: Array = np.empty((0, 3))
        self._pool = ThreadPoolExecutor(1)

    def observe(self, frame: StereoFrame | TrackFrame) -> Observation:
        """Take in a rectified pair."""
        assert isinstance(frame, StereoFrame)
        before = self._current
        half_left, half_right = opencv.halve(frame.left), opencv.halve(frame.right)
        # New corners and rough depth are wanted only after the motion; they are found beside it.
        survey = self._pool.submit(self._survey, half_left, half_right)
        self._current = _View(frame.left, frame.right, half_left, half_right, survey, np.empty((0, 3)), _NO_POINTS)
        # Comparing the small images first leaves the costly comparison to true repetitions.
        repeated = (
            before is not None
            and np.array_equal(before.half_left, half_left)
            and np.array_equal(before.left, frame.left)
            and np.array_equal(before.right, frame.right)
        )
        return Observation(image_stats(frame.left, half_left), bool(repeated))

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Follow the reference's points into the left image, then find each in the right one."""
        reference, current = self._reference, self._current
        if reference is None or current is None or len(reference.uvd) == 0:
            return EMPTY
        config = self._config
        uvd, left_uv, guess = reference.uvd, reference.left_uv, self._predict(T_prev_cur_guess)
        if from_scratch:
            chosen, uv = self._match_descriptors(reference, current)
            uvd, left_uv = uvd[chosen], left_uv[chosen]
            guess = np.column_stack([uv, uvd[:, 2]])
        cur_left, found = opencv.track(
            reference.left, current.left, left_uv, guess[:, :2], config.klt_window_px, config.klt_levels
        )
        uvd, cur_left, disparity = uvd[found], cur_left[found], guess[found, 2]
        # One search in the right image serves both the followed points and the new corners between them.
        new_uv, new_disparity = self._new_corners(current, cur_left)
        both_uv = np.concatenate([cur_left, new_uv])
        both_uvd, both_good = self._find_right(current, both_uv, np.concatenate([disparity, new_disparity]))
        n = len(cur_left)
        self._new = _New(len(new_uv), new_uv[both_good[n:]], both_uvd[n:][both_good[n:]])
        uvd_cur, good = both_uvd[:n], both_good[:n]
        self._matched_left, self._matched_uvd = cur_left[good], uvd_cur[good]
        return Matches(uvd[good], uvd_cur[good], int(found.sum()))

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """Carry on the inliers, and add new corners where there are none."""
        current = self._current
        assert current is not None
        if inliers is None:
            self._matched_left, self._matched_uvd = _NO_POINTS, np.empty((0, 3))
            new_uv, disparity = self._new_corners(current, _NO_POINTS)
            new_uvd, good = self._find_right(current, new_uv, disparity)
            self._new = _New(len(new_uv), new_uv[good], new_uvd[good])
            inliers = np.zeros(0, bool)
        uv, new = self._matched_left[inliers], self._new
        current.left_uv = np.concatenate([uv, new.left_uv])
        current.uvd = np.concatenate([self._matched_uvd[inliers], new.uvd])
        if len(current.uvd) >= at_least:
            self._reference = current
        self._matched_left, self._matched_uvd, self._new = _NO_POINTS, np.empty((0, 3)), _NONE_NEW
        return len(uv) + new.detected, len(current.uvd)

    def _predict(self, T_prev_cur: Array) -> Array:
        """(N, 3) where the guess puts the reference's points; the old place for those it puts out of sight."""
        assert self._reference is not None
        uvd = self._reference.uvd
        moved = transfer(T_prev_cur, uvd, self._camera)
        w, h = self._camera.width, self._camera.height
        u, v, d = moved.uvd
        visible = moved.in_front & (u >= 0) & (u < w) & (v >= 0) & (v < h) & (d < w)
        return np.where(visible[:, None], moved.uvd.T, uvd)

    def _survey(self, half_left: Image, half_right: Image) -> tuple[Points, NDArray[np.float32]]:
        """Corners of the half-size left image, strongest first, and disparity at a quarter of the size."""
        config = self._config
        limit = int(config.max_disparity_share * self._camera.width / 4)
        found = opencv.corners(
            half_left, config.max_features, config.corner_quality, config.min_distance_px / 2, self._half_mask
        )
        return found, opencv.coarse_disparity(opencv.halve(half_left), opencv.halve(half_right), limit)

    def _new_corners(self, view: _View, taken_uv: Points) -> tuple[Points, Array]:
        """Corners (N, 2) away from those taken, on even pixels of the full image, and their rough disparity (N,)."""
        corners, coarse = view.survey.result()
        uv = corners * 2.0
        if len(taken_uv) and len(uv):
            # Axis by axis in float32: a tenth of the time of a sum over the last axis.
            (x, y), (taken_x, taken_y) = uv.T, taken_uv.astype(np.float32).T
            distance2 = (x[:, None] - taken_x) ** 2 + (y[:, None] - taken_y) ** 2
            uv = uv[distance2.min(1) > self._config.min_distance_px**2]
        uv = uv[: self._config.max_features - len(taken_uv)]
        column, row = (uv / 4).astype(int).T
        near = coarse[np.clip(row, 0, coarse.shape[0] - 1), np.clip(column, 0, coarse.shape[1] - 1)]
        known = near >= 0
        # Where the block matcher saw nothing, the median of what it saw is the fairest start.
        default = np.median(near[known]) if known.any() else 2.0
        return uv, 4.0 * np.where(known, near, default)

    def _find_right(self, view: _View, uv_left: Points, disparity: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) measurements of left points, from a guessed disparity; and which of them can be believed."""
        config = self._config
        guess = np.column_stack([uv_left[:, 0] - disparity, uv_left[:, 1]])
        uv_right, found = opencv.track(view.left, view.right, uv_left, guess, config.klt_window_px, 2)
        d = uv_left[:, 0].astype(np.float64) - uv_right[:, 0]
        row_error = uv_right[:, 1].astype(np.float64) - uv_left[:, 1]
        uvd = np.column_stack([uv_left[:, 0], uv_left[:, 1] + 0.5 * row_error, d])
        good = found & (d >= config.min_disparity_px) & (d <= config.max_disparity_share * self._camera.width)
        return uvd, good & (np.abs(row_error) <= config.max_row_error_px)

    def _match_descriptors(self, reference: _View, current: _View) -> tuple[NDArray[np.int64], Points]:
        """Reference points (indices) and their places in the current left image, without any guess."""
        described = self._pool.submit(opencv.describe, reference.half_left, reference.left_uv / 2, quick=True)
        cur_uv, cur_bits = opencv.describe(current.half_left, current.survey.result()[0], quick=True)
        ref_uv, ref_bits = described.result()
        pairs = opencv.match_mutual(ref_bits, cur_bits)
        # AKAZE drops corners at the border, so the kept ones are found again by their place.
        place = {(round(float(x), 2), round(float(y), 2)): k for k, (x, y) in enumerate(reference.left_uv / 2)}
        index = np.array([place.get((round(float(x), 2), round(float(y), 2)), -1) for x, y in ref_uv], np.int64)
        pairs = pairs[index[pairs[:, 0]] >= 0] if len(pairs) else pairs
        return index[pairs[:, 0]], 2.0 * cur_uv[pairs[:, 1]]
