"""Stereo images from ROS 1 bags, ROS 2 bags and MCAP files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.kalibr import camchain_topics
from gpvo.cameras.readers import SIDES, CameraInfo, find_calibration, read_stereo_yaml, rig_from_camera_info
from gpvo.cameras.rig import StereoRig
from gpvo.errors import CalibrationError, SourceError, printable
from gpvo.io.bag_messages import (
    FrameTree,
    decode_message,
    encoding_of,
    frame_name,
    has_moved,
    imu_topics,
    pair_streams,
    read_imu,
    read_poses,
)
from gpvo.io.bag_reader import (
    IMAGE_TYPES,
    IMU_TYPE,
    INFO_TYPE,
    ODOMETRY_TYPE,
    POSE_TYPES,
    TF_STATIC,
    TF_TOPICS,
    TF_TYPE,
    is_bag,
    messages,
    open_bag,
    stamp_ns,
    topics_of,
)
from gpvo.io.images import Image8, ImageSource, check_size
from gpvo.io.source import SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, tolerance_ns, usual_interval
from gpvo.io.trajectory import MOTION_CAPTURE, UNKNOWN, Trajectory, carry, check_overlap
from gpvo.types import Array, TruthLog

_CAPTURE_NAMES = ("vicon", "mocap", "optitrack", "vrpn", "qualisys")
_BASE = "base_link"


@dataclass(frozen=True)
class _Topics:
    left: str
    right: str
    imu: list[tuple[str, ...]]
    truth: str | None
    doubtful: str | None  # poses that may be a truth, but nobody said whose
    count: int
    unused: tuple[str, ...] = ()  # odometry that nothing reads


class BagSource(ImageSource):
    """A pair of image topics with CameraInfo, or a Kalibr camera chain beside the bag.

    Topics are guessed from the calibration's ``rostopic`` or the drivers' habits; ``left_topic``, ``right_topic``,
    ``imu_topic`` and ``truth_topic`` (``"none"`` for no truth) override. Stamps of a pair may differ by
    ``tolerance_s``. The place of an IMU that the calibration does not know is that of its frame by /tf_static.
    ``truth_frame`` (``"imu"`` or ``"cam"``) says whose poses the truth topic holds: the IMU's where the calibration
    knows its place, unless stated. Poses of motion capture are guessed to be the truth only with ``truth_frame``:
    its markers rarely sit where the IMU does. ``bits`` is the depth of the samples in 16-bit images. ``base_frame``:
    the robot's frame that becomes the body, located through /tf_static and /tf from that of the left images.
    """

    format = "rosbag"

    def __init__(
        self,
        path: Path,
        *,
        left_topic: str | None = None,
        right_topic: str | None = None,
        imu_topic: str | None = None,
        truth_topic: str | None = None,
        truth_frame: str | None = None,
        base_frame: str | None = None,
        tolerance_s: float = PAIR_TOLERANCE_S,
        calibration: str | Path | None = None,
        **options: Any,
    ) -> None:
        if truth_frame not in (None, "imu", "cam"):
            raise SourceError(f"truth frame '{truth_frame}' is neither 'imu' nor 'cam'")
        chain = Path(calibration) if calibration is not None else find_calibration(path, path.parent)
        with open_bag(path) as reader:
            asked = (left_topic, right_topic, imu_topic, truth_topic)
            self._topics = _choose_topics(reader, path, chain, asked, any_truth=truth_frame is not None)
            sizes, first = _first_images(reader, path, self._topics)
            _, image = next(messages(reader, [self._topics.left], lambda _: None))
            self._camera = frame_name(image.header.frame_id)
            is_placed = TF_STATIC in topics_of(reader, (TF_TYPE,))
            rig = read_stereo_yaml(chain, size=sizes[0]) if chain else _rig_from_bag(reader, path, self._topics, sizes)
            for size, lens, topic in zip(sizes, (rig.left, rig.right), (self._topics.left, self._topics.right)):
                check_size(f"images on '{topic}' are", size, lens, path)
        super().__init__(path, path.stem if path.is_file() else path.resolve().name, rig, **options)
        self.span_ns = span = _span(first, self._topics.count)
        self._tolerance_ns = tolerance_ns(tolerance_s)
        if base_frame is not None:
            self._place(frame_name(base_frame))
        elif is_placed and self.mounting.T_body_cam is None:
            self._say_where_placed()
        measured = read_imu(path, self._topics.imu, rig.timeshift_cam_imu_s, self.remark)
        if measured is not None:
            self.imu, frame = measured
            if self.imu.t_ns[0] > span[1] or self.imu.t_ns[-1] < span[0]:
                self.remark("the IMU does not overlap the images in time, so it says nothing of them: two clocks?")
            if is_placed and self.mounting.T_imu_cam is None:
                self._place_imu(frame)
        if self._topics.truth is not None:
            self.truth = self._read_truth(self._topics.truth, truth_frame)
        if self._topics.doubtful is not None:
            whose = "whose they are is unknown; give --truth-topic and --truth-frame"
            self.remark(f"poses on '{self._topics.doubtful}' not used as truth: {whose}")
        for topic in self._topics.unused:
            option = f"'gpvo import {path.name} --topic {topic}' makes a run of it, --truth-topic takes it as truth"
            self.remark(f"the odometry on '{topic}' is not used: {option}")

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """A ``.bag``, ``.db3`` or ``.mcap`` file, a ROS 2 bag folder, or a folder of those of one recording."""
        return is_bag(path)

    def __len__(self) -> int:
        return self._topics.count

    def raw_pairs(self, report: SourceReport) -> Iterator[tuple[int, Image8 | None, Image8 | None]]:
        """Pairs in the order of recording, decoded."""
        topics = self._topics
        with open_bag(self.path) as reader:
            stream = messages(
                reader,
                [topics.left, topics.right],
                lambda topic: report.count("unreadable", f"a message on '{topic}' is torn"),
            )
            for t_ns, left, right in pair_streams(stream, topics.left, self._tolerance_ns, report, self.path):
                yield t_ns, decode_message(left, self.depth), decode_message(right, self.depth)

    def _place(self, base: str) -> None:
        """Take ``base`` for the body."""
        if base == self._camera:
            told = f"'{printable(base)}' is the frame of the left images: its axes are the camera's, not a robot's"
            raise SourceError(told, where=self.path, cure=f"name another frame, such as {_BASE}")
        if (T_base_camera := self._place_on(base, TF_TOPICS)) is None:
            told = f"no transform on {' or '.join(TF_TOPICS)} joins '{printable(base)}' to '{printable(self._camera)}'"
            cure = "name a frame that they join to it, or leave out --base-frame"
            raise SourceError(f"{told}, the frame of the left images", where=self.path, cure=cure)
        self.mounting = replace(self.mounting, T_body_cam=T_base_camera @ self.rectifier.T_left_cam, body=base)

    def _place_imu(self, imu: str) -> None:
        """Take the place of the IMU from the bag's static transforms."""
        joined = f"{TF_STATIC} ('{printable(imu)}' to '{printable(self._camera)}')"
        try:
            T_imu_camera = self._place_on(imu, (TF_STATIC,))
        except SourceError:
            self.remark(f"where the IMU sits on the camera is not taken from {joined}: it changes")
            return
        if T_imu_camera is not None:
            self.mounting = replace(self.mounting, T_imu_cam=T_imu_camera @ self.rectifier.T_left_cam)
            told = "a calibration with T_cam_imu would be used instead"
            self.remark(f"where the IMU sits on the camera is taken from {joined}; {told}")

    def _say_where_placed(self) -> None:
        """That the bag places its camera on a base_link, which is not used; what it says may as well be of no use."""
        with suppress(SourceError):
            if self._place_on(_BASE, (TF_STATIC,)) is not None:
                what = f"{TF_STATIC} says where the camera sits on '{_BASE}', which is not used"
                self.remark(f"{what}: with --base-frame {_BASE} it is what 'gpvo publish' speaks of")

    def _place_on(self, base: str, topics: tuple[str, ...]) -> Array | None:
        """T_base_camera (4, 4) by the transforms in the bag, None where they do not join the two; one name for both
        frames, as some drivers have it, says nothing.

        Raises SourceError where it changes: a mounting is rigid.
        """
        tree, place = FrameTree(), None
        with open_bag(self.path) as reader:
            known = [t for t in topics if t in topics_of(reader, (TF_TYPE,)) and base != self._camera]
            for _, message in messages(reader, known, lambda _: None) if known else ():
                tree.take(message)
                now = tree.transform(base, self._camera)
                if place is not None and now is not None and has_moved(place, now):
                    told = f"the transform from '{printable(base)}' to '{printable(self._camera)}' changes"
                    cure = "name a frame that is rigidly joined to the camera"
                    raise SourceError(told, where=self.path, cure=cure)
                place = now if place is None else place
        return place

    def _read_truth(self, topic: str, frame: str | None) -> TruthLog:
        try:
            t, T, _ = read_poses(self.path, topic, self.remark, complete=True)
        except SourceError as error:
            cure = "; ".join(filter(None, (error.cure, "--truth-topic none ignores it")))
            raise SourceError(error.what, where=error.where, cure=cure) from None
        if frame == "imu" and self.mounting.T_imu_cam is None:
            cure = "give --calibration CAMCHAIN with T_cam_imu, or --truth-frame cam"
            raise CalibrationError("does not say where the IMU sits", where=self.path, cure=cure)
        whose = frame or ("cam" if self.rectifier.rig.T_imu_left is None else "imu")
        place = self.rectifier.T_left_cam if whose == "cam" else self.mounting.T_imu_cam
        assert place is not None
        self.remark(f"truth on '{topic}' taken as poses of the {whose} frame")
        truth = carry(Trajectory(t, T), place, MOTION_CAPTURE if _is_capture(topic) else UNKNOWN)
        check_overlap(truth, self.span_ns, self.path)
        return truth


