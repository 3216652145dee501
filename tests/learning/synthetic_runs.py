"""Runs whose error law is known: covariance, jitter, white and bias are drawn as stated."""

from __future__ import annotations

import numpy as np
from gpvo.geometry import se3
from gpvo.types import Status, StereoCamera, TruthLog, VoLog, VoRecord

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
UNIT = np.array([1.0, 1.0, 2.0, 0.4, 0.4, 0.4]) * 1e-3
"""Standard deviation per axis of a motion seen by 100 inliers [m, rad]."""


def correlation() -> np.ndarray:
    R = np.eye(6)
    R[0, 4] = R[4, 0] = 0.7
    R[1, 3] = R[3, 1] = -0.7
    return R


def make_run(
    seed: int,
    n: int = 400,
    *,
    speed: float = 1.0,
    rate_hz: float = 20.0,
    share: tuple[float, float, float] = (0.4, 0.4, 0.2),
    tau_s: float = 1.5,
    geometry_scale: float = 0.1,
    geometry: bool = True,
) -> tuple[VoLog, TruthLog]:
    """A log and its truth. The true variance goes with 100 / inliers and with the square of the turn rate; the
    geometric covariance knows of the inliers alone and is ``geometry_scale`` of the variance."""
    rng = np.random.default_rng(seed)
    dt = 1.0 / rate_hz
    twist = np.zeros((n, 6))
    for j, (size, mean) in enumerate([(0.1, 0.0), (0.05, 0.0), (0.3, 1.0), (0.1, 0.0), (0.3, 0.0), (0.1, 0.0)]):
        twist[:, j] = (mean + size * _smooth(rng, n)) * (speed if j < 3 else 1.0)
    inliers = np.clip(100 * np.exp(0.6 * _smooth(rng, n)), 15, 500).astype(int)
    sigma = UNIT * np.sqrt(100 / inliers * (1 + 4 * twist[:, 4] ** 2))[:, None]
    a, w, b = share
    L = np.linalg.cholesky(correlation())
    noise = rng.standard_normal((n + 1, 6)) @ L.T
    rho = np.exp(-dt / tau_s)
    bias = np.zeros((n, 6))
    bias[0] = rng.standard_normal(6)
    for k in range(1, n):
        bias[k] = rho * bias[k - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(6)
    z = (
        np.sqrt(a / 2) * (noise[1:] - noise[:-1])
        + np.sqrt(w) * rng.standard_normal((n, 6)) @ L.T
        + np.sqrt(b) * bias @ L.T
    )
    T_true = se3.exp(twist * dt)
    T_est = T_true @ se3.exp(z * sigma)
    return _log(T_true, T_est, dt, inliers, geometry_scale if geometry else None)


def _smooth(rng: np.random.Generator, n: int, memory: float = 0.95) -> np.ndarray:
    out = np.empty(n)
    out[0] = rng.standard_normal()
    for k in range(1, n):
        out[k] = memory * out[k - 1] + np.sqrt(1 - memory**2) * rng.standard_normal()
    return out


def _log(T_true, T_est, dt, inliers, geometry_scale) -> tuple[VoLog, TruthLog]:
    n = len(T_true)
    t = (np.arange(n + 1) * dt * 1e9).astype(np.int64)
    records = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))]
    poses = [np.eye(4)]
    base = np.outer(UNIT, UNIT) * correlation()
    for k in range(n):
        covariances = (
            {} if geometry_scale is None else {"pointing_matching": base * (100 / inliers[k]) * geometry_scale}
        )
        records.append(
            VoRecord(
                int(t[k + 1]),
                int(t[k]),
                Status.OK,
                T_est[k],
                n_detected=600,
                n_stereo=500,
                n_tracked=int(inliers[k] * 1.2) + 1,
                n_inliers=int(inliers[k]),
                covariances=covariances,
            )
        )
        poses.append(poses[-1] @ T_true[k])
    return VoLog(records, CAMERA), TruthLog(t, np.array(poses))
