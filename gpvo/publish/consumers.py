"""What popular filters do with the published numbers, and which parameter hides the covariance.

PX4: src/modules/mavlink/mavlink_receiver.cpp and src/modules/ekf2/params_external_vision.yaml. ArduPilot:
libraries/GCS_MAVLink/GCS_Common.cpp (the two scalars of a pose, before and after pull request 32084 of February 2026,
and that of a velocity, since pull request 32478), libraries/AP_VisualOdom/AP_VisualOdom_MAV.cpp (the parameters'
clamps) and libraries/AP_NavEKF3 (the filter's own, in AP_NavEKF3_PosVelFusion.cpp, ``FuseVelPosNED``, and
AP_NavEKF3_Measurements.cpp, ``writeExtNavData``).
robot_localization: src/ros_filter.cpp and src/ekf.cpp, branch ros2. FusionCore: fusioncore_ros/src/fusion_node.cpp (its
inputs) and fusioncore_core/include/fusioncore/sensors/vslam.hpp (floors, and what stands in for zeros).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.geometry.covariance import variances
from gpvo.online.features import AXES
from gpvo.publish.odometry import Odometry
from gpvo.types import Array
from gpvo.types.columns import batches

CONSUMERS = ("px4", "ardupilot", "robot_localization", "fusioncore")

PX4 = {"EKF2_EVP_NOISE": (0.1, 0.01), "EKF2_EVV_NOISE": (0.1, 0.01), "EKF2_EVA_NOISE": (0.1, 0.05)}
"""Of external vision: the default of each parameter, and the least that it may be set to."""
ARDUPILOT = {
    "VISO_POS_M_NSE": (0.2, 0.01),
    "VISO_YAW_M_NSE": (0.2, float(np.deg2rad(5.0))),
    "VISO_VEL_M_NSE": (0.1, 0.05),
}
"""Of visual odometry: the default of each parameter, and the least sigma EKF3 works with, whatever it is set to."""
FUSIONCORE_FALLBACK = (0.1, 0.02)
"""Standard deviations [m, rad] that FusionCore takes for a position or an attitude of which a variance is zero."""
FUSIONCORE_LEAST = (0.01, 0.001)
"""Smallest standard deviations [m, rad] that it takes."""
_PLANAR = [0, 1, 5]  # what it reads of a twist


def fusioncore_sigmas(covariance: Array) -> Array:
    """(6,) standard deviations that FusionCore's gate and update use of a pose's: of the diagonal alone."""
    variance = variances(covariance).reshape(2, 3)
    least, fallback = (np.array(sigmas)[:, None] for sigmas in (FUSIONCORE_LEAST, FUSIONCORE_FALLBACK))
    stated = np.maximum(np.sqrt(np.maximum(variance, 0.0)), least)
    return np.where((variance > 0).all(axis=1, keepdims=True), stated, fallback).reshape(6)


@dataclass(frozen=True)
class Axis:
    """``predicted_sigma``: its 5th, 50th and 95th percentile; ``hidden_percent``: share of frames in which a floor is
    above it; ``name``: empty where there is only one."""

    name: str
    predicted_sigma: tuple[float, float, float]
    unit: str
    hidden_percent: float

    def __str__(self) -> str:
        low, middle, high = self.predicted_sigma
        return f"{self.name} {low:.3g} / {middle:.3g} / {high:.3g} {self.unit}".lstrip()


@dataclass(frozen=True)
class Verdict:
    """What a consumer does with one quantity: ``hidden_percent`` of the frames have something hidden, an axis or a
    combination of them."""

    quantity: str
    parameter: str
    value: float | None  # None where what hides the covariance is no number
    hidden_percent: float
    axes: tuple[Axis, ...]
    advice: str = ""

    def __str__(self) -> str:
        value = "" if self.value is None else f" = {self.value:g}"
        sigmas, shares = ", ".join(map(str, self.axes)), [f"{a.hidden_percent:.0f} %" for a in self.axes]
        hides = f"it in {shares[0]}"
        if len(set(shares)) > 1:
            hides = ", ".join(f"{a.name} in {share}" for a, share in zip(self.axes, shares, strict=True))
        line = (
            f"{self.quantity}: predicted sigma {sigmas} (5, 50, 95 %); {self.parameter}{value} hides {hides} of frames"
        )
        return line + (f". {self.advice}" if self.advice else "")

    def document(self) -> dict[str, Any]:
        """Machine-readable form."""
        names = "p5", "p50", "p95"
        axes = [{**vars(a), "predicted_sigma": dict(zip(names, a.predicted_sigma, strict=True))} for a in self.axes]
        return {**vars(self), "axes": axes, "advice": self.advice or None}


class Check:
    """What ``consumer`` will do with messages that pass by. Raises GpvoError for an unknown one."""

    def __init__(self, consumer: str) -> None:
        if consumer not in CONSUMERS:
            raise GpvoError(f"unknown consumer '{consumer}'", cure=f"choose {', '.join(CONSUMERS)}")
        self._consumer, self._seen = consumer, list[tuple[Array, ...]]()

    def passing(self, odometry: Iterable[Odometry]) -> Iterator[Odometry]:
        """The same messages; of each, what the verdicts rest on is kept."""
        for some in batches(odometry):
            if good := [o for o in some if o.twist_covariance is not None]:
                pose = np.array([o.pose_covariance for o in good])
                twist = np.array([o.twist_covariance for o in good], dtype=np.float64)
                hidden = (_hidden(pose, twist),) if self._consumer == "fusioncore" else ()
                self._seen.append((variances(pose).copy(), variances(twist).copy(), *hidden))
            yield from some

    def verdicts(self) -> list[Verdict]:
        """On all that have passed. Raises GpvoError where none of them was tracked."""
        if not self._seen:
            raise GpvoError("no frame of this run has a motion to publish")
        told = [np.concatenate(parts) for parts in zip(*self._seen, strict=True)]
        return _CHECKS[self._consumer](*told)


def _check_robot_localization(pose: Array, twist: Array) -> list[Verdict]:
    """By variances (n, 6), as the others."""
    pose, twist = np.sqrt(pose), np.sqrt(twist)
    parts = (
        ("velocity", twist[:, :3], "m/s"),
        ("turn rate", twist[:, 3:], "rad/s"),
        ("position", pose[:, :3], "m"),
        ("orientation", pose[:, 3:], "rad"),
    )
    return [_verdict(q, "variance floor", 1e-9, sigma, unit, floor=1e-9**0.5) for q, sigma, unit in parts]


def _check_px4(pose: Array, twist: Array) -> list[Verdict]:
    pose, twist = np.sqrt(pose), np.sqrt(twist)
    parts = (
        ("velocity", "EKF2_EVV_NOISE", twist[:, :3], "m/s", 0.05),
        ("position", "EKF2_EVP_NOISE", pose[:, :3], "m", 0.5),
        ("yaw", "EKF2_EVA_NOISE", pose[:, 5], "rad", 0.5),
    )
    return [_verdict(q, n, PX4[n][0], sigma, unit, minimum=PX4[n][1], typical=t) for q, n, sigma, unit, t in parts]


def _hidden(pose: Array, twist: Array) -> NDArray[np.bool_]:
    """(n, 2) whether FusionCore takes a combination of axes, of twists and of poses (n, 6, 6), for more than twice as
    uncertain as it is: correlations are lost, and a pose's small sigmas."""
    planar = twist[:, _PLANAR][:, :, _PLANAR]
    used = np.array([fusioncore_sigmas(C) for C in pose])
    pairs = (planar, np.sqrt(variances(planar))), (pose, used)
    least = [np.linalg.eigvalsh(C / (sigma[:, :, None] * sigma[:, None, :]))[:, 0] for C, sigma in pairs]
    return np.stack(least, axis=1) < 0.25


