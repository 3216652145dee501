"""Where the engine's results go: topics on a wire, MAVLink, a bag; and the wire that transports share."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from gpvo.errors import GpvoError
from gpvo.files import is_writable
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPE
from gpvo.live.engine import Health
from gpvo.publish import ros
from gpvo.publish.mavlink import Link
from gpvo.publish.odometry import Odometry

DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
Send = Callable[[bytes], None]


class Wire(Protocol):
    """A transport of serialised ROS messages. ``store``: rosbags' types of the messages as they travel.

    ``subscribe`` calls ``deliver(topic, bytes)`` from any thread, with ``kept`` also for what publishers keep for those
    who come late (ROS 2: transient local; ROS 1: latched); ``advertise`` gives the function that sends.
    ``ros1``: headers carry a sequence number, and bytes are ROS 1's.
    """

    store: Any
    ros1: bool

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


class WireOutput:
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

    def close(self) -> None:
        """The wire is closed by whoever opened it."""


class Px4Output:
    """``px4_msgs/VehicleOdometry`` for a flight controller that listens by uXRCE-DDS; a lost frame is NaN."""

    def __init__(self, wire: Wire) -> None:
        ros.register_px4(wire.store)
        self._wire, self._send = wire, wire.advertise(ros.PX4_TOPIC, ros.PX4_TYPE)

    def odometry(self, odometry: Odometry) -> None:
        """Send one frame."""
        self._send(encode(self._wire, ros.vehicle_odometry(odometry, self._wire.store.types)))

    def health(self, health: Health) -> None:
        """It is carried as the message's quality."""

    def close(self) -> None:
        """The wire is closed by whoever opened it."""


class MavlinkOutput:
    """ODOMETRY, VISION_SPEED_ESTIMATE and HEARTBEAT to ``udp:HOST:PORT`` or ``serial:DEVICE:BAUD``."""

    def __init__(self, address: str, system: int = 1) -> None:
        self._link = Link(address, system)

    def odometry(self, odometry: Odometry) -> None:
        """Send one frame; a lost one with quality -1."""
        self._link.send(odometry)

    def health(self, health: Health) -> None:
        """MAVLink carries it as ODOMETRY's quality."""

    def close(self) -> None:
        """A datagram needs no farewell."""


class FileOutput:
    """A ROS 1 bag (``.bag``), MCAP (``.mcap``) or ROS 2 bag folder of the odometry, written at the end.

    Raises GpvoError at once where something lies there, as it may be the flight before a restart, and where nothing
    can be written or the suffix is of another kind of file.
    """

    def __init__(self, path: Path, topic: str = ros.TOPIC) -> None:
        if path.exists():
            raise GpvoError("already exists", where=path, cure="give another name or remove it")
        if path.suffix not in ("", ".bag", ".mcap"):
            cure = "end it in .bag or .mcap, or name a folder"
            raise GpvoError("its suffix does not tell what to write", where=path, cure=cure)
        if not is_writable(path):
            raise GpvoError("cannot be written", where=path, cure="name a file in a writable folder")
        self._path, self._topic = path, topic
        self._odometry: list[Odometry] = []

    def odometry(self, odometry: Odometry) -> None:
        """Keep one frame."""
        self._odometry.append(odometry)

    def health(self, health: Health) -> None:
        """A bag of odometry holds none."""

    def close(self) -> None:
        """Write the bag; only warn where there is nothing to write, as when the end comes before the first image."""
        if all(o.twist_body is None for o in self._odometry):
            warnings.warn(f"{self._path}: not written, because no frame had a motion", stacklevel=2)
        elif self._path.suffix == ".bag":
            ros.write_ros1(self._path, self._odometry, self._topic)
        else:
            ros.write_ros2(self._path, self._odometry, self._topic, mcap=self._path.suffix == ".mcap")
