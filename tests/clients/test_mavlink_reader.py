"""pymavlink's own parser reads back what was sent: all 21 values of both covariances, from file and socket."""

from __future__ import annotations

import os
import socket
import time
import tty
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL, T_FLU_OPTICAL, rotate_covariance
from gpvo.publish.mavlink import COMPONENT, Link, Sender, quality, write_tlog
from gpvo.publish.odometry import Odometry
from gpvo.publish.ros import register_px4, vehicle_odometry
from rosbags.typesys import Stores, get_typestore

pytest.importorskip("pymavlink")
from pymavlink import mavutil
from pymavlink.dialects.v20 import common

FLIP = np.array([1.0, -1, -1, 1, -1, -1])


def _read(path: Path) -> list:
    log = mavutil.mavlink_connection(str(path), dialect="common")
    out = []
    while (message := log.recv_match()) is not None:
        out.append(message)
    return out


def _full(upper: list[float]) -> np.ndarray:
    C = np.zeros((6, 6))
    C[np.triu_indices(6)] = upper
    return C + np.triu(C, 1).T


@pytest.fixture(scope="module")
def received(odometry: list[Odometry], tmp_path_factory: pytest.TempPathFactory) -> list:
    path = tmp_path_factory.mktemp("mavlink") / "flight.tlog"
    assert write_tlog(path, odometry) == len(odometry)
    return _read(path)


def test_odometry_comes_back_in_frd(odometry: list[Odometry], received: list) -> None:
    got = [m for m in received if m.get_type() == "ODOMETRY"]
    for message, sent in zip(got, odometry, strict=True):
        assert message.time_usec == sent.t_ns // 1000
        assert (message.frame_id, message.child_frame_id) == (20, 12)
        assert (message.get_srcSystem(), message.get_srcComponent()) == (1, COMPONENT)
        assert message.estimator_type == common.MAV_ESTIMATOR_TYPE_VISION
        assert message.quality == quality(sent)
        position = sent.T_odom_body[:3, 3] * FLIP[:3] if sent.tracked else np.full(3, np.nan)
        np.testing.assert_allclose([message.x, message.y, message.z], position, rtol=1e-6, atol=1e-6)
        twist = [message.vx, message.vy, message.vz, message.rollspeed, message.pitchspeed, message.yawspeed]
        if sent.twist_body is None:
            assert np.isnan(twist).all()
            assert np.isnan(message.velocity_covariance[0])
            assert not any(message.velocity_covariance[1:])
            # The first frame has no motion yet, but a pose; a lost frame has neither.
            assert np.isnan(message.pose_covariance[0]) == (not sent.tracked)
            continue
        np.testing.assert_allclose(twist, sent.twist_body * FLIP, rtol=1e-6, atol=1e-7)
        for wire, C in (
            (message.pose_covariance, sent.pose_covariance),
            (message.velocity_covariance, sent.twist_covariance),
        ):
            assert len(wire) == 21
            np.testing.assert_allclose(_full(wire), C * np.outer(FLIP, FLIP), rtol=1e-6, atol=1e-12)


def test_quaternion_turns_body_frd_into_local_frd(odometry: list[Odometry], received: list) -> None:
    got = [m for m in received if m.get_type() == "ODOMETRY"]
    for message, sent in zip(got, odometry, strict=True):
        w, x, y, z = message.q
        if not sent.tracked:
            assert np.isnan(message.q).all()
            continue
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        F = np.diag(FLIP[:3])
        np.testing.assert_allclose(R, F @ sent.T_odom_body[:3, :3] @ F, atol=1e-6)


def test_speed_is_in_local_axes_with_nine_covariances(odometry: list[Odometry], received: list) -> None:
    got = [m for m in received if m.get_type() == "VISION_SPEED_ESTIMATE"]
    tracked = [o for o in odometry if o.twist_body is not None]
    for message, sent in zip(got, tracked, strict=True):
        R = np.diag(FLIP[:3]) @ sent.T_odom_body[:3, :3]
        np.testing.assert_allclose([message.x, message.y, message.z], R @ sent.twist_body[:3], rtol=1e-5, atol=1e-6)
        C = R @ sent.twist_covariance[:3, :3] @ R.T
        np.testing.assert_allclose(np.reshape(message.covariance, (3, 3)), C, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("frames", [("odom", "cam_optical_frame"), ("left_optical", "Left_Optical")])
def test_the_axes_of_a_camera_become_those_of_a_body(
    frames: tuple[str, str], odometry: list[Odometry], received: list, tmp_path: Path
) -> None:
    """REP 103's optical frames: the same flight, told by a camera that looks ahead."""
    R, turned = R_FLU_OPTICAL.T, []
    for o in odometry:
        T, pose = o.T_odom_body @ T_FLU_OPTICAL, o.pose_covariance
        if "optical" in frames[0]:
            T, pose = se3.inverse(T_FLU_OPTICAL) @ T, rotate_covariance(R, pose)
        twist = None if o.twist_body is None else np.concatenate([R @ o.twist_body[:3], R @ o.twist_body[3:]])
        C = None if o.twist_covariance is None else rotate_covariance(R, o.twist_covariance)
        turned.append(
            replace(
                o,
                T_odom_body=T,
                pose_covariance=pose,
                twist_body=twist,
                twist_covariance=C,
                frame_id=frames[0],
                child_frame_id=frames[1],
            )
        )
    write_tlog(tmp_path / "turned.tlog", turned)
    store = get_typestore(Stores.ROS2_JAZZY)
    register_px4(store)
    for ours, theirs in zip(turned, odometry, strict=True):
        one, other = (vars(vehicle_odometry(o, store.types)) for o in (ours, theirs))
        for name in ("position", "velocity", "angular_velocity", "position_variance", "velocity_variance"):
            np.testing.assert_allclose(one[name], other[name], rtol=1e-4, atol=1e-6)
    for message, want in zip(_read(tmp_path / "turned.tlog"), received, strict=True):
        for name in message.get_fieldnames():
            ours, theirs = (np.atleast_1d(getattr(m, name)) for m in (message, want))
            np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6, err_msg=name)