def _check_fusioncore(pose: Array, twist: Array, hidden: NDArray[np.bool_]) -> list[Verdict]:
    """``hidden_percent``: share of the frames of which something is :func:`_hidden`."""
    out = []
    of_twist = ("vx", "m/s"), ("vy", "m/s"), ("yaw rate", "rad/s")
    of_pose = tuple(zip(AXES, ("m",) * 3 + ("rad",) * 3, strict=True))
    for quantity, variance, hides, axes, reads in (
        ("twist", twist[:, _PLANAR], hidden[:, 0], of_twist, "vx, vy and the yaw rate as an encoder's"),
        ("pose", pose, hidden[:, 1], of_pose, "the pose as VSLAM's, to no less than 0.01 m and 0.001 rad"),
    ):
        percent, stated = 100.0 * float(hides.mean()), np.sqrt(variance)
        told = (Axis(name, _percentiles(s), unit, percent) for (name, unit), s in zip(axes, stated.T, strict=True))
        advice = f"It reads {reads}, and its chi-square gate is only as good as these sigmas; send no zeros"
        cause = "use of the diagonal alone"
        out.append(Verdict(quantity, cause, None, percent, tuple(told), advice))
    return out


def _check_ardupilot(pose: Array, twist: Array) -> list[Verdict]:
    out = []
    for quantity, name, old, new, unit in (
        ("position", "VISO_POS_M_NSE", np.cbrt((pose[:, :3] ** 2).sum(1)), np.sqrt(pose[:, :3].sum(1)), "m"),
        ("angle", "VISO_YAW_M_NSE", np.cbrt((pose[:, 3:] ** 2).sum(1)), np.sqrt(pose[:, 3:].sum(1)), "rad"),
    ):
        value, minimum = ARDUPILOT[name]
        out.append(_verdict(quantity, name, value, new, unit, minimum=minimum))
        out.append(_verdict(f"{quantity}, releases to early 2026", name, value, old, unit, minimum=minimum))
    name = "VISO_VEL_M_NSE"
    value, least = ARDUPILOT[name]
    predicted, speed = _percentiles(np.sqrt(twist[:, :3]).max(axis=1)), np.sqrt(twist[:, :3].sum(1))
    read = "velocity of VISION_SPEED_ESTIMATE since pull request 32478"
    out.append(_verdict(read, name, value, speed, "m/s", minimum=least, typical=0.05))
    advice = (
        "ODOMETRY's velocity covariance is never read, VISION_SPEED_ESTIMATE's not in older releases: set "
        f"{name} to {max(predicted[1], least):.2g}; EKF3 takes no sigma below {least:g}. From 1 on, VISO_QUAL_MIN lets "
        "ODOMETRY's quality decide frame by frame, but drops every VISION_SPEED_ESTIMATE, which has none; below 0 it "
        "would accept frames far outside the model's domain"
    )
    return [*out, Verdict("velocity otherwise", name, value, 100.0, (Axis("", predicted, "m/s", 100.0),), advice)]


