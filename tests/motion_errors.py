"""Stated errors for tests, from the covariance of each part."""

from __future__ import annotations

from typing import Any

import numpy as np
from gpvo.geometry.covariance import scaled_root
from gpvo.types import MotionError, Prediction


def parts(
    jitter: np.ndarray,
    white: np.ndarray,
    bias: np.ndarray,
    tau_s: np.ndarray | float = 1.0,
    calibration_root: np.ndarray | None = None,
    calibration_tau_s: np.ndarray | float = 1.0,
) -> dict[str, Any]:
    """Fields of a motion's error; ``bias`` is what persists without the part of the calibration."""
    root = np.zeros((6, 6)) if calibration_root is None else calibration_root
    return {
        "jitter": jitter,
        "white": white,
        "persistent_root": np.hstack([scaled_root(bias), root]),
        "persistent_tau_s": np.concatenate([np.broadcast_to(tau_s, 6), np.broadcast_to(calibration_tau_s, 6)]),
    }


def motion_error(*args: Any, dt_s: float = 0.05, **more: Any) -> MotionError:
    """Of one motion without a mean; arguments of :func:`parts`."""
    return MotionError(mean=np.zeros(6), dt_s=dt_s, **parts(*args, **more))


def prediction(t_ns: int, *args: Any, dt_s: float = 0.1, confidence: float = 0.8, **more: Any) -> Prediction:
    """The same as a model's."""
    sure = {"epistemic": np.zeros(6), "confidence": confidence, "in_domain": 1.0}
    return Prediction(mean=np.zeros(6), dt_s=dt_s, t_ns=t_ns, **sure, **parts(*args, **more))
