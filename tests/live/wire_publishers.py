"""Who publishes on a wire: another odometry, and static transforms that are kept for those who come late."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gpvo.io.bag_reader import ODOMETRY_TYPE, TF_STATIC, TF_TYPE
from gpvo.live.outputs import Wire
from gpvo.live.ros_wire import ros1_types
from ros1_tools import SYSTEM_PYTHON, environment
from rosbags.typesys import Stores, get_typestore
from wire_peers import Place, running

BAG_PUBLISHER = """
import sys, rosbag, rospy
from nav_msgs.msg import Odometry
rospy.init_node("vio", anonymous=True, disable_signals=True)
out = rospy.Publisher(sys.argv[2], Odometry, queue_size=1000)
while out.get_num_connections() == 0:
    rospy.sleep(0.05)
for _, m, _ in rosbag.Bag(sys.argv[1]).read_messages():
    out.publish(m)
    rospy.sleep(0.02)
rospy.sleep(0.5)
"""


def publish(at: Place, topic: str, arrivals: list[Any], folder: Path) -> None:
    """Another odometry, at its pace: ``nav_msgs/Odometry`` messages of any typestore."""
    if at.wire == "ros1":
        from rosbags.rosbag1 import Writer

        store = get_typestore(Stores.ROS1_NOETIC)
        with Writer(folder / "vio.bag") as writer:
            connection = writer.add_connection(topic, ODOMETRY_TYPE, typestore=store)
            for k, a in enumerate(arrivals):
                data = store.serialize_ros1(same(store.types, a.message, k), ODOMETRY_TYPE)
                writer.write(connection, a.received_ns, data)
        command = [SYSTEM_PYTHON, "-c", BAG_PUBLISHER, str(folder / "vio.bag"), topic]
        subprocess.run(command, env=environment(ROS_MASTER_URI=at.address), check=True, timeout=60)
        return
    from gpvo.live.job import open_wire

    wire: Wire = open_wire(at.wire, at.address, int(at.address) if at.wire == "dds" else 0)
    try:
        send = publish_on(wire, topic)
        for a in arrivals:
            send(a.message)
            time.sleep(0.02)
        time.sleep(0.5)
    finally:
        wire.close()


def publish_on(wire: Wire, topic: str, msgtype: str = ODOMETRY_TYPE) -> Callable[[Any], None]:
    """A function that sends messages of any typestore, once somebody has had time to find the topic."""
    send = wire.advertise(topic, msgtype)
    time.sleep(0.5)
    return lambda message: send(bytes(wire.store.serialize_cdr(same(wire.store.types, message), msgtype)))


def same(types: Any, message: Any, seq: int | None = None) -> Any:
    """The message rebuilt of another typestore's classes; ``seq``: for ROS 1, whose headers have a number."""
    if isinstance(message, list):
        return [same(types, part, seq) for part in message]
    if not hasattr(message, "__msgtype__"):
        return message
    names = [f for f in message.__dataclass_fields__ if f != "__msgtype__"]
    numbered = {"seq": seq} if seq is not None and message.__msgtype__ == "std_msgs/msg/Header" else {}
    return types[message.__msgtype__](**numbered, **{n: same(types, getattr(message, n), seq) for n in names})


@contextmanager
def latched(at: Place, message: Any, folder: Path) -> Iterator[None]:
    """``message`` on /tf_static, as a StaticTransformBroadcaster publishes it there."""
    if at.wire == "ros1":
        store = ros1_types()
        payload, definition = folder / "transforms.bin", folder / "transforms.msg"
        payload.write_bytes(bytes(store.serialize_ros1(same(store.types, message, 0), TF_TYPE)))
        definition.write_text(store.generate_msgdef(TF_TYPE, ros_version=1)[0])
        command = [SYSTEM_PYTHON, "-c", ROS1_LATCHED, str(definition), str(payload)]
        with running(*command, wait_for="latched", env=environment(ROS_MASTER_URI=at.address)):
            yield
        return
    store = get_typestore(Stores.ROS2_JAZZY)
    data = bytes(store.serialize_cdr(same(store.types, message), TF_TYPE))
    with _dds(int(at.address), data) if at.wire == "dds" else _zenoh(at.address, data, store.hash_rihs01(TF_TYPE)):
        time.sleep(0.5)
        yield


@contextmanager
def _dds(domain: int, data: bytes) -> Iterator[None]:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
    from gpvo.live.rosless_wire import raw_type

    kind = raw_type(TF_TYPE)
    lasting = (Policy.Reliability.Reliable(duration(seconds=1)), Policy.Durability.TransientLocal)
    participant = DomainParticipant(domain)
    topic = Topic(participant, f"rt{TF_STATIC}", kind)
    writer = DataWriter(participant, topic, qos=Qos(Policy.History.KeepLast(1), *lasting))
    sample = kind.__new__(kind)
    sample.cdr = data
    writer.write(sample)
    yield


@contextmanager
def _zenoh(address: str, data: bytes, type_hash: str) -> Iterator[None]:
    """github.com/ros2/rmw_zenoh, src/detail/rmw_publisher_data.cpp: a cache, and publishers that can be detected."""
    import json

    import zenoh
    from zenoh import ext

    config: Any = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([address]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")  # as in rmw_zenoh's DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5
    with zenoh.open(config) as session:
        key = f"0{TF_STATIC}/tf2_msgs::msg::dds_::TFMessage_/{type_hash}"
        publisher = ext.declare_advanced_publisher(
            session, key, cache=ext.CacheConfig(max_samples=1), publisher_detection=True
        )
        publisher.put(data)
        yield


ROS1_LATCHED = """
import sys, genpy.dynamic, rospy
kind = genpy.dynamic.generate_dynamic("tf2_msgs/TFMessage", open(sys.argv[1]).read())["tf2_msgs/TFMessage"]
rospy.init_node("static_transforms", anonymous=True, disable_signals=True)
out = rospy.Publisher("/tf_static", kind, queue_size=1, latch=True)
out.publish(kind().deserialize(open(sys.argv[2], "rb").read()))
print("latched", file=sys.stderr, flush=True)
rospy.spin()
"""