def test_a_heartbeat_a_second_and_no_gap_in_the_sequence(received: list) -> None:
    beats = [m for m in received if m.get_type() == "HEARTBEAT"]
    assert len(beats) in (4, 5)
    numbers = np.array([m.get_seq() for m in received])
    assert set(np.diff(numbers) % 256) == {1}
    sender = Sender()
    assert [sender.heartbeat()[4] for _ in range(258)] == [*range(256), 0, 1]


@pytest.mark.parametrize(
    "change, expected",
    [
        ({"confidence": 0.8, "in_domain": 0.9}, 80),
        ({"confidence": 0.0, "in_domain": 0.9}, 1),
        ({"confidence": 1.0, "in_domain": 1.0}, 100),
        ({"confidence": 0.7, "in_domain": 0.0}, -1),
        ({"confidence": 0.7, "in_domain": 0.0099}, -1),
        ({"confidence": 0.7, "in_domain": 0.0101}, 70),
        ({"confidence": 0.001, "in_domain": 0.001}, -1),
        ({"confidence": None, "in_domain": None}, 0),
        ({"tracked": False}, -1),
    ],
)
def test_quality(odometry: list[Odometry], change: dict, expected: int) -> None:
    assert quality(replace(odometry[5], **change)) == expected


def test_a_speed_without_a_model_is_sent_and_tells_of_resets(odometry: list[Odometry]) -> None:
    sender, parser = Sender(), common.MAVLink(None)
    frame = replace(odometry[5], confidence=None, in_domain=None, reset_counter=9)
    for data in (sender.speed(frame), sender.odometry(frame)):
        (message,) = parser.parse_buffer(data)
        assert message.reset_counter == 9
    assert sender.speed(replace(frame, confidence=0.5, in_domain=0.0)) is None


def test_udp(odometry: list[Odometry]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        link = Link(f"udp:127.0.0.1:{receiver.getsockname()[1]}")
        link.send(odometry[5])
        link.send(replace(odometry[6], in_domain=0.0))
        parser = common.MAVLink(None)
        names = [parser.decode(bytearray(receiver.recv(1000))).get_type() for _ in range(4)]
    # The velocity that has a covariance comes first, as EKF3 takes one of the two; none goes without its quality of -1.
    assert names == ["HEARTBEAT", "VISION_SPEED_ESTIMATE", "ODOMETRY", "ODOMETRY"]


@pytest.mark.parametrize(
    "address",
    [
        "udp:localhost",
        "tcp:localhost:1",
        "serial::9600",
        "serial:/nowhere:57600",
        "udp:localhost:0",
        "udp:localhost:99999",
    ],
)
def test_a_bad_address_is_one_line(address: str) -> None:
    with pytest.raises(GpvoError):
        Link(address)


def test_a_serial_line_that_takes_nothing_is_left_alone_for_a_second_and_one_that_comes_back_is_used(
    odometry: list[Odometry], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("serial")
    clock = [time.monotonic()]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device = tmp_path / "ttyUSB0"
    device.symlink_to(os.ttyname(theirs))
    link = Link(f"serial:{device}:57600")
    with pytest.raises(GpvoError, match=r"cannot send to serial:.*ttyUSB0:57600"):
        [link.send(odometry[5]) for _ in range(1000)]
    start = time.perf_counter()
    with pytest.raises(GpvoError):
        link.send(odometry[5])
    assert time.perf_counter() - start < 0.05
    os.close(ours)
    os.close(theirs)
    clock[0] += 2.0
    with pytest.raises(GpvoError):  # unplugged
        link.send(odometry[5])
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    device.unlink()
    device.symlink_to(os.ttyname(theirs))
    clock[0] += 2.0
    link.send(odometry[5])
    assert os.read(ours, 1) == b"\xfd"


def test_a_heartbeat_a_second_also_after_the_clock_of_the_odometry_went_back(odometry: list[Odometry]) -> None:
    sender, moving = Sender(), next(o for o in odometry if o.twist_body is not None)
    stamps = [*range(10**18, 10**18 + 10 * 10**9, 10**8), *range(0, 10 * 10**9, 10**8)]
    beats = [len(sender.due(replace(moving, t_ns=t))) == 3 for t in stamps]
    assert sum(beats[:100]) == 10
    assert sum(beats[100:]) == 10
