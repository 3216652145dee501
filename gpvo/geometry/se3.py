"""SE(3) as 4x4 matrices, with batches in the leading axes, and the fixed rotations between the field's frames (REP 103,
REP 105; MAVLink's MAV_FRAME).

Conventions: a tangent vector is ``(translation xyz [m], rotation xyz [rad])`` and perturbs on the right,
``T Exp(xi)``. ``T_a_b`` maps coordinates in ``b`` to coordinates in ``a``.

Formulas: J. Sola, J. Deray, D. Atchuthan, "A micro Lie theory for state estimation in robotics" (2018),
appendices B (SO(3)) and D (SE(3)); T. Barfoot, "State Estimation for Robotics" (2017), section 7.1.
"""

from __future__ import annotations

import math

import numpy as np

from gpvo.types import Array

# Below this angle the closed forms lose more digits to cancellation than the series drop.
_SMALL_ANGLE_RAD = 1e-4
_NOT_RIGID = 1e-3
_EYE = np.eye(3)
_SIGNS = 2.0 * np.eye(4, 3) - [[1.0], [1.0], [1.0], [-1.0]]  # of a rotation's diagonal in each squared component


def skew(v: Array) -> Array:
    """Matrix of the cross product: ``skew(v) @ w == cross(v, w)``. (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    if v.size == 3:
        x, y, z = v.ravel().tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).reshape(*v.shape, 3)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def _coefficients(theta2: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 from t^2, by series near zero."""
    if np.size(theta2) == 1:
        a, b, c = (np.reshape(v, np.shape(theta2)) for v in _coefficients_of_one(np.reshape(theta2, ())[()]))
        return a, b, c
    theta = np.sqrt(theta2)
    small = theta < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1.0 - theta2 / 6.0, np.sin(safe) / safe)
    # 2 sin^2(t/2) keeps the digits that 1 - cos(t) loses.
    b = np.where(small, 0.5 - theta2 / 24.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe**2)
    c_small = 1.0 / 6.0 - theta2 / 120.0
    c = np.where(theta < 1e-2, c_small + theta2**2 / 5040.0, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def _coefficients_of_one(theta2: Array) -> tuple[Array, Array, Array]:
    """The same of one value, to the last bit; it works out only what it needs."""
    theta = np.sqrt(theta2)
    if theta < _SMALL_ANGLE_RAD:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        a, b = np.sin(theta) / theta, 2.0 * np.sin(theta / 2.0) ** 2 / np.square(theta)
    if theta < 1e-2:
        return a, b, 1.0 / 6.0 - theta2 / 120.0 + np.square(theta2) / 5040.0
    return a, b, (theta - np.sin(theta)) / np.power(theta, 3)


def _powers(phi: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Of a rotation vector (..., 3) [rad]: the coefficients, each (..., 1, 1) or a number, its skew matrix and that
    squared."""
    phi = np.asarray(phi, dtype=np.float64)
    W = skew(phi)
    if phi.size == 3:  # numbers do as well
        return *_coefficients_of_one((phi**2).sum()), W, W @ W
    a, b, c = (v[..., None, None] for v in _coefficients((phi**2).sum(-1)))
    return a, b, c, W, W @ W


def so3_exp(phi: Array) -> Array:
    """Rotation vector [rad] to rotation matrix (Rodrigues). (..., 3) -> (..., 3, 3)."""
    a, b, _, W, WW = _powers(phi)
    return np.asarray(_EYE + a * W + b * WW)


def so3_exp_and_right_jacobian(phi: Array) -> tuple[Array, Array]:
    """:func:`so3_exp` and the right Jacobian, which is the left one of ``-phi``, for the price of one."""
    a, b, c, W, WW = _powers(phi)
    return _EYE + a * W + b * WW, _EYE - b * W + c * WW


def so3_log(R: Array) -> Array:
    """Rotation matrix to rotation vector [rad] of angle at most pi. (..., 3, 3) -> (..., 3).

    Goes through the quaternion, which stays accurate at both zero and pi.
    """
    q_xyzw = rotation_to_quaternion_xyzw(R)
    xyz, w = q_xyzw[..., :3], q_xyzw[..., 3]
    sine = np.linalg.norm(xyz, axis=-1)
    angle = 2.0 * np.arctan2(sine, w)
    small = sine < 1e-9
    scale = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return xyz * scale[..., None]


def right_jacobian_inverse(xi: Array) -> Array:
    """d log(T exp(e)) / d e at e = 0, for xi = log(T). (..., 6) -> (..., 6, 6).

    The series with Bernoulli numbers, to the sixth order (T. Barfoot, "State Estimation for Robotics", 2017, section
    7.1): to 1e-3 at 2 rad.
    """
    ad = np.zeros((*xi.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = skew(xi[..., 3:])
    ad[..., :3, 3:] = skew(xi[..., :3])
    square = ad @ ad
    return np.asarray(np.eye(6) + ad / 2 + square / 12 - square @ square / 720 + square @ square @ square / 30240)


def so3_left_jacobian_inverse(phi: Array) -> Array:
    """Inverse of the left Jacobian of SO(3), which is ``V`` in the SE(3) exponential. (..., 3) -> (..., 3, 3)."""
    phi = np.asarray(phi, dtype=np.float64)
    theta2 = (phi**2).sum(-1)
    a, b, _ = _coefficients(theta2)
    small = theta2 < 1e-4
    safe = np.where(small, 1.0, theta2)
    # (1 - a / (2 b)) / t^2, and its series 1/12 + t^2/720 + t^4/30240.
    d = np.where(
        small,
        1.0 / 12.0 + theta2 / 720.0 + theta2**2 / 30240.0,
        (1.0 - a / (2.0 * np.where(b == 0, 1.0, b))) / safe,
    )
    W = skew(phi)
    return np.eye(3) - 0.5 * W + d[..., None, None] * (W @ W)


def exp(xi: Array) -> Array:
    """Tangent (..., 6) to pose (..., 4, 4)."""
    xi = np.asarray(xi, dtype=np.float64)
    a, b, c, W, WW = _powers(xi[..., 3:])
    return from_rt(_EYE + a * W + b * WW, ((_EYE + b * W + c * WW) @ xi[..., :3, None])[..., 0])


def log(T: Array) -> Array:
    """Pose (..., 4, 4) to tangent (..., 6)."""
    T = np.asarray(T, dtype=np.float64)
    if T.size == 16:
        return _log_one(T.reshape(4, 4)).reshape(*T.shape[:-2], 6)
    phi = so3_log(T[..., :3, :3])
    rho = (so3_left_jacobian_inverse(phi) @ T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def _log_one(T: Array) -> Array:
    """The same of a single pose, in plain numbers: a tenth of the time, as arrays of three are all overhead."""
    (r00, r01, r02, tx), (r10, r11, r12, ty), (r20, r21, r22, tz), _ = T.tolist()
    q = _long_quaternion((r00, r01, r02), (r10, r11, r12), (r20, r21, r22))
    length = math.copysign(math.hypot(*q), q[3] if q[3] else 1.0)
    x, y, z, w = (v / length for v in q) if length else (math.nan,) * 4
    sine = math.hypot(x, y, z)
    scale = 2.0 if sine < 1e-9 else 2.0 * math.atan2(sine, w) / sine
    x, y, z = x * scale, y * scale, z * scale
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-4:
        d = 1.0 / 12.0 + theta2 / 720.0 + theta2**2 / 30240.0
    else:
        theta = math.sqrt(theta2)
        d = (1.0 - theta * math.sin(theta) / (4.0 * math.sin(theta / 2.0) ** 2)) / theta2
    # (I - W / 2 + d W^2) t, with W v = phi x v.
    ax, ay, az = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
    bx, by, bz = y * az - z * ay, z * ax - x * az, x * ay - y * ax
    return np.array([tx - 0.5 * ax + d * bx, ty - 0.5 * ay + d * by, tz - 0.5 * az + d * bz, x, y, z])


def _long_quaternion(*rows: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Multiple of the quaternion x y z w of a rotation, by its largest component (S. W. Shepperd, 1978)."""
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rows
    trace = r00 + r11 + r22
    largest = max(r00, r11, r22, trace)
    if largest == r00:
        return 1 + r00 - r11 - r22, r01 + r10, r20 + r02, r21 - r12
    if largest == r11:
        return r01 + r10, 1 - r00 + r11 - r22, r12 + r21, r02 - r20
    if largest == r22:
        return r20 + r02, r12 + r21, 1 - r00 - r11 + r22, r10 - r01
    return r21 - r12, r02 - r20, r10 - r01, 1 + trace


def inverse(T: Array) -> Array:
    """Inverse pose, by transposing the rotation. (..., 4, 4) -> (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    return from_rt(Rt, -(Rt @ T[..., :3, 3, None])[..., 0])


def adjoint(T: Array) -> Array:
    """``Ad(T)``, with ``T Exp(xi) T^-1 == Exp(Ad(T) xi)``. (..., 4, 4) -> (..., 6, 6)."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., :3, 3:] = skew(T[..., :3, 3]) @ R
    return out


def transform(T: Array, points: Array) -> Array:
    """Apply one pose (4, 4) to points (..., 3)."""
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def from_rt(R: Array, t: Array) -> Array:
    """Pose (..., 4, 4) from rotation (..., 3, 3) and translation (..., 3)."""
    R, t = np.asarray(R, dtype=np.float64), np.asarray(t, dtype=np.float64)
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def from_quaternion(t: Array, q_xyzw: Array) -> Array:
    """Pose (..., 4, 4) from translation (..., 3) and quaternion (..., 4) in x, y, z, w order.

    The quaternion is normalised first: published ground truth is unit only to about 1e-4.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    R = np.stack([np.stack(row, -1) for row in rows], -2)
    return from_rt(R, t)


def rotation_to_quaternion_xyzw(R: Array) -> Array:
    """Unit quaternion (..., 4), x y z w with w >= 0, of a rotation matrix (..., 3, 3).

    Picks the largest of the four components to divide by (S. W. Shepperd, 1978).
    """
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2:
        q = np.array(_long_quaternion(*R.tolist()))
        return q / math.copysign(np.linalg.norm(q), q[3] if q[3] else 1.0)
    d = np.diagonal(R, axis1=-2, axis2=-1)
    choice = np.argmax(np.concatenate([d, (d[..., :1] + d[..., 1:2] + d[..., 2:])], -1), axis=-1)
    multiples = np.empty((*d.shape[:-1], 4, 4))  # 4 q q^T: each row is one of q
    multiples[..., :3, :3] = R + np.swapaxes(R, -1, -2)
    multiples[..., :3, 3] = multiples[..., 3, :3] = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    signed = d[..., None, :] * _SIGNS
    multiples[..., range(4), range(4)] = 1 + signed[..., 0] + signed[..., 1] + signed[..., 2]
    q = np.take_along_axis(multiples, choice[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def interpolate(T_a: Array, T_b: Array, fraction: Array) -> Array:
    """Geodesic between poses (..., 4, 4), at ``fraction`` (...) of the way: translation straight, rotation slerp."""
    fraction = np.asarray(fraction, dtype=np.float64)
    R_a = T_a[..., :3, :3]
    phi = so3_log(np.swapaxes(R_a, -1, -2) @ T_b[..., :3, :3])
    R = R_a @ so3_exp(fraction[..., None] * phi)
    t = T_a[..., :3, 3] + fraction[..., None] * (T_b[..., :3, 3] - T_a[..., :3, 3])
    return from_rt(R, t)


def is_rigid(T: Array, farthest_m: float) -> bool:
    """Whether one matrix (4, 4) is finite, a rotation to a thousandth, and no translation longer than that.

    A mirror image is none, nor is a transposed pose, whose translation is in the last row.
    """
    rows = T.tolist()
    # Comparisons with NaN are false.
    if not all(-farthest_m < value < farthest_m for row in rows for value in row):
        return False
    (a, b, c, _), (d, e, f, _), (g, h, i, _), last = rows
    mirrored = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0
    if mirrored or max(map(abs, last[:3])) > 1e-9 or abs(last[3] - 1.0) > 1e-9:
        return False
    # R^T R less the identity.
    deviation = (
        a * a + d * d + g * g - 1.0, b * b + e * e + h * h - 1.0, c * c + f * f + i * i - 1.0,
        a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i,
    )  # fmt: skip
    return all(-_NOT_RIGID < value < _NOT_RIGID for value in deviation)


def orthonormalise(T: Array) -> Array:
    """Pose whose rotation block is the nearest rotation matrix (SVD). (..., 4, 4) -> (..., 4, 4)."""
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    sign = np.linalg.det(U @ Vt)
    U = U * np.stack([np.ones_like(sign), np.ones_like(sign), sign], -1)[..., None, :]
    return from_rt(U @ Vt, T[..., :3, 3])


def path_length_m(position_m: Array) -> Array:
    """(N,) length of a path of straight lines up to each of its points (N, d)."""
    steps = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


# Optical (x right, y down, z forward) to FLU body (x forward, y left, z up) of a forward-looking camera.
R_FLU_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# FLU to FRD and back: its own inverse.
R_FRD_FLU: Array = np.diag([1.0, -1.0, -1.0])
# ENU to NED and back: its own inverse.
R_NED_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# RealSense T265 pose stream (x right, y up, z back) to FLU.
R_FLU_T265: Array = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# FLU body at the camera's own place, looking forward.
T_FLU_OPTICAL: Array = from_rt(R_FLU_OPTICAL, np.zeros(3))
for _M in (R_FLU_OPTICAL, R_FRD_FLU, R_NED_ENU, R_FLU_T265, T_FLU_OPTICAL):
    _M.setflags(write=False)


def rotate_covariance(R_new_old: Array, covariance: Array, of_rotation: Array | None = None) -> Array:
    """(..., 6, 6) covariance (translation, rotation), expressed in rotated axes: ``B C B^T``, B = blockdiag(R, R);
    with ``of_rotation`` (..., 3, 3) as the latter R, where the rotation's old axes are others."""
    B = np.zeros(covariance.shape)
    B[..., :3, :3], B[..., 3:, 3:] = R_new_old, R_new_old if of_rotation is None else of_rotation
    return B @ covariance @ np.swapaxes(B, -1, -2)
