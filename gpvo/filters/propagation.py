"""How the state moves between two samples, and how its error moves with it.

With an IMU: the trapezoidal strapdown rule. Over one interval of length dt with samples at both ends,

    E = Exp((w0 + w1) / 2 dt)        R1 = R0 E
    a = (R0 f0 + R1 f1) / 2 + g      v1 = v0 + a dt,  p1 = p0 + v0 dt + a dt^2 / 2

whose global error falls with the square of dt. ``w`` and ``f`` are gyroscope and specific force less their
biases. Without an IMU: constant velocity and turn rate in the body's own axes.

The error state is (dp world, dv world, dtheta body, dba, dbg), R = R_hat Exp(dtheta); J. Sola, "Quaternion
kinematics for the error-state Kalman filter" (2017), sections 5 and 7 (local angular error), derived there for the
Euler rule and here for the trapezoid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from gpvo.geometry import se3
from gpvo.types import Array, ImuNoise, VoRecord, field_names

P, V, TH, BA, BG = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
CORE = 15
_SHARE_OF_FASTEST = 0.1  # of a vehicle's speed, below which it counts as resting

# A consumer-grade MEMS IMU, for logs that do not say what theirs is.
DEFAULT_IMU_NOISE = ImuNoise(
    gyro_density_radps_sqrthz=2e-4,
    acc_density_mps2_sqrthz=2e-3,
    gyro_walk_radps2_sqrthz=2e-5,
    acc_walk_mps3_sqrthz=3e-3,
)


_Arrays = TypeVar("_Arrays")


def transpose(M: Array) -> Array:
    """(B, n, m) to (B, m, n), a view."""
    return M.transpose(0, 2, 1)


def each(arrays: _Arrays, change: Callable[[Array], Array]) -> _Arrays:
    """A dataclass of arrays with each of them changed."""
    return type(arrays)(**{name: change(getattr(arrays, name)) for name in field_names(type(arrays))})


@dataclass
class Nominal:
    """The estimate itself, B members at once: position [m] and velocity [m/s] of the IMU in the world, attitude
    ``R_world_imu`` and the biases [m/s^2, rad/s]. Without an IMU the gyroscope slot holds the turn rate."""

    position: Array
    velocity: Array
    R_world_imu: Array
    acc_bias: Array
    gyro_bias: Array

    def copy(self) -> Nominal:
        """An independent copy."""
        return each(self, lambda values: values.copy())


@dataclass(frozen=True)
class ConstantVelocityNoise:
    """White acceleration [m/s^2/sqrt(Hz)] and angular acceleration [rad/s^2/sqrt(Hz)] that bend the motion."""

    acceleration: float = 1.0
    angular_acceleration: float = 0.5


def imu_step(x: Nominal, F: Array, dt: float, gyro0: Array, acc0: Array, gyro1: Array, acc1: Array, g: Array) -> None:
    """Move ``x`` over one IMU interval in place and write the error transition into ``F`` (B, 15, 15), an identity but
    for what varies.

    ``gyro0, acc0, gyro1, acc1`` (B, 3) or (1, 3): raw samples at both ends; ``g`` (3,): gravity in the world [m/s^2].
    """
    R0 = x.R_world_imu
    E, J = se3.so3_exp_and_right_jacobian((0.5 * (gyro0 + gyro1) - x.gyro_bias) * dt)
    R1 = R0 @ E
    f0, f1 = acc0 - x.acc_bias, acc1 - x.acc_bias
    half0 = 0.5 * (R0 @ se3.skew(f0))
    half1 = 0.5 * (R1 @ se3.skew(f1))
    a = 0.5 * ((R0 @ f0[:, :, None])[:, :, 0] + (R1 @ f1[:, :, None])[:, :, 0]) + g
    a_th = -(half0 + half1 @ transpose(E))
    a_ba = -0.5 * (R0 + R1)
    J *= dt
    a_bg = half1 @ J

    F[:, TH, TH] = transpose(E)
    np.negative(J, out=F[:, TH, BG])
    for block, column in ((a_th, TH), (a_ba, BA), (a_bg, BG)):
        dv = F[:, V, column]
        np.multiply(block, dt, out=dv)
        np.multiply(dv, 0.5 * dt, out=F[:, P, column])
    F[:, 0, 3] = F[:, 1, 4] = F[:, 2, 5] = dt

    x.position = x.position + (dt * x.velocity + (0.5 * dt * dt) * a)
    x.velocity = x.velocity + dt * a
    x.R_world_imu = R1


def constant_velocity_step(x: Nominal, F: Array, dt: float) -> None:
    """Move ``x`` with constant body velocity and turn rate, in place; the transition goes into ``F`` (B, 15, 15)."""
    R0, rate = x.R_world_imu, x.gyro_bias
    E, J = se3.so3_exp_and_right_jacobian(rate * dt)
    R1 = R0 @ E
    u = transpose(R0) @ x.velocity[:, :, None]
    v1 = R1 @ u
    turned = se3.skew((E @ u)[:, :, 0])
    straight = se3.skew(u[:, :, 0])
    J *= dt

    A = R1 @ transpose(R0)
    B = R0 @ (E @ straight - turned)
    C = -(R1 @ straight) @ J
    F[:, V, V], F[:, V, TH], F[:, V, BG] = A, B, C
    # The position moves with the mean of the two velocities.
    F[:, P, V] = 0.5 * dt * (A + np.eye(3))
    F[:, P, TH], F[:, P, BG] = 0.5 * dt * B, 0.5 * dt * C
    F[:, TH, TH], F[:, TH, BG] = transpose(E), J

    x.position = x.position + 0.5 * dt * (x.velocity + v1[:, :, 0])
    x.velocity = v1[:, :, 0]
    x.R_world_imu = R1


def imu_densities(noise: ImuNoise) -> Array:
    """(15,) spectral densities of the white noise that drives an IMU's state."""
    driven = noise.acc_density_mps2_sqrthz, noise.gyro_density_radps_sqrthz
    walks = noise.acc_walk_mps3_sqrthz, noise.gyro_walk_radps2_sqrthz
    return np.repeat(np.square([0.0, *driven, *walks]), 3)


