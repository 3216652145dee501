"""MAVLink 2 for flight controllers: ODOMETRY, VISION_SPEED_ESTIMATE and HEARTBEAT, to a file, UDP or serial.

FRD and NED occur only in this module and in :mod:`gpvo.publish.ros`. ODOMETRY (331): LOCAL_FRD / BODY_FRD, quaternion
w, x, y, z, upper triangles row-major (21); message_definitions/v1.0/common.xml. pymavlink (LGPL) is optional.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import inf
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from gpvo.errors import GpvoError, MissingExtraError, require
from gpvo.files import replacing
from gpvo.geometry import se3
from gpvo.geometry.covariance import upper
from gpvo.geometry.se3 import R_FLU_OPTICAL, R_FRD_FLU, T_FLU_OPTICAL, rotate_covariance
from gpvo.io.foreign import is_optical
from gpvo.publish.odometry import Odometry
from gpvo.types import Array

COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_LOCAL_FRD, _BODY_FRD, _ESTIMATOR_VISION = 20, 12, 2
# ``in_domain`` three training standard deviations outside: there the model knows nothing of use.
_OUTSIDE_BELOW = 0.01
# A line that takes nothing must not hold up what goes elsewhere: it is given this long, and not before that long again.
_WAIT_S, _AGAIN_S = 0.1, 1.0


def dialect() -> ModuleType:
    """pymavlink's MAVLink 2 dialect. Raises ``MissingExtraError`` without pymavlink."""
    require("pymavlink")
    from pymavlink.dialects.v20 import common

    module: ModuleType = common
    return module


def quality(odometry: Odometry) -> int:
    """MAVLink quality: -1 lost or out of domain, 0 no model, else 1 to 100 from the confidence."""
    if not odometry.tracked or (odometry.in_domain is not None and odometry.in_domain < _OUTSIDE_BELOW):
        return -1
    if odometry.confidence is None:
        return 0
    return int(np.clip(round(100 * odometry.confidence), 1, 100))


def flu(odometry: Odometry) -> Odometry:
    """In FLU axes: x ahead, where a frame is a camera's by its name. Flight controllers know no other frames."""
    T, pose, twist, C = odometry.T_odom_body, odometry.pose_covariance, odometry.twist_body, odometry.twist_covariance
    if is_optical(odometry.frame_id):
        T, pose = T_FLU_OPTICAL @ T, rotate_covariance(R_FLU_OPTICAL, pose)
    if is_optical(odometry.child_frame_id):
        T = T @ se3.inverse(T_FLU_OPTICAL)
        twist = None if twist is None else (twist.reshape(2, 3) @ R_FLU_OPTICAL.T).ravel()
        C = None if C is None else rotate_covariance(R_FLU_OPTICAL, C)
    return replace(odometry, T_odom_body=T, pose_covariance=pose, twist_body=twist, twist_covariance=C)


def frd(odometry: Odometry) -> tuple[Array, Array]:
    """Pose (7,), position then quaternion w, x, y, z, and twist (6,) in FRD, of an odometry in FLU; NaN where there is
    none."""
    pose, twist = np.full(7, np.nan), np.full(6, np.nan)
    if odometry.tracked:
        R = R_FRD_FLU @ odometry.T_odom_body[:3, :3] @ R_FRD_FLU
        pose[:3] = R_FRD_FLU @ odometry.T_odom_body[:3, 3]
        pose[3:] = np.roll(se3.rotation_to_quaternion_xyzw(R), 1)
    if odometry.twist_body is not None:
        twist = np.concatenate([R_FRD_FLU @ odometry.twist_body[:3], R_FRD_FLU @ odometry.twist_body[3:]])
    return pose, twist


def upper_triangle(covariance: Array | None) -> list[float]:
    """21 floats of a (6, 6) covariance; unknown is NaN in element 0 and zeros after it."""
    if covariance is None:
        return [float("nan")] + [0.0] * 20
    if not np.isfinite(covariance).all():
        raise ValueError("a covariance must be finite everywhere, or None")
    return [float(v) for v in upper(covariance)]


