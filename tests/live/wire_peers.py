"""Processes around ``gpvo live`` on the loopback: other people's readers, publishers, routers and masters."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpvo.io.bag_reader import ODOMETRY_TYPE
from ros1_tools import SYSTEM_PYTHON, environment, ros_master, with_gpvo
from rosbags.typesys import Stores, get_typestore

ROOT = Path(__file__).parents[2]
Rows = list[dict[str, Any]]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def write_definitions(folder: Path) -> Path:
    """The .msg files of Odometry and what it holds, for a client that would fetch them from GitHub."""
    text = (
        "MSG: nav_msgs/Odometry\n" + get_typestore(Stores.ROS2_JAZZY).generate_msgdef(ODOMETRY_TYPE, ros_version=2)[0]
    )
    for part in re.split(r"=+\n", text):
        head, _, body = part.partition("\n")
        package, name = head.removeprefix("MSG: ").split("/")[::2] if head.count("/") == 2 else head[5:].split("/")
        path = folder / package / "msg" / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(body)
    return folder


@dataclass(frozen=True)
class Place:
    """Where a wire is: what ``gpvo live`` and ``bench.live_peers`` are told, and how a Python is started there."""

    wire: str
    address: str
    options: list[str]
    python: list[str] = field(default_factory=lambda: [sys.executable])
    env: dict[str, str] | None = None


@contextmanager
def place(wire: str) -> Iterator[Place]:
    """A router or master of its own, or a domain that nobody else is likely to use."""
    port = free_port()
    if wire == "dds":
        domain = str(100 + port % 100)
        yield Place(wire, domain, ["--dds", "--domain", domain])
    elif wire == "ros1":
        with ros_master() as uri:
            yield Place(wire, uri, ["--ros1"], [SYSTEM_PYTHON], with_gpvo(ROS_MASTER_URI=uri))
    else:
        from gpvo.live.rosless_wire import ZenohWire

        address = f"tcp/127.0.0.1:{port}"
        router = ZenohWire(f"listen:{address}", node="router")
        try:
            yield Place(wire, address, ["--zenoh", "--address", address])
        finally:
            router.close()


@contextmanager
def running(
    *command: str, wait_for: str | None = None, env: dict[str, str] | None = None
) -> Iterator[subprocess.Popen[str]]:
    """A process, killed at the end whatever happens; its standard error is watched for a word."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, cwd=ROOT)
    try:
        if wait_for is not None:
            assert process.stderr is not None
            seen = process.stderr.readline()
            assert wait_for in seen, seen
        yield process
    finally:
        process.kill()
        process.wait(10)


@contextmanager
def live(at: Place, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``gpvo live`` there, listening."""
    command = [*at.python, "-m", "gpvo", "live", *options, *at.options, "--json", "--depth", "200"]
    with running(*command, wait_for="listening", env=at.env) as process:
        yield process


def ends(process: subprocess.Popen[str]) -> dict[str, int]:
    """SIGTERM ends it with its counts."""
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 0, err
    counts: dict[str, int] = json.loads(out)["counts"]
    assert counts.get("undecodable", 0) == 0
    assert counts.get("failed", 0) == 0
    return counts


@contextmanager
def reader(at: Place, want: int, folder: Path) -> Iterator[tuple[Any, Callable[[], Rows]]]:
    """Somebody else's subscriber to /gpvo/odometry: what it lists, and a function that waits for all it read."""
    if at.wire == "ros1":
        with _bag_recorder(at, folder) as both:
            yield both
        return
    arguments = {
        "zenoh": [ZENOH_READER + READ_ON, at.address.rpartition(":")[2], str(want), str(folder / "msgs")],
        "dds": [DDS_READER + READ_ON, at.address, str(want)],
    }[at.wire]
    if at.wire == "zenoh":
        write_definitions(folder / "msgs")
    with running(sys.executable, "-c", *arguments) as process:
        assert process.stdout is not None
        listed = process.stdout.readline()
        assert listed

        def rows() -> Rows:
            out, err = process.communicate(timeout=60)
            assert out, err
            return [json.loads(line) for line in out.splitlines()]

        yield json.loads(listed), rows


@contextmanager
def _bag_recorder(at: Place, folder: Path) -> Iterator[tuple[Any, Callable[[], Rows]]]:
    """``rosbag record`` and ``rostopic echo`` of Debian; ``rostopic list`` and ``info`` beforehand."""
    env, bag, echoed = environment(ROS_MASTER_URI=at.address), folder / "recorded.bag", folder / "echo.csv"
    command = ["rosbag", "record", "-O", str(bag), "/gpvo/odometry", "/diagnostics"]
    info = subprocess.run(["rostopic", "type", "/gpvo/odometry"], env=env, capture_output=True, text=True, timeout=60)
    with ExitStack() as held:
        recorder = held.enter_context(running(*command, env=env))
        file = held.enter_context(echoed.open("w"))
        echo = subprocess.Popen(["rostopic", "echo", "-p", "/gpvo/odometry"], stdout=file, env=env)
        held.callback(echo.wait, 10)
        held.callback(echo.kill)
        _wait_for_subscribers(env, 2)

        def rows() -> Rows:
            time.sleep(0.5)
            for process in (recorder, echo):
                process.send_signal(signal.SIGINT)
                process.wait(20)
            lines = echoed.read_text().splitlines()
            reading = [SYSTEM_PYTHON, "-c", BAG_READER, str(bag)]
            run = subprocess.run(reading, env=env, capture_output=True, text=True, check=True, timeout=60)
            out = [json.loads(line) for line in run.stdout.splitlines()]
            assert [int(line.split(",")[0]) for line in lines[1:]] == [row["t"] for row in out]
            return out

        yield info.stdout.strip(), rows


def _wait_for_subscribers(env: dict[str, str], want: int) -> None:
    command = ["rostopic", "info", "/gpvo/odometry"]
    for _ in range(60):
        said = subprocess.run(command, env=env, capture_output=True, text=True, timeout=60).stdout
        if said.partition("Subscribers:")[2].count(" * ") >= want:
            return
        time.sleep(0.2)
    raise AssertionError("the readers did not subscribe")


BAG_READER = """
import json, sys, rosbag
for topic, m, t in rosbag.Bag(sys.argv[1]).read_messages(["/gpvo/odometry"]):
    print(json.dumps({"t": m.header.stamp.to_nsec(), "frame": m.header.frame_id, "child": m.child_frame_id,
                      "x": m.pose.pose.position.x, "pose": list(m.pose.covariance), "twist": list(m.twist.covariance)}))
"""

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