def constant_velocity_densities(noise: ConstantVelocityNoise) -> Array:
    """The same for the constant-velocity model: the turn rate walks and the attitude integrates it."""
    return np.repeat(np.square([0.0, noise.acceleration, 0.0, 0.0, noise.angular_acceleration]), 3)


def process_noise(densities: Array, dt: float, with_imu: bool) -> Array:
    """(15, 15) covariance added over ``dt``: white noise, integrated once more into the position, and without an IMU
    that of the turn rate into the attitude."""
    Q = np.diag(densities * dt)
    for slow, fast in ((P, V),) if with_imu else ((P, V), (TH, BG)):
        q = float(densities[fast.start])
        Q[slow, slow] += np.eye(3) * (q * dt**3 / 3.0)
        Q[slow, fast] = Q[fast, slow] = np.eye(3) * (q * dt * dt / 2.0)
    return Q


def constant_velocity_noise(records: Sequence[VoRecord]) -> ConstantVelocityNoise:
    """How much the vehicle's velocity and turn rate walk while it moves, from the log itself: robust spread of their
    changes from frame to frame, or what explains the fiercest second, whichever is more. Rest does not count, and
    cruising not alone: a filter that takes the vehicle to stay so rejects the motions of its start, which differ
    little from frame to frame, but for long.

    VO's own noise is in these changes too, which errs on the wide side.
    """
    usable = [r for r in records if r.usable and r.dt_s > 0 and np.isfinite(r.T_prev_cur).all()]
    if len(usable) < 3:
        return ConstantVelocityNoise()
    dt = np.array([r.dt_s for r in usable])
    end = np.array([(r.t_ns - usable[0].t_ns) * 1e-9 for r in usable])
    twist = se3.log(np.array([r.T_prev_cur for r in usable])) / dt[:, None]
    second = max(5, round(1.0 / float(np.median(dt))))
    walks = []
    for n, size in ((1, _walk), (second, _fiercest)):
        # The means of a walk over two stretches, one after the other, differ by the variance of this much time.
        walked = (end - 0.5 * dt)[n:] - (end - 0.5 * dt)[:-n] - (dt[n:] + dt[:-n]) / 6.0
        apart = end[n:] - dt[n:] > end[:-n] - 1e-6
        if apart.any():
            change = np.abs(twist[n:] - twist[:-n])[apart] / np.sqrt(walked[apart, None])
            both = (change[:, :3], twist[n:, :3][apart]), (change[:, 3:], twist[n:, 3:][apart])
            walks.append([size(c.max(axis=1), np.linalg.norm(speed, axis=1), second) for c, speed in both])
    if not walks:
        return ConstantVelocityNoise()
    sigma = np.max(walks, axis=0)
    # The least is for logs without any change: an endoscope's velocity walks by less than a millimetre per second.
    return ConstantVelocityNoise(acceleration=max(sigma[0], 1e-6), angular_acceleration=max(sigma[1], 1e-3))


def _fiercest(change: Array, _: Array, second: int) -> float:
    """Standard deviation of a Gaussian walk whose largest ``change`` (n,) is that of the log, by medians over a second,
    of so many frames: what lasts for a few frames is a failure of VO."""
    blocks = change[: len(change) // second * second].reshape(-1, second)
    return float(np.median(blocks, axis=1).max() / np.sqrt(2.0 * np.log(2.0 * len(blocks)))) if len(blocks) else 0.0


def _walk(change: Array, speed: Array, second: int) -> float:
    """Robust standard deviation of ``change`` (n,) where ``speed`` (n,) is more than a tenth of that in the fastest
    second, of so many frames: what is faster for a few frames is a failure of VO."""
    blocks = speed[: len(speed) // second * second].reshape(-1, second)
    fastest = np.median(blocks, axis=1).max() if len(blocks) else np.median(speed)
    moving = change[speed >= _SHARE_OF_FASTEST * fastest]
    # 1.4826 times the median absolute value is the standard deviation of a Gaussian; the mean of heavy tails.
    return max(1.4826 * float(np.median(moving)), float(np.quantile(moving, 0.9)) / 2)
