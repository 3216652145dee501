"""The node's parameters, which are the options of ``gpvo live``; nothing here needs ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpvo.cameras.rectify import read_size
from gpvo.errors import GpvoError
from gpvo.live import POSE_TYPE_NAMES, LiveSettings, WireSettings
from gpvo.live.stereo_stage import StereoSettings
from gpvo.types import VEHICLES, Vehicle
from gpvo.vo.config import PRESETS, make_config, read_settings


@dataclass(frozen=True)
class Parameter:
    """Its default, which also says its type; what it is; its range, both ends included, or the texts it may be."""

    default: str | int | float | bool
    description: str
    range: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()


PARAMETERS = {
    "autostart": Parameter(True, "Configure and activate at the start; false leaves that to a lifecycle manager."),
    "model": Parameter("", "Error model of this camera, or of this odometry: a .gpvo file."),
    "odometry": Parameter("", "Topic of another odometry, to be republished with an honest covariance ..."),
    "odometry_type": Parameter("odometry", "Type of that topic.", choices=tuple(POSE_TYPE_NAMES)),
    "covariance_axes": Parameter(
        "auto", "Axes of the covariances of its poses; mixed for OpenVINS.", choices=("auto", "world", "body", "mixed")
    ),
    "left": Parameter("", "... or topics of a stereo pair, raw or rectified, whole or compressed."),
    "right": Parameter("", "The other topic of the pair."),
    "imu": Parameter("", "Topic of the IMU, beside a stereo pair."),
    "calibration": Parameter("", "Calibration file of the pair; default: CameraInfo beside the images."),
    "preset": Parameter("fast", "Settings of the odometry of a stereo pair.", choices=tuple(PRESETS)),
    "settings": Parameter("", "More of them, NAME=VALUE separated by spaces, such as window=5."),
    "calibration_state": Parameter("", "Start from the calibration errors of an earlier run: its folder."),
    "hfov_deg": Parameter(0.0, "Field of view of the rectified images [deg]; 0: the lens's own.", (0.0, 179.0)),
    "size": Parameter("", "Size of the rectified images, WIDTHxHEIGHT; default: that of the raw ones."),
    "mask_left": Parameter("", "Mask image for the left lens: which pixels may be used."),
    "mask_right": Parameter("", "The same for the right lens."),
    "pair_tolerance": Parameter(0.002, "Largest difference between the stamps of a stereo pair [s].", (0.0, 10.0)),
    "bits": Parameter(16, "Bits in use per sample of 16-bit images, e.g. 12.", (8, 16)),
    "base_frame": Parameter(
        "", "Publish the odometry of this frame, located through /tf_static and /tf; default: the source's own."
    ),
    "truth": Parameter("", "Topic of ground truth that arrives late; the covariance adapts to it."),
    "truth_type": Parameter("pose", "Type of that topic.", choices=tuple(POSE_TYPE_NAMES)),
    "topic": Parameter("/gpvo/odometry", "Topic on which the odometry is published."),
    "pose_topic": Parameter("", "Also publish PoseWithCovarianceStamped here."),
    "pose_covariance": Parameter(
        "accumulated",
        "Covariance of the pose: since the start, or of the last motion.",
        choices=("accumulated", "increment"),
    ),
    "mavlink": Parameter("", "Also send MAVLink to udp:HOST:PORT or serial:DEVICE:BAUD."),
    "px4": Parameter(False, "Also publish px4_msgs/VehicleOdometry, for PX4 over uXRCE-DDS."),
    "state": Parameter("", "File in which the state is saved, and from which it is restored."),
    "vehicle": Parameter("any", "What carries the camera.", choices=tuple(VEHICLES)),
    "max_acceleration": Parameter(0.0, "Largest acceleration [m/s^2]; 0: the vehicle's.", (0.0, 1e4)),
    "max_turn": Parameter(0.0, "Largest angular acceleration [rad/s^2]; 0: the vehicle's.", (0.0, 1e5)),
    "depth": Parameter(10, "Queue length per topic; older messages are dropped.", (2, 1000)),
}


_AS_THEY_ARE = (
    "imu", "odometry", "odometry_type", "covariance_axes", "truth", "truth_type", "base_frame", "mavlink", "px4",
    "topic", "pose_topic", "pose_covariance", "depth",
)  # fmt: skip


def settings_of(given: Mapping[str, Any]) -> LiveSettings:
    """What ``gpvo live`` would have been asked, from parameters; empty texts are not given.

    Raises
    ------
    GpvoError
        Where they contradict each other, or a text is none of its choices.
    """
    values = {**{name: p.default for name, p in PARAMETERS.items()}, **given}
    p: dict[str, Any] = {name: value if value != "" else None for name, value in values.items()}
    if p["model"] is None:
        raise GpvoError("the parameter 'model' is empty", cure="name a .gpvo file")
    if (p["left"] is None) != (p["right"] is None):
        raise GpvoError("one of the parameters 'left' and 'right' is empty")
    for name, parameter in PARAMETERS.items():
        if parameter.choices and p[name] not in parameter.choices:
            raise GpvoError(f"the parameter '{name}' is '{p[name]}'", cure=f"choose {', '.join(parameter.choices)}")
    known = VEHICLES[p["vehicle"]]
    vehicle = Vehicle(p["max_acceleration"] or known.max_acceleration_mps2, p["max_turn"] or known.max_turn_radps2)
    return LiveSettings(
        model=Path(p["model"]),
        stereo=None if p["left"] is None else (p["left"], p["right"]),
        vo=None if p["left"] is None else _stereo_settings(p, vehicle),
        calibration=None if p["calibration"] is None else Path(p["calibration"]),
        wire=WireSettings(ros2=True),
        state=None if p["state"] is None else Path(p["state"]),
        vehicle=vehicle,
        **{name: p[name] for name in _AS_THEY_ARE},
    )


def _stereo_settings(p: Mapping[str, Any], vehicle: Vehicle) -> StereoSettings:
    bounds = {"max_acceleration_mps2": vehicle.max_acceleration_mps2, "max_turn_radps2": vehicle.max_turn_radps2}
    config = make_config(p["preset"], **{**bounds, **read_settings((p["settings"] or "").split())})
    state, left, right = (p[name] and Path(p[name]) for name in ("calibration_state", "mask_left", "mask_right"))
    view = (p["hfov_deg"] or None, p["size"] and read_size(p["size"]))
    return StereoSettings(config, state, *view, left, right, p["pair_tolerance"], p["bits"])


def typed(name: str, text: str) -> str | int | float | bool:
    """The text of a launch argument as its parameter's type; KeyError or ValueError where it is none."""
    kind = type(PARAMETERS[name].default)
    if kind is bool:
        return {"true": True, "false": False}[text.lower()]
    return kind(text)
