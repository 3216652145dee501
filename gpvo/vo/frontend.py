"""What a front end gives the odometry, and what becomes of it: matches from motion to motion, joined into tracks.

Two front ends are here: for pixel tracks made by other software, and that of the thesis (corners, AKAZE descriptors,
brute-force matching left to right and to the previous frame). That of Lucas and Kanade is :mod:`gpvo.vo.klt`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, StereoCamera, StereoFrame, StereoTracks, TrackFrame, VoRecord
from gpvo.vo import opencv
from gpvo.vo.config import VoConfig
from gpvo.vo.opencv import Image, ImageStats, Light, Points, image_stats
from gpvo.vo.rig_error import RigError

_PART = 1 / 8  # of an image's rows: fewer cannot make a motion of their own


@dataclass(frozen=True)
class Observation:
    """What is known about a frame before its motion is.

    ``repeated``: the pair is identical to that of the previous frame; ``alone``: which image alone is, ``left`` or
    ``right``; ``partly``: an eighth or more of the rows of one are, and hold a picture, as they were not a frame ago.
    ``right_light``: by what factor the right image is brighter or has more contrast; 1 if they are alike.
    ``right_blur``: by what factor it is more blurred. ``woven``: every second row of one is of another moment.
    """

    stats: ImageStats | None
    repeated: bool
    alone: str = ""
    right_light: float = 1.0
    right_blur: float = 1.0
    woven: bool = False
    partly: bool = False


class Repeats:
    """What of each frame was in the one before: an image, or rows of it, where a buffer was not filled in time. Noise
    makes it impossible that a camera sees the same twice."""

    def __init__(self) -> None:
        self._images: tuple[Image, Image] | None = None
        self._rows = [np.zeros(1, bool)] * 2

    def step(self, left: Image, right: Image) -> dict[str, Any]:
        """Fields of the frame's :class:`Observation`. Rows that repeat time and again are of a caption."""
        before, self._images = self._images, (left, right)
        if before is None:
            return {"repeated": False}
        equal, rows = zip(*map(opencv.same_rows, self._images, before), strict=True)
        partly = any((now & ~was).mean() >= _PART for now, was in zip(rows, self._rows, strict=True))
        self._rows = list(rows)
        alone = "" if equal[0] == equal[1] else "left" if equal[0] else "right"
        return {"repeated": all(equal), "alone": alone, "partly": partly and not any(equal)}


@dataclass(frozen=True)
class RightSearch:
    """How the search in the right image for points of the left one went, while both could still be compared.

    Of ``sought`` points ``found`` gave a measurement, ``behind`` lie behind the cameras and ``off_row`` in another row.
    ``row_error_px`` (n,): right row minus left row, of points followed from the previous frame;
    ``row_motion_px`` (n,): by how much these moved down the left image.
    """

    sought: int
    found: int
    behind: int
    off_row: int
    row_error_px: Array
    row_motion_px: Array


@dataclass(frozen=True)
class Matches:
    """The same points in the reference and the current frame: (u, v, d) [px], each (N, 3).

    ``row_error`` (N,): row in the right image less that in the left one, in the current frame [px]. ``n_tracked``:
    points found again in the left image, with or without a right one. ``spare`` (N,) marks weaker points where the
    strong ones leave the image empty: they decide no motion while strong ones do, but speak against it; None for none.
    ``right``: how the search in the right image went. ``sought_uvd`` (M, 3): all points of the reference.
    ``displaced``: those of the frame whose rows are too far off alike, as of :meth:`RigError.displaced`.
    """

    uvd_prev: Array
    uvd_cur: Array
    row_error: Array
    n_tracked: int
    spare: NDArray[np.bool_] | None = None
    right: RightSearch | None = None
    sought_uvd: Array | None = None
    displaced: tuple[Array, Array] | None = None

    @property
    def strong(self) -> NDArray[np.bool_]:
        """(N,) the points that decide the motion."""
        return np.ones(len(self.uvd_cur), bool) if self.spare is None else ~self.spare


