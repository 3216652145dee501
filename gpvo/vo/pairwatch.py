"""Do the two images of a pair belong together? What is wrong with the right camera, and the remedy."""

from __future__ import annotations

from collections import Counter

import numpy as np

from gpvo.types import Array, StereoCamera
from gpvo.vo.frontend import Observation, RightSearch

_MEMORY = 0.8  # of the running sums: about five frames
_NAMED_FROM = 0.05  # share of the frames
_DARKER = 1.25

_CURES = {
    "frozen": "the right image repeats itself while the left one changes; look at the right camera's driver",
    "late": "left and right are a frame apart; pair them by time stamp, or trigger both cameras together",
    "swapped": "most points lie behind the cameras; exchange left and right",
    "rows": "most points are in another row on the right; calibrate the pair again",
    "few": "most points are not found in the right image; look at its exposure, focus and lens",
    "light": "the right image has other light than the left one; give both cameras the same exposure and gain",
    "size": "the calibration is of images twice as large; scale it, or use images of full size",
}


class PairWatch:
    """Watches the pairs of a run: :meth:`step` says what is doubtful in one, :meth:`findings` what is in the run."""

    def __init__(self, camera: StereoCamera) -> None:
        # A principal point in the lower right corner is the centre of an image of twice the size.
        doubled = 2 * np.array([camera.cx_px, camera.cy_px]) / [camera.width, camera.height]
        self._half_size = bool((np.abs(doubled - 2.0) < 0.4).all())
        self._rows = np.zeros(4)
        self._frames = 0
        self._seen: Counter[str] = Counter()

    def step(self, seen: Observation, right: RightSearch | None) -> list[str]:
        """What is doubtful about this pair, in words; empty for a good one."""
        self._frames += 1
        self._seen["frozen"] += seen.right_repeated
        self._seen["light"] += not 1 / _DARKER < seen.right_light < _DARKER
        doubts = []
        if self._half_size:
            self._seen["size"] += 1
            doubts.append("the principal point lies in the corner of the image")
        if right is None:
            return doubts
        if abs(late := self._lateness(right)) > 0.25:
            self._seen["late"] += 1
            doubts.append(f"the {'right' if late > 0 else 'left'} image is {abs(late):.1f} frames late")
        if right.sought > 0 and right.found < 0.6 * right.sought:
            lost = right.sought - right.found
            cause = "swapped" if right.behind > 0.5 * lost else "rows" if right.off_row > 0.5 * lost else "few"
            self._seen[cause] += 1
            doubts.append(f"only {right.found} of {right.sought} points are found in the right image")
        return doubts

    def findings(self) -> list[str]:
        """What was wrong in more than a twentieth of the pairs, with the remedy."""
        often = [(n, cause) for cause, n in self._seen.items() if n > max(2, _NAMED_FROM * self._frames)]
        return [f"{_CURES[cause]} ({n} of {self._frames} pairs)" for n, cause in sorted(often, reverse=True)]

    def _lateness(self, right: RightSearch) -> float:
        """By how many frames the right image is older than the left one; 0 where nothing speaks for it.

        Then a point's right row is where the left one was: the error of rows is the motion of rows, with a minus.
        """
        error, motion = _centred(right.row_error_px), _centred(right.row_motion_px)
        now = np.array([len(error), error @ error, error @ motion, motion @ motion])
        self._rows = _MEMORY * self._rows + now
        n, ee, em, mm = self._rows
        # Rows must move by more than a pixel, and their motion explain a quarter of the error's variance.
        if n < 20 or mm < n or em**2 < 0.25 * ee * mm:
            return 0.0
        late = -em / mm
        return float(late) if abs(late) < 2.0 else 0.0


def _centred(x: Array) -> Array:
    """Without its median: a vertical offset of the cameras is no delay."""
    return np.asarray(x, np.float64) - np.median(x) if len(x) else np.zeros(0)
