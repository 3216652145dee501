"""What the filters that people fly make of a message, by their parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gpvo.publish.odometry import Odometry
from gpvo.types import Array


@dataclass(frozen=True)
class Px4Parameters:
    """PX4's parameters of external vision, at their defaults."""

    EKF2_EV_NOISE_MD: int = 0
    EKF2_EVP_NOISE: float = 0.1
    EKF2_EVV_NOISE: float = 0.1
    EKF2_EVA_NOISE: float = 0.1


VISO_POS_M_NSE, VISO_YAW_M_NSE = 0.2, 0.2  # ArduPilot's defaults


def px4_sigmas(odometry: Odometry, parameters: Px4Parameters | None = None) -> dict[str, Array]:
    """Standard deviations that EKF2 uses: position (3,), velocity (3,), yaw (1,).

    Only diagonals are read, and of the attitude only yaw. In mode 0 the parameters are lower bounds; in mode 1 they
    replace the message.
    """
    p = parameters or Px4Parameters()
    pose = np.sqrt(np.diagonal(odometry.pose_covariance))
    twist = np.full(6, np.nan) if odometry.twist_covariance is None else np.sqrt(np.diagonal(odometry.twist_covariance))
    sent = {"position": pose[:3], "velocity": twist[:3], "yaw": pose[5:6]}
    floor = {"position": p.EKF2_EVP_NOISE, "velocity": p.EKF2_EVV_NOISE, "yaw": p.EKF2_EVA_NOISE}
    if p.EKF2_EV_NOISE_MD == 1:
        return {k: np.full_like(v, floor[k]) for k, v in sent.items()}
    return {k: np.maximum(v, floor[k]) for k, v in sent.items()}


def ardupilot_errors(pose_covariance: Array, *, before_2026: bool = False) -> tuple[float, float]:
    """Position [m] and angle [rad] error that EKF3 takes from a pose covariance (6, 6), after its clamps.

    ``before_2026``: the cube root of the sum of squared variances, which is no standard deviation; since then the root
    of their sum. NaN in element 0 means unknown: the parameters are used.
    """
    c = np.diagonal(pose_covariance)
    if np.isnan(c[0]):
        return VISO_POS_M_NSE, VISO_YAW_M_NSE
    if before_2026:
        position, angle = np.cbrt((c[:3] ** 2).sum()), np.cbrt((c[3:] ** 2).sum())
    else:
        position, angle = np.sqrt(c[:3].sum()), np.sqrt(c[3:].sum())
    return float(np.clip(position, VISO_POS_M_NSE, 100.0)), float(np.clip(angle, VISO_YAW_M_NSE, 1.5))


def robot_localization_covariance(covariance: Array) -> Array:
    """(6, 6) as its update uses it: negative variances by their absolute value, variances under 1e-9 set to 1e-9."""
    out = np.array(covariance, dtype=np.float64)
    diagonal = np.abs(np.diagonal(out))
    np.fill_diagonal(out, np.maximum(diagonal, 1e-9))
    return out
