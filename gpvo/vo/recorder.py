"""Records what odometry saw: its matches from motion to motion, joined into tracks.

A front end carries the measurements of a point unchanged from the frame in which it was found to the next match, so
equal measurements in the reference are the same point. No front end needs to number its points for this.
"""

from __future__ import annotations

import numpy as np

from gpvo.types import Array, StereoTracks, VoRecord
from gpvo.vo.frontend import Followed


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
    """What tells measurements (N, 3) apart: their bytes."""
    return [row.tobytes() for row in np.ascontiguousarray(uvd, dtype=np.float64)]
