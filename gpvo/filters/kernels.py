"""SO(3) on batches, written for the few microseconds a filter step has: preallocation and no generality.

The formulas are those of :mod:`gpvo.geometry.se3`; tests compare the two.
"""

from __future__ import annotations

import math

import numpy as np

from gpvo.geometry.se3 import skew
from gpvo.types import Array

_EYE3 = np.eye(3)
_SMALL_ANGLE_2 = 1e-8  # squared angle below which the series are exact to rounding


def _coefficients(theta2: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1 - cos t)/t^2, (t - sin t)/t^3 of t^2 (B,)."""
    if len(theta2) == 1:
        return _coefficients_of_one(float(theta2[0]))
    safe2 = np.maximum(theta2, _SMALL_ANGLE_2)
    t = np.sqrt(safe2)
    s = np.sin(t)
    small = theta2 < _SMALL_ANGLE_2
    a = np.where(small, 1.0 - theta2 / 6.0, s / t)
    b = np.where(small, 0.5 - theta2 / 24.0, 2.0 * np.sin(0.5 * t) ** 2 / safe2)
    # t - sin t loses digits below a hundredth of a radian.
    c = np.where(theta2 < 1e-4, 1.0 / 6.0 - theta2 / 120.0 + theta2**2 / 5040.0, (t - s) / (safe2 * t))
    return a, b, c


def _coefficients_of_one(t2: float) -> tuple[Array, Array, Array]:
    """The same of one value, by scalar functions: several times as fast."""
    if t2 < _SMALL_ANGLE_2:
        a, b, c = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        t = math.sqrt(t2)
        s = math.sin(t)
        a, b = s / t, 2.0 * math.sin(0.5 * t) ** 2 / t2
        c = (t - s) / (t2 * t) if t2 > 1e-4 else 1.0 / 6.0 - t2 / 120.0 + t2 * t2 / 5040.0
    return np.array([a]), np.array([b]), np.array([c])


def exp_and_right_jacobian(phi: Array) -> tuple[Array, Array]:
    """Rotation matrix (B, 3, 3) of rotation vectors (B, 3) [rad], and the right Jacobian (B, 3, 3)."""
    a, b, c = _coefficients((phi * phi).sum(1))
    W = skew(phi)
    WW = W @ W
    bW = b[:, None, None] * W
    E = a[:, None, None] * W
    E += _EYE3
    E += b[:, None, None] * WW
    J = c[:, None, None] * WW
    J += _EYE3
    J -= bW
    return E, J


def log(R: Array) -> Array:
    """Rotation vectors (B, 3) [rad] of rotation matrices (B, 3, 3), for angles below pi.

    Uses the antisymmetric part, exact to rounding near zero; within a milliradian of pi it loses accuracy,
    which no innovation of a filter in use comes near.
    """
    vee = np.empty((len(R), 3))
    vee[:, 0] = R[:, 2, 1] - R[:, 1, 2]
    vee[:, 1] = R[:, 0, 2] - R[:, 2, 0]
    vee[:, 2] = R[:, 1, 0] - R[:, 0, 1]
    sine = 0.5 * np.sqrt((vee * vee).sum(1))
    cosine = 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine < 1e-7, 0.5, 0.5 * angle / np.maximum(sine, 1e-300))
    return vee * scale[:, None]


def left_jacobian_inverse(phi: Array) -> Array:
    """Inverse left Jacobian of SO(3), (B, 3) to (B, 3, 3): ``I - W/2 + d W^2``."""
    t2 = (phi * phi).sum(1)
    half = 0.5 * np.sqrt(np.maximum(t2, 1e-4))
    d = np.where(t2 < 1e-4, 1.0 / 12.0 + t2 / 720.0, (1.0 - half / np.tan(half)) / np.maximum(t2, 1e-4))
    W = skew(phi)
    return _EYE3 - 0.5 * W + d[:, None, None] * (W @ W)


def transpose(M: Array) -> Array:
    """(B, n, m) to (B, m, n), a view."""
    return M.transpose(0, 2, 1)


def orthonormalise(R: Array) -> Array:
    """One Newton step towards the nearest rotation: ``R (3 I - R^T R) / 2``, enough for rounding drift."""
    return R @ (1.5 * _EYE3 - 0.5 * (transpose(R) @ R))


def motion_log(R: Array, t: Array) -> Array:
    """SE(3) logarithm (B, 6), translation first, of rotations (B, 3, 3) and translations (B, 3)."""
    phi = log(R)
    out = np.empty((len(R), 6))
    out[:, :3] = (left_jacobian_inverse(phi) @ t[:, :, None])[:, :, 0]
    out[:, 3:] = phi
    return out


def motion_exp(xi: Array) -> tuple[Array, Array]:
    """SE(3) exponential of (B, 6), translation first: rotations (B, 3, 3) and translations (B, 3)."""
    a, b, c = _coefficients((xi[:, 3:] * xi[:, 3:]).sum(1))
    W = skew(xi[:, 3:])
    WW = W @ W
    R = _EYE3 + a[:, None, None] * W + b[:, None, None] * WW
    V = _EYE3 + b[:, None, None] * W + c[:, None, None] * WW
    return R, (V @ xi[:, :3, None])[:, :, 0]
