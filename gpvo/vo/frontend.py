"""What a front end gives the odometry, and the front end for pixel tracks made by other software."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, StereoFrame, TrackFrame
from gpvo.vo.config import VoConfig
from gpvo.vo.image import ImageStats
from gpvo.vo.rig_error import RigError


@dataclass(frozen=True)
class Observation:
    """What is known about a frame before its motion is.

    ``repeated``, ``right_repeated``: the pair, or its right image alone, is identical to that of the previous frame.
    ``right_light``: by what factor the right image is brighter or has more contrast; 1 if they are alike.
    """

    stats: ImageStats | None
    repeated: bool
    right_repeated: bool = False
    right_light: float = 1.0


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
    strong ones leave the image empty: they do not decide the motion, but may speak against it; None for none.
    ``right``: how the search in the right image went. ``sought_uvd`` (M, 3): all points of the reference.
    """

    uvd_prev: Array
    uvd_cur: Array
    row_error: Array
    n_tracked: int
    spare: NDArray[np.bool_] | None = None
    right: RightSearch | None = None
    sought_uvd: Array | None = None

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

    def observe(self, frame: StereoFrame | TrackFrame) -> Observation:
        """Take in a new frame."""

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Points of the reference found in the observed frame, near where the guess puts them.

        ``from_scratch``: the guess cannot be trusted.
        """

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """Make the observed frame the reference; counts of detected and of stereo-matched points.

        ``inliers`` marks which of the last matches may be carried on, None for none. With fewer stereo points than
        ``at_least`` the old reference stays.
        """


class TrackFrontend:
    """For stereo tracks: points are matched by their identity."""

    def __init__(self, rig_error: RigError, config: VoConfig) -> None:
        self._rig_error = rig_error
        self._min_disparity_px = config.min_disparity_px
        self._max_row_error_px = config.max_row_error_px
        self._previous: tuple[NDArray[np.int64], Array] | None = None
        self._current: tuple[NDArray[np.int64], Array] | None = None
        self._row_error: Array = np.empty(0)
        self._detected = 0

    def observe(self, frame: StereoFrame | TrackFrame) -> Observation:
        """Take in a :class:`TrackFrame`; a non-finite pixel or an impossible disparity drops its point."""
        assert isinstance(frame, TrackFrame)
        left, right = np.asarray(frame.uv_left, np.float64), np.asarray(frame.uv_right, np.float64)
        uvd = np.stack([left[:, 0], 0.5 * (left[:, 1] + right[:, 1]), left[:, 0] - right[:, 0]], 1)
        row_error = right[:, 1] - left[:, 1]
        good = self._rig_error.allows(uvd, row_error, self._min_disparity_px, np.inf, max(self._max_row_error_px, 3.0))
        self._detected = len(left)
        track, first = np.unique(frame.track[good], return_index=True)
        before, self._current = self._current, (track, uvd[good][first])
        self._row_error = row_error[good][first]
        repeated = before is not None and len(track) > 0 and np.array_equal(before[1], self._current[1])
        return Observation(None, repeated)

    def match(self, T_prev_cur_guess: Array, *, from_scratch: bool = False) -> Matches:
        """Pair the points of equal identity."""
        if self._previous is None or self._current is None:
            return EMPTY
        _, i, j = np.intersect1d(self._previous[0], self._current[0], assume_unique=True, return_indices=True)
        sought = self._previous[1]
        return Matches(sought[i], self._current[1][j], self._row_error[j], len(i), sought_uvd=sought)

    def promote(self, inliers: NDArray[np.bool_] | None, at_least: int = 0) -> tuple[int, int]:
        """See :class:`Frontend`."""
        assert self._current is not None
        if len(self._current[0]) >= at_least:
            self._previous = self._current
        return self._detected, len(self._current[0])
