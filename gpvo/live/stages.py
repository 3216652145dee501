"""From messages to VO records: another odometry's poses, or pairs of images through gpvo's own odometry."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from gpvo.cameras.projections import CameraInfo, rig_from_camera_info
from gpvo.cameras.rectify import Rectifier
from gpvo.cameras.rig import StereoRig
from gpvo.geometry import se3
from gpvo.geometry.covariance import change_body, is_positive_definite, symmetrise
from gpvo.geometry.se3 import rotate_covariance
from gpvo.io.bag_images import PairQueue, decode_message
from gpvo.io.bag_reader import pose_of, stamp_ns
from gpvo.io.bags import camera_info_of, info_topic
from gpvo.io.foreign import T_FLU_OPTICAL
from gpvo.io.foreign_records import UNKNOWN_RAD
from gpvo.io.images import Image8
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S
from gpvo.live.intake import Arrival, Sequence, StampWatch
from gpvo.types import IMPORTED, IMPORTED_POSE, Array, ImuLog, Status, StereoCamera, StereoFrame, VoRecord
from gpvo.vo.odometry import StereoOdometry

_MAX_M, _MAX_MPS, _MAX_RADPS = 1e7, 300.0, 50.0
_ENOUGH, _GROWS = 20, 0.95
_IMU_KEPT = 4000
_PAIRS_KEPT = 10  # while no CameraInfo has come


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
    """``camera``: of the images, None for poses. ``method``: the covariance that stands in for a prediction."""

    counts: Counter[str]
    camera: StereoCamera | None
    T_body_cam: Array
    method: str

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """What a message makes complete."""

    def flush(self) -> Iterator[Taken]:
        """What waited for a message that did not come."""

    def reset(self) -> None:
        """Begin anew with the next message."""


class PoseStage:
    """Somebody else's ``nav_msgs/Odometry`` or ``PoseWithCovarianceStamped`` as records of relative motions.

    The same rules as in :mod:`gpvo.io.foreign`, message by message: the covariance of a motion is that of the twist
    where it is positive definite, else the growth of the pose's. ``T_body_cam``: where the camera sits on the body
    that the poses describe.
    """

    method = IMPORTED
    camera: StereoCamera | None = None

    def __init__(self, topic: str, T_body_cam: Array = T_FLU_OPTICAL) -> None:
        self.topic, self.T_body_cam = topic, T_body_cam
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


class StereoStage:
    """Pairs of images through :class:`gpvo.vo.odometry.StereoOdometry`, with an IMU where one is named.

    ``rig``: the calibration; without it pairs, ten at most, wait for CameraInfo beside the image topics. A pair waits
    for the first IMU sample after it, or for the next pair.
    """

    method = "pointing_matching"

    def __init__(self, left: str, right: str, imu: str | None = None, rig: StereoRig | None = None) -> None:
        self.left, self.right, self.imu = left, right, imu
        self.counts: Counter[str] = Counter()
        self._infos: dict[str, CameraInfo] = {}
        self._rectifier: Rectifier | None = None
        self._odometry: StereoOdometry | None = None
        self._t_last_ns = 0
        self.camera: StereoCamera | None = None
        self.T_body_cam = T_FLU_OPTICAL
        self._shift_ns = 0
        if rig is not None:
            self._calibrate(rig)
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next pair."""
        self._report = SourceReport()
        self._pairs = PairQueue(self.left, round(PAIR_TOLERANCE_S * 1e9), self._report)
        self._watch = StampWatch()
        self._samples: deque[tuple[int, Array]] = deque(maxlen=_IMU_KEPT)
        self._waiting: deque[tuple[int, Any, Any, int]] = deque(maxlen=_PAIRS_KEPT)  # with time of arrival
        self._restart()

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """A record for each pair that is complete, with the IMU's samples since the one before."""
        topic, message = arrival.topic, arrival.message
        if topic == self.imu:
            self._take_imu(message)
        elif topic in (self.left, self.right):
            missing = self._report.missing
            pair = self._pairs.push(topic, message)
            self.counts["unpaired"] += self._report.missing - missing
            if pair is not None:
                if self._rectifier is not None:
                    yield from self.flush()
                elif len(self._waiting) == _PAIRS_KEPT:
                    self.counts["uncalibrated"] += 1
                self._waiting.append((*pair, arrival.received_ns))
        elif topic in (info_topic(self.left), info_topic(self.right)):
            self._take_info(topic, message)
        late = self._samples[-1][0] if self._samples else 0
        is_calibrated = self._rectifier is not None
        if self._waiting and is_calibrated and (self.imu is None or late >= self._waiting[-1][0]):
            yield from self.flush()

    def flush(self) -> Iterator[Taken]:
        """The pairs that wait, with what the IMU has said so far."""
        while self._waiting:
            yield from self._step(*self._waiting.popleft())

    def _step(self, t_ns: int, left: Any, right: Any, received_ns: int) -> Iterator[Taken]:
        if self._rectifier is None or self.camera is None:
            self.counts["uncalibrated"] += 1
            return
        images = [decode_message(m) for m in (left, right)]
        if not all(_fits(i, c) for i, c in zip(images, (self._rectifier.rig.left, self._rectifier.rig.right))):
            self.counts["unreadable"] += 1
            return
        seen = self._watch.see(t_ns)
        self.counts[seen.value] += 1
        if seen.dropped:
            return
        if seen is Sequence.RESTART:
            self._restart()
        begins = self._odometry is None
        if self._odometry is None:
            self._odometry = StereoOdometry(self.camera, mask=self._rectifier.mask)
        assert images[0] is not None
        assert images[1] is not None
        frame = StereoFrame(t_ns, *self._rectifier.apply(images[0], images[1]))
        record = self._odometry.step(frame, None if begins else self._imu_since(t_ns))
        self._t_last_ns = t_ns
        yield Taken(record, begins, received_ns)

    def _restart(self) -> None:
        self._odometry, self._t_last_ns = None, 0

    def _take_info(self, topic: str, message: Any) -> None:
        if self._rectifier is not None:
            return
        self._infos[topic] = camera_info_of(message, topic, topic)
        names = [info_topic(t) for t in (self.left, self.right)]
        if all(n in self._infos for n in names):
            rectified = all("rect" in t for t in (self.left, self.right))
            self._calibrate(rig_from_camera_info(*(self._infos[n] for n in names), rectified=rectified, where=names[1]))

    def _calibrate(self, rig: StereoRig) -> None:
        self._rectifier = Rectifier(rig)
        self.camera = self._rectifier.camera
        self._shift_ns = round(rig.timeshift_cam_imu_s * 1e9)
        place = self._rectifier.mounting.T_body_cam
        self.T_body_cam = T_FLU_OPTICAL if place is None else place

    def _take_imu(self, message: Any) -> None:
        w, a = message.angular_velocity, message.linear_acceleration
        row = np.array([w.x, w.y, w.z, a.x, a.y, a.z])
        t_ns = stamp_ns(message) - self._shift_ns
        if not np.isfinite(row).all() or (self._samples and 0 <= self._samples[-1][0] - t_ns < 10**9):
            self.counts["imu_dropped"] += 1
            return
        self._samples.append((t_ns, row))

    def _imu_since(self, t_ns: int) -> ImuLog | None:
        chosen = [s for s in self._samples if self._t_last_ns < s[0] <= t_ns]
        while self._samples and self._samples[0][0] <= t_ns:
            self._samples.popleft()
        if not chosen:
            return None
        data = np.array([row for _, row in chosen])
        return ImuLog(np.array([t for t, _ in chosen], dtype=np.int64), data[:, :3], data[:, 3:])


def _fits(image: Image8 | None, lens: Any) -> bool:
    return image is not None and image.shape == (lens.height, lens.width)


def lost(record: VoRecord, duration_s: float, covariance: Array, method: str) -> VoRecord:
    """The unknown motion, of ``duration_s``, that leads from the last message of before to the first of anew."""
    t_prev_ns = record.t_ns - max(round(duration_s * 1e9), 1)
    unknown = VoRecord(record.t_ns, t_prev_ns, Status.LOST, np.eye(4), reason="restart of the source")
    return replace(unknown, covariances={method: covariance})
