"""What ROS messages hold: images, and the pairing of two image topics as they stream by; poses; and IMU samples, of one
topic, or of two where a driver publishes gyroscope and accelerometer apart."""

from __future__ import annotations

from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.imagesize import decoded
from gpvo.errors import SourceError, printable
from gpvo.geometry import se3
from gpvo.io.bag_reader import POSE_TYPES, messages, open_bag, stamp_ns, topics_of
from gpvo.io.source import Depth, SourceReport
from gpvo.io.stamps import BACK_NS, PAIR_TOLERANCE_S, Stamps, astray, no_pair, reach_ns, steps_ns
from gpvo.io.trajectory import FARTHEST_M, make_imu
from gpvo.stats.series import interpolated
from gpvo.types import Array, ImuLog

# OpenCV names the pattern by its second row and column.
_BAYER = {"bayer_rggb": "BG", "bayer_bggr": "RG", "bayer_gbrg": "GR", "bayer_grbg": "GB"}
_CHANNELS = {"mono": (1, True), "rgb": (3, False), "bgr": (3, True), "rgba": (4, False), "bgra": (4, True)}
_CHANNELS |= dict.fromkeys(_BAYER, (1, True))
# Names of sensor_msgs/image_encodings.hpp: (type, channels, blue first)
_ENCODINGS: dict[str, tuple[str, int, bool]] = {}
for _bits in (8, 16):
    _ENCODINGS |= {f"{name}{_bits}": (f"u{_bits // 8}", *kind) for name, kind in _CHANNELS.items()}
    _ENCODINGS |= {f"{_bits}uc{n}": (f"u{_bits // 8}", n, True) for n in (1, 3, 4)}
# Of YUV the brightness alone: (bytes from one to the next, first of them); where it is a plane, it comes first.
_LUMA = {
    **dict.fromkeys(("uyvy", "yuv422"), (2, 1)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), (2, 0)),
    **dict.fromkeys(("nv12", "nv21", "nv24"), (1, 0)),
}
# Pairs arrive within a few messages of one another; beyond that a message has lost its partner.
_WAITING = 12
_ENOUGH = 8  # intervals, of both cameras, that tell the usual one
_MOST_FRAMES = 1000
_MOVED_M, _MOVED_RAD = 5e-3, 5e-3
_LEAST_LEFT = 0.9  # of the messages of a topic of poses, without those that repeat a stamp


def decode_message(message: Any, depth: Depth | None = None) -> NDArray[np.uint8] | None:
    """A sensor_msgs Image or CompressedImage as (H, W) uint8; None where it is damaged or of unknown encoding."""
    import cv2

    from gpvo.io.images import to_grey8

    if hasattr(message, "encoding"):
        name, (pixels, bgr) = str(message.encoding).lower(), _raw_pixels(message)
    else:
        # Of image_transport, "bayer_rggb8; png compressed": it compresses the mosaic of a colour filter as it is.
        name, bgr = str(message.format).partition(";")[0].strip().lower(), True
        pixels = decoded(np.asarray(message.data, dtype=np.uint8))
    if pixels is None:
        return None
    pattern = _BAYER.get(name.rstrip("0123456789"))
    if pattern is not None and pixels[0, 0].size == 1:
        pixels = np.asarray(cv2.cvtColor(pixels, getattr(cv2, f"COLOR_Bayer{pattern}2GRAY")))
    return to_grey8(pixels, bgr=bgr, depth=depth)


def encoding_of(message: Any) -> str:
    """What an Image or CompressedImage says that its pixels are."""
    return printable(getattr(message, "encoding", getattr(message, "format", "?")))


