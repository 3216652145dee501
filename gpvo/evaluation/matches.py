"""The points behind single motions of a run, as figures: what odometry saw, and which matches it used.

A run folder holds no images, so the sequence is opened again and odometry repeated with the run's own settings.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.io.source import Source
from gpvo.runner import Step, steps
from gpvo.vo.config import VoConfig

_GOOD, _BAD = (60, 200, 60), (40, 40, 230)  # blue, green, red


@dataclass(frozen=True)
class MatchPicture:
    """One frame's left image with its points; ``uri`` is a JPEG as a data URI."""

    frame: int
    caption: str
    uri: str


def match_pictures(source: Source, config: VoConfig, frames: Sequence[int]) -> list[MatchPicture]:
    """Figures of the frames of these indices. Raises GpvoError for a frame that the sequence does not have."""
    if min(frames) < 0:
        raise GpvoError(f"there is no frame {min(frames)}", where=source.path, cure="frames are numbered from 0")
    wanted, last, found = set(frames), max(frames), []
    for k, step in enumerate(steps(source, config)):
        if k in wanted:
            found.append(_picture(k, step, source))
        if k == last:
            return found
    raise GpvoError(f"there is no frame {last}", where=source.path, cure="name frames that the sequence has")


def _picture(k: int, step: Step, source: Source) -> MatchPicture:
    record, matches, inliers = step.record, step.followed.matches, step.followed.inliers
    image = getattr(step.frame, "left", None)
    grey = np.full((source.camera.height, source.camera.width), 40, np.uint8) if image is None else image
    canvas = cv2.cvtColor(np.ascontiguousarray(grey), cv2.COLOR_GRAY2BGR)
    for before, now, good in zip(matches.uvd_prev, matches.uvd_cur, inliers, strict=True):
        _arrow(canvas, before[:2], now[:2], _GOOD if good else _BAD)
    done, packed = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert done
    reason = f" ({record.reason})" if record.reason else ""
    caption = (
        f"frame {k}: {record.status.value}{reason}; {int(inliers.sum())} of {len(inliers)} matches agree,"
        f" {record.reproj_rms_px:.2f} px rms"
    )
    return MatchPicture(k, caption, "data:image/jpeg;base64," + base64.b64encode(packed.tobytes()).decode("ascii"))


def _arrow(canvas: NDArray[np.uint8], before: NDArray[np.float64], now: NDArray[np.float64], colour: tuple) -> None:
    a, b = (tuple(int(v) for v in np.round(16 * p)) for p in (before, now))
    cv2.line(canvas, a, b, colour, 1, cv2.LINE_AA, shift=4)
    cv2.circle(canvas, b, 32, colour, 1, cv2.LINE_AA, shift=4)
