"""``gpvo live`` put together: a source of messages, the engine, outputs, and the end by a signal."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpvo.cameras.readers import read_stereo_yaml
from gpvo.errors import GpvoError
from gpvo.io.bag_reader import IMAGE_TYPES, IMU_TYPE, INFO_TYPE, open_bag
from gpvo.io.bags import info_topic
from gpvo.live.engine import Engine, EngineSettings
from gpvo.live.intake import Arrival, Mailbox, arrivals
from gpvo.live.late_truth import LateTruth
from gpvo.live.outputs import ODOMETRY, POSE, FileOutput, MavlinkOutput, Px4Output, Wire, WireOutput, decode
from gpvo.live.replay import odometry_topic, replay
from gpvo.live.stages import PoseStage, Stage, StereoStage
from gpvo.online.predictor import Predictor

WIRES = ("zenoh", "dds", "ros2", "ros1")
_IMU_DEPTH = 400


@dataclass(frozen=True)
class LiveSettings:
    """What ``gpvo live`` was asked. ``wire``: one of :data:`WIRES`; ``address``: where its router or peer is."""

    model: Path
    stereo: tuple[str, str] | None = None
    imu: str | None = None
    odometry: str | None = None
    pose_type: str = ODOMETRY
    truth: str | None = None
    truth_type: str = POSE
    calibration: Path | None = None
    replay: Path | None = None
    fast: bool = False
    wire: str | None = None
    address: str | None = None
    domain: int = 0
    mavlink: str | None = None
    px4: bool = False
    out: Path | None = None
    topic: str = "/gpvo/odometry"
    pose_topic: str | None = None
    depth: int = 10
    engine: EngineSettings = field(default_factory=EngineSettings)


def run_live(settings: LiveSettings, tell: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Run until the source ends or a signal comes; returns the counts.

    Raises
    ------
    GpvoError
        Where an option, the model, the recording or the transport cannot be used; never for a bad message.
    """
    if settings.wire is None and settings.replay is None:
        raise GpvoError("there is no source", cure=f"give --replay BAG, or one of --{', --'.join(WIRES)}")
    wire = open_wire(settings.wire, settings.address, settings.domain) if settings.wire else None
    try:
        return serve(settings, wire, threading.Event(), tell or _tell)
    finally:
        if wire is not None:
            wire.close()


def serve(
    settings: LiveSettings, wire: Wire | None, stop: threading.Event, tell: Callable[[str], None]
) -> dict[str, Any]:
    """The same over an open ``wire`` (none: a recording), until ``stop``."""
    stage = make_stage(settings)
    outputs: list[Any] = [WireOutput(wire, settings.topic, settings.pose_topic)] if wire else []
    if settings.px4:
        if wire is None or wire.ros1:
            raise GpvoError("--px4 speaks DDS", cure="add --dds or --ros2")
        outputs.append(Px4Output(wire))
    outputs += [MavlinkOutput(settings.mavlink)] if settings.mavlink else []
    outputs += [FileOutput(settings.out)] if settings.out else []
    truth = None if settings.truth is None else LateTruth(settings.truth)
    engine = Engine(stage, Predictor.load(settings.model), outputs, settings.engine, tell, truth)
    with ending_by_signal(stop):
        for arrival in _arrivals(settings, stage, engine, wire, stop):
            engine.take(arrival)
        engine.close()
    return {"counts": {k: n for source in engine.sources for k, n in sorted(source.items()) if n}}


def make_stage(settings: LiveSettings) -> Stage:
    """The stage that was asked for: images where topics of images are named, else poses."""
    if settings.stereo is not None:
        if settings.odometry is not None:
            raise GpvoError("--stereo and --odometry exclude each other", cure="choose one")
        rig = None if settings.calibration is None else read_stereo_yaml(settings.calibration)
        return StereoStage(*settings.stereo, settings.imu, rig)
    if settings.odometry is not None:
        return PoseStage(settings.odometry)
    if settings.replay is None:
        raise GpvoError("no input was given", cure="give --stereo LEFT RIGHT or --odometry TOPIC")
    return PoseStage(odometry_topic(settings.replay))


def topics_in(stage: Stage, settings: LiveSettings) -> dict[str, str]:
    """Topics to subscribe to, with their types."""
    if isinstance(stage, PoseStage):
        return {stage.topic: settings.pose_type}
    assert isinstance(stage, StereoStage)
    images = {t: IMAGE_TYPES["compressed" in t] for t in (stage.left, stage.right)}
    infos = {} if stage.camera is not None else {info_topic(t): INFO_TYPE for t in images}
    return {**images, **infos, **({stage.imu: IMU_TYPE} if stage.imu else {})}


def open_wire(name: str, address: str | None = None, domain: int = 0) -> Wire:
    """One of :data:`WIRES`. MissingExtraError, one line, where its package is not installed."""
    if name == "zenoh":
        from gpvo.live.zenoh_wire import ZenohWire

        return ZenohWire(address, domain)
    if name == "dds":
        from gpvo.live.dds_wire import DdsWire

        return DdsWire(domain)
    if name in ("ros1", "ros2"):
        from gpvo.live.ros_wire import Ros1Wire, Ros2Wire

        return Ros1Wire() if name == "ros1" else Ros2Wire()
    raise GpvoError(f"unknown transport '{name}'", cure=f"choose {', '.join(WIRES)}")


def _arrivals(
    settings: LiveSettings, stage: Stage, engine: Engine, wire: Wire | None, stop: threading.Event
) -> Iterator[Arrival | None]:
    topics = topics_in(stage, settings) | ({settings.truth: settings.truth_type} if settings.truth else {})
    if settings.replay is not None:
        with open_bag(settings.replay) as reader:
            present = set(reader.topics)
        wanted = [t for t, kind in topics.items() if kind != INFO_TYPE or t in present]
        return replay(settings.replay, wanted, stop, fast=settings.fast)
    assert wire is not None
    return listen(wire, topics, engine, stop, settings.depth)


def listen(
    wire: Wire, topics: dict[str, str], engine: Engine, stop: threading.Event, depth: int = 10
) -> Iterator[Arrival | None]:
    """Subscribe to topics, with their types, and yield what arrives until ``stop``."""
    mailbox = Mailbox(depth)
    engine.sources.append(mailbox.dropped)
    for topic, kind in topics.items():
        lane_depth = _IMU_DEPTH if kind == IMU_TYPE else depth
        wire.subscribe(topic, kind, lambda name, data, n=lane_depth: mailbox.put(name, data, n))  # type: ignore[misc]
    engine.tell(f"listening to {', '.join(topics)}")
    return arrivals(mailbox, lambda topic, data: decode(wire, data, topics[topic]), stop, engine.counts)


@contextmanager
def ending_by_signal(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM set ``stop`` inside the block; a second one ends the process at once."""

    def end(number: int, _frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _tell(text: str) -> None:
    print(f"gpvo live: {text}", file=sys.stderr, flush=True)


POSE_TYPE_NAMES = {"odometry": ODOMETRY, "pose": POSE, "pose_stamped": "geometry_msgs/msg/PoseStamped"}