def _raw_pixels(message: Any) -> tuple[NDArray[Any] | None, bool]:
    """Pixels (H, W, channels) of an Image, None as above, and whether blue comes first."""
    raw, name = np.asarray(message.data, dtype=np.uint8), str(message.encoding).lower()
    stride, first = _LUMA.get(name, (1, 0))
    kind, channels, bgr = ("u1", 1, True) if name in _LUMA else _ENCODINGS.get(name, ("", 0, True))
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * int(kind[1:] or 0) * stride
    if not 0 < height <= 16384 or not 0 < width <= 16384 or not 0 < row <= step or len(raw) < height * step:
        return None, bgr
    packed = np.ascontiguousarray(raw[: height * step].reshape(height, step)[:, first:row:stride])
    pixels: NDArray[Any] = packed.view((">" if message.is_bigendian else "<") + kind)
    return pixels.astype(kind, copy=False).reshape(height, width, channels), bgr


class PairQueue:
    """Pairs the messages of two image topics as they come in, by stamps at most :func:`reach_ns` apart. Where the
    tolerance might join neighbours, the first ones wait until the interval is known.

    A message that finds no partner among the next dozen is counted as missing; so are those it was overtaken by.
    ``nearest_ns``: the closest that two stamps of both sides ever were.
    """

    def __init__(self, left: str, tolerance_ns: int, report: SourceReport) -> None:
        self._left, self._tolerance_ns, self._report = left, tolerance_ns, report
        self._waiting: dict[bool, deque[tuple[int, Any]]] = {True: deque(), False: deque()}
        self._stamps: dict[bool, deque[int]] = {side: deque(maxlen=_WAITING) for side in (True, False)}
        self._is_sure = tolerance_ns <= PAIR_TOLERANCE_S * 1e9
        self.nearest_ns: float = np.inf

    def push(self, topic: str, message: Any) -> list[tuple[int, Any, Any]]:
        """(left stamp, left message, right message) of the pairs that this message completes."""
        is_left, t = topic == self._left, stamp_ns(message)
        own, others = self._waiting[is_left], self._waiting[not is_left]
        self.nearest_ns = min([self.nearest_ns, *(abs(s - t) for s, _ in others)])
        self._stamps[is_left].append(t)
        own.append((t, message))
        self._is_sure = self._is_sure or len(steps_ns(*self._stamps.values())) >= _ENOUGH
        pairs = self._matched() if self._is_sure else []
        if len(own) > _WAITING:
            _drop(own, 1, self._report)
        return pairs

    def _matched(self) -> list[tuple[int, Any, Any]]:
        reach, out = reach_ns(self._tolerance_ns, *self._stamps.values()), []
        left, right = self._waiting[True], self._waiting[False]
        while found := next(((i, j) for i, (s, _) in enumerate(left) for j, (t, _) in enumerate(right)
                             if abs(s - t) <= reach), None):  # fmt: skip
            for queue, before in zip((left, right), found):
                _drop(queue, before, self._report)
            out.append((*left.popleft(), right.popleft()[1]))
        return out

    def end(self) -> list[tuple[int, Any, Any]]:
        """The pairs among what waits; what stays alone is counted as missing, and forgotten."""
        pairs = self._matched()
        for queue in self._waiting.values():
            _drop(queue, len(queue), self._report)
        return pairs


def pair_streams(
    stream: Iterable[tuple[str, Any]], left: str, tolerance_ns: int, report: SourceReport, where: object
) -> Iterator[tuple[int, Any, Any]]:
    """(left stamp, left message, right message) of a whole recording: :class:`PairQueue`. Images without a stamp are
    counted as missing.

    Raises SourceError at the end, where no message found a partner.
    """
    queue = PairQueue(left, tolerance_ns, report)
    for topic, message in stream:
        if stamp_ns(message) == 0:
            report.count("missing", f"an image on '{topic}' carries no stamp")
        else:
            yield from queue.push(topic, message)
    yield from queue.end()
    if tolerance_ns < queue.nearest_ns < np.inf:
        raise no_pair(tolerance_ns, int(queue.nearest_ns), where)


def _drop(queue: deque[tuple[int, Any]], count: int, report: SourceReport) -> None:
    for _ in range(count):
        report.count("missing", f"no partner for the image at {queue.popleft()[0]} ns")