class Sender:
    """Makes messages as the VIO component of the vehicle ``system``."""

    def __init__(self, system: int = 1) -> None:
        self._dialect: Any = dialect()
        self._link: Any = self._dialect.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)
        self._next_beat_ns: int | None = None

    def odometry(self, odometry: Odometry) -> bytes:
        """ODOMETRY of one frame; a lost one is NaN throughout.

        PX4 skips what is not finite. Its quality alone would not keep a lost frame out: with EKF2_EV_QMIN at 0, the
        default, every quality passes (src/modules/ekf2/EKF/aid_sources/external_vision/ev_control.cpp).
        """
        odometry = flu(odometry)
        pose, twist = frd(odometry)
        velocity_covariance = None
        if odometry.twist_covariance is not None:
            velocity_covariance = rotate_covariance(R_FRD_FLU, odometry.twist_covariance)
        message = self._link.odometry_encode(
            odometry.t_ns // 1000,
            _LOCAL_FRD,
            _BODY_FRD,
            *(float(v) for v in pose[:3]),
            [float(v) for v in pose[3:]],
            *(float(v) for v in twist),
            upper_triangle(rotate_covariance(R_FRD_FLU, odometry.pose_covariance) if odometry.tracked else None),
            upper_triangle(velocity_covariance),
            odometry.reset_counter,
            _ESTIMATOR_VISION,
            quality(odometry),
        )
        return self._packed(message)

    def speed(self, odometry: Odometry) -> bytes | None:
        """VISION_SPEED_ESTIMATE: velocity in local FRD axes with its full 3x3, row-major.

        None where the quality is -1: this message carries none by which a receiver could refuse it.

        LOCAL_FRD serves as the local NED frame where the vehicle's heading is given to the autopilot by vision too
        (EK3_SRC1_YAW 6): AP_VisualOdom_MAV.cpp rotates no velocity.
        """
        odometry = flu(odometry)
        if odometry.twist_body is None or odometry.twist_covariance is None or quality(odometry) < 0:
            return None
        R = R_FRD_FLU @ odometry.T_odom_body[:3, :3]
        velocity = R @ odometry.twist_body[:3]
        covariance = R @ odometry.twist_covariance[:3, :3] @ R.T
        message = self._link.vision_speed_estimate_encode(
            odometry.t_ns // 1000,
            *(float(v) for v in velocity),
            [float(v) for v in covariance.reshape(9)],
            odometry.reset_counter,
        )
        return self._packed(message)

    def heartbeat(self) -> bytes:
        """HEARTBEAT, due once a second."""
        m = self._dialect
        message = self._link.heartbeat_encode(
            m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE
        )
        return self._packed(message)

    def due(self, odometry: Odometry) -> list[bytes]:
        """What is sent of one frame: a heartbeat where a second has passed, speed, then odometry.

        ArduPilot's EKF3 takes one velocity in 20 ms, the first: the one whose covariance it reads comes first.
        """
        out: list[bytes | None] = []
        left_ns = None if self._next_beat_ns is None else self._next_beat_ns - odometry.t_ns
        if left_ns is None or not 0 < left_ns <= 10**9:  # more than a second: the source's clock went back
            out.append(self.heartbeat())
            self._next_beat_ns = odometry.t_ns + 10**9
        out += [self.speed(odometry), self.odometry(odometry)]
        return [message for message in out if message is not None]

    def _packed(self, message: Any) -> bytes:
        packed: bytes = message.pack(self._link)
        # The sequence number is the link's: without it a receiver counts every message as lost.
        self._link.seq = (self._link.seq + 1) % 256
        return packed


TLOG = (rb"\A.{8}\xfd\x09.{3}[^\x00]\xc5\x00\x00\x00", "telemetry log")
"""It begins with a time and the heartbeat of a component that sees (197), where an autopilot's own log has another."""


def write_tlog(path: Path, odometry: Iterable[Odometry], *, system: int = 1) -> int:
    """Write a telemetry log: every message after its time, 8 bytes big-endian microseconds. Returns frames."""
    sender, count = Sender(system), 0
    with replacing(path, TLOG) as temporary, temporary.open("wb") as file:
        for item in odometry:
            for message in sender.due(item):
                file.write(struct.pack(">Q", item.t_ns // 1000) + message)
            count += 1
    return count


class Link:
    """A live connection: ``udp:HOST:PORT`` or ``serial:DEVICE:BAUD`` (pyserial)."""

    def __init__(self, address: str, system: int = 1) -> None:
        self.address, self.sender = address, Sender(system)
        kind, _, rest = address.partition(":")
        place, _, number = rest.rpartition(":")
        if kind not in ("udp", "serial") or not place or not number.isdecimal():
            raise GpvoError(f"'{address}' is not an address", cure="give udp:HOST:PORT or serial:DEVICE:BAUD")
        if kind == "udp" and not 1 <= int(number) <= 65535:
            raise GpvoError(f"'{address}' has no valid UDP port", cure="give one of 1 to 65535")
        self._send = _udp(place, int(number)) if kind == "udp" else _serial(place, int(number))

    def send(self, odometry: Odometry) -> None:
        """Send one frame now, and a heartbeat where one is due. Raises GpvoError where the link is down."""
        try:
            for message in self.sender.due(odometry):
                self._send(message)
        except OSError as error:
            raise GpvoError(f"cannot send to {self.address}: {error.strerror or error}") from None


def _udp(host: str, port: int) -> Callable[[bytes], object]:
    try:
        family, kind, protocol, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    except OSError as error:
        raise GpvoError(f"cannot reach {host}: {error.strerror}") from None
    connection = socket.socket(family, kind, protocol)
    return lambda data: connection.sendto(data, target)


def _serial(device: str, baud: int) -> Callable[[bytes], object]:
    try:
        import serial
    except ImportError:
        raise MissingExtraError("pyserial", "mavlink") from None
    try:
        port = serial.Serial(device, baud, write_timeout=_WAIT_S)
    except (OSError, ValueError) as error:
        raise GpvoError(f"cannot open {device}: {error}") from None
    again_s = -inf

    def send(data: bytes) -> None:
        nonlocal again_s
        if time.monotonic() < again_s:
            raise OSError("it has just failed")
        try:
            if not port.is_open:
                port.open()
            port.write(data)
        except OSError as error:
            again_s = time.monotonic() + _AGAIN_S
            if isinstance(error, serial.SerialTimeoutException):  # what waits is out of date
                port.reset_output_buffer()
            else:  # it may be plugged in again
                port.close()
            raise

    return send
