"""``nav_msgs/Odometry`` in ROS 1 bags, ROS 2 sqlite3 bags and MCAP, by the ``rosbags`` library; no ROS needed.
And PX4's ``px4_msgs/VehicleOdometry``.

REP 103: quaternion x, y, z, w; covariance row-major 6x6, order (x, y, z, rotation about X, Y, Z) in fixed axes; pose
in ``header.frame_id``, twist in ``child_frame_id``. Lost frames are not written: a receiver would fuse them.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import tempfile
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gpvo.errors import GpvoError
from gpvo.files import make_folder
from gpvo.geometry import se3
from gpvo.io.bag_reader import ODOMETRY_TYPE, open_bag
from gpvo.publish.mavlink import flu, frd, quality
from gpvo.publish.odometry import Odometry

TOPIC = "/gpvo/odometry"
PX4_TOPIC = "/fmu/in/vehicle_visual_odometry"
PX4_TYPE = "px4_msgs/msg/VehicleOdometry"
_POSE_FRAME_FRD, _VELOCITY_FRAME_BODY_FRD = 2, 3
_PX4_DEFINITION = """uint64 timestamp
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


def odometry_message(odometry: Odometry, types: dict[str, Any], *, seq: int | None = None) -> Any:
    """``nav_msgs/Odometry`` of one tracked frame; ``types`` is a typestore's, ``seq`` for ROS 1 only."""
    if odometry.twist_body is None or odometry.twist_covariance is None:
        raise ValueError("a frame without a motion has no Odometry message")
    q = se3.rotation_to_quaternion_xyzw(odometry.T_odom_body[:3, :3])
    linear, angular = odometry.twist_body[:3], odometry.twist_body[3:]
    point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
    pose = types["geometry_msgs/msg/Pose"](
        point(*odometry.T_odom_body[:3, 3]), types["geometry_msgs/msg/Quaternion"](*q)
    )
    twist = types["geometry_msgs/msg/Twist"](vector(*linear), vector(*angular))
    stamp = types["builtin_interfaces/msg/Time"](odometry.t_ns // 10**9, odometry.t_ns % 10**9)
    numbered = {} if seq is None else {"seq": seq}
    return types[ODOMETRY_TYPE](
        header=types["std_msgs/msg/Header"](**numbered, stamp=stamp, frame_id=odometry.frame_id),
        child_frame_id=odometry.child_frame_id,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, _flat(odometry.pose_covariance)),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist, _flat(odometry.twist_covariance)),
    )


