"""Genuine ROS 1 tools from Debian (python3-rosbag, python3-rospy, python3-rosmaster), where they are installed."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from gpvo.publish.odometry import Odometry
from gpvo.publish.ros import TOPIC, write_bag
from ros1_tools import SYSTEM_PYTHON, environment, needs_rosbag, needs_rospy, ros_master

READ = """
import json, sys, rosbag
for topic, m, t in rosbag.Bag(sys.argv[1]).read_messages():
    print(json.dumps({"topic": topic, "t": t.to_nsec(), "stamp": m.header.stamp.to_nsec(), "x": m.pose.pose.position.x,
                      "frame": m.header.frame_id, "child": m.child_frame_id,
                      "pose": list(m.pose.covariance), "twist": list(m.twist.covariance)}))
"""


@pytest.fixture(scope="module")
def bag(odometry: list[Odometry], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ros1") / "odometry.bag"
    write_bag(path, odometry)
    return path


@needs_rosbag
def test_rosbag_info_reads_it(bag: Path, odometry: list[Odometry]) -> None:
    command = [SYSTEM_PYTHON, "-c", "import rosbag; rosbag.rosbagmain()", "info", "-y", str(bag)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False, timeout=60)
    assert run.returncode == 0, run.stderr
    assert "nav_msgs/Odometry" in run.stdout
    assert f"messages: {sum(o.twist_body is not None for o in odometry)}" in run.stdout


@needs_rosbag
def test_rosbag_reads_every_number(bag: Path, odometry: list[Odometry]) -> None:
    command = [SYSTEM_PYTHON, "-c", READ, str(bag)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False, timeout=60)
    assert run.returncode == 0, run.stderr
    got = [json.loads(line) for line in run.stdout.splitlines()]
    tracked = [o for o in odometry if o.twist_body is not None]
    for message, sent in zip(got, tracked, strict=True):
        assert message["topic"] == TOPIC
        assert (message["t"], message["stamp"]) == (sent.t_ns, sent.t_ns)
        assert (message["frame"], message["child"]) == ("odom", "base_link")
        assert message["x"] == sent.T_odom_body[0, 3]
        np.testing.assert_array_equal(message["pose"], sent.pose_covariance.reshape(36))
        np.testing.assert_array_equal(message["twist"], sent.twist_covariance.reshape(36))


SUBSCRIBE = """
import sys, rospy
from nav_msgs.msg import Odometry
want, got = int(sys.argv[2]), []
rospy.init_node("listener", anonymous=True, disable_signals=True)
rospy.Subscriber(sys.argv[1], Odometry, lambda m: got.append((m.header.stamp.to_nsec(), sum(m.twist.covariance))))
print("ready", flush=True)
for _ in range(600):
    if len(got) >= want:
        break
    rospy.sleep(0.05)
for stamp, total in got:
    print(stamp, repr(total))
"""

PUBLISH = """
import sys, rosbag, rospy
from nav_msgs.msg import Odometry
rospy.init_node("talker", anonymous=True, disable_signals=True)
out = rospy.Publisher(sys.argv[2], Odometry, queue_size=1000)
while out.get_num_connections() == 0:
    rospy.sleep(0.05)
for _, m, _ in rosbag.Bag(sys.argv[1]).read_messages():
    out.publish(m)
    rospy.sleep(0.005)
rospy.sleep(1.0)
"""


@pytest.fixture
def master() -> Iterator[str]:
    with ros_master() as uri:
        yield uri


@needs_rosbag
@needs_rospy
def test_a_live_subscriber_receives_every_message(bag: Path, odometry: list[Odometry], master: str) -> None:
    tracked = [o for o in odometry if o.twist_body is not None]
    env = environment(ROS_MASTER_URI=master)
    listener = subprocess.Popen(
        [SYSTEM_PYTHON, "-c", SUBSCRIBE, TOPIC, str(len(tracked))], env=env, stdout=subprocess.PIPE, text=True
    )
    try:
        assert listener.stdout is not None
        assert listener.stdout.readline() == "ready\n"
        talker = [SYSTEM_PYTHON, "-c", PUBLISH, str(bag), TOPIC]
        subprocess.run(talker, env=env, check=True, timeout=60, capture_output=True)
        out, _ = listener.communicate(timeout=60)
    finally:
        listener.kill()
    got = [line.split() for line in out.splitlines()]
    assert [int(stamp) for stamp, _ in got] == [o.t_ns for o in tracked]
    sums = [sum(o.twist_covariance.reshape(36).tolist()) for o in tracked if o.twist_covariance is not None]
    assert [float(total) for _, total in got] == sums
