"""ROS 1 bags, ROS 2 bags (sqlite3) and MCAP through one reader, with their failures as one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.errors import GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.types import Array

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU_TYPE = "sensor_msgs/msg/Imu"
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPES = (
    ODOMETRY_TYPE,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a ROS 2 storage file, or a ROS 2 bag folder."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() and (any(path.glob("*.db3*")) or any(path.glob("*.mcap*")))
    return path.is_file() and path.suffix.lower() in (".bag", ".db3", ".mcap")


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """An open ``rosbags`` reader.

    Raises
    ------
    SourceError
        Where the bag cannot be read, at opening or later inside the block; one line in any case.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        # Bags of ROS 2 before Jazzy hold no message definitions: those of Humble serve.
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except (GpvoError, GeneratorExit, KeyboardInterrupt):
        raise
    # The readers below raise whatever their storage does: struct, sqlite3, zstd, Unicode, index, assertion and
    # memory errors, the last for a length that is no length.
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        cure = "the recording was cut off: 'rosbag reindex' or 'ros2 bag reindex' may mend it"
        raise SourceError(f"unreadable bag: {reason or type(error).__name__}", where=path, cure=cure) from None


def topics_of(reader: Any, types: tuple[str, ...]) -> dict[str, str]:
    """Topics that hold messages of one of the types, with the type."""
    return {
        name: info.msgtype for name, info in sorted(reader.topics.items()) if info.msgtype in types and info.msgcount
    }


def messages(reader: Any, topics: list[str]) -> Iterator[tuple[str, Any]]:
    """(topic, message) of the named topics, in the order of recording."""
    connections = [c for c in reader.connections if c.topic in topics]
    for connection, _, raw in reader.messages(connections=connections):
        yield connection.topic, reader.deserialize(raw, connection.msgtype)


def stamp_ns(message: Any) -> int:
    """``header.stamp`` in nanoseconds: the sensor's time, never that of recording."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def pose_of(message: Any) -> Array:
    """(7,) position and quaternion x y z w of an Odometry, PoseStamped, PoseWithCovarianceStamped or
    TransformStamped."""
    if hasattr(message, "transform"):
        p, q = message.transform.translation, message.transform.rotation
    else:
        pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=np.float64)


def read_poses(path: Path, topic: str) -> tuple[np.ndarray, Array, list[Any]]:
    """Stamps (N,) [ns], poses (N, 4, 4) and the messages of one topic, in order of time, repeated stamps dropped.

    Raises
    ------
    SourceError
        Where the topic has no poses, or one that is not finite.
    """
    stamps, rows, kept = [], [], []
    with open_bag(path) as reader:
        available = topics_of(reader, POSE_TYPES)
        if topic not in available:
            found = ", ".join(available) or "none"
            raise SourceError(f"has no poses on '{topic}' (topics with poses: {found})", where=path)
        for _, message in messages(reader, [topic]):
            stamps.append(stamp_ns(message))
            rows.append(pose_of(message))
            kept.append(message)
    if not rows:
        raise SourceError(f"holds no message on '{topic}'", where=path)
    t, data = np.array(stamps, dtype=np.int64), np.stack(rows)
    order = np.argsort(t, kind="stable")
    order = order[np.concatenate([[True], np.diff(t[order]) > 0])]
    t, data = t[order], data[order]
    norm = np.linalg.norm(data[:, 3:], axis=1)
    bad = np.flatnonzero(~np.isfinite(data).all(axis=1) | ~(np.abs(norm - 1) < 0.1))
    if len(bad):
        raise SourceError(f"message {order[bad[0]] + 1} on '{topic}' holds no valid pose", where=path)
    return t, se3.from_quaternion(data[:, :3], data[:, 3:]), [kept[i] for i in order]
