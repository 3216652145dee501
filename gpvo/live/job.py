"""``gpvo live`` put together: a source of messages, the engine, outputs, and the end by a signal."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from gpvo.cameras.readers import read_stereo_yaml
from gpvo.errors import GpvoError
from gpvo.io.bag_messages import accelerometer_beside
from gpvo.io.bag_reader import (
    IMAGE_TYPES,
    IMU_TYPE,
    INFO_TYPE,
    TF_STATIC,
    TF_TOPICS,
    TF_TYPE,
    open_bag,
)
from gpvo.io.bags import has_word, info_topic
from gpvo.live import POSE_TYPE_NAMES, WIRES, LiveSettings
from gpvo.live.engine import Engine, Output
from gpvo.live.intake import Arrival, Mailbox, arrivals, odometry_topic, replay
from gpvo.live.late_truth import LateTruth
from gpvo.live.outputs import FileOutput, MavlinkOutput, Px4Output, Wire, WireOutput, decode
from gpvo.live.stages import BaseFrameStage, PoseStage
from gpvo.live.stereo_stage import Stage, StereoSettings, StereoStage
from gpvo.online.predictor import Predictor
from gpvo.parallel import after_first, ending_signals
from gpvo.publish.ros import check_topic

_DEPTHS = {IMU_TYPE: 400, TF_TYPE: 100}
_LASTING = (INFO_TYPE, TF_TYPE)  # what was said holds until it is said anew; a recording may lack it


def run_live(settings: LiveSettings) -> dict[str, Any]:
    """Run until the source ends or a signal comes; returns the counts.

    Raises GpvoError where an option, the model, the recording or the transport cannot be used; never for a bad message.
    """
    transport = settings.wire.transport()
    if transport is None and settings.replay is None:
        raise GpvoError("there is no source", cure=f"give --replay BAG, or one of --{', --'.join(WIRES)}")
    for is_used, names, cure in (
        (settings.replay, ("fast",), "add --replay BAG"),
        (transport == "zenoh", ("address",), "add --zenoh"),
        (transport in ("zenoh", "dds"), ("domain",), "add --zenoh or --dds"),
        (transport, ("pose_topic",), f"add one of --{', --'.join(WIRES)}"),
        (settings.replay is None, ("depth",), "a recording has no queue"),
    ):
        if not is_used:
            _refuse_idle(settings, names, cure)
    wire = open_wire(transport, settings.wire.address, settings.wire.domain) if transport else None
    stop = threading.Event()
    try:
        with ending_by_signal(stop):
            live = Live(settings, wire, _tell)
            try:
                live.run(stop)
            finally:  # a recording that breaks off has given something
                counts = live.close()
            return {"counts": counts}
    finally:
        if wire is not None:
            wire.close()


def _refuse_idle(settings: LiveSettings, names: tuple[str, ...], cure: str) -> None:
    """GpvoError where one of the settings was given, though nothing will read it."""
    asked, fresh = ({**vars(s), **vars(s.wire)} for s in (settings, LiveSettings(settings.model)))
    given = [f"--{name.replace('_', '-')}" for name in names if asked[name] != fresh[name]]
    if given:
        raise GpvoError(f"{', '.join(given)} would be ignored", cure=cure)


class Live:
    """Engine and outputs of ``settings`` over an open ``wire`` (none: a recording), subscribed but not yet running.

    Whatever can be refused is refused here: an option, the model, the calibration or the recording, by GpvoError. A
    managed node of ROS 2 is configured when it holds one of these, active between ``start`` and ``stop``, and cleaned
    up by ``close``.
    """

    def __init__(self, settings: LiveSettings, wire: Wire | None, tell: Callable[[str], None]) -> None:
        stage = make_stage(settings)
        truth = None if settings.truth is None else LateTruth(settings.truth)
        predictor, outputs = Predictor.load(settings.model), _outputs(settings, wire)
        self._settings, self._wire, self._tell = settings, wire, tell
        self._topics = topics_in(stage, settings)
        needed = [t for t, kind in self._topics.items() if kind != TF_TYPE or settings.base_frame is not None]
        self.engine = Engine(
            stage, predictor, outputs, tell=tell, truth=truth, topics=needed,
            increment=settings.pose_covariance == "increment", state=settings.state, vehicle=settings.vehicle,
        )  # fmt: skip
        self._mailbox = Mailbox(settings.depth)
        self._ending, self._has_run = threading.Event(), False
        self._thread: threading.Thread | None = None
        if settings.replay is None:
            self._subscribe()

    def run(self, stop: threading.Event) -> None:
        """Use what arrives until ``stop`` or the end of the recording.

        A second time begins anew, across an unknown motion: what arrived between the two is not used.
        """
        if self._has_run:
            self.engine.stage.reset()
        self._has_run = True
        for arrival in self._arrivals(stop):
            self.engine.take(arrival)
        self._mailbox.close()

    def start(self) -> None:
        """Run in a thread, until ``stop``."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self.run, args=(self._ending,), name="gpvo-live", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, if there is one, after the message in hand."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def close(self) -> dict[str, int]:
        """Stop, use what waits, save the state, close the outputs; returns the counts."""
        self.stop()
        self.engine.close()
        return {k: n for source in self.engine.sources for k, n in sorted(source.items()) if n}

    def _subscribe(self) -> None:
        assert self._wire is not None
        self._mailbox.close()
        self.engine.sources.append(self._mailbox.dropped)
        for topic, kind in self._topics.items():
            check_topic(topic)
            depth = _DEPTHS.get(kind, self._settings.depth)

            def deliver(name: str, data: bytes, n: int = depth) -> None:
                self._mailbox.put(name, data, n)

            self._wire.subscribe(topic, kind, deliver, kept=topic == TF_STATIC)

    def _arrivals(self, stop: threading.Event) -> Iterator[Arrival | None]:
        path, wire, topics = self._settings.replay, self._wire, self._topics
        if path is not None:
            with open_bag(path) as reader:
                present = set(reader.topics)
            accelerometer = accelerometer_beside(self._settings.imu or "")  # that there is one, its name only suggests
            wanted = [t for t, kind in topics.items() if t in present or (kind not in _LASTING and t != accelerometer)]
            return replay(path, wanted, stop, self.engine.counts, fast=self._settings.fast)
        assert wire is not None
        self._mailbox.open([t for t, kind in topics.items() if kind in _LASTING])
        self._tell(f"listening to {', '.join(topics)}")
        return arrivals(self._mailbox, lambda t, data: decode(wire, data, topics[t]), stop, self.engine.counts)


