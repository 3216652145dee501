"""The shim in a process of its own, fed and read over the loopback by processes that share none of its code's state.

The readers are other people's: ``zenoh-ros2-sdk``, and ``cyclonedds`` with IDL written out by hand.
"""

from __future__ import annotations

import importlib.util
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.io.foreign import T_FLU_OPTICAL
from gpvo.live.outputs import ODOMETRY, Wire
from gpvo.publish.odometry import Odometry
from rosbags.typesys import Stores, get_typestore
from shim_bags import TOPIC, engine, flight, flown, save_model

HERE = Path(__file__).parent
needs_zenoh = pytest.mark.skipif(
    importlib.util.find_spec("zenoh_ros2_sdk") is None, reason="needs eclipse-zenoh and zenoh-ros2-sdk"
)
needs_dds = pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="needs cyclonedds")
MESSAGES = 40

ZENOH_READER = """
import json, os, sys, time
from zenoh_ros2_sdk.discovery import get_topic_info
from zenoh_ros2_sdk.message_registry import get_registry
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.subscriber import ROS2Subscriber
port, want, definitions = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
ZenohSession.get_instance("127.0.0.1", port)
get_registry(definitions)
got = []
router = dict(router_ip="127.0.0.1", router_port=port, domain_id=0)
ROS2Subscriber("/gpvo/odometry", "nav_msgs/msg/Odometry", got.append, **router)
info = get_topic_info("/gpvo/odometry", 0, "127.0.0.1", port, timeout=5.0, verbose=True)
print(json.dumps([[p.topic_type, p.type_hash, p.node_name] for p in info.publishers]), flush=True)
"""

DDS_READER = """
import json, os, sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
def ros(package, name):
    return dict(typename=f"{package}::msg::dds_::{name}_")
@dataclass
class Time(IdlStruct, **ros("builtin_interfaces", "Time")): sec: int32; nanosec: uint32
@dataclass
class Header(IdlStruct, **ros("std_msgs", "Header")): stamp: Time; frame_id: str
@dataclass
class Vector3(IdlStruct, **ros("geometry_msgs", "Vector3")): x: float64; y: float64; z: float64
@dataclass
class Point(IdlStruct, **ros("geometry_msgs", "Point")): x: float64; y: float64; z: float64
@dataclass
class Quaternion(IdlStruct, **ros("geometry_msgs", "Quaternion")): x: float64; y: float64; z: float64; w: float64
@dataclass
class Pose(IdlStruct, **ros("geometry_msgs", "Pose")): position: Point; orientation: Quaternion
@dataclass
class PoseC(IdlStruct, **ros("geometry_msgs", "PoseWithCovariance")): pose: Pose; covariance: array[float64, 36]
@dataclass
class Twist(IdlStruct, **ros("geometry_msgs", "Twist")): linear: Vector3; angular: Vector3
@dataclass
class TwistC(IdlStruct, **ros("geometry_msgs", "TwistWithCovariance")): twist: Twist; covariance: array[float64, 36]
@dataclass
class Odometry(IdlStruct, **ros("nav_msgs", "Odometry")):
    header: Header; child_frame_id: str; pose: PoseC; twist: TwistC
domain, want = int(sys.argv[1]), int(sys.argv[2])
node = DomainParticipant(domain)
qos = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(1000))
reader = DataReader(node, Topic(node, "rt/gpvo/odometry", Odometry), qos)
publications = BuiltinDataReader(node, BuiltinTopicDcpsPublication)
found = []
for _ in range(100):
    ours = [p for p in publications.read(100) if p.topic_name == "rt/gpvo/odometry"]
    found = [[p.type_name, p.qos[Policy.Userdata].data.decode()] for p in ours]
    if found:
        break
    time.sleep(0.1)
print(json.dumps(found), flush=True)
got = []
"""

READ_ON = """
for _ in range(600):
    if "reader" in globals():
        got += reader.take(100)
    if len(got) >= want:
        break
    time.sleep(0.05)
for m in got:
    print(json.dumps({"t": m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, "frame": m.header.frame_id,
                      "child": m.child_frame_id, "x": m.pose.pose.position.x,
                      "pose": [float(v) for v in m.pose.covariance], "twist": [float(v) for v in m.twist.covariance]}))
sys.stdout.flush()
os._exit(0)  # a session's threads would hold the process
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def write_definitions(folder: Path) -> Path:
    """The .msg files of Odometry and what it holds, for a client that would fetch them from GitHub."""
    text = "MSG: nav_msgs/Odometry\n" + get_typestore(Stores.ROS2_JAZZY).generate_msgdef(ODOMETRY, ros_version=2)[0]
    for part in re.split(r"=+\n", text):
        head, _, body = part.partition("\n")
        package, name = head.removeprefix("MSG: ").split("/")[::2] if head.count("/") == 2 else head[5:].split("/")
        path = folder / package / "msg" / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(body)
    return folder


@contextmanager
def running(*command: str, wait_for: str | None = None) -> Iterator[subprocess.Popen[str]]:
    """A process, killed at the end whatever happens; its standard error is watched for a word."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        if wait_for is not None:
            assert process.stderr is not None
            seen = process.stderr.readline()
            assert wait_for in seen, seen
        yield process
    finally:
        process.kill()
        process.wait(10)


