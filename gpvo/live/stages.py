"""From messages to VO records: what a stage is, and the stage of another odometry's poses."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from gpvo.geometry import se3
from gpvo.geometry.covariance import change_body, is_positive_definite, symmetrise
from gpvo.geometry.se3 import rotate_covariance
from gpvo.io.bag_reader import pose_of, stamp_ns
from gpvo.io.foreign import T_FLU_OPTICAL
from gpvo.io.stated import UNKNOWN_RAD
from gpvo.live.intake import Arrival, Sequence, StampWatch
from gpvo.types import IMPORTED, IMPORTED_POSE, Array, Status, StereoCamera, VoRecord

_MAX_M, _MAX_MPS, _MAX_RADPS = 1e7, 300.0, 50.0
_ENOUGH, _GROWS = 20, 0.95


@dataclass(frozen=True)
class Taken:
    """One record for the engine. ``begins``: nothing before it holds (the first message, or one after a restart)."""

    record: VoRecord
    begins: bool
    received_ns: int
    T_parent_body: Array | None = None  # the source's own pose of the body, where it has one
    frame_id: str = "odom"
    child_frame_id: str = "base_link"


class Stage(Protocol):
    """``method``: the covariance that stands in for a prediction. ``topic``: where the source names its own frame, on
    which the camera sits at ``T_source_cam`` (4, 4).
    """

    counts: Counter[str]
    method: str
    topic: str

    @property
    def camera(self) -> StereoCamera | None:
        """Of the images; None for poses."""

    @property
    def T_source_cam(self) -> Array:
        """Camera to the frame that messages on ``topic`` name."""

    @property
    def T_body_cam(self) -> Array:
        """Camera to the body whose odometry is published."""

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """What a message makes complete."""

    def flush(self) -> Iterator[Taken]:
        """What waited for a message that did not come."""

    def reset(self) -> None:
        """Begin anew with the next message."""

    def problems(self) -> list[str]:
        """What keeps it from working, in words."""


class PoseStage:
    """Somebody else's ``nav_msgs/Odometry`` or ``PoseWithCovarianceStamped`` as records of relative motions.

    The same rules as in :mod:`gpvo.io.foreign`, message by message: the covariance of a motion is that of the twist
    where it is positive definite, else the growth of the pose's. ``T_body_cam``: where the camera sits on the body
    that the poses describe.
    """

    method = IMPORTED
    camera: StereoCamera | None = None

    def __init__(self, topic: str, T_body_cam: Array = T_FLU_OPTICAL) -> None:
        self.topic, self.T_body_cam, self.T_source_cam = topic, T_body_cam, T_body_cam
        self.counts: Counter[str] = Counter()
        self._T_cam_body = se3.inverse(T_body_cam)
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next message."""
        self._watch = StampWatch()
        self._last: tuple[int, Array, Array | None] | None = None  # stamp, T_parent_cam, covariance of the pose
        self._growth: deque[bool] = deque(maxlen=200)

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """One record, unless the message is late, repeated, absurd or of another clock."""
        if arrival.topic != self.topic:
            return
        message, row = arrival.message, pose_of(arrival.message)
        norm = float(np.linalg.norm(row[3:]))
        if not np.isfinite(row).all() or abs(norm - 1.0) > 0.1 or np.abs(row[:3]).max() > _MAX_M:
            self.counts["absurd"] += 1
            return
        t_ns = stamp_ns(message)
        seen = self._watch.see(t_ns)
        self.counts[seen.value] += 1
        if seen.dropped:
            return
        if seen is Sequence.RESTART:
            self._last = None
        T_parent_body = se3.from_quaternion(row[None, :3], row[None, 3:] / norm)[0]
        begins = self._last is None
        record = self._record(t_ns, T_parent_body @ self.T_body_cam, message, seen)
        child = str(getattr(message, "child_frame_id", "")) or "base_link"
        frame = str(message.header.frame_id) or "odom"
        yield Taken(record, begins, arrival.received_ns, T_parent_body, frame, child)

    def flush(self) -> Iterator[Taken]:
        """Nothing: a pose waits for nothing."""
        return iter(())

    def problems(self) -> list[str]:
        """None: a pose needs nothing else."""
        return []

    def _record(self, t_ns: int, T_parent_cam: Array, message: Any, seen: Sequence) -> VoRecord:
        before, pose = self._last, self._pose_covariance(message, T_parent_cam)
        self._last = (t_ns, T_parent_cam, pose)
        if before is None:
            return VoRecord(t_ns, t_ns, Status.START, np.eye(4))
        T_prev_cur = se3.inverse(before[1]) @ T_parent_cam
        dt_s = (t_ns - before[0]) * 1e-9
        stated = self._stated(message, T_prev_cur, dt_s, before[2], pose)
        status, reason = Status.OK, ""
        rate = np.abs(se3.log(T_prev_cur)) / dt_s
        if seen is Sequence.GAP:
            status, reason = Status.LOST, "gap in the log"
        elif rate[:3].max() > _MAX_MPS or rate[3:].max() > _MAX_RADPS:
            status, reason = Status.LOST, "impossible speed"
            self.counts["jumps"] += 1
        elif IMPORTED in stated and (np.diagonal(stated[IMPORTED])[3:] > UNKNOWN_RAD**2).all():
            status, reason = Status.LOST, "stated as unknown"
        return VoRecord(t_ns, before[0], status, T_prev_cur, reason=reason, covariances=stated)

    def _pose_covariance(self, message: Any, T_parent_cam: Array) -> Array | None:
        """(6, 6) in the camera's axes, None where none is stated."""
        C = _matrix(getattr(message, "pose", None))
        if C is None:
            return None
        R_parent_body = (T_parent_cam @ self._T_cam_body)[:3, :3]
        return change_body(self._T_cam_body, rotate_covariance(R_parent_body.T, C))

    def _stated(
        self, message: Any, T_prev_cur: Array, dt_s: float, before: Array | None, now: Array | None
    ) -> dict[str, Array]:
        twist = _matrix(getattr(message, "twist", None))
        if twist is not None:
            return {IMPORTED: symmetrise(change_body(self._T_cam_body, twist) * dt_s**2)}
        if before is None or now is None:
            return {}
        A = se3.adjoint(se3.inverse(T_prev_cur))
        growth = symmetrise(now - A @ before @ A.T)
        grows = is_positive_definite(growth)
        self._growth.append(grows)
        if len(self._growth) >= _ENOUGH and np.mean(self._growth) < _GROWS:
            return {IMPORTED_POSE: symmetrise(now)}
        return {IMPORTED: growth} if grows else {}


def _matrix(holder: Any) -> Array | None:
    """The (6, 6) covariance of a PoseWithCovariance or TwistWithCovariance; None where it states nothing."""
    flat = getattr(holder, "covariance", None)
    if flat is None or np.size(flat) != 36:
        return None
    C = np.asarray(flat, dtype=np.float64).reshape(6, 6)
    return C if is_positive_definite(C) else None


def lost(record: VoRecord, duration_s: float, covariance: Array, method: str) -> VoRecord:
    """The unknown motion, of ``duration_s``, that leads from the last message of before to the first of anew."""
    t_prev_ns = record.t_ns - max(round(duration_s * 1e9), 1)
    unknown = VoRecord(record.t_ns, t_prev_ns, Status.LOST, np.eye(4), reason="restart of the source")
    return replace(unknown, covariances={method: covariance})
