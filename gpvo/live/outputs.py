"""Where the engine's results go: topics on a wire, MAVLink, a bag; and the wire that transports share."""

from __future__ import annotations

import shutil
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from gpvo.errors import GpvoError
from gpvo.files import refuse_foreign
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPE
from gpvo.live.engine import Health, Output
from gpvo.publish import ros
from gpvo.publish.mavlink import Link
from gpvo.publish.odometry import Odometry

PART_S = 30.0
"""How often what has come for a bag is written to a part of it."""
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
Send = Callable[[bytes], None]


class Wire(Protocol):
    """A transport of serialised ROS messages. ``store``: rosbags' types of the messages as they travel.

    ``subscribe`` calls ``deliver(topic, bytes)`` from any thread, with ``kept`` also for what publishers keep for those
    who come late (ROS 2: transient local; ROS 1: latched); ``advertise`` gives the function that sends.
    ``ros1``: headers carry a sequence number, and bytes are ROS 1's.
    """

    store: Any
    ros1: bool = False

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic from now on."""

    def advertise(self, topic: str, msgtype: str) -> Send:
        """Announce a topic."""

    def close(self) -> None:
        """End every subscription and topic."""


def encode(wire: Wire, message: Any) -> bytes:
    """A message of the wire's types as it travels."""
    serialise = wire.store.serialize_ros1 if wire.ros1 else wire.store.serialize_cdr
    return bytes(serialise(message, message.__msgtype__))


def decode(wire: Wire, data: bytes, msgtype: str) -> Any:
    """The message in bytes that came by the wire."""
    deserialise = wire.store.deserialize_ros1 if wire.ros1 else wire.store.deserialize_cdr
    return deserialise(data, msgtype)


class WireOutput(Output):
    """``nav_msgs/Odometry`` on ``topic`` and ``/diagnostics``; ``PoseWithCovarianceStamped`` on ``pose_topic``.

    Lost frames are not sent: a receiver would fuse them. The diagnostics say that they are missing.
    """

    def __init__(self, wire: Wire, topic: str = ros.TOPIC, pose_topic: str | None = None) -> None:
        self._wire, self._types, self._seq = wire, wire.store.types, 0
        self._send = wire.advertise(topic, ODOMETRY_TYPE)
        self._send_pose = None if pose_topic is None else wire.advertise(pose_topic, POSE_TYPE)
        self._send_health = wire.advertise("/diagnostics", DIAGNOSTICS)

    def odometry(self, odometry: Odometry) -> None:
        """Send one frame."""
        if odometry.twist_body is None:
            return
        message = ros.odometry_message(odometry, self._types, seq=self._seq if self._wire.ros1 else None)
        self._seq += 1
        self._send(encode(self._wire, message))
        if self._send_pose is not None:
            self._send_pose(encode(self._wire, self._types[POSE_TYPE](header=message.header, pose=message.pose)))

    def health(self, health: Health) -> None:
        """Send one DiagnosticArray."""
        t = self._types
        numbered = {"seq": self._seq} if self._wire.ros1 else {}
        stamp = t["builtin_interfaces/msg/Time"](health.t_ns // 10**9, health.t_ns % 10**9)
        values = [t["diagnostic_msgs/msg/KeyValue"](key, value) for key, value in health.values.items()]
        status = t["diagnostic_msgs/msg/DiagnosticStatus"](
            level=health.level, name="gpvo: odometry", message=health.text, hardware_id="gpvo", values=values
        )
        header = t["std_msgs/msg/Header"](**numbered, stamp=stamp, frame_id="")
        self._send_health(encode(self._wire, t[DIAGNOSTICS](header=header, status=[status])))


class Px4Output(Output):
    """``px4_msgs/VehicleOdometry`` for a flight controller that listens by uXRCE-DDS; a lost frame is NaN.

    The message's quality is what it says of health.
    """

    def __init__(self, wire: Wire) -> None:
        ros.register_px4(wire.store)
        self._wire, self._send = wire, wire.advertise(ros.PX4_TOPIC, ros.PX4_TYPE)

    def odometry(self, odometry: Odometry) -> None:
        """Send one frame."""
        self._send(encode(self._wire, ros.vehicle_odometry(odometry, self._wire.store.types)))


class MavlinkOutput(Output):
    """ODOMETRY, whose quality is the health, VISION_SPEED_ESTIMATE and HEARTBEAT to ``udp:HOST:PORT`` or
    ``serial:DEVICE:BAUD``."""

    def __init__(self, address: str) -> None:
        self._link = Link(address)

    def odometry(self, odometry: Odometry) -> None:
        """Send one frame; a lost one with quality -1."""
        self._link.send(odometry)


class FileOutput(Output):
    """A ROS 1 bag (``.bag``), MCAP (``.mcap``) or ROS 2 bag folder of the odometry, written at the end.

    Until then, what came in each half minute is a bag of its own in the folder ``<name>.parts`` beside it, by its first
    stamp: nothing else remains where the process is killed, and memory holds no more than what is not yet written.
    Raises GpvoError at once where the bag exists, as it may be the flight before a restart, and where nothing can be
    written or the suffix is of another kind of file.
    """

    def __init__(self, path: Path, topic: str = ros.TOPIC) -> None:
        if path.exists():
            raise GpvoError("already exists", where=path, cure="give another name or remove it")
        if path.suffix.lower() not in ("", ".bag", ".mcap"):
            cure = "end it in .bag or .mcap, or name a folder"
            raise GpvoError("its suffix does not tell what to write", where=path, cure=cure)
        refuse_foreign(path, b"", "bag")
        self._path, self._topic, self._folder = path, topic, path.with_name(f"{path.name}.parts")
        self._part: list[Odometry] = []
        self._begun_s, self._count = time.monotonic(), 0
        self._writer = ThreadPoolExecutor(1)  # frames must not wait for the disk
        self._parts: dict[Path, Callable[[], None]] = {}  # what writes each, if it is not written
        self._last: Future[None] | None = None

    def odometry(self, odometry: Odometry) -> None:
        """Keep one frame. GpvoError where the part before could not be written."""
        if odometry.twist_body is not None:
            self._part.append(odometry)
        if self._part and time.monotonic() - self._begun_s >= PART_S:
            before, self._last = self._last, self._writer.submit(self._end_part())
            self._begun_s = time.monotonic()
            if before is not None and before.done():
                before.result()

    def _end_part(self) -> Callable[[], None]:
        """What writes the frames of this part where nothing lies, and then lets go of them."""
        part, self._part, seq = self._part, [], self._count
        self._count += len(part)
        stamp = part[0].t_ns
        while (place := self._folder / f"{stamp}{self._path.suffix.lower()}").exists() or place in self._parts:
            stamp += 1

        def write() -> None:
            if part:
                ros.write_bag(place, part, self._topic, seq=seq)
                part.clear()

        self._parts[place] = write
        return write

    def close(self) -> None:
        """Write the bag; only warn where there is nothing to write, as when the end comes before the first image."""
        self._writer.shutdown()
        if self._part:
            self._end_part()
        if not self._parts:
            warnings.warn(f"{self._path}: not written, because no frame had a motion", stacklevel=2)
            return
        for write in self._parts.values():
            write()
        ros.join_bags(self._path, self._parts, self._topic)
        for place in self._parts:  # those of a process that was killed stay
            shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
        with suppress(OSError):
            self._folder.rmdir()