def _choose_topics(
    reader: Any, path: Path, chain: Path | None, asked: tuple[str | None, ...], *, any_truth: bool
) -> _Topics:
    left, right, imu, truth = asked
    images, imus, poses = (list(topics_of(reader, types)) for types in (IMAGE_TYPES, (IMU_TYPE,), POSE_TYPES))
    for topic, what, found in (
        (left, "images", images), (right, "images", images), (imu, "IMU", imus), (truth, "poses", [*poses, "none"])
    ):  # fmt: skip
        if topic is not None and topic not in found:
            raise SourceError(f"has no {what} on '{topic}' ({what} on: {', '.join(found) or 'none'})", where=path)
    if left is None or right is None:
        pair = _guess_pair(images, chain)
        if pair is None:
            cure = "poses alone are for 'gpvo import'" if poses else "is this the bag with the images?"
            cure = "name them with --left-topic and --right-topic" if images else cure
            text = f"no stereo pair among its image topics ({', '.join(images) or 'none'})"
            raise SourceError(text, where=path, cure=cure)
        left, right = left or pair[0], right or pair[1]
    if left == right:
        raise SourceError(f"left and right are the same topic '{left}'", where=path)
    count = min(reader.topics[t].msgcount for t in (left, right))
    doubtful = None
    if truth is None:
        truth, doubtful = _guess_truth(poses, any_truth)
    truth = None if truth == "none" else truth
    sensors = imu_topics(imus)
    if imu is not None:
        sensors = [s for s in sensors if s[0] == imu] or [(imu,)]
    unused = tuple(t for t in topics_of(reader, (ODOMETRY_TYPE,)) if t not in (truth, doubtful))
    return _Topics(left, right, sensors, truth, doubtful, count, unused)


