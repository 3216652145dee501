"""From messages to VO records: the stage of another odometry's poses, and that of a robot's base frame by the
transforms that ROS publishes on /tf and /tf_static.

A stage's ``method`` is the covariance that stands in for a prediction; on ``topic`` the source names its own frame, on
which the camera sits at ``T_source_cam`` (4, 4), and at ``T_body_cam`` on the body whose odometry is published.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import printable
from gpvo.geometry import se3
from gpvo.geometry.covariance import (
    are_semidefinite,
    change_body,
    is_positive_definite,
    is_symmetric,
    symmetrise,
)
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.bag_messages import FrameTree, frame_name, has_moved, read_pose
from gpvo.io.bag_reader import TF_TOPICS, stamp_ns
from gpvo.io.foreign import definite_in_plane, into_body, is_optical, moving_frame
from gpvo.io.stated import is_turn_unknown
from gpvo.live.intake import CONFIRM, Arrival, Sequence, StampWatch
from gpvo.stats.consistency import SEEN
from gpvo.stats.series import Doubt
from gpvo.types import IMPORTED, IMPORTED_POSE, Array, Status, StereoCamera, VoRecord

if TYPE_CHECKING:
    from gpvo.live.stereo_stage import StereoStage

_MAX_M, _MAX_MPS, _MAX_RADPS = 1e7, 300.0, 50.0
_ENOUGH, _GROWS = 20, 0.95
_RECENT, _FEW = 50, 0.1  # messages that troubles are looked for in, and the share of them that is none
_IMPOSSIBLE = "impossible speed"
_FAST = "are reached at impossible speeds: does something else publish there, too, or are they not in metres?"


@dataclass(frozen=True)
class Taken:
    """One record for the engine. ``begins``: nothing before it holds (the first message, or one after a restart)."""

    record: VoRecord
    begins: bool
    received_ns: int
    T_parent_body: Array | None = None  # the source's own pose of the body, where it has one
    frame_id: str = "odom"
    child_frame_id: str = "base_link"


class PoseStage:
    """Somebody else's ``nav_msgs/Odometry`` or ``PoseWithCovarianceStamped`` as records of relative motions.

    The same rules as in :mod:`gpvo.io.foreign`, message by message: the covariance of a motion is that of the twist
    where it is positive definite, else the growth of the pose's; of a robot in a plane, on the axes along which it has
    moved. ``T_body_cam``: where the camera sits on the body that the poses describe; by default as the messages name
    their frame, optical or not. ``covariance_axes``: of the poses' covariances, as ``read_foreign`` has them.
    """

    method = IMPORTED
    camera: StereoCamera | None = None
    odometry: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, topic: str, T_body_cam: Array | None = None, covariance_axes: str = "auto") -> None:
        self.topic, self._is_fixed, self._axes = topic, T_body_cam is not None, covariance_axes
        self.counts: Counter[str] = Counter()
        self._place(T_FLU_OPTICAL if T_body_cam is None else T_body_cam)
        self.reset()

    def _place(self, T_body_cam: Array) -> None:
        self.T_body_cam = self.T_source_cam = T_body_cam
        self._T_cam_body = se3.inverse(T_body_cam)

    def reset(self) -> None:
        """Begin anew with the next message."""
        self._watch = StampWatch()
        self._frames: tuple[str, str] | None = None
        self._doubt: Doubt[tuple[str, str]] = Doubt(CONFIRM)
        self._last: tuple[int, Array, Array | None] | None = None  # stamp, T_parent_cam, covariance of the pose
        self._is_unknown = False
        self._growth: deque[bool] = deque(maxlen=200)
        self._troubles: deque[str] = deque(maxlen=_RECENT)  # of the last messages, empty for none
        self._moved, self._motions = np.zeros(6), 0  # sum of the squared motions of the body by axis, and their count

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """One record, unless the message is late, repeated, absurd, of another clock or between other frames."""
        if arrival.topic != self.topic:
            return
        message, T_parent_body = arrival.message, read_pose(arrival.message, _MAX_M)
        if T_parent_body is None:
            self.counts["absurd"] += 1
            return
        frames = str(message.header.frame_id), str(getattr(message, "child_frame_id", ""))
        if frames == (self._frames or frames):
            self._doubt.clear()
        elif self._doubt.is_settled_by(frames, lambda before, now: before == now):
            self._last = None
        else:
            self.counts["other_frames"] += 1
            told = printable(" to ".join(filter(None, frames)))
            self._troubles.append(f"are between other frames ({told}): does something else publish there, too?")
            return
        if frames != self._frames and not self._is_fixed:
            self._place(np.eye(4) if is_optical(moving_frame(message)) else T_FLU_OPTICAL)
        self._frames = frames
        t_ns = stamp_ns(message)
        seen = self._watch.see(t_ns)
        self.counts[seen.value] += 1
        if seen.dropped:
            return
        if seen is Sequence.RESTART:
            self._last = None
        begins = self._last is None
        record = self._record(t_ns, T_parent_body @ self.T_body_cam, message, seen)
        self._troubles.append(_FAST if record.reason == _IMPOSSIBLE else "")
        parent, child = frames
        if not child and is_optical(parent):  # a pose message's one name is that of what moves
            parent, child = child, parent
        yield Taken(record, begins, arrival.received_ns, T_parent_body, parent or "odom", child or "base_link")

    def flush(self) -> Iterator[Taken]:
        """Nothing: a pose waits for nothing."""
        return iter(())

    def problems(self) -> list[str]:
        """Many messages of late between other frames, or too far from one to the next."""
        found = Counter(filter(None, self._troubles)).most_common(1)
        if not found or found[0][1] <= _FEW * _RECENT:
            return []
        (what, count), last = found[0], len(self._troubles)
        return [f"{count} of the last {last} poses on '{self.topic}' {what}"]

    def _record(self, t_ns: int, T_parent_cam: Array, message: Any, seen: Sequence) -> VoRecord:
        before, pose = self._last, stated_covariance(getattr(message, "pose", None))
        if pose is not None:  # in the body's axes
            pose = into_body(T_parent_cam @ self._T_cam_body, pose, self._axes)
        self._last = (t_ns, T_parent_cam, pose)
        if before is None:
            return VoRecord(t_ns, t_ns, Status.START, np.eye(4))
        T_prev_cur = se3.inverse(before[1]) @ T_parent_cam
        dt_s = (t_ns - before[0]) * 1e-9
        stated = self._stated(message, self.T_body_cam @ T_prev_cur @ self._T_cam_body, dt_s, before[2], pose)
        was_unknown = self._is_unknown
        self._is_unknown = IMPORTED in stated and bool(is_turn_unknown(stated[IMPORTED][None])[0])
        if self._is_unknown:  # its pose is a placeholder, as in to_records
            T_prev_cur, self._last = np.eye(4), (t_ns, before[1], pose)
        status, reason = Status.OK, ""
        rate = np.abs(se3.log(T_prev_cur)) / dt_s
        if seen is Sequence.GAP:
            status, reason = Status.LOST, "gap in the log"
        elif rate[:3].max() > _MAX_MPS or rate[3:].max() > _MAX_RADPS:
            status, reason = Status.LOST, _IMPOSSIBLE
            self.counts["jumps"] += 1
        elif self._is_unknown or was_unknown:
            status, reason = Status.LOST, "stated as unknown"
        return VoRecord(t_ns, before[0], status, T_prev_cur, reason=reason, covariances=stated)

    def _stated(
        self, message: Any, T_body_prev_cur: Array, dt_s: float, before: Array | None, now: Array | None
    ) -> dict[str, Array]:
        """What is stated of the body's motion, or else of its poses, in the camera's axes."""
        self._moved, self._motions = self._moved + se3.log(T_body_prev_cur) ** 2, self._motions + 1
        twist = stated_covariance(getattr(message, "twist", None))
        if twist is not None and (of_velocity := self._of_camera(twist)) is not None:
            return {IMPORTED: of_velocity * dt_s**2}
        if before is None or now is None:
            return {}
        A = se3.adjoint(se3.inverse(T_body_prev_cur))
        name, found = IMPORTED, self._of_camera(now - A @ before @ A.T, np.diagonal(now))
        if found is not None or not self._still.all():  # before it moves, nothing tells the axes of a plane
            self._growth.append(found is not None)
        if len(self._growth) >= _ENOUGH and np.mean(self._growth) < _GROWS:
            name, found = IMPORTED_POSE, self._of_camera(now)
        return {} if found is None else {name: found}

    @property
    def _still(self) -> NDArray[np.bool_]:
        """(6,) axes of the body along and about which it has not moved so far: see ``still_axes``."""
        return np.asarray(self._moved < self._motions * SEEN**2)

    def _of_camera(self, covariance: Array, variance: Array | None = None) -> Array | None:
        """A covariance (6, 6) of the body in the camera's axes; None where it is not a covariance."""
        of_pose = None if variance is None else variance[None]
        C = definite_in_plane(symmetrise(covariance)[None], self._still, of_pose)[0]
        return symmetrise(change_body(self._T_cam_body, C)) if is_positive_definite(C) else None