def pose_of(message: Any) -> Array:
    """(7,) position and quaternion x y z w of an Odometry, PoseStamped, PoseWithCovarianceStamped or
    TransformStamped."""
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=np.float64)


def read_pose(message: Any, farthest_m: float = FARTHEST_M) -> Array | None:
    """The pose or transform (4, 4) of a message; None where it is not finite, too far away, or no rotation."""
    row = pose_of(message)
    norm = float(np.linalg.norm(row[3:]))
    # Comparisons with NaN are false.
    if not (np.abs(row[:3]).max() <= farthest_m and abs(norm - 1.0) <= 0.1):
        return None
    return se3.from_quaternion(row[:3], row[3:] / norm)


def frame_name(name: object) -> str:
    """Of a frame, without ROS 1's leading slash."""
    return str(name).removeprefix("/")


class FrameTree:
    """The tree of frames in ``tf2_msgs/TFMessage``; of each frame the newest place on its parent holds.

    ``refused``: how many transforms were not finite, no rotation, or of a frame on itself.
    """

    def __init__(self) -> None:
        self.refused = 0
        self._places: dict[str, tuple[str, Array]] = {}  # child: parent, T_parent_child

    def take(self, message: Any) -> None:
        """The transforms of one message."""
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            T_parent_child = read_pose(transform)
            is_full = child not in self._places and len(self._places) >= _MOST_FRAMES
            if T_parent_child is None or parent == child or is_full:
                self.refused += 1
            else:
                self._places[child] = (parent, T_parent_child)

    def transform(self, target: str, source: str) -> Array | None:
        """T_target_source (4, 4); None where no chain of transforms joins the two frames."""
        to_target, to_source = self._ancestors(target), self._ancestors(source)
        common = next((name for name in to_target if name in to_source), None)
        return None if common is None else se3.inverse(to_target[common]) @ to_source[common]

    def _ancestors(self, name: str) -> dict[str, Array]:
        """The frame itself and all above it, nearest first, with T_ancestor_frame."""
        T, out = np.eye(4), {name: np.eye(4)}
        while name in self._places and self._places[name][0] not in out:
            name, T_parent = self._places[name]
            out[name] = T = T_parent @ T
        return out


def has_moved(T_a: Array, T_b: Array) -> bool:
    """Whether a mounting (4, 4) is another than it was, beyond rounding and a calibration that is refined."""
    change = np.abs(se3.log(se3.inverse(T_a) @ T_b))
    return bool(change[:3].max() > _MOVED_M or change[3:].max() > _MOVED_RAD)


def covariances_of(messages: Sequence[Any], name: str) -> Array | None:
    """(N, 6, 6) covariances of the ``pose`` or ``twist`` of messages, None where their type has none."""
    if not hasattr(getattr(messages[0], name, None), "covariance"):
        return None
    return np.array([getattr(m, name).covariance for m in messages], dtype=np.float64).reshape(-1, 6, 6)


def read_poses(
    path: Path, topic: str, remark: Callable[[str], None], *, complete: bool = False
) -> tuple[np.ndarray, Array, list[Any]]:
    """Stamps (N,) [ns], poses (N, 4, 4) and the messages of one topic, in order of time, repeated stamps dropped.

    ``remark`` is told how many were dropped, or out of order. Messages that hold no pose, as some odometries send when
    they are lost, are dropped, or refused where the poses must be ``complete``; those without a stamp, or with a wrong
    one, and a few between other frames than most, are dropped. Raises SourceError where the topic has no poses or mixes
    frames, and where its clock goes back by more than a second or gives many messages one stamp.
    """
    with open_bag(path) as reader:
        available = topics_of(reader, POSE_TYPES)
        if topic not in available:
            found = ", ".join(available) or "none"
            raise SourceError(f"has no poses on '{topic}' (topics with poses: {found})", where=path)
        kept = [message for _, message in messages(reader, [topic])]
    kept = _of_one_odometry(kept, topic, path, remark)
    t = np.array([stamp_ns(m) for m in kept], dtype=np.int64)
    wrong = astray(t)
    if wrong.any():
        remark(f"left out: {int(wrong.sum())} of {len(t)} messages on '{topic}', stamped seconds off")
    t, kept = t[~wrong], list(compress(kept, ~wrong))
    data = np.array([pose_of(m) for m in kept])
    order = _in_time(t, data, topic, path, remark)
    good = np.isfinite(data[order]).all(axis=1) & (np.abs(np.linalg.norm(data[order, 3:], axis=1) - 1) < 0.1)
    if bad := int((~good).sum()):
        if complete or bad == len(order):
            raise SourceError(f"message {order[~good][0] + 1} on '{topic}' holds no valid pose", where=path)
        remark(f"left out: {bad} of {len(t)} messages on '{topic}', without a valid pose")
    order = order[good]
    t, data = t[order], data[order]
    return t, se3.from_quaternion(data[:, :3], data[:, 3:]), [kept[i] for i in order]


