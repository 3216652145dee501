"""Round trips through the rosbags library: ROS 1, ROS 2 sqlite3, MCAP."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.publish.odometry import Odometry
from gpvo.publish.ros import TOPIC, robot_localization_yaml, write_bag
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer as RosbagWriter
from rosbags.typesys import Stores, get_typestore


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_every_number_comes_back(odometry: list[Odometry], tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("odometry.bag" if kind == "ros1" else "odometry")
    count = write_bag(path, odometry, kind=kind)
    tracked = [o for o in odometry if o.twist_body is not None]
    assert count == len(tracked) < len(odometry)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        assert [c.topic for c in reader.connections] == [TOPIC]
        assert [c.msgtype for c in reader.connections] == ["nav_msgs/msg/Odometry"]
        for sent, (connection, t_ns, raw) in zip(tracked, reader.messages(), strict=True):
            got = reader.deserialize(raw, connection.msgtype)
            assert t_ns == sent.t_ns == got.header.stamp.sec * 10**9 + got.header.stamp.nanosec
            assert (got.header.frame_id, got.child_frame_id) == ("odom", "base_link")
            p, q = got.pose.pose.position, got.pose.pose.orientation
            T = se3.from_quaternion(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
            np.testing.assert_allclose(T, sent.T_odom_body, atol=1e-12)
            v, w = got.twist.twist.linear, got.twist.twist.angular
            np.testing.assert_array_equal([v.x, v.y, v.z, w.x, w.y, w.z], sent.twist_body)
            np.testing.assert_array_equal(got.pose.covariance.reshape(6, 6), sent.pose_covariance)
            np.testing.assert_array_equal(got.twist.covariance.reshape(6, 6), sent.twist_covariance)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_clock_that_is_set_back_reorders_no_recording(odometry: list[Odometry], tmp_path: Path, kind: str) -> None:
    """Readers sort by the time of recording: it goes on by the steps of the stamps, which stay what they are."""
    tracked = [o for o in odometry if o.twist_body is not None][:40]
    sent = [replace(o, t_ns=o.t_ns - 3 * 10**9 * (k >= 20)) for k, o in enumerate(tracked)]
    path = tmp_path / ("odometry.bag" if kind == "ros1" else "odometry")
    write_bag(path, sent, kind=kind)
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    with AnyReader([path], default_typestore=store) as reader:
        messages = [(t_ns, reader.deserialize(raw, c.msgtype).header.stamp) for c, t_ns, raw in reader.messages()]
    assert [s.sec * 10**9 + s.nanosec for _, s in messages] == [o.t_ns for o in sent]
    recorded = np.array([t_ns for t_ns, _ in messages])
    np.testing.assert_array_equal(recorded[:20], [o.t_ns for o in sent[:20]])
    assert recorded[20] == recorded[19] + 1
    np.testing.assert_array_equal(np.diff(recorded[20:]), np.diff([o.t_ns for o in sent[20:]]))


def test_an_old_bag_is_replaced_and_nothing_else(odometry: list[Odometry], tmp_path: Path) -> None:
    write_bag(tmp_path / "bag", odometry)
    assert write_bag(tmp_path / "bag", odometry[:10], kind="mcap") == 9
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"")
    with pytest.raises(GpvoError, match="not a bag of /gpvo/odometry alone"):
        write_bag(tmp_path / "photos", odometry)
    with RosbagWriter(tmp_path / "both", version=9) as writer:  # also where a recording holds such messages, too
        for topic in (TOPIC, "/camera/odometry"):
            writer.add_connection(topic, "nav_msgs/msg/Odometry", typestore=get_typestore(Stores.ROS2_HUMBLE))
    for name in ("flight", "flight.bag", "both"):
        if name != "both":
            write_bag(tmp_path / name, odometry, "/camera/odometry")  # a recording
        with pytest.raises(GpvoError, match="not a bag of /gpvo/odometry alone"):
            write_bag(tmp_path / name, odometry)


def test_yaml_fuses_the_twist_alone() -> None:
    parameters = yaml.safe_load(robot_localization_yaml())["ekf_filter_node"]["ros__parameters"]
    assert parameters["odom0"] == TOPIC
    assert parameters["odom0_config"] == [False] * 6 + [True] * 6 + [False] * 3
    assert parameters["world_frame"] == "odom"