def stated_covariance(holder: Any) -> Array | None:
    """The (6, 6) covariance of a PoseWithCovariance or TwistWithCovariance, zeros too; None where it is not one."""
    flat = getattr(holder, "covariance", None)
    if flat is None or np.size(flat) != 36:
        return None
    C = np.asarray(flat, dtype=np.float64).reshape(6, 6)
    return C if are_semidefinite(C[None])[0] and is_symmetric(C) else None


def lost(record: VoRecord, duration_s: float, covariance: Array, method: str) -> VoRecord:
    """The unknown motion, of ``duration_s``, from the last message before a restart to the first after it."""
    t_prev_ns = record.t_ns - max(round(duration_s * 1e9), 1)
    stated, reason = {method: covariance}, "restart of the source"
    return VoRecord(record.t_ns, t_prev_ns, Status.LOST, np.eye(4), reason=reason, covariances=stated)


class BaseFrameStage:
    """A stage whose odometry is that of the frame ``base``, which sits rigidly on the frame that the source names.

    The place is read once for each frame that the source names, from the first transforms that join the two; messages
    of before are dropped and counted (``unplaced``). If the transforms say something else later, that is a problem, and
    the first place stays.
    """

    def __init__(self, inner: PoseStage | StereoStage, base: str) -> None:
        self.inner, self.base, self.topic = inner, frame_name(base), inner.topic
        self.counts: Counter[str] = inner.counts
        self.method = inner.method
        self._tree = FrameTree()
        self._source: str | None = None
        self._T_base_source: Array | None = None
        self._has_moved = self._is_nameless = False

    @property
    def camera(self) -> StereoCamera | None:
        """Of the images; None for poses."""
        return self.inner.camera

    @property
    def odometry(self) -> Mapping[str, Any]:
        """Of the stage within."""
        return self.inner.odometry

    @property
    def T_source_cam(self) -> Array:
        """As the stage within has it."""
        return self.inner.T_source_cam

    @property
    def T_body_cam(self) -> Array:
        """Camera to base; of a base that has no place yet, to the source's frame."""
        return self.T_source_cam if self._T_base_source is None else self._T_base_source @ self.T_source_cam

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """What the stage within takes, once the place of the base is known."""
        if arrival.topic in TF_TOPICS:
            self._tree.take(arrival.message)
            self.counts["tf_refused"] = self._tree.refused
            self._look_again()
            yield from map(self._of_base, self.inner.take(arrival))  # it may place an IMU, too
            return
        names_it = arrival.topic == self.topic
        if names_it and self._T_base_source is None and not self._is_placed(arrival.message):
            self.counts["unplaced"] += 1
            return
        for taken in self.inner.take(arrival):
            if names_it and taken.begins and not self._is_placed(arrival.message):
                self.counts["unplaced"] += 1
                self.inner.reset()
                return
            yield self._of_base(taken)

    def flush(self) -> Iterator[Taken]:
        """What waited in the stage within."""
        yield from map(self._of_base, self.inner.flush())

    def reset(self) -> None:
        """Begin anew with the next message; the place of the base holds."""
        self.inner.reset()

    def problems(self) -> list[str]:
        """What the transforms do not say, or say in two ways."""
        if self._is_nameless:
            return ["the poses do not name the frame that moves: --base-frame needs nav_msgs/Odometry"]
        joined = f"{printable(self.base)} to {printable(self._source or '')}"
        if self._source is not None and self._T_base_source is None:
            return [f"no transform from {joined} on /tf_static or /tf", *self.inner.problems()]
        moved = [f"the transform from {joined} changes: the mounting must be rigid"] if self._has_moved else []
        return moved + self.inner.problems()

    def _is_placed(self, message: Any) -> bool:
        # The header of an image names what is placed; that of a pose names the frame that it is stated in.
        header_names_it = not isinstance(self.inner, PoseStage)
        named = getattr(message, "child_frame_id", message.header.frame_id if header_names_it else None)
        self._is_nameless = named is None
        if named is None:
            return False
        if self._T_base_source is None or frame_name(named) != self._source:
            self._source, self._has_moved = frame_name(named), False
            self._T_base_source = self._tree.transform(self.base, self._source)
        return self._T_base_source is not None

    def _look_again(self) -> None:
        if self._T_base_source is None or self._source is None:
            return
        now = self._tree.transform(self.base, self._source)
        if now is not None:
            self._has_moved = has_moved(self._T_base_source, now)

    def _of_base(self, taken: Taken) -> Taken:
        T = taken.T_parent_body
        if T is not None and self._T_base_source is not None:
            T = T @ se3.inverse(self._T_base_source)
        return replace(taken, T_parent_body=T, child_frame_id=self.base)