def _of_one_odometry(given: list[Any], topic: str, path: Path, remark: Callable[[str], None]) -> list[Any]:
    """Those with a stamp, if any has one, and of the frames that most are between."""
    kept = [m for m in given if stamp_ns(m)]
    if not kept or min(map(stamp_ns, kept)) < BACK_NS:  # on a clock that starts there, zero is a stamp
        kept = given
    if unset := len(given) - len(kept):
        remark(f"left out: {unset} of {len(given)} messages on '{topic}', without a stamp")
    frames = [(str(m.header.frame_id), str(getattr(m, "child_frame_id", ""))) for m in kept]
    (most, count), *others = Counter(frames).most_common()
    if count < _LEAST_LEFT * len(kept):
        a, b = (" to ".join(filter(None, pair)) for pair in (most, others[0][0]))
        cure = "one topic must be one odometry's: record its publishers apart, or split the bag where the frames change"
        raise SourceError(f"poses of different frames are mixed on '{topic}': {a}, and {b}", where=path, cure=cure)
    if others:
        remark(f"left out: {len(kept) - count} of {len(kept)} messages on '{topic}', of other frames")
    return [m for m, pair in zip(kept, frames) if pair == most]


def _in_time(t_ns: Stamps, poses: Array, topic: str, path: Path, remark: Callable[[str], None]) -> NDArray[np.intp]:
    """Indices of the messages at (N,) stamps, of (N, 7) poses, in order of time, the first of those that share one."""
    where, steps = f"on '{topic}'", np.diff(t_ns)
    if len(steps) and -steps.min() > BACK_NS:
        text = f"the stamps {where} go back by {-steps.min() * 1e-9:.3f} s at message {int(steps.argmin()) + 2}"
        raise SourceError(text, where=path, cure="the clock was set or restarted: split the bag there")
    order = np.argsort(t_ns, kind="stable")
    again = np.concatenate([[False], np.diff(t_ns[order]) == 0])
    # A driver may publish each pose twice; other poses at one time are no poses.
    other = int((again[1:] & (np.diff(poses[order], axis=0) != 0).any(axis=1)).sum())
    order, repeated, late = order[~again], int(again.sum()), int((steps < 0).sum())
    if other > (1 - _LEAST_LEFT) * len(t_ns):
        text = f"{other} of {len(t_ns)} messages {where} repeat a stamp with another pose"
        cure = "header.stamp must be the time of each measurement; after the clock restarts, use a new bag"
        raise SourceError(text, where=path, cure=cure)
    if repeated:
        remark(f"left out: {repeated} of {len(t_ns)} messages {where}, with a repeated stamp")
    if late:
        remark(f"sorted by stamp: {late} of {len(t_ns)} messages {where}, which came out of order")
    return order


def imu_topics(topics: list[str]) -> list[tuple[str, ...]]:
    """What can serve as IMU, the best first: whole topics, then gyroscopes with the accelerometer beside them."""
    pairs = [(t, acc) for t in topics if (acc := accelerometer_beside(t)) in topics and acc is not None]
    halves = {topic for pair in pairs for topic in pair}
    return [*((t,) for t in topics if t not in halves), *pairs]


