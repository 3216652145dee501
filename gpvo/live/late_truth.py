"""Truth that comes late (motion capture, tags, closed loops): errors of motions that were published already."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from gpvo.dataset.errors import interpolation_sigma, motion_targets
from gpvo.geometry.covariance import is_positive_definite
from gpvo.io.bag_messages import read_pose
from gpvo.io.bag_reader import stamp_ns
from gpvo.live.intake import Sequence, StampWatch
from gpvo.live.stages import stated_covariance
from gpvo.types import Array, Prediction, TruthLog, VoRecord

_MOTIONS, _POSES = 500, 5000
_KEPT = 33  # poses that tell what interpolation between them misses
_TRUTH_SHARE = 0.25
"""Of an axis' predicted variance; where truth's own variance is more, it cannot judge the axis."""


class LateTruth:
    """Poses on ``topic`` of the body that the odometry describes, in any fixed frame.

    A motion waits until truth lies at both of its ends, for 500 motions at most. Where the message states a covariance,
    axes that the truth knows too little of are left alone; else it counts as exact, but for what interpolation misses
    where it comes more slowly than the odometry.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.forget()

    def forget(self) -> None:
        """The odometry's clock or origin is another one from here on."""
        self._waiting: deque[tuple[VoRecord, Prediction]] = deque(maxlen=_MOTIONS)
        self._watch = StampWatch()
        self._poses: deque[tuple[int, Array, float, float]] = deque(maxlen=_POSES)  # with variances [m^2, rad^2]

    def predicted(self, record: VoRecord, prediction: Prediction | None) -> None:
        """A motion whose error is not known yet."""
        if prediction is not None and record.usable and record.dt_s > 0:
            self._waiting.append((record, prediction))

    def take(self, message: Any, T_body_cam: Array) -> Iterator[tuple[int, Array]]:
        """Stamps and errors ``xi`` (6,) of the motions that a message of truth makes known; NaN where it cannot say."""
        t_ns, T_world_body = stamp_ns(message), read_pose(message)
        if T_world_body is None:
            return
        seen = self._watch.see(t_ns)
        if seen.dropped:
            return
        if seen is Sequence.RESTART:
            self._poses.clear()
        self._poses.append((t_ns, T_world_body @ T_body_cam, *_variances(message)))
        ready = []
        while self._waiting and self._waiting[0][0].t_ns <= t_ns:
            ready.append(self._waiting.popleft())
        if not ready:
            return
        truth = TruthLog(np.array([p[0] for p in self._poses], dtype=np.int64), np.array([p[1] for p in self._poses]))
        errors, known = motion_targets([record for record, _ in ready], truth)
        own = np.repeat(2.0 * np.max([p[2:] for p in self._poses], axis=0), 3)
        stamps = np.array([ready[0][0].t_prev_ns, *(r.t_ns for r, _ in ready)], dtype=np.int64)
        own += 2.0 * interpolation_sigma(truth, stamps) ** 2
        while len(self._poses) > _KEPT and self._poses[1][0] <= stamps[-1]:
            self._poses.popleft()
        for (record, prediction), xi, is_known in zip(ready, errors, known):
            judged = own <= _TRUTH_SHARE * np.diagonal(prediction.covariance)
            if is_known and judged.any():
                yield record.t_ns, np.where(judged, xi, np.nan)


def _variances(message: Any) -> tuple[float, float]:
    """Largest variance of position [m^2] and rotation [rad^2] that is stated; zeros where none is."""
    C = stated_covariance(getattr(message, "pose", None))
    if C is None or not is_positive_definite(C):
        return 0.0, 0.0
    return float(C.diagonal()[:3].max()), float(C.diagonal()[3:].max())