def _outputs(settings: LiveSettings, wire: Wire | None) -> list[Output]:
    for topic in (settings.topic, *([settings.pose_topic] if settings.pose_topic else [])):
        check_topic(topic)
    if settings.pose_covariance == "increment" and (settings.px4 or settings.mavlink):
        what = "a flight controller takes the covariance of a pose for that of the whole way, not of an increment"
        raise GpvoError(what, cure="leave out --pose-covariance increment")
    outputs: list[Output] = [WireOutput(wire, settings.topic, settings.pose_topic)] if wire else []
    if settings.px4:
        if wire is None or wire.ros1:
            raise GpvoError("--px4 needs DDS", cure="add --dds or --ros2")
        outputs.append(Px4Output(wire))
    outputs += [MavlinkOutput(settings.mavlink)] if settings.mavlink else []
    outputs += [FileOutput(settings.out, settings.topic)] if settings.out else []
    return outputs


def make_stage(settings: LiveSettings) -> Stage:
    """The stage that was asked for: images where topics of images are named, else poses; of another frame if named."""
    stage = _source_stage(settings)
    if settings.base_frame is None:
        return stage
    if isinstance(stage, PoseStage) and settings.odometry_type != "odometry":
        raise GpvoError(
            "--base-frame needs to know which frame the poses are of, and these messages do not name one",
            cure="use a topic of nav_msgs/Odometry",
        )
    return BaseFrameStage(stage, settings.base_frame)


def _source_stage(settings: LiveSettings) -> PoseStage | StereoStage:
    if settings.stereo is not None:
        if settings.odometry is not None:
            raise GpvoError("--stereo and --odometry are mutually exclusive", cure="choose one")
        if settings.stereo[0] == settings.stereo[1]:
            raise GpvoError(f"left and right are the same topic '{settings.stereo[0]}'", cure="name two topics")
        path = settings.calibration
        is_kitti = path is not None and path.suffix.lower() == ".txt"  # which does not state the size of the images
        rig = path if path is None or is_kitti else read_stereo_yaml(path)
        _refuse_idle(settings, ("covariance_axes",), "images state no covariance")
        return StereoStage(*settings.stereo, settings.imu, rig, settings.vo)
    if settings.vo not in (None, StereoSettings()):
        raise GpvoError("the odometry was given settings, but no images to run on", cure="add --stereo LEFT RIGHT")
    _refuse_idle(settings, ("imu", "calibration"), "add --stereo LEFT RIGHT")
    if settings.odometry is not None:
        return PoseStage(settings.odometry, covariance_axes=settings.covariance_axes)
    if settings.replay is None:
        raise GpvoError("no input was given", cure="give --stereo LEFT RIGHT or --odometry TOPIC")
    return PoseStage(odometry_topic(settings.replay), covariance_axes=settings.covariance_axes)


def topics_in(stage: Stage, settings: LiveSettings) -> dict[str, str]:
    """Topics to subscribe to, with their types."""
    if isinstance(stage, BaseFrameStage):
        return topics_in(stage.inner, settings) | dict.fromkeys(TF_TOPICS, TF_TYPE)
    truth = {settings.truth: POSE_TYPE_NAMES[settings.truth_type]} if settings.truth else {}
    if isinstance(stage, PoseStage):
        return {stage.topic: POSE_TYPE_NAMES[settings.odometry_type], **truth}
    images = {t: IMAGE_TYPES[has_word("compressed", t)] for t in (stage.left, stage.right)}
    infos = {info_topic(t): INFO_TYPE for t in images} if stage.wants_info else {}
    placing = {TF_STATIC: TF_TYPE} if stage.wants_place else {}
    imu = dict.fromkeys(filter(None, (stage.imu, stage.accelerometer)), IMU_TYPE)
    return {**images, **infos, **imu, **placing, **truth}


def open_wire(name: str, address: str | None = None, domain: int = 0) -> Wire:
    """One of :data:`WIRES`. MissingExtraError, one line, where its package is not installed."""
    if name in ("zenoh", "dds"):
        from gpvo.live.rosless_wire import DdsWire, ZenohWire

        return ZenohWire(address, domain) if name == "zenoh" else DdsWire(domain)
    if name in ("ros1", "ros2"):
        from gpvo.live.ros_wire import Ros1Wire, Ros2Wire

        return Ros1Wire() if name == "ros1" else Ros2Wire()
    raise GpvoError(f"unknown transport '{name}'", cure=f"choose {', '.join(WIRES)}")


@contextmanager
def ending_by_signal(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C, SIGTERM and SIGHUP set ``stop`` inside the block; a second one of the former ends the process at once."""

    def end(number: int, _frame: object) -> None:
        signal.signal(number, after_first(number))
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, end) for number in (signal.SIGINT, *ending_signals())}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _tell(text: str) -> None:
    with suppress(OSError):  # the terminal may be gone, and what is recorded is still to be written
        print(f"gpvo live: {text}", file=sys.stderr, flush=True)