def accelerometer_beside(gyroscope: str) -> str | None:
    """The topic of the accelerometer of a driver that publishes gyroscope and accelerometer apart, None by other names.

    realsense-ros has ``/camera/gyro/sample`` and ``/camera/accel/sample``, each with the other's fields zero.
    """
    names = (("gyro", "accel"), ("Gyro", "Accel"))
    return next((gyroscope.replace(gyro, acc) for gyro, acc in names if gyro in gyroscope), None)


def read_imu(
    path: Path, candidates: list[tuple[str, ...]], shift_s: float, remark: Callable[[str], None]
) -> tuple[ImuLog, str] | None:
    """The first of the candidates that measures rates, in the camera's time by ``t_imu = t_cam + shift_s``, and the
    name of its frame.

    An accelerometer of its own is interpolated onto the gyroscope's stamps, inside the time that both cover.
    ``acc_mps2`` is NaN throughout where nothing measured it.
    """
    for topics in candidates:
        t_ns, data, frame = _samples(path, topics[0])
        if len(topics) == 2:
            t_ns, data = with_accelerometer(t_ns, data, *_samples(path, topics[1])[:2])
        no_acc = bool(np.isnan(data[:, 3:]).all())
        good = np.isfinite(data[:, :3]).all(axis=1) & (no_acc | np.isfinite(data[:, 3:]).all(axis=1))
        if not good.any():
            when = f" while '{topics[1]}' runs" if len(topics) == 2 else ""
            remark(f"'{topics[0]}' not used as IMU: it measures no rates{when}")
            continue
        if no_acc:
            remark(f"'{topics[0]}' is a gyroscope only: it measures no acceleration")
        elif len(topics) == 2:
            remark(f"IMU of '{topics[0]}', with '{topics[1]}' interpolated onto its stamps")
        return make_imu(t_ns[good], data[good], shift_s=shift_s, remark=remark), frame
    return None


def _samples(path: Path, topic: str) -> tuple[Stamps, Array, str]:
    """Stamps (N,) and samples (N, 6), gyro first; NaN where the topic does not measure: its covariance begins with -1,
    as ROS has it, or nothing but exact zeros came. And the frame that the last one names."""
    frame, stamps, rows = "", array("q"), array("d")  # of hours: lists of numbers take several times as much
    with open_bag(path) as reader:
        for _, m in messages(reader, [topic]):
            stamps.append(stamp_ns(m))
            frame = m.header.frame_id
            measured = (m.angular_velocity, m.linear_acceleration)
            covariances = (m.angular_velocity_covariance, m.linear_acceleration_covariance)
            for v, C in zip(measured, covariances):
                rows.extend((v.x, v.y, v.z, C[0]))
    data = np.array(rows, dtype=np.float64).reshape(-1, 2, 4)
    for values in (data[:, 0], data[:, 1]):
        if (values[:, 3] == -1).all() or not values[:, :3].any():
            values[:] = np.nan
    return np.array(stamps, dtype=np.int64), data[:, :, :3].reshape(-1, 6), frame_name(frame)


def with_accelerometer(t_ns: Stamps, data: Array, t_acc_ns: Stamps, acc_data: Array) -> tuple[Stamps, Array]:
    """Stamps and samples (N, 6) of a gyroscope with accelerations (M, 6) interpolated onto them, where both cover; as
    they were where nothing measures any."""
    good = np.isfinite(acc_data[:, 3:]).all(axis=1)
    t_acc, first = np.unique(t_acc_ns[good], return_index=True)
    if len(t_acc) == 0:
        return t_ns, data
    acc = acc_data[good, 3:][first]
    inside = (t_ns >= t_acc[0]) & (t_ns <= t_acc[-1])
    t, out = t_ns[inside], data[inside].copy()
    # From the first stamp on: nanoseconds of an epoch are finer than a float.
    out[:, 3:] = interpolated(t - t_acc[0], t_acc - t_acc[0], acc)
    return t, out
