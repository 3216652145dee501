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


class KltFrontend:
    """See the module's text. One instance per run; not for use from several threads at once."""

    def __init__(self, camera: StereoCamera, config: VoConfig, mask: NDArray[np.bool_] | None = None) -> None:
        self._camera = camera
        self._config = config
        half = None if mask is None else mask[: camera.height // 2 * 2 : 2, : camera.width // 2 * 2 : 2]
        self._half_mask = None if half is None else np.ascontiguousarray(half.astype(np.uint8) * 255)
        self._reference: _View | None = None
        self._current: _View | None = None
        self._matched_left: Points = np.empty((0, 2), np.float32)
        self._matched_uvd: Array = np.empty((0, 3))
        self._pool = ThreadPoolExecutor(1)

    def observe(self, frame: StereoFrame | TrackFrame) -> Observation:
        """Take in a rectified pair."""
        assert isinstance(frame, StereoFrame)
        before = self._current
        half_left, half_right = opencv.halve(frame.left), opencv.halve(frame.right)
        # New corners and rough depth are wanted only after the motion; they are found beside it.
        survey = self._pool.submit(self._survey, half_left, half_right)
        self._current = _View(
            frame.left, frame.right, half_left, half_right, survey, np.empty((0, 3)), np.empty((0, 2), np.float32)
        )
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
        uvd_cur, good = self._find_right(current, cur_left, disparity)
        self._matched_left, self._matched_uvd = cur_left[good], uvd_cur[good]
        return Matches(uvd[good], uvd_cur[good], int(found.sum()))

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """Carry on the inliers, and add new corners where there are none."""
        current = self._current
        assert current is not None
        carried = np.zeros(len(self._matched_uvd), bool) if inliers is None else inliers
        uv, uvd = self._matched_left[carried], self._matched_uvd[carried]
        new_uv = self._new_corners(current, uv)
        new_uvd, good = self._new_stereo(current, new_uv)
        current.left_uv = np.concatenate([uv, new_uv[good]])
        current.uvd = np.concatenate([uvd, new_uvd[good]])
        if len(current.uvd) >= at_least:
            self._reference = current
        self._matched_left, self._matched_uvd = np.empty((0, 2), np.float32), np.empty((0, 3))
        return len(uv) + len(new_uv), len(current.uvd)

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

    def _new_corners(self, view: _View, taken_uv: Points) -> Points:
        """Corners (N, 2) away from those taken, on even pixels of the full image."""
        room = self._config.max_features - len(taken_uv)
        found = view.survey.result()[0] * 2.0
        if len(taken_uv) == 0 or len(found) == 0:
            return found[:room]
        distance2 = ((found[:, None] - taken_uv[None]) ** 2).sum(-1).min(1)
        return found[distance2 > self._config.min_distance_px**2][:room]

    def _new_stereo(self, view: _View, uv: Points) -> tuple[Array, NDArray[np.bool_]]:
        """Stereo measurement of new corners: the rough disparity starts Lucas-Kanade at full resolution."""
        if len(uv) == 0:
            return np.empty((0, 3)), np.empty(0, bool)
        coarse = view.survey.result()[1]
        x, y = (uv / 4).astype(int).T
        near = coarse[np.clip(y, 0, coarse.shape[0] - 1), np.clip(x, 0, coarse.shape[1] - 1)]
        known = near >= 0
        # Where the block matcher saw nothing, the median of what it saw is the fairest start.
        default = np.median(near[known]) if known.any() else 2.0
        return self._find_right(view, uv, 4.0 * np.where(known, near, default))

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
