"""``px4_msgs/VehicleOdometry`` for PX4 over uXRCE-DDS, on ``/fmu/in/vehicle_visual_odometry``.

Pose in FRD of arbitrary heading, velocity in the body's FRD, diagonals alone; what is unknown is NaN.
github.com/PX4/px4_msgs, msg/VehicleOdometry.msg; the agent turns Unix time into the flight controller's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from gpvo.publish.mavlink import frd, quality
from gpvo.publish.odometry import Odometry

TOPIC = "/fmu/in/vehicle_visual_odometry"
TYPE = "px4_msgs/msg/VehicleOdometry"
_POSE_FRAME_FRD, _VELOCITY_FRAME_BODY_FRD = 2, 3
_DEFINITION = """uint64 timestamp
uint64 timestamp_sample
uint8 pose_frame
float32[3] position
float32[4] q
uint8 velocity_frame
float32[3] velocity
float32[3] angular_velocity
float32[3] position_variance
float32[3] orientation_variance
float32[3] velocity_variance
uint8 reset_counter
int8 quality
"""


def register(store: Any) -> None:
    """Teach a typestore of rosbags the message, once."""
    if TYPE not in store.fielddefs:
        store.register(get_types_from_msg(_DEFINITION, TYPE))


def vehicle_odometry(odometry: Odometry, types: dict[str, Any]) -> Any:
    """The message of one frame; a lost one is NaN throughout, with quality -1."""
    pose, twist = frd(odometry)
    nan = np.full(6, np.nan)
    # FLU and FRD differ in signs, which variances have not.
    known = np.diagonal(odometry.pose_covariance) if odometry.tracked else nan
    velocity = nan if odometry.twist_covariance is None else np.diagonal(odometry.twist_covariance)
    t_us = odometry.t_ns // 1000
    return types[TYPE](
        timestamp=t_us,
        timestamp_sample=t_us,
        pose_frame=_POSE_FRAME_FRD,
        position=_float32(pose[:3]),
        q=_float32(pose[3:]),
        velocity_frame=_VELOCITY_FRAME_BODY_FRD,
        velocity=_float32(twist[:3]),
        angular_velocity=_float32(twist[3:]),
        position_variance=_float32(known[:3]),
        orientation_variance=_float32(known[3:]),
        velocity_variance=_float32(velocity[:3]),
        reset_counter=odometry.reset_counter,
        quality=quality(odometry),
    )


def _float32(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)