def _flat(covariance: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(covariance, dtype=np.float64).reshape(36)


def check_topic(topic: str) -> str:
    """The topic, or GpvoError if it is no valid ROS name: words of letters, digits and ``_``, ``/`` between them."""
    if not re.fullmatch(r"/?[A-Za-z]\w*(/[A-Za-z_]\w*)*", topic, re.ASCII):
        raise GpvoError(f"the topic {topic[:80]!r} is not a valid ROS name", cure="give one like /gpvo/odometry")
    return topic


def write_bag(
    path: Path, odometry: Iterable[Odometry], topic: str = TOPIC, kind: str | None = None, seq: int = 0
) -> int:
    """Write every frame that has a motion, in place of a bag of ``topic`` alone; returns the number of messages.

    ``kind``: a file for ``ros1``, a ROS 2 bag folder for ``sqlite3`` and ``mcap``; by default as the suffix says.
    ``seq``: of the first message, in ROS 1. Raises GpvoError where something else lies there, or nothing can be
    written.
    """
    kind = kind or kind_of(path)
    return _write(path, _serialised(odometry, kind, seq), topic, kind)


def join_bags(path: Path, parts: Iterable[Path], topic: str = TOPIC) -> int:
    """The same of the messages of other bags that :func:`write_bag` wrote, of the kind that the suffix says."""
    return _write(path, _raw(parts), topic, kind_of(path))


def kind_of(path: Path, to: str | None = None) -> str:
    """``ros1``, ``mcap`` or ``sqlite3``, as the suffix says, or where it says nothing, what is asked for."""
    return {".bag": "ros1", ".mcap": "mcap"}.get(path.suffix.lower(), "mcap" if to == "mcap" else "sqlite3")


def refuse_other(path: Path, topic: str, kind: str) -> None:
    """Raise GpvoError where something else than a bag of ``topic`` alone lies."""
    if kind != "ros1" and path.is_file():
        raise GpvoError("is a file, and a ROS 2 bag is a folder", where=path, cure="choose another -o")
    if path.exists() and not _holds_only(path, topic):
        raise GpvoError(f"exists, and is not a bag of {topic} alone", where=path, cure="choose another -o")


def _write(path: Path, messages: Iterable[tuple[int, bytes]], topic: str, kind: str) -> int:
    refuse_other(path, topic, kind)
    holder: Path | None = None
    try:
        make_folder(path.parent)
        holder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        # A bag's files carry its name inside, so the temporary one has the same name in a folder of its own.
        count = _fill(holder / path.name, messages, topic, kind)
        if path.is_dir():
            shutil.rmtree(path)
        os.replace(holder / path.name, path)
    except (OSError, sqlite3.Error) as error:
        raise GpvoError(f"cannot be written: {getattr(error, 'strerror', error)}", where=path) from None
    finally:
        if holder is not None:
            shutil.rmtree(holder, ignore_errors=True)
    return count


def _fill(path: Path, messages: Iterable[tuple[int, bytes]], topic: str, kind: str) -> int:
    ros1, count, shift_ns, last_ns = kind == "ros1", 0, 0, -1
    opened: Any = Ros1Writer(path) if ros1 else Ros2Writer(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
    with opened as writer:
        connection = writer.add_connection(topic, ODOMETRY_TYPE, typestore=_store(kind))
        for t_ns, data in messages:
            # Readers sort by the time of recording: where the stamps are set back, that goes on.
            shift_ns = max(shift_ns, last_ns + 1 - t_ns)
            last_ns = t_ns + shift_ns
            writer.write(connection, last_ns, data)
            count += 1
    return count


def _store(kind: str) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)


def _serialised(odometry: Iterable[Odometry], kind: str, seq: int) -> Iterator[tuple[int, bytes]]:
    store, ros1 = _store(kind), kind == "ros1"
    serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
    for number, item in enumerate((o for o in odometry if o.twist_body is not None), seq):
        yield item.t_ns, serialise(odometry_message(item, store.types, seq=number if ros1 else None), ODOMETRY_TYPE)


def _raw(bags: Iterable[Path]) -> Iterator[tuple[int, bytes]]:
    for bag in bags:
        with open_bag(bag) as reader:
            for _, t_ns, data in reader.messages():
                yield t_ns, data


def _holds_only(bag: Path, topic: str) -> bool:
    try:
        with open_bag(bag) as reader:
            return all(c.topic == topic for c in reader.connections)
    except GpvoError:
        return False


def robot_localization_yaml(
    topic: str = TOPIC, *, rate_hz: float = 30.0, ros1: bool = False, base: str = "base_link"
) -> str:
    """Parameters for robot_localization that use the twist alone, as its manual advises for odometry.

    The pose of an odometry is its integrated twist: fusing both would count one measurement twice. ``ros1``: for
    ``rosparam load`` into the namespace of an ekf_localization_node; else a parameter file of ROS 2's ekf_node.
    """
    row = "false, false, false"
    use = "true,  true,  true "
    head = f"""# robot_localization fed by gpvo: body twist with its full covariance.
# gpvo publishes {topic} in odom -> {base} and broadcasts no transform; this node does, to base_link:
# if that is another frame, it needs the transform between the two.
"""
    parameters = f"""frequency: {rate_hz:.1f}
sensor_timeout: 0.2
two_d_mode: false
publish_tf: true
map_frame: map
odom_frame: odom
base_link_frame: base_link
world_frame: odom
odom0: {topic}
# x, y, z | roll, pitch, yaw | vx, vy, vz | vroll, vpitch, vyaw | ax, ay, az
odom0_config: [{row},
               {row},
               {use},
               {use},
               {row}]
odom0_differential: false
odom0_relative: false
odom0_queue_size: 10
# against the root of the sum over all six axes, which exceeds 3 for one honest twist in six
odom0_twist_rejection_threshold: 5.0
"""
    if ros1:
        return head + parameters
    return f"{head}ekf_filter_node:\n  ros__parameters:\n{textwrap.indent(parameters, '    ')}"


def register_px4(store: Any) -> None:
    """Teach a typestore of rosbags the message, once."""
    if PX4_TYPE not in store.fielddefs:
        store.register(get_types_from_msg(_PX4_DEFINITION, PX4_TYPE))


def vehicle_odometry(odometry: Odometry, types: dict[str, Any]) -> Any:
    """``px4_msgs/VehicleOdometry`` for PX4 over uXRCE-DDS, on ``/fmu/in/vehicle_visual_odometry``.

    Pose in FRD of arbitrary heading, velocity in the body's FRD, diagonals only; unknown values are NaN, and a lost
    frame is NaN throughout, with quality -1. github.com/PX4/px4_msgs, msg/VehicleOdometry.msg; PX4's client turns the
    time of the agent's machine, Unix time, into its own.
    """
    odometry = flu(odometry)
    pose, twist = frd(odometry)
    nan = np.full(6, np.nan)
    # FLU and FRD differ in signs, which variances have not.
    known = np.diagonal(odometry.pose_covariance) if odometry.tracked else nan
    velocity = nan if odometry.twist_covariance is None else np.diagonal(odometry.twist_covariance)
    vectors = {"position": pose[:3], "q": pose[3:], "velocity": twist[:3], "angular_velocity": twist[3:]}
    vectors |= {"position_variance": known[:3], "orientation_variance": known[3:], "velocity_variance": velocity[:3]}
    return types[PX4_TYPE](
        **dict.fromkeys(("timestamp", "timestamp_sample"), odometry.t_ns // 1000),
        pose_frame=_POSE_FRAME_FRD,
        velocity_frame=_VELOCITY_FRAME_BODY_FRD,
        reset_counter=odometry.reset_counter,
        quality=quality(odometry),
        **{name: v.astype(np.float32) for name, v in vectors.items()},
    )
