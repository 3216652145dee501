"""The other two processes of the live benchmark: ``python -m bench.live_peers poses|pictures|listen WIRE PLACE ...``.

``poses`` and ``pictures`` publish at 20 Hz and print when each was sent; ``listen`` prints when each odometry of ``gpvo
live`` came, and what its last diagnostics said.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gpvo.geometry import se3
from gpvo.io.bag_reader import ODOMETRY_TYPE
from gpvo.live.job import open_wire
from gpvo.live.outputs import DIAGNOSTICS, Wire, decode, encode
from gpvo.publish import ros
from gpvo.publish.odometry import Odometry
from gpvo.types import Status

POSES, LEFT, RIGHT = "/vio/odometry", "/left/image_raw", "/right/image_raw"
_RATE_HZ, _SETTLE_S = 20.0, 2.0


def main(role: str, wire: str, place: str, *rest: str) -> None:
    """Run one peer to its end."""
    link = open_wire(wire, place if wire == "zenoh" else None, int(place) if wire == "dds" else 0)
    if role == "listen":
        _listen(link, int(rest[0]), float(rest[1]))
    elif role == "poses":
        _publish(float(rest[0]), _poses(link))
    else:
        _publish(float(rest[0]), _pictures(link, Path(rest[1])))
    sys.stdout.flush()
    os._exit(0)  # a session's threads would hold the process


def _publish(seconds: float, send: Callable[[int, int], None]) -> None:
    """``send(k, t_ns)`` at the rate; prints stamps and times of sending [ns] as JSON."""
    time.sleep(_SETTLE_S)
    start_ns, sent = time.time_ns(), []
    for k in range(round(seconds * _RATE_HZ)):
        stamp_ns = start_ns + round(k * 1e9 / _RATE_HZ)
        time.sleep(max(0.0, (stamp_ns - time.time_ns()) * 1e-9))
        sent.append((stamp_ns, time.time_ns()))
        send(k, stamp_ns)
    time.sleep(1.0)
    print(json.dumps(sent))


def _poses(link: Wire) -> Callable[[int, int], None]:
    emit, types = link.advertise(POSES, ODOMETRY_TYPE), link.store.types
    eye = 1e-4 * np.eye(6)

    def send(k: int, t_ns: int) -> None:
        T = pose(k / _RATE_HZ)
        message = Odometry(t_ns, T, eye, np.zeros(6), eye, Status.OK, True, child_frame_id="imu")
        emit(encode(link, ros.odometry_message(message, types, seq=k if link.ros1 else None)))

    return send


def pose(t_s: float) -> np.ndarray:
    """(4, 4) body pose of a flight that never ends: loops of some metres, about 1 m/s."""
    position = [4 * np.sin(0.25 * t_s), 3 * np.cos(0.31 * t_s), np.sin(0.17 * t_s)]
    turn = se3.so3_exp(np.array([0.1 * np.sin(0.7 * t_s), 0.1 * np.cos(0.9 * t_s), 0.0]))
    return se3.from_rt(se3.so3_exp(np.array([0, 0, 0.3 * t_s % (2 * np.pi)])) @ turn, np.array(position))


def _pictures(link: Wire, clip: Path) -> Callable[[int, int], None]:
    """The pairs of a clip, forward and backward without end, with CameraInfo beside them."""
    with np.load(clip) as data:
        pairs, camera = data["pairs"], {k: float(data[k]) for k in ("f", "cx", "cy", "baseline_m")}
    t, sides = link.store.types, []
    for side, topic in enumerate((LEFT, RIGHT)):
        info = link.advertise(topic.replace("image_raw", "camera_info"), "sensor_msgs/msg/CameraInfo")
        sides.append((side, link.advertise(topic, "sensor_msgs/msg/Image"), info))
    order = [*range(len(pairs)), *range(len(pairs) - 2, 0, -1)]
    sequence = {"seq": 0} if link.ros1 else {}

    def send(k: int, t_ns: int) -> None:
        stamp = t["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
        header = t["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="cam")
        for side, emit, emit_info in sides:
            image = pairs[order[k % len(order)], side]
            message = t["sensor_msgs/msg/Image"](
                header, *image.shape, "mono8", 0, image.shape[1], np.ascontiguousarray(image).ravel()
            )
            emit(encode(link, message))
            emit_info(encode(link, _info(link, header, camera, side, image.shape)))

    return send


def _info(link: Wire, header: Any, camera: dict[str, float], side: int, shape: tuple[int, ...]) -> Any:
    t, f, cx, cy = link.store.types, camera["f"], camera["cx"], camera["cy"]
    tx = -side * f * camera["baseline_m"]
    matrices = (np.zeros(5), np.array([f, 0, cx, 0, f, cy, 0, 0, 1]), np.eye(3).ravel(),
                np.array([f, 0, cx, tx, 0, f, cy, 0, 0, 0, 1, 0]))  # fmt: skip
    values = dict(zip("DKRP" if link.ros1 else "dkrp", matrices, strict=True))
    roi = t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return t["sensor_msgs/msg/CameraInfo"](
        header=header, height=shape[0], width=shape[1], distortion_model="plumb_bob", binning_x=0, binning_y=0,
        roi=roi, **values,
    )  # fmt: skip


def _listen(link: Wire, want: int, seconds: float) -> None:
    came: list[tuple[int, int]] = []
    health: list[dict[str, str]] = [{}]

    def odometry(_topic: str, data: bytes) -> None:
        now_ns = time.time_ns()
        stamp = decode(link, data, ODOMETRY_TYPE).header.stamp
        came.append((stamp.sec * 10**9 + stamp.nanosec, now_ns))

    def diagnostics(_topic: str, data: bytes) -> None:
        status = decode(link, data, DIAGNOSTICS).status[0]
        health[0] = {v.key: v.value for v in status.values}

    link.subscribe(ros.TOPIC, ODOMETRY_TYPE, odometry)
    link.subscribe("/diagnostics", DIAGNOSTICS, diagnostics)
    print("ready", flush=True)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and len(came) < want:
        time.sleep(0.05)
    print(json.dumps({"came": came, "health": health[0]}))


if __name__ == "__main__":
    main(*sys.argv[1:])