def expected() -> tuple[np.ndarray, np.ndarray, list[Odometry]]:
    stamps, T = flight(n=MESSAGES)
    live, kept, _ = engine()
    for arrival in flown(stamps, T):
        live.take(arrival)
    return stamps, T, [o for o in kept.frames if o.twist_body is not None]


def publish(wire: Wire, stamps: np.ndarray, T: np.ndarray) -> None:
    """Another odometry, at its pace."""
    send = wire.advertise(TOPIC, ODOMETRY)
    time.sleep(0.5)
    store: Any = wire.store
    types = store.types
    for arrival in flown(stamps, T):
        m = arrival.message
        send(bytes(store.serialize_cdr(_same(types, m), ODOMETRY)))
        time.sleep(0.02)


def _same(types: Any, message: Any) -> Any:
    """The message rebuilt of another typestore's classes."""
    if hasattr(message, "__msgtype__"):
        names = [f for f in message.__dataclass_fields__ if f != "__msgtype__"]
        return types[message.__msgtype__](**{n: _same(types, getattr(message, n)) for n in names})
    return message


def check(reader: subprocess.Popen[str], want: list[Odometry]) -> None:
    """Every message arrived, with the numbers of the offline path."""
    out, err = reader.communicate(timeout=60)
    got = [json.loads(line) for line in out.splitlines()]
    assert got, err
    assert [g["t"] for g in got] == [o.t_ns for o in want]
    for ours, theirs in zip(got, want, strict=True):
        assert (ours["frame"], ours["child"]) == ("odom", "base_link")
        assert ours["x"] == pytest.approx(theirs.T_odom_body[0, 3], abs=1e-9)
        np.testing.assert_allclose(ours["pose"], theirs.pose_covariance.reshape(36), rtol=1e-9, atol=1e-15)
        assert theirs.twist_covariance is not None
        np.testing.assert_allclose(ours["twist"], theirs.twist_covariance.reshape(36), rtol=1e-9, atol=1e-15)


def shim(model: Path, *options: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "gpvo",
        "live",
        "--odometry",
        TOPIC,
        "--model",
        str(model),
        "--json",
        "--depth",
        "200",
        *options,
    ]


def ends_by_sigterm(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    counts = json.loads(out)["counts"]
    assert counts["frames_start"] == 1
    assert counts.get("undecodable", 0) == 0


@needs_zenoh
def test_zenoh_is_read_by_zenoh_ros2_sdk(tmp_path: Path) -> None:
    from gpvo.live.zenoh_wire import ZenohWire

    port, (stamps, T, want) = free_port(), expected()
    router = ZenohWire(f"listen:tcp/127.0.0.1:{port}", node="vio")
    definitions = write_definitions(tmp_path / "msgs")
    command = shim(save_model(tmp_path / "m.gpvo"), "--zenoh", "--address", f"tcp/127.0.0.1:{port}")
    reading = [sys.executable, "-c", ZENOH_READER + READ_ON, str(port), str(len(want)), str(definitions)]
    try:
        with running(*command, wait_for="listening") as live, running(*reading) as reader:
            assert reader.stdout is not None
            listed = reader.stdout.readline()
            assert listed
            hash_ = "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
            assert json.loads(listed) == [["nav_msgs/msg/Odometry", hash_, "gpvo"]]
            publish(router, stamps, T)
            check(reader, want)
            ends_by_sigterm(live)
    finally:
        router.close()


@needs_dds
def test_dds_is_read_by_cyclonedds(tmp_path: Path) -> None:
    from gpvo.live.dds_wire import DdsWire

    domain, (stamps, T, want) = 100 + free_port() % 100, expected()
    command = shim(save_model(tmp_path / "m.gpvo"), "--dds", "--domain", str(domain))
    reading = [sys.executable, "-c", DDS_READER + READ_ON, str(domain), str(len(want))]
    wire = DdsWire(domain)
    try:
        with running(*command, wait_for="listening") as live, running(*reading) as reader:
            assert reader.stdout is not None
            listed = reader.stdout.readline()
            assert listed
            [(name, data)] = json.loads(listed)
            assert name == "nav_msgs::msg::dds_::Odometry_"
            assert data.startswith("typehash=RIHS01_3cc97dc7")
            publish(wire, stamps, T)
            check(reader, want)
            ends_by_sigterm(live)
    finally:
        wire.close()


def test_the_pose_of_a_flu_body_is_what_the_shim_takes() -> None:
    """What the tests above rely on: the flight's poses are of a body whose camera looks ahead."""
    _, T = flight(n=3)
    assert se3.inverse(T_FLU_OPTICAL)[2, 0] == 1.0
    assert T.shape == (4, 4, 4)
