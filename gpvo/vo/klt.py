"""The fast front end: corners at half resolution, followed and matched left to right by Lucas-Kanade.

Whole-pixel corners dominate the error of a descriptor pipeline; here a corner only says which patch to follow, and
every position that enters the motion is the sub-pixel result of aligning that patch (:mod:`gpvo.vo.patches`). Where
too little is found near the guess, both images are matched afresh by features of every scale (P. Alcantarilla, J.
Nuevo, A. Bartoli, "Fast explicit diffusion for accelerated features in nonlinear scale spaces", 2013).
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.stats.series import median
from gpvo.types import Array, StereoCamera, StereoFrame, TrackFrame
from gpvo.vo import opencv
from gpvo.vo.config import KNOWN_DEPTH_PX, VoConfig
from gpvo.vo.frontend import EMPTY, Matches, Observation, Repeats, RightSearch
from gpvo.vo.motion import transfer
from gpvo.vo.opencv import Image, ImageStats, Light, Points, image_stats, in_light_of
from gpvo.vo.patches import Patches, align, cut, stands_out
from gpvo.vo.rig_error import RigError
from gpvo.vo.rivals import cells

_FEATURES = 2000  # of an image that is matched afresh
_MOST_DEFORMED = 0.5  # of a patch, over its size: beyond, it is no longer the same picture
_LEVEL: Array = np.empty((0, 2))  # slopes of the disparity where nothing is known of any


@dataclass(frozen=True)
class _Seen:
    """Points seen in both images.

    ``left_uv`` (N, 2): their places in the left one, the middles of their patches; ``uvd`` (N, 3): their measurements;
    ``slope`` (N, 2): by how much the disparity of their surface grows per pixel of u and of v; ``patches`` of the left
    image around them.
    """

    left_uv: Points
    uvd: Array
    slope: Array
    patches: Patches

    def __len__(self) -> int:
        return len(self.uvd)

    def __getitem__(self, which: NDArray[np.bool_ | np.intp] | slice) -> _Seen:
        return _Seen(*(getattr(self, f.name)[which] for f in fields(self)))

    def __add__(self, other: _Seen) -> _Seen:
        both = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return _Seen(*(np.concatenate(pair) for pair in both))


@dataclass(frozen=True)
class _Survey:
    """What new points start from: corners (N, 2) of the half-size left image, strongest first, and the disparity (H, W)
    at a quarter of the size, negative where it is not known."""

    corners: Points
    disparity: NDArray[np.float32]


@dataclass
class _View:
    """One observed pair and what was found in it."""

    left: Image
    right: Image
    half_left: Image
    half_right: Image
    light_left: Light
    stats: ImageStats
    right_as_left: Image  # the right image in the left's light
    seen: _Seen  # usable as reference
    survey: Future[_Survey] | None = None  # once begun
    strong: int = 0  # the points from here on are spare ones
    features: tuple[Points, NDArray[np.uint8]] | None = None  # those of the left image to find again, once asked for


@dataclass(frozen=True)
class _Found:
    """What the search in the right image came to: for each point sought ``seen``, whether it can be believed, ``good``
    (N,), by how much the right row lies below the left one, ``row_error`` (N,), NaN where nothing was found, and
    whether that image should show it at all, ``inside`` (N,)."""

    seen: _Seen
    good: NDArray[np.bool_]
    row_error: Array
    inside: NDArray[np.bool_]


@dataclass(frozen=True)
class _New:
    """New corners of the current frame: how many were found, and those also seen in the right image.

    ``strong``: how many of them are the image's best; after them come spare ones.
    """

    detected: int
    seen: _Seen
    strong: int


class KltFrontend:
    """See the module's text. One instance per run; not for use from several threads at once."""

    def __init__(
        self, camera: StereoCamera, rig_error: RigError, config: VoConfig, mask: NDArray[np.bool_] | None = None
    ) -> None:
        self._camera = camera
        self._rig_error = rig_error
        self._config = config
        self._mask = opencv.as_mask(mask)
        half = None if mask is None else mask[: camera.height // 2 * 2 : 2, : camera.width // 2 * 2 : 2]
        self._half_mask = opencv.as_mask(half)
        self._reference: _View | None = None
        self._current: _View | None = None
        no_patches = np.empty((0, 3, config.klt_window_px**2), np.float32)
        self._nothing = _Seen(np.empty((0, 2), np.float32), np.empty((0, 3)), np.empty((0, 2)), no_patches)
        self._new: _New | None = None
        self._matched = self._nothing, np.empty(0, np.intp)  # points seen, and which of them are the last matches
        self._repeats = Repeats()
        self._pool = ThreadPoolExecutor(1)

    def observe(self, frame: StereoFrame | TrackFrame, *, stays: bool = False) -> Observation:
        """Take in a rectified pair."""
        assert isinstance(frame, StereoFrame)
        half_left, half_right = opencv.halve(frame.left), opencv.halve(frame.right)
        light_left, light_right = Light.of(half_left), Light.of(half_right)
        right = in_light_of(frame.right, light_right, light_left)
        stats = image_stats(frame.left, light_left)
        self._current = _View(frame.left, frame.right, half_left, half_right, light_left, stats, right, self._nothing)
        self._new = None
        if not stays:
            self._begin_survey(self._current)  # beside what comes first
        return Observation(
            stats,
            right_light=light_left.ratio(light_right),
            right_blur=light_left.blur(light_right),
            woven=opencv.woven(frame.left) or opencv.woven(frame.right),
            **self._repeats.step(frame.left, frame.right),
        )

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Follow the reference's points into the left image, then find each in the right one."""
        reference, current = self._reference, self._current
        if reference is None or current is None or len(reference.seen) == 0:
            return EMPTY
        if from_scratch:
            return self._find_again(reference, current)
        followed, found, uv, disparity, slope = self._follow(reference, current, T_prev_cur_guess)
        before, n = reference.seen, len(uv)
        # New corners are sought beside the known points where the survey has begun, and else when they are wanted.
        search = self._find_right if current.survey is None else self._with_new_corners
        both = search(current, uv, disparity, slope)
        good = both.good[:n]
        self._matched = both.seen, np.flatnonzero(good)
        return Matches(
            before.uvd[found][good],
            both.seen.uvd[:n][good],
            both.row_error[:n][good],
            int(followed[: reference.strong].sum()),
            spare=(np.flatnonzero(found) >= reference.strong)[good],
            right=self._right_search(current, both, uv[:, 1] - before.left_uv[found, 1]),
            sought_uvd=before.uvd,
            displaced=self._displaced(both),
        )

    def _follow(
        self, reference: _View, current: _View, T_prev_cur: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Points, Array, Array]:
        """The reference's points found in the left image near where the motion puts them.

        Which of them (N,) something was found for, and which (N,) look like what was sought; of these M, their places
        (M, 2), and the disparity (M,) and its slope (M, 2) that the motion lets expect.
        """
        config, seen = self._config, reference.seen
        uvd, A, h, slope = self._expected(seen, T_prev_cur)
        left = in_light_of(current.left, current.light_left, reference.light_left)
        uv, followed = opencv.track(
            reference.left, left, seen.left_uv, uvd[:, :2], config.klt_window_px, config.klt_levels
        )
        found = followed.copy()
        near = align(seen.patches[found], left, uv[found], A[found], h[found])
        found[found] = near.alike
        return followed, found, near.uv[near.alike], uvd[found, 2], slope[found]

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """Carry on the inliers, and add new corners where there are none."""
        current = self._current
        assert current is not None
        seen, matched = self._matched
        if inliers is None:
            matched, inliers, self._new = matched[:0], np.zeros(0, bool), None
        if self._new is None:
            self._with_new_corners(current, self._nothing.left_uv, np.empty(0), taken_uv=seen.left_uv[matched])
        kept, new = seen[matched[inliers]], self._new
        assert new is not None
        current.seen = kept + new.seen
        current.strong = len(kept) + new.strong
        if current.strong >= at_least:
            self._reference = current
        self._matched, self._new = (self._nothing, matched[:0]), None
        return len(kept) + new.detected, current.strong

    def _expected(self, seen: _Seen, T_prev_cur: Array) -> tuple[Array, Array, Array, Array]:
        """Where a motion puts the points (N, 3), how it deforms their patches, (N, 2, 2) and (N, 2) of :func:`align`,
        and the slope of their disparity there (N, 2); as they were for those it puts out of sight."""
        c = self._camera
        moved = transfer(T_prev_cur, seen.uvd, c)
        (u, v, d), G = moved.uvd, moved.G.transpose(2, 0, 1)
        A = G[:, :2, :2] + G[:, :2, 2:] * seen.slope[:, None]
        slope = G[:, 2, :2] + G[:, 2, 2:] * seen.slope
        visible = moved.in_front & (u >= 0) & (u < c.width) & (v >= 0) & (v < c.height) & (d < c.width)
        visible &= np.abs(A - np.eye(2)).max(axis=(1, 2), initial=0.0) < _MOST_DEFORMED
        # Depth over that of before is linear in the place and in the disparity, and so over a plane.
        forward = se3.inverse(T_prev_cur)[2]
        by_u, by_v, by_d = forward[[0, 1, 3]] / (c.fx_px, c.fy_px, c.fx_px * c.baseline_m)
        nearer = np.where(visible, 1.0 / np.where(visible, moved.depth, 1.0), 0.0)
        h = nearer[:, None] * ((by_u, by_v) + by_d * seen.slope)
        A = np.where(visible[:, None, None], A, np.eye(2))
        there = np.linalg.solve(A.transpose(0, 2, 1), slope[:, :, None])[:, :, 0]
        slope = np.where(visible[:, None], there, seen.slope)
        return np.where(visible[:, None], np.column_stack([u, v, d]), seen.uvd), A, h, slope

    def _begin_survey(self, view: _View) -> Future[_Survey]:
        if view.survey is None:
            view.survey = self._pool.submit(self._survey, view.half_left, view.half_right)
        return view.survey

    def _survey(self, half_left: Image, half_right: Image) -> _Survey:
        config = self._config
        limit = int(config.max_disparity_share * self._camera.width / 4)
        # Many: where a strong texture holds the best corners, others must be left to speak for the scene.
        found = opencv.corners(
            half_left, 8 * config.max_features, config.corner_quality, config.min_distance_px / 2, self._half_mask
        )
        return _Survey(found, opencv.coarse_disparity(opencv.halve(half_left), opencv.halve(half_right), limit))

    def _new_corners(self, view: _View, taken_uv: Points) -> tuple[Points, Array, int]:
        """Corners (N, 2) away from those taken, on even pixels of the full image, and their rough disparity (N,).

        The first of them, whose number comes last, are the image's best; the others stand alone in their parts of it.
        """
        uv, limit = self._begin_survey(view).result().corners * 2.0, self._config.max_features
        strong = uv[:limit]
        if len(taken_uv) and len(uv):
            # Axis by axis in float32: a tenth of the time of a sum over the last axis.
            (x, y), (taken_x, taken_y) = strong.T, taken_uv.astype(np.float32).T
            distance2 = (x[:, None] - taken_x) ** 2 + (y[:, None] - taken_y) ** 2
            strong = strong[distance2.min(1) > self._config.min_distance_px**2]
        best = strong[: max(limit - len(taken_uv), 0)]
        uv = np.concatenate([best, self._alone(uv[limit:], np.concatenate([best, taken_uv]))])
        return *self._rough(view, uv), len(best)

    def _rough(self, view: _View, uv: Points) -> tuple[Points, Array]:
        """Points (N, 2) of the left image with their rough disparity (N,)."""
        coarse = self._begin_survey(view).result().disparity
        column, row = (uv / 4).astype(int).T
        near = coarse[np.clip(row, 0, coarse.shape[0] - 1), np.clip(column, 0, coarse.shape[1] - 1)]
        known = near >= 0
        # Where the block matcher saw nothing, the median of what it saw is the fairest start.
        default = median(near[known]) if known.any() else 2.0
        return uv, 4.0 * np.where(known, near, default)

    def _alone(self, uv: Points, taken_uv: Points) -> Points:
        """The strongest of the corners (N, 2) in each cell of the image that holds none of those taken."""
        cell, taken = (cells(a, self._camera) for a in (uv, taken_uv))
        chosen, first = np.unique(cell, return_index=True)
        return uv[first[~np.isin(chosen, taken)]]

    def _with_new_corners(
        self, view: _View, uv: Points, disparity: Array, slope: Array = _LEVEL, taken_uv: Points | None = None
    ) -> _Found:
        """One search in the right image for points of the left one and for new corners between them, or between those
        ``taken_uv`` (M, 2), which are measured already: as :meth:`_find_right`, the new corners last."""
        new_uv, new_disparity, detected = self._new_corners(view, uv if taken_uv is None else taken_uv)
        found = self._find_right(view, np.concatenate([uv, new_uv]), np.concatenate([disparity, new_disparity]), slope)
        seen, good = found.seen[len(uv) :], found.good[len(uv) :]
        self._new = _New(detected, seen[good], int(good[:detected].sum()))
        return found

    def _find_right(self, view: _View, uv_left: Points, disparity: Array, slope: Array = _LEVEL) -> _Found:
        """Points (N, 2) of the left image sought in the right one, from a guessed disparity (N,) and, of the first n,
        its slope (n, 2)."""
        config = self._config
        guess = np.column_stack([uv_left[:, 0] - disparity, uv_left[:, 1]])
        window_px = config.klt_window_px
        uv_right, found = opencv.track(view.left, view.right_as_left, uv_left, guess, window_px, 2)
        A = np.tile(np.eye(2), (len(uv_left), 1, 1))
        A[: len(slope), 0] -= slope
        patches = cut(view.left, uv_left, window_px)
        near = align(patches, view.right_as_left, uv_right, A)
        uv_right = np.where(near.alike[:, None], near.uv, uv_right)
        d = uv_left[:, 0].astype(np.float64) - uv_right[:, 0]
        row_error = uv_right[:, 1].astype(np.float64) - uv_left[:, 1]
        uvd = np.column_stack([uv_left[:, 0], uv_left[:, 1] + 0.5 * row_error, d])
        limit = config.max_disparity_share * self._camera.width
        found &= near.alike
        good = found & self._rig_error.allows(uvd, row_error, config.min_disparity_px, limit, config.max_row_error_px)
        seen = _Seen(uv_left, uvd, (1.0, 0.0) - near.A[:, 0], patches)
        return _Found(seen, good, np.where(found, row_error, np.nan), good | (guess[:, 0] >= 0))

    def _right_search(self, view: _View, both: _Found, row_motion: Array) -> RightSearch:
        """What the search in the right image came to; the first points were followed and have moved down so far."""
        uvd, n = both.seen.uvd, len(row_motion)
        d_expected, row_expected = self._rig_error.errors(uvd)
        disparity, row_error = uvd[:, 2] - d_expected, both.row_error - row_expected
        # A pair that is off by the same rows everywhere is still a pair: its rows are counted from there.
        off_px = np.abs(row_error - median(row_error[np.isfinite(row_error)]))
        off_row = both.inside & (off_px > self._config.max_row_error_px)
        # Corners of noise would not be found even in a good pair.
        sought, known = both.inside.copy(), both.inside & np.isfinite(row_error)
        missing = sought & ~known
        sought[missing] = stands_out(both.seen.patches[missing], 255 * view.stats.noise_level)
        least_px = self._config.min_disparity_px
        behind = known & ~off_row & (disparity < min(least_px, -KNOWN_DEPTH_PX))
        # Points at infinity have no measurable depth, which is nobody's fault; nor is what lies beyond the image.
        far = known & ~behind & (disparity < max(least_px, KNOWN_DEPTH_PX))
        seen = np.abs(row_error[:n]) < self._config.klt_window_px
        return RightSearch(
            int((sought & ~far).sum()),
            int((both.good & ~off_row & ~far & ~behind).sum()),
            int(behind.sum()),
            int(off_row.sum()),
            # Rows that spread may be those of an image that is late; a turn about the optical axis is the rig's.
            (both.row_error[:n] - self._rig_error.tilt(uvd[:n]))[seen],
            row_motion[seen],
        )

    def _displaced(self, both: _Found) -> tuple[Array, Array] | None:
        uvd, row_error = both.seen.uvd[both.inside], both.row_error[both.inside]
        return self._rig_error.displaced(uvd, row_error, self._config.max_row_error_px)

    def _find_again(self, reference: _View, current: _View) -> Matches:
        """Match both left images afresh, without any guess and over any change of scale."""
        (from_uv, from_bits), (to_uv, to_bits) = self._features(reference), self._features(current)
        pairs = opencv.match_mutual(from_bits, to_bits)
        uv, disparity = self._rough(reference, from_uv[pairs[:, 0]])
        before = self._find_right(reference, uv, disparity)
        uv, disparity = self._rough(current, to_uv[pairs[:, 1]])
        now = self._with_new_corners(current, uv, disparity)
        n = len(uv)
        good = before.good & now.good[:n]
        self._matched = now.seen, np.flatnonzero(good)
        # Wrong pairs are no second motion: nothing is said of points sought in vain, nor of how rows move.
        right = self._right_search(current, now, np.empty(0))
        uvd, displaced = now.seen.uvd[:n][good], self._displaced(now)
        return Matches(before.seen.uvd[good], uvd, now.row_error[:n][good], n, right=right, displaced=displaced)

    def _features(self, view: _View) -> tuple[Points, NDArray[np.uint8]]:
        if view.features is None:
            view.features = opencv.features(view.left, _FEATURES, self._mask)
        return view.features
