"""ROS itself, where it is installed: rclpy and rospy, fed with serialised messages like every other transport."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gpvo.errors import GpvoError
from gpvo.io.bag_reader import TF_TYPE
from gpvo.live.outputs import Send, Wire

_DEPTH, _KEPT = 10, 100


def message_class(msgtype: str) -> Any:
    """ROS's own class of a message type, such as ``nav_msgs/msg/Odometry``."""
    package, _, name = msgtype.split("/")
    return getattr(import_module(f"{package}.msg"), name)


class Ros2Wire(Wire):
    """A node of rclpy: ``node`` where one exists already, else one of its own, spun in a thread.

    Subscribes best effort, publishes reliably, keeps the last 10.
    """

    def __init__(self, node: Any = None) -> None:
        _require("rclpy", "source ROS 2's setup file, or use --zenoh or --dds, which need no ROS")
        import rclpy

        self.store = get_typestore(Stores.ROS2_JAZZY)
        self._thread: threading.Thread | None = None
        self._undo: list[Callable[[], object]] = []
        if node is None:
            rclpy.init()
            node = rclpy.create_node("gpvo")
            self._thread = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
            self._thread.start()
        self._node = node

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data

        reliable, local = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
        lasting = QoSProfile(depth=_KEPT, reliability=reliable, durability=local)
        qos = lasting if kept else qos_profile_sensor_data
        kind = message_class(msgtype)
        made = self._node.create_subscription(kind, topic, lambda b: deliver(topic, b), qos, raw=True)
        self._undo.append(lambda: self._node.destroy_subscription(made))

    def advertise(self, topic: str, msgtype: str) -> Send:
        """Announce a topic."""
        publisher = self._node.create_publisher(message_class(msgtype), topic, _DEPTH)
        self._undo.append(lambda: self._node.destroy_publisher(publisher))

        def send(data: bytes) -> None:
            if self._node.context.ok():  # a signal may have ended it
                publisher.publish(data)

        return send

    def close(self) -> None:
        """End every subscription and topic, and the node, if it is of our own making."""
        for undo in self._undo:
            undo()
        self._undo.clear()
        if self._thread is not None:
            import rclpy

            rclpy.shutdown()
            self._thread.join(1.0)


class Ros1Wire(Wire):
    """A node of rospy, at the master that ROS_MASTER_URI names. GpvoError where there is none."""

    ros1 = True

    def __init__(self) -> None:
        _require("rospy", "source ROS 1's setup file, or make rospy visible to this Python")
        import rosgraph
        import rospy

        if not rosgraph.is_master_online():
            place = os.environ.get("ROS_MASTER_URI", "")
            raise GpvoError(f"no ROS master at '{place}'", cure="start roscore, or set ROS_MASTER_URI")
        self.store = ros1_types()
        rospy.init_node("gpvo", anonymous=True, disable_signals=True)

    def subscribe(self, topic: str, msgtype: str, deliver: Callable[[str, bytes], None], *, kept: bool = False) -> None:
        """Deliver every message of a topic, whatever type its publisher says it has."""
        import rospy

        def taken(message: Any) -> None:
            deliver(topic, message._buff)

        # Without TCP_NODELAY a message waits for the next one, up to 40 ms.
        rospy.Subscriber(topic, rospy.AnyMsg, taken, queue_size=_DEPTH, buff_size=1 << 24, tcp_nodelay=True)

    def advertise(self, topic: str, msgtype: str) -> Send:
        """Announce a topic."""
        import rospy

        kind = message_class(msgtype)
        publisher = rospy.Publisher(topic, _raw(kind), queue_size=_DEPTH)

        def send(data: bytes) -> None:
            message = publisher.data_class()
            message.raw = data
            publisher.publish(message)

        return send

    def close(self) -> None:
        """End the node."""
        import rospy

        rospy.signal_shutdown("gpvo live has ended")


def ros1_types() -> Any:
    """rosbags' types of ROS 1, with the transforms that it leaves out."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE))
    return store


def _raw(kind: Any) -> Any:
    """A message class of the same name and checksum, whose instances are bytes."""

    class Raw(kind):
        raw = b""

        def serialize(self, buffer: io.BytesIO) -> None:
            buffer.write(self.raw)

    return Raw


def _require(package: str, cure: str) -> None:
    if find_spec(package) is None:
        raise GpvoError(f"{package} is not installed for this Python", cure=cure)