def _guess_truth(poses: list[str], any_truth: bool) -> tuple[str | None, str | None]:
    """The topic that calls itself the truth, and one of motion capture where that is left unused."""
    markers = [t for t in poses if _is_capture(t)]
    named = [t for t in poses if "truth" in t.lower() and t not in markers]
    usable = named + markers if any_truth else named
    if usable:
        return usable[0], None
    return None, markers[0] if markers else None


def _is_capture(topic: str) -> bool:
    return any(n in topic.lower() for n in _CAPTURE_NAMES)


def _guess_pair(images: list[str], chain: Path | None) -> tuple[str, str] | None:
    """Left and right topic by the calibration, by name, or because there are but two."""
    if chain is not None:
        a, b = camchain_topics(chain)
        if a is not None and b is not None and {a, b} <= set(images):
            return a, b
    # The last word that names a side is the camera's; "/left_head/left" may be one of two heads.
    sides = (
        (topic, partner, (k, i))
        for k, (one, other) in enumerate(SIDES)
        for topic in images
        for i, partner in enumerate((other.join(topic.rsplit(one, 1)), topic.replace(one, other)))
    )
    # Raw before rectified before compressed.
    pairs = [
        (has_word("compressed", topic), has_word("rect", topic), rank, topic, partner)
        for topic, partner, rank in sides
        if partner != topic and partner in images and "depth" not in topic
    ]
    if pairs:
        return min(pairs)[3:]
    return (images[0], images[1]) if len(images) == 2 else None


