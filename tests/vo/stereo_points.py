"""Simulated stereo points with known pixel noise, shared by the odometry's tests."""

from __future__ import annotations

import numpy as np
from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.motion import transfer

CAMERA = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)


def scene(rng: np.random.Generator, count: int, disparity_px: tuple[float, float]) -> tuple[Array, Array, Array]:
    """A random motion of a few centimetres and degrees, and exact (u, v, d) before and after it."""
    low, high = disparity_px
    d = 1.0 / rng.uniform(1 / high, 1 / low, count)
    uvd = np.stack([rng.uniform(0, 640, count), rng.uniform(0, 480, count), d], 1)
    T_prev_cur = se3.exp(np.r_[rng.normal(0, 0.05, 3), rng.normal(0, 0.02, 3)])
    T_prev_cur[2, 3] += 0.1
    return T_prev_cur, uvd, transfer(T_prev_cur, uvd, CAMERA).uvd.T


def noisy(rng: np.random.Generator, uvd: Array, sigma_px: float) -> Array:
    """Independent noise on uL, vL, uR and vR; the row is the mean of both."""
    n = len(uvd)
    e = sigma_px * rng.standard_normal((4, n))
    return np.stack([uvd[:, 0] + e[0], uvd[:, 1] + 0.5 * (e[1] + e[3]), uvd[:, 2] + e[0] - e[2]], 1)