EMPTY = Matches(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), 0)


@dataclass(frozen=True)
class Followed:
    """The matches of one motion as measured, and which of them (N,) agree with it."""

    matches: Matches
    inliers: NDArray[np.bool_]


class Frontend(Protocol):
    """Turns frames into matches. The odometry calls ``observe``, then ``match``, then perhaps ``promote``."""

    def observe(self, frame: StereoFrame | TrackFrame, *, stays: bool = False) -> Observation:
        """Take in a new frame. ``stays``: the reference is expected to stay, so that no new points will be wanted."""

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Points of the reference found in the observed frame, near where the guess puts them.

        ``from_scratch``: the guess cannot be trusted.
        """

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """Make the observed frame the reference; counts of detected and of stereo-matched points.

        ``inliers`` marks which of the last matches may be carried on, None for none. With fewer stereo points than
        ``at_least`` the old reference stays.
        """


def stereo_uvd(left: Points, right: Points) -> tuple[Array, Array]:
    """(u, v, d) (N, 3) of pixels (N, 2) in the left and the right image, and by how much the right row lies below the
    left one (N,)."""
    left, right = np.asarray(left, np.float64), np.asarray(right, np.float64)
    uvd = np.column_stack([left[:, 0], 0.5 * (left[:, 1] + right[:, 1]), left[:, 0] - right[:, 0]])
    return uvd, right[:, 1] - left[:, 1]


@dataclass(frozen=True)
class _Measured:
    """Stereo points of one frame: ``uvd`` (N, 3), ``row_error`` (N,), and the ``mark`` (N, ...) by which they are known
    again. ``detected``: points of the left image, with or without a right one. ``displaced``: see :class:`Matches`."""

    uvd: Array
    row_error: Array
    mark: NDArray[Any]
    detected: int
    displaced: tuple[Array, Array] | None


class _AfreshFrontend(ABC):
    """Measures every frame for itself, and finds the points of the reference by their marks."""

    _reference: _Measured | None = None
    _current: _Measured | None = None
    _says_what_was_sought = False

    @abstractmethod
    def _pairs(self, before: NDArray[Any], now: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Places of equal marks."""

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Pair the points of equal marks; the guess is not used."""
        if self._reference is None or self._current is None:
            return EMPTY
        i, j = self._pairs(self._reference.mark, self._current.mark)
        sought = self._reference.uvd if self._says_what_was_sought else None
        now = self._current
        return Matches(
            self._reference.uvd[i], now.uvd[j], now.row_error[j], len(i), sought_uvd=sought, displaced=now.displaced
        )

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """See :class:`Frontend`."""
        assert self._current is not None
        if len(self._current.uvd) >= at_least:
            self._reference = self._current
        return self._current.detected, len(self._current.uvd)


class TrackFrontend(_AfreshFrontend):
    """For stereo tracks: points are matched by their identity, and all of the reference's are sought."""

    _says_what_was_sought = True

    def __init__(self, rig_error: RigError, config: VoConfig) -> None:
        self._rig_error, self._config = rig_error, config

    def observe(self, frame: StereoFrame | TrackFrame, *, stays: bool = False) -> Observation:
        """Take in a :class:`TrackFrame`; a non-finite pixel or an impossible disparity drops its point."""
        assert isinstance(frame, TrackFrame)
        uvd, row_error = stereo_uvd(frame.uv_left, frame.uv_right)
        limit = max(self._config.max_row_error_px, 3.0)
        good = self._rig_error.allows(uvd, row_error, self._config.min_disparity_px, np.inf, limit)
        track, first = np.unique(frame.track[good], return_index=True)
        before = self._current
        displaced = self._rig_error.displaced(uvd, row_error, limit)
        self._current = _Measured(uvd[good][first], row_error[good][first], track, len(uvd), displaced)
        repeated = before is not None and len(track) > 0 and np.array_equal(before.uvd, self._current.uvd)
        return Observation(None, repeated)

    def _pairs(self, before: NDArray[Any], now: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return np.intersect1d(before, now, assume_unique=True, return_indices=True)[1:]


class DescriptorFrontend(_AfreshFrontend):
    """Every frame is detected, described and matched afresh (D. Ross, thesis, chapter 2)."""

    def __init__(
        self, camera: StereoCamera, rig_error: RigError, config: VoConfig, mask: NDArray[np.bool_] | None = None
    ) -> None:
        self._camera, self._rig_error, self._config = camera, rig_error, config
        self._mask = opencv.as_mask(mask)
        self._repeats = Repeats()
        self._pool = ThreadPoolExecutor(1)

    def observe(self, frame: StereoFrame | TrackFrame, *, stays: bool = False) -> Observation:
        """Detect, describe and match left to right."""
        assert isinstance(frame, StereoFrame)
        right = self._pool.submit(self._features, frame.right)
        uv_left, bits = self._features(frame.left)
        uv_right, bits_right = right.result()
        i, j = self._pairs(bits, bits_right)
        uvd, row_error = stereo_uvd(uv_left[i], uv_right[j])
        config = self._config
        most_px, rows_px = config.max_disparity_share * self._camera.width, 2 * config.max_row_error_px
        good = self._rig_error.allows(uvd, row_error, config.min_disparity_px, most_px, rows_px)
        displaced = self._rig_error.displaced(uvd, row_error, rows_px)
        self._current = _Measured(uvd[good], row_error[good], bits[i][good], len(uv_left), displaced)
        stats = image_stats(frame.left, Light.of(opencv.halve(frame.left)))
        return Observation(stats, **self._repeats.step(frame.left, frame.right))

    def _pairs(self, before: NDArray[Any], now: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        i, j = opencv.match_mutual(before, now).T
        return i, j

    def _features(self, image: opencv.Image) -> tuple[Points, NDArray[np.uint8]]:
        config = self._config
        uv = opencv.corners(image, config.max_features, config.corner_quality, config.min_distance_px, self._mask)
        return opencv.describe(image, uv)


class TrackRecorder:
    """Feed it every record with the matches behind it; it returns the observations that are new."""

    def __init__(self) -> None:
        self._reference: dict[bytes, int] = {}  # measurement in the reference frame: track
        self._begun = 0  # tracks, by number

    def step(self, record: VoRecord, followed: Followed) -> StereoTracks | None:
        """Observations of this frame, and of the reference where a point is matched for the first time.

        None where nothing was matched.
        """
        if record.t_ns == record.t_prev_ns:
            return None
        matches = followed.matches
        before, now = keys(matches.uvd_prev), keys(matches.uvd_cur)
        new = np.array([k not in self._reference for k in before], dtype=bool)
        track = np.array([self._reference.setdefault(k, self._begun + i) for i, k in enumerate(before)], dtype=np.int64)
        self._begun += len(before)
        if record.is_reference:
            self._reference = dict(zip(now, track.tolist(), strict=True))
        if len(track) == 0:
            return None
        return StereoTracks(
            t_ns=np.repeat([record.t_prev_ns, record.t_ns], [new.sum(), len(track)]),
            track=np.concatenate([track[new], track]),
            uvd=np.concatenate([matches.uvd_prev[new], matches.uvd_cur]),
            is_inlier=np.concatenate([np.ones(new.sum(), bool), followed.inliers]),
        )


def keys(uvd: Array) -> list[bytes]:
    """What tells measurements (N, 3) apart: their bytes; equal ones, as whole pixels may be, by their order."""
    out: dict[bytes, None] = {}
    for row in np.ascontiguousarray(uvd, dtype=np.float64):
        key = row.tobytes()
        while key in out:
            key += b"+"
        out[key] = None
    return list(out)