def _first_images(reader: Any, path: Path, topics: _Topics) -> tuple[list[tuple[int, int]], list[int]]:
    """(width, height) of the first readable image of each camera, and the first stamps [ns] of one."""
    sizes: list[tuple[int, int]] = []
    for topic in (topics.left, topics.right):
        stamps, image = [], None
        for _, message in islice(messages(reader, [topic], lambda _: None), 20):  # one by one: each may be large
            stamps.append(stamp_ns(message))
            image = decode_message(message) if image is None else image
        if image is None:
            encoding = encoding_of(message) if stamps else "?"
            raise SourceError(f"no readable image on '{topic}' (encoding '{encoding}')", where=path)
        sizes.append((image.shape[1], image.shape[0]))
        stamps = [t for t in stamps if t]
        if not stamps:
            raise SourceError(f"images on '{topic}' carry no stamp", where=path, cure="the driver must set them")
    return sizes, stamps


def _span(first: list[int], count: int) -> tuple[int, int]:
    """About the first and last of ``count`` stamps [ns], even if one of the ``first`` is wrong: the bag's own times are
    those of recording, of all its topics."""
    usual_ns = usual_interval(first) or 0.0
    begin = sorted(first)[len(first) // 2] - round(usual_ns * (len(first) // 2))
    return begin, begin + round(usual_ns * (count - 1))


def _rig_from_bag(reader: Any, path: Path, topics: _Topics, sizes: list[tuple[int, int]]) -> StereoRig:
    infos = []
    available = topics_of(reader, (INFO_TYPE,))
    for topic, size in zip((topics.left, topics.right), sizes, strict=True):
        name = info_topic(topic)
        if name not in available:
            text = f"no calibration: no CameraInfo on '{name}' and no camchain.yaml beside the bag"
            cure = "put Kalibr's camchain.yaml beside the bag or name one with --calibration"
            raise CalibrationError(text, where=path, cure=cure)
        _, message = next(messages(reader, [name]))
        infos.append(camera_info_of(message, path, name).of_images(size))
    rectified = has_word("rect", topics.left, topics.right)
    return rig_from_camera_info(infos[0], infos[1], rectified=rectified, where=path)


def has_word(word: str, *topics: str) -> bool:
    """Whether all topics hold a word that begins so: of "rect", neither "direct" nor "unrectified" does."""
    return all(re.search(f"(?<![a-z]){word}", topic) for topic in topics)


def info_topic(image_topic: str) -> str:
    """Where drivers publish the CameraInfo of an image topic: beside it."""
    base = re.sub(r"/(compressed|image/compressed)$", "", image_topic)
    return f"{base.rsplit('/', 1)[0]}/camera_info"


def camera_info_of(message: Any, where: object, topic: str) -> CameraInfo:
    """The message in gpvo's type; ROS 1 writes the matrices in capitals."""

    def numbers(name: str) -> np.ndarray:
        value = getattr(message, name, None)
        return np.asarray(getattr(message, name.upper()) if value is None else value, dtype=np.float64)

    D, K, R, P = (numbers(n) for n in ("d", "k", "r", "p"))
    if not all(np.isfinite(m).all() for m in (D, K, R, P)):
        raise CalibrationError(f"CameraInfo on '{topic}' holds NaN or infinity", where=where)
    R = R.reshape(3, 3) if np.any(R) else np.eye(3)
    size, roi = (int(message.width), int(message.height)), message.roi
    return CameraInfo(
        *size, str(message.distortion_model), D=D, K=K.reshape(3, 3), R=R, P=P.reshape(3, 4),
        window=(int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)),
        binning=(int(message.binning_x) or 1, int(message.binning_y) or 1),
    )  # fmt: skip