def _percentiles(sigma: Array) -> tuple[float, float, float]:
    low, middle, high = (float(q) for q in np.quantile(sigma, [0.05, 0.5, 0.95]))
    return low, middle, high


def _verdict(
    quantity: str,
    name: str,
    value: float,
    sigma: Array,
    unit: str,
    *,
    minimum: float = 0.0,
    typical: float = 0.5,
    floor: float | None = None,
) -> Verdict:
    """Of a ``sigma`` (n,), or (n, 3) of axes. ``typical``: its quantile, of every axis, that the parameter should not
    exceed. A velocity's has a usual level and its low end matters; a pose's grows from nothing, so its middle does."""
    names, sigma = "xyz" if sigma.ndim > 1 else ("",), sigma.reshape(len(sigma), -1)
    # Variances were lifted to the one floor, up to rounding.
    below = sigma < (value if floor is None else floor * (1 + 1e-6))
    shares = zip(names, sigma.T, 100.0 * below.mean(axis=0), strict=True)
    axes = tuple(Axis(axis, _percentiles(s), unit, float(share)) for axis, s, share in shares)
    hidden, wanted = 100.0 * float(below.any(axis=1).mean()), float(np.quantile(sigma, typical, axis=0).min())
    advice = ""
    if hidden > 1.0 and floor is None and wanted < value:
        advice = f"Set {name} to {max(wanted, minimum):.2g}"
        if wanted < minimum:
            still = 100 * float((sigma < minimum).any(axis=1).mean())
            advice += f", the smallest it accepts, which hides {'an axis in ' * (len(axes) > 1)}{still:.0f} %"
    return Verdict(quantity, name, value, hidden, axes, advice)


_CHECKS: dict[str, Callable[..., list[Verdict]]] = dict(
    zip(CONSUMERS, (_check_px4, _check_ardupilot, _check_robot_localization, _check_fusioncore), strict=True)
)
