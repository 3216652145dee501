"""ROS 2 node: gpvo's live engine with rclpy as its wire; parameters in place of the command's options.

It broadcasts no transform: the filter that consumes the odometry does.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import rclpy
from gpvo.errors import GpvoError
from gpvo.live.engine import EngineSettings
from gpvo.live.job import POSE_TYPE_NAMES, LiveSettings, serve
from gpvo.live.ros_wire import Ros2Wire
from rclpy.node import Node

DEFAULTS: dict[str, Any] = {
    "model": "",
    "odometry": "",
    "odometry_type": "odometry",
    "left": "",
    "right": "",
    "imu": "",
    "truth": "",
    "truth_type": "pose",
    "calibration": "",
    "topic": "/gpvo/odometry",
    "pose_topic": "",
    "pose_covariance": "accumulated",
    "state": "",
    "depth": 10,
}


def settings_of(given: dict[str, Any]) -> LiveSettings:
    """What ``gpvo live`` would have been asked, from parameters; empty texts are not given. GpvoError where they
    contradict each other."""
    p = {name: value if value != "" else None for name, value in {**DEFAULTS, **given}.items()}
    if p["model"] is None:
        raise GpvoError("the parameter 'model' is empty", cure="name a .gpvo file")
    if (p["left"] is None) != (p["right"] is None):
        raise GpvoError("one of the parameters 'left' and 'right' is empty")
    for name in ("odometry_type", "truth_type"):
        if p[name] not in POSE_TYPE_NAMES:
            raise GpvoError(f"{name} is '{p[name]}'", cure=f"choose {', '.join(POSE_TYPE_NAMES)}")
    return LiveSettings(
        model=Path(p["model"]),
        stereo=None if p["left"] is None else (p["left"], p["right"]),
        imu=p["imu"],
        odometry=p["odometry"],
        pose_type=POSE_TYPE_NAMES[p["odometry_type"]],
        truth=p["truth"],
        truth_type=POSE_TYPE_NAMES[p["truth_type"]],
        calibration=None if p["calibration"] is None else Path(p["calibration"]),
        wire="ros2",
        topic=p["topic"],
        pose_topic=p["pose_topic"],
        depth=p["depth"],
        engine=EngineSettings(
            increment=p["pose_covariance"] == "increment",
            state=None if p["state"] is None else Path(p["state"]),
        ),
    )


def main() -> None:
    """Run until the node is shut down."""
    rclpy.init()
    node = Node("gpvo")
    given = {name: node.declare_parameter(name, default).value for name, default in DEFAULTS.items()}
    stop = threading.Event()
    spinning = threading.Thread(target=rclpy.spin, args=(node,), daemon=True)
    spinning.start()
    try:
        serve(settings_of(given), Ros2Wire(node), stop, lambda text: node.get_logger().warning(text))
    except GpvoError as error:
        node.get_logger().fatal(str(error))
    finally:
        rclpy.try_shutdown()
        spinning.join(1.0)


if __name__ == "__main__":
    main()
