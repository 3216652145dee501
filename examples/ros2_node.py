"""ROS 2 node: a rectified stereo pair with CameraInfo in, ``nav_msgs/Odometry`` with predicted covariance out.

    ros2 run ... or: python examples/ros2_node.py --ros-args -p model:=tunnel.gpvo \\
        -r left/image_rect:=/stereo/left/image_rect -r right/image_rect:=/stereo/right/image_rect \\
        -r left/camera_info:=/stereo/left/camera_info -r right/camera_info:=/stereo/right/camera_info

Broadcasts no transform: the filter that consumes the message (robot_localization) does.
"""

from __future__ import annotations

import message_filters
import numpy as np
import rclpy
from gpvo.geometry import se3
from gpvo.online.predictor import Predictor
from gpvo.publish.odometry import OdometryBuilder
from gpvo.types import StereoCamera, StereoFrame
from gpvo.vo.odometry import StereoOdometry
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image


class GpvoNode(Node):
    """Steps VO on each synchronised pair and publishes in ``odom`` -> ``base_link``."""

    def __init__(self) -> None:
        super().__init__("gpvo")
        model = self.declare_parameter("model", "").value
        mounting = self.declare_parameter("T_body_cam", [0.0] * 16).value
        self.predictor = Predictor.load(model, for_filter=True) if model else None
        T_body_cam = np.reshape(mounting, (4, 4)) if any(mounting) else None
        self.builder = OdometryBuilder(T_body_cam, method="pointing_matching")
        self.odometry: StereoOdometry | None = None
        self.publisher = self.create_publisher(Odometry, "gpvo/odometry", 10)
        names = ("left/image_rect", "right/image_rect", "left/camera_info", "right/camera_info")
        qos = qos_profile_sensor_data
        types = [CameraInfo if "info" in name else Image for name in names]
        inputs = [message_filters.Subscriber(self, t, n, qos_profile=qos) for t, n in zip(types, names)]
        self.sync = message_filters.TimeSynchronizer(inputs, 10)
        self.sync.registerCallback(self.on_pair)

    def on_pair(self, left: Image, right: Image, left_info: CameraInfo, right_info: CameraInfo) -> None:
        """One rectified pair."""
        if self.odometry is None:
            camera = camera_of(left_info, right_info)
            self.odometry = StereoOdometry(camera)
            if self.predictor:
                self.predictor.reset(camera)
        t_ns = left.header.stamp.sec * 10**9 + left.header.stamp.nanosec
        record = self.odometry.step(StereoFrame(t_ns, grey(left), grey(right)))
        prediction = self.predictor.step(record) if self.predictor else None
        out = self.builder.step(record, prediction)
        if out.twist_body is None or out.twist_covariance is None:
            return
        message = Odometry()
        message.header.stamp = left.header.stamp
        message.header.frame_id, message.child_frame_id = out.frame_id, out.child_frame_id
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = out.T_odom_body[:3, 3].tolist()
        q.x, q.y, q.z, q.w = se3.rotation_to_quaternion_xyzw(out.T_odom_body[:3, :3]).tolist()
        v, w = message.twist.twist.linear, message.twist.twist.angular
        v.x, v.y, v.z, w.x, w.y, w.z = out.twist_body.tolist()
        message.pose.covariance = out.pose_covariance.reshape(36).tolist()
        message.twist.covariance = out.twist_covariance.reshape(36).tolist()
        self.publisher.publish(message)


def camera_of(left: CameraInfo, right: CameraInfo) -> StereoCamera:
    """Rectified pair from both CameraInfo: ``P[3]`` of the right one is ``-fx * baseline``."""
    P = left.p
    return StereoCamera(P[0], P[5], P[2], P[6], -right.p[3] / right.p[0], left.width, left.height)


def grey(image: Image) -> np.ndarray:
    """(H, W) uint8 of a mono8 image; rows may be padded."""
    if image.encoding not in ("mono8", "8UC1"):
        raise ValueError(f"images must be mono8, not {image.encoding}")
    return np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)[:, : image.width]


def main() -> None:
    """Spin until interrupted."""
    rclpy.init()
    node = GpvoNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
