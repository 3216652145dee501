"""Writes small stereo bags of every kind with rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import sequences as seq
from gpvo.geometry import se3
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore


class BagMaker:
    """Collects messages and writes them in the order of their recording."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        self.messages: list[tuple[int, str, Any]] = []

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, t_ns: int, frame: str = "cam") -> Any:
        stamp = self.type("builtin_interfaces/msg/Time")(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        seq_field = {"seq": 0} if self.ros1 else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **seq_field)

    def add(self, topic: str, message: Any, t_ns: int) -> None:
        self.messages.append((t_ns, topic, message))

    def image(
        self, topic: str, t_ns: int, image: np.ndarray, encoding: str = "mono8", delay_ns: int = 5_000_000
    ) -> None:
        data = np.ascontiguousarray(image)
        step = data.strides[0]
        message = self.type("sensor_msgs/msg/Image")(
            header=self.header(t_ns), height=image.shape[0], width=image.shape[1], encoding=encoding,
            is_bigendian=0, step=step, data=data.view(np.uint8).ravel(),
        )  # fmt: skip
        self.add(topic, message, t_ns + delay_ns)

    def compressed(self, topic: str, t_ns: int, image: np.ndarray, encoding: str = "png") -> None:
        data = cv2.imencode(".png", image)[1].ravel()
        message = self.type("sensor_msgs/msg/CompressedImage")(header=self.header(t_ns), format=encoding, data=data)
        self.add(topic, message, t_ns)

    def camera_info(self, topic: str, t_ns: int, tx: float, corner: tuple[int, int] | None = None) -> None:
        """``corner``: of the window of a larger sensor that the images show, two by two pixels in one."""
        names = "DKRP" if self.ros1 else "dkrp"
        f, cx, cy, width, height, bins, window = 60.0, 31.5, 23.5, seq.WIDTH, seq.HEIGHT, 0, (0, 0, 0, 0)
        if corner is not None:
            f, tx, cx, cy, bins = 2 * f, 2 * tx, 63.5 + corner[0], 47.5 + corner[1], 2
            window = (*corner, 2 * height, 2 * width)
            width, height = 200, 150
        K = np.array([f, 0, cx, 0, f, cy, 0, 0, 1])
        P = np.array([f, 0, cx, tx, 0, f, cy, 0, 0, 0, 1, 0])
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(*window, False)
        values = dict(zip(names, (np.zeros(5), K, np.eye(3).ravel(), P), strict=True))
        message = self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(t_ns), height=height, width=width, distortion_model="plumb_bob",
            binning_x=bins, binning_y=bins, roi=roi, **values,
        )  # fmt: skip
        self.add(topic, message, t_ns)

    def imu(
        self, topic: str, t_ns: int, gyro=(0.1, 0.2, 0.3), acc=(0.0, 0.0, 9.81), *, known=(0.0, 0.0), frame="cam"
    ) -> None:
        """``known``: what the covariances of rate and acceleration begin with, -1 for none."""
        v = self.type("geometry_msgs/msg/Vector3")
        q = self.type("geometry_msgs/msg/Quaternion")
        message = self.type("sensor_msgs/msg/Imu")(
            header=self.header(t_ns, frame), orientation=q(0, 0, 0, 1), orientation_covariance=np.zeros(9),
            angular_velocity=v(*gyro), angular_velocity_covariance=np.array([known[0], *[0.0] * 8]),
            linear_acceleration=v(*acc), linear_acceleration_covariance=np.array([known[1], *[0.0] * 8]),
        )  # fmt: skip
        self.add(topic, message, t_ns)

    def _pose(self, T: np.ndarray) -> tuple[Any, Any]:
        q = se3.rotation_to_quaternion_xyzw(T[:3, :3])
        return [float(v) for v in T[:3, 3]], self.type("geometry_msgs/msg/Quaternion")(*(float(v) for v in q))

    def transform(self, topic: str, t_ns: int, T: np.ndarray, parent: str = "world", child: str = "body") -> None:
        p, q = self._pose(T)
        body = self.type("geometry_msgs/msg/Transform")(self.type("geometry_msgs/msg/Vector3")(*p), q)
        message = self.type("geometry_msgs/msg/TransformStamped")(self.header(t_ns, parent), child, body)
        self.add(topic, message, t_ns)

    def tf(self, topic: str, t_ns: int, *transforms: tuple[np.ndarray, str, str]) -> None:
        """One message of transforms: each (4, 4), its parent and its child."""
        parts = BagMaker(self.ros1)
        for T, parent, child in transforms:
            parts.transform("/", 0, T, parent, child)
        self.add(topic, self.type("tf2_msgs/msg/TFMessage")([m for _, _, m in parts.messages]), t_ns)

    def pose_with_covariance(self, topic: str, t_ns: int, T: np.ndarray, cov: np.ndarray, frame: str = "odom") -> None:
        p, q = self._pose(T)
        t = self.type
        pose = t("geometry_msgs/msg/Pose")(t("geometry_msgs/msg/Point")(*p), q)
        body = t("geometry_msgs/msg/PoseWithCovariance")(pose, cov.ravel())
        message = t("geometry_msgs/msg/PoseWithCovarianceStamped")(self.header(t_ns, frame), body)
        self.add(topic, message, t_ns)

    def odometry(
        self,
        topic: str,
        t_ns: int,
        T: np.ndarray,
        pose_cov: np.ndarray,
        twist_cov: np.ndarray,
        child: str = "base_link",
    ) -> None:
        p, q = self._pose(T)
        t = self.type
        pose = t("geometry_msgs/msg/Pose")(t("geometry_msgs/msg/Point")(*p), q)
        zero = t("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        message = t("nav_msgs/msg/Odometry")(
            self.header(t_ns, "odom"), child,
            t("geometry_msgs/msg/PoseWithCovariance")(pose, pose_cov.ravel()),
            t("geometry_msgs/msg/TwistWithCovariance")(t("geometry_msgs/msg/Twist")(zero, zero), twist_cov.ravel()),
        )  # fmt: skip
        self.add(topic, message, t_ns)

    def write(self, path: Path, mcap: bool = False) -> Path:
        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        writer: Any = Writer1(path) if self.ros1 else Writer2(path, version=8, storage_plugin=plugin)
        with writer:
            connections = {}
            for t_ns, topic, message in sorted(self.messages, key=lambda m: m[0]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
                writer.write(connections[topic], t_ns, serialize(message, kind))
        return path


def stereo_bag(ros1: bool, n: int = 12, *, skip=(), infos: bool = True) -> BagMaker:
    """A pair of cameras with CameraInfo, IMU and motion capture; ``skip``: (index, side) left out."""
    maker = BagMaker(ros1)
    for k, t in enumerate(seq.stamps(n)):
        for side in ("left", "right"):
            if (k, side) not in skip:
                maker.image(f"/camera/{side}/image_raw", t + (300_000 if side == "right" else 0), seq.grey(k))
            if infos:
                maker.camera_info(f"/camera/{side}/camera_info", t, -6.0 if side == "right" else 0.0)
        maker.transform("/vicon/head/head", t, seq.true_poses(n)[k])
        for i in range(5):
            maker.imu("/imu0", t + i * 10_000_000)
    return maker
