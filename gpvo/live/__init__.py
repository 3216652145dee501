"""``gpvo live``: images or anyone's odometry in, odometry with its covariance out, as messages; what it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gpvo.errors import GpvoError
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPE
from gpvo.types import VEHICLES, Vehicle

WIRES = ("zenoh", "dds", "ros2", "ros1")
POSE_TYPE_NAMES = {"odometry": ODOMETRY_TYPE, "pose": POSE_TYPE, "pose_stamped": "geometry_msgs/msg/PoseStamped"}


@dataclass(frozen=True)
class WireSettings:
    """How messages of a running system come in."""

    zenoh: Annotated[bool, "ROS 2 over Zenoh, without ROS (extra gpvo[ros])."] = False
    dds: Annotated[bool, "ROS 2 over DDS, without ROS (extra gpvo[ros])."] = False
    ros2: Annotated[bool, "ROS 2 through rclpy, where it is installed."] = False
    ros1: Annotated[bool, "ROS 1 through rospy, where it is installed."] = False
    address: Annotated[str | None, "Zenoh router, e.g. tcp/127.0.0.1:7447; default: the local one."] = None
    domain: Annotated[int, "ROS domain id, for --zenoh and --dds.", {"min": 0, "max": 232}] = 0

    def transport(self) -> str | None:
        """The one of :data:`WIRES` that was chosen, None if none was. Raises GpvoError if several were."""
        flags = zip(WIRES, (self.zenoh, self.dds, self.ros2, self.ros1))
        chosen = [name for name, is_on in flags if is_on]
        if len(chosen) > 1:
            raise GpvoError(f"--{' and --'.join(chosen)} are mutually exclusive", cure="choose one")
        return chosen[0] if chosen else None


@dataclass(frozen=True)
class LiveSettings:
    """What ``gpvo live`` is asked, each with its help. ``vo``: the StereoSettings of images; ``vehicle``: what slips
    are told by; ``depth``: queue length per topic."""

    model: Annotated[Path, "--model", "Error model of this camera, or of this odometry."]
    stereo: Annotated[tuple[str, str] | None, "Topics of the images.", {"metavar": "LEFT RIGHT"}] = None
    imu: Annotated[str | None, "Topic of the IMU, with --stereo; .../gyro/... is joined by .../accel/...."] = None
    odometry: Annotated[str | None, "Topic of another odometry, to be republished with an honest covariance."] = None
    odometry_type: Annotated[str, "Type of that topic: odometry, pose (PoseWithCovarianceStamped) or pose_stamped."] = (
        "odometry"
    )
    covariance_axes: Annotated[
        str, "Axes of the covariances of its poses: world (auto), body, or mixed, as of OpenVINS; see gpvo import."
    ] = "auto"
    truth: Annotated[str | None, "Topic of delayed ground truth (mocap, tags); the covariance adapts to it."] = None
    truth_type: Annotated[str, "Type of that topic: pose, odometry or pose_stamped."] = "pose"
    replay: Annotated[Path | None, "Replay a bag instead of listening to a transport."] = None
    fast: Annotated[bool, "Replay as fast as possible."] = False
    wire: WireSettings = WireSettings()
    mavlink: Annotated[str | None, "Send MAVLink to udp:HOST:PORT or serial:DEVICE:BAUD."] = None
    px4: Annotated[bool, "Also send px4_msgs/VehicleOdometry, for PX4 over uXRCE-DDS."] = False
    out: Annotated[Path | None, "Write a new bag, in parts until the end: .bag, .mcap or a ROS 2 folder."] = None
    topic: Annotated[str, "Topic on which the odometry is published."] = "/gpvo/odometry"
    pose_topic: Annotated[str | None, "Also publish PoseWithCovarianceStamped here."] = None
    calibration: Annotated[Path | None, "Calibration; default: CameraInfo beside the images."] = None
    base_frame: Annotated[
        str | None, "Publish the odometry of this robot frame, located through /tf_static and /tf."
    ] = None
    pose_covariance: Annotated[str, "accumulated (since the start) or increment (the last motion)."] = "accumulated"
    state: Annotated[Path | None, "File that keeps the state, so that a restart continues from it."] = None
    vo: Any = None
    vehicle: Vehicle = VEHICLES["any"]
    depth: int = 10
