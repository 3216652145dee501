"""PX4's own message, over DDS, read by a type written out by hand."""

import importlib.util
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.publish import ros
from gpvo.publish.odometry import Odometry
from gpvo.types import Status
from rosbags.typesys import Stores, get_typestore

C = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
FRAME = Odometry(
    10**18,
    se3.exp(np.array([1.0, 2.0, 3.0, 0, 0, np.pi / 2])),
    C,
    np.arange(1.0, 7.0),
    10 * C,
    Status.OK,
    True,
    0.5,
    1.0,
)


def test_left_becomes_right_and_up_becomes_down() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    ros.register_px4(store)
    m = ros.vehicle_odometry(FRAME, store.types)
    assert (m.pose_frame, m.velocity_frame, m.quality, m.timestamp) == (2, 3, 50, 10**15)
    T = FRAME.T_odom_body
    np.testing.assert_allclose(m.position, [T[0, 3], -T[1, 3], -T[2, 3]], rtol=1e-6)
    # A quarter turn to the left: about the axis that points down, backwards.
    np.testing.assert_allclose(m.q, [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-6)
    np.testing.assert_allclose(m.velocity, [1, -2, -3])
    np.testing.assert_allclose(m.angular_velocity, [4, -5, -6])
    np.testing.assert_allclose(m.position_variance, [1, 2, 3])
    np.testing.assert_allclose(m.orientation_variance, [4, 5, 6])
    np.testing.assert_allclose(m.velocity_variance, [10, 20, 30])


def test_a_camera_s_frame_is_turned_to_look_ahead_and_resets_are_counted() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    ros.register_px4(store)
    optical = replace(FRAME, frame_id="left_optical", child_frame_id="left_optical", reset_counter=7)
    m = ros.vehicle_odometry(optical, store.types)
    # x right, y down, z ahead are FRD's y, z and x.
    np.testing.assert_allclose(m.velocity, [3, 1, 2], atol=1e-6)
    np.testing.assert_allclose(m.angular_velocity, [6, 4, 5], atol=1e-6)
    np.testing.assert_allclose(m.velocity_variance, [30, 10, 20], rtol=1e-6)
    np.testing.assert_allclose(m.position, np.roll(FRAME.T_odom_body[:3, 3], 1), rtol=1e-6)
    np.testing.assert_allclose(m.position_variance, [3, 1, 2], rtol=1e-6)
    np.testing.assert_allclose(m.q, [np.sqrt(0.5), np.sqrt(0.5), 0, 0], atol=1e-6)
    assert m.reset_counter == 7


def test_a_lost_frame_is_nan_with_quality_minus_one() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    ros.register_px4(store)
    lost = replace(FRAME, tracked=False, twist_body=None, twist_covariance=None, status=Status.LOST)
    m = ros.vehicle_odometry(lost, store.types)
    assert m.quality == -1
    for name in ("position", "q", "velocity", "position_variance", "velocity_variance"):
        assert np.isnan(getattr(m, name)).all()


@pytest.mark.skipif(importlib.util.find_spec("cyclonedds") is None, reason="needs cyclonedds")
def test_it_travels_by_dds() -> None:
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl import types as idl
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from gpvo.live.outputs import Px4Output
    from gpvo.live.rosless_wire import DdsWire

    three, four = idl.array[idl.float32, 3], idl.array[idl.float32, 4]

    @dataclass
    class VehicleOdometry(IdlStruct, typename="px4_msgs::msg::dds_::VehicleOdometry_"):
        timestamp: idl.uint64
        timestamp_sample: idl.uint64
        pose_frame: idl.uint8
        position: three
        q: four
        velocity_frame: idl.uint8
        velocity: three
        angular_velocity: three
        position_variance: three
        orientation_variance: three
        velocity_variance: three
        reset_counter: idl.uint8
        quality: idl.int8

    node, wire = DomainParticipant(99), DdsWire(99)
    try:
        topic = Topic(node, "rt/fmu/in/vehicle_visual_odometry", VehicleOdometry)
        reader = DataReader(node, topic, Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(10)))
        output, got = Px4Output(wire), []
        for _ in range(100):
            output.odometry(FRAME)
            time.sleep(0.05)
            got += reader.take(10)
            if got:
                break
        assert got
        assert (got[0].timestamp, got[0].quality) == (10**15, 50)
        np.testing.assert_allclose(got[0].velocity_variance, [10, 20, 30])
    finally:
        wire.close()
