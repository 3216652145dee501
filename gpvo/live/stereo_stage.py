"""From pairs of images, and an IMU, to VO records through gpvo's own odometry."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.cameras.readers import CameraInfo, read_projections, read_stereo_yaml, rig_from_camera_info
from gpvo.cameras.rectify import Rectifier, read_mask
from gpvo.cameras.rig import StereoRig
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.bag_messages import (
    FrameTree,
    PairQueue,
    accelerometer_beside,
    decode_message,
    encoding_of,
    frame_name,
    with_accelerometer,
)
from gpvo.io.bag_reader import TF_STATIC, stamp_ns
from gpvo.io.bags import camera_info_of, has_word, info_topic
from gpvo.io.images import SWAPPED, Image8, OrderCheck
from gpvo.io.source import Depth, SourceReport
from gpvo.io.stamps import PAIR_TOLERANCE_S, Stamps, no_pair, tolerance_ns
from gpvo.live.intake import AHEAD_S, Arrival, Sequence, StampWatch
from gpvo.live.stages import BaseFrameStage, PoseStage, Taken
from gpvo.types import Array, ImuLog, StereoCamera, StereoFrame
from gpvo.vo.config import VoConfig
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.rig_error import RigState
from gpvo.vo.rig_findings import read_state

_IMU_KEPT = 4000
_LATE_NS = 1_000_000_000  # without an accelerometer: there is none
_PAIRS_KEPT = 10  # while no CameraInfo has come
_UNUSED = 20  # motions on end without a sample, after which the IMU is called out


@dataclass(frozen=True)
class StereoSettings:
    """How ``gpvo run`` would go about it: the model knows only the odometry that it was trained on.

    ``calibration_state``: what an earlier run found out. ``hfov_deg``, ``size``: of the rectified images.
    ``mask_left``, ``mask_right``: images of the usable pixels. ``tolerance_s``: between the stamps of a pair.
    ``bits``: depth of the samples in 16-bit images.
    """

    config: VoConfig = field(default_factory=VoConfig)
    calibration_state: Path | None = None
    hfov_deg: float | None = None
    size: tuple[int, int] | None = None
    mask_left: Path | None = None
    mask_right: Path | None = None
    tolerance_s: float = PAIR_TOLERANCE_S
    bits: int = 16


class StereoStage:
    """Pairs of images through :class:`gpvo.vo.odometry.StereoOdometry`, with an IMU where one is named.

    ``rig``: the calibration, or the file of one that does not state the size of the images, as KITTI's: it is read when
    the first pair tells. Without one pairs, ten at most, wait for CameraInfo beside the image topics. A pair waits for
    the first IMU sample after it, or for the next pair. Where the ``rig`` does not know the place of the IMU, static
    transforms between the frames of IMU and left images tell it, from when they come.

    Raises GpvoError if a file of the ``settings`` cannot be used, or does not fit the ``rig``.
    """

    def __init__(
        self,
        left: str,
        right: str,
        imu: str | None = None,
        rig: StereoRig | Path | None = None,
        settings: StereoSettings | None = None,
    ) -> None:
        self.settings = settings or StereoSettings()
        masks = (self.settings.mask_left, self.settings.mask_right)
        self._masks = None if masks == (None, None) else [None if m is None else read_mask(m) for m in masks]
        self._depth, self._tolerance_ns = Depth(self.settings.bits), tolerance_ns(self.settings.tolerance_s)
        self._state: RigState | None = None
        self.odometry = asdict(self.settings.config)
        stated = self.settings.config.stated
        self.method = "pointing_matching" if "pointing_matching" in stated else stated[0]
        self.topic, self.left, self.right, self.imu = left, left, right, imu
        self.accelerometer = accelerometer_beside(imu or "")
        self.counts: Counter[str] = Counter()
        self._infos: dict[str, CameraInfo] = {}
        self._rectifier: Rectifier | None = None
        self._odometry: StereoOdometry | None = None
        self._t_last_ns = 0
        self.camera: StereoCamera | None = None
        self.T_body_cam, self.T_source_cam = T_FLU_OPTICAL, np.eye(4)
        self._shift_ns = 0
        self._tree, self._imu_frame = FrameTree(), ""
        self._T_imu_cam: Array | None = None
        self._without_size: Path | None = None
        if isinstance(rig, StereoRig):
            self._calibrate(rig)
        elif rig is not None:
            read_projections(rig)  # a file that cannot be read is refused at once
            self._without_size = rig
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next pair."""
        self._report, self._order, self._unfit = SourceReport(), OrderCheck(), ""
        self._pairs = PairQueue(self.left, self._tolerance_ns, self._report)
        self._watch, self._imu_watch = StampWatch(), StampWatch()
        self._without_imu = 0  # motions on end
        self._measures = np.zeros(2, dtype=bool)  # rates, accelerations
        self._samples: deque[tuple[int, Array]] = deque(maxlen=_IMU_KEPT)
        self._rates = self._samples.copy()  # that wait for the accelerometer of a driver that publishes it apart
        self._accelerations, self._has_accelerometer = self._samples.copy(), self.accelerometer is not None
        self._waiting: deque[tuple[int, Any, Any, int]] = deque(maxlen=_PAIRS_KEPT)  # with time of arrival
        self._restart()

    def take(self, arrival: Arrival) -> Iterator[Taken]:
        """A record for each pair that is complete, with the IMU's samples since the one before."""
        topic, message = arrival.topic, arrival.message
        if topic == TF_STATIC:
            self._tree.take(message)
            self.counts["tf_refused"] = self._tree.refused
            return
        if topic == self.imu:
            self._take_imu(message)
        elif topic == self.accelerometer:
            self._take_acceleration(message)
        elif topic in (self.left, self.right):
            missing = self._report.missing
            pairs = self._pairs.push(topic, message)
            self.counts["unpaired"] += self._report.missing - missing
            for pair in pairs:
                self._take_sizes(*pair[1:])
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

    def problems(self) -> list[str]:
        """Images that nobody says the calibration of, that it is not for, that make no pair, cannot be read, or are
        swapped; and an IMU that says nothing of them."""
        if self.camera is None and self._unfit:
            return [self._unfit]
        if self.camera is None and self.counts["uncalibrated"]:
            return ["images arrive, but no calibration: no CameraInfo comes with them"]
        nearest_ns, apart = self._pairs.nearest_ns, ""
        if self._tolerance_ns < nearest_ns < np.inf:
            apart = str(no_pair(self._tolerance_ns, int(nearest_ns), None))
        unused = self.imu is not None and self._without_imu >= _UNUSED
        idle = f"no sample of the IMU on '{self.imu}' falls between the pairs: does it run, on the cameras' clock?"
        return [text for text in (apart, self._unfit, self._depth.doubt(), idle * unused) if text]

    def _step(self, t_ns: int, left: Any, right: Any, received_ns: int) -> Iterator[Taken]:
        if self._rectifier is None or self.camera is None:
            self.counts["uncalibrated"] += 1
            return
        images: list[Image8] = []
        for message, lens in ((left, self._rectifier.rig.left), (right, self._rectifier.rig.right)):
            image = decode_message(message, self._depth)
            if image is None or image.shape != (lens.height, lens.width):
                self.counts["unreadable"] += 1
                self._unfit = _unread(message)
                if image is not None:
                    size = f"{image.shape[1]}x{image.shape[0]}"
                    self._unfit = f"images are {size}, the calibration is for {lens.width}x{lens.height}"
                return
            images.append(image)
        self._unfit = ""
        seen = self._watch.see(t_ns)
        self.counts[seen.value] += 1
        if seen.dropped:
            return
        if seen is Sequence.RESTART:
            self._restart()
        frame = StereoFrame(t_ns, *self._rectifier.apply(*images))
        if self._order.is_swapped(frame):
            self.counts["swapped"] += 1
            self._unfit = SWAPPED
            return
        begins = self._odometry is None
        if self._odometry is None:
            place, mask = self._T_imu_cam, self._rectifier.mask
            self._odometry = StereoOdometry(self.camera, self.settings.config, mask, self._state, place)
        if self._T_imu_cam is None and self.imu is not None:
            self._place_imu(self._odometry, frame_name(left.header.frame_id))
        record = self._odometry.step(frame, None if begins else self._imu_since(t_ns))
        self._t_last_ns = t_ns
        yield Taken(record, begins, received_ns)

    def _place_imu(self, odometry: StereoOdometry, camera: str) -> None:
        T_imu_camera = self._tree.transform(self._imu_frame, camera)
        if T_imu_camera is not None and self._imu_frame != camera:  # one name for both, as some drivers have it
            self._T_imu_cam = T_imu_camera @ self.T_source_cam
            odometry.place_imu(self._T_imu_cam)
            self.counts["imu_placed"] += 1

    def _restart(self) -> None:
        self._odometry, self._t_last_ns = None, 0

    def _take_info(self, topic: str, message: Any) -> None:
        if not self.wants_info:
            return
        self._infos[topic] = camera_info_of(message, topic, topic)
        if self._waiting:
            self._take_sizes(*self._waiting[0][1:3])

    @property
    def wants_info(self) -> bool:
        """Whether the calibration is still to come, by CameraInfo."""
        return self.camera is None and self._without_size is None

    @property
    def wants_place(self) -> bool:
        """Whether no calibration says where the IMU sits on the camera."""
        return self.imu is not None and self._T_imu_cam is None

    def _take_sizes(self, left: Any, right: Any) -> None:
        """Calibrate by what says everything but what size the images are, or how much of the sensor they show."""
        names = [info_topic(t) for t in (self.left, self.right)]
        if self.camera is not None or (self.wants_info and not all(n in self._infos for n in names)):
            return
        sizes = []
        for message in (left, right):
            if (image := decode_message(message)) is None:
                self._unfit = _unread(message)
                return
            sizes.append((image.shape[1], image.shape[0]))
        self._unfit = ""
        if self._without_size is not None:
            self._calibrate(read_stereo_yaml(self._without_size, size=sizes[0]))
            return
        left_info, right_info = (self._infos[n].of_images(size) for n, size in zip(names, sizes))
        rectified = has_word("rect", self.left, self.right)
        self._calibrate(rig_from_camera_info(left_info, right_info, rectified=rectified, where=names[1]))

    def _calibrate(self, rig: StereoRig) -> None:
        if self._masks is not None:
            rig = rig.with_masks(*self._masks)
        rectifier = Rectifier(rig, hfov_deg=self.settings.hfov_deg, size=self.settings.size)
        if self.settings.calibration_state is not None:
            self._state = read_state(self.settings.calibration_state, rectifier.camera)
        self._rectifier, self.camera = rectifier, rectifier.camera
        self._shift_ns = round(rig.timeshift_cam_imu_s * 1e9)
        self.T_source_cam, self._T_imu_cam = self._rectifier.T_left_cam, self._rectifier.mounting.T_imu_cam
        place = self._rectifier.mounting.T_body_cam
        self.T_body_cam = T_FLU_OPTICAL if place is None else place

    def _take_imu(self, message: Any) -> None:
        row = _imu_row(message)
        # As bags are read: what has been nothing but zeros so far is not measured.
        self._measures |= np.isfinite(row).all(axis=1) & row.any(axis=1)
        row[~self._measures] = np.nan
        known = np.asarray(np.isfinite(row).all(axis=1))
        self._imu_frame = frame_name(message.header.frame_id)
        t_ns = stamp_ns(message)
        seen = self._imu_watch.see(t_ns)
        if seen.dropped or not known[0] or known[1] != self._measures[1]:
            self.counts["imu_dropped"] += 1
            return
        if seen is Sequence.RESTART:
            for kept in (self._samples, self._rates, self._accelerations):
                kept.clear()
        self._rates.append((t_ns - self._shift_ns, row.ravel()))
        if self._measures[1] or (not self._accelerations and t_ns - self._shift_ns - self._rates[0][0] > _LATE_NS):
            self._has_accelerometer = False
        self._complete()

    def _take_acceleration(self, message: Any) -> None:
        row, t_ns = _imu_row(message), stamp_ns(message) - self._shift_ns
        last_ns = self._accelerations[-1][0] if self._accelerations else t_ns - 1
        if self._has_accelerometer and np.isfinite(row[1]).all() and 0 < t_ns - last_ns <= AHEAD_S * 1e9:
            self._accelerations.append((t_ns, row.ravel()))
            self._complete()

    def _complete(self) -> None:
        """Pass on the rates that wait, with the accelerations interpolated where these are measured apart."""
        if self._has_accelerometer and not self._accelerations:
            return
        until_ns = self._accelerations[-1][0] if self._has_accelerometer else self._rates[-1][0]
        ready = [self._rates.popleft() for _ in range(sum(t <= until_ns for t, _ in self._rates))]
        if not self._has_accelerometer or not ready:
            self._samples.extend(ready)
            return
        t, data = with_accelerometer(*_columns(ready), *_columns(self._accelerations))
        self._samples.extend(zip(t.tolist(), data))
        while len(self._accelerations) > 1 and self._accelerations[1][0] <= ready[-1][0]:
            self._accelerations.popleft()

    def _imu_since(self, t_ns: int) -> ImuLog | None:
        chosen = [s for s in self._samples if self._t_last_ns < s[0] <= t_ns]
        while self._samples and self._samples[0][0] <= t_ns:
            self._samples.popleft()
        self._without_imu = 0 if chosen else self._without_imu + 1
        if not chosen:
            return None
        t, data = _columns(chosen)
        return ImuLog(t, data[:, :3], data[:, 3:])


Stage = PoseStage | StereoStage | BaseFrameStage


def _imu_row(message: Any) -> Array:
    """(2, 3) rates and accelerations, NaN where not measured, as ROS has it."""
    rates = (message.angular_velocity, message.angular_velocity_covariance)
    forces = (message.linear_acceleration, message.linear_acceleration_covariance)
    return np.array([[np.nan] * 3 if C[0] == -1 else [v.x, v.y, v.z] for v, C in (rates, forces)])


def _columns(samples: Iterable[tuple[int, Array]]) -> tuple[Stamps, Array]:
    """Stamps (N,) and samples (N, 6)."""
    t_ns, rows = zip(*samples, strict=True)
    return np.array(t_ns, dtype=np.int64), np.array(rows)


def _unread(image: Any) -> str:
    return f"images of encoding '{encoding_of(image)}' cannot be read"
