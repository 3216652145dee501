"""Where a filter starts, and how certain it claims to be."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.filters.plausible import cleaned, usable
from gpvo.filters.propagation import BA, BG, DEFAULT_IMU_NOISE, TH, Nominal, V
from gpvo.geometry import se3
from gpvo.stats.series import integral, interpolated, median
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuLog

_SLOPE_POSES = 5  # true poses that the velocity at the start is taken from
# Stamps are missing where they are further apart than both. Of both truth and IMU, for an integral that a few lost
# samples do not spoil: so longer than what a filter guesses over (filters.plausible), or interpolates (dataset.errors).
_GAP_S, _GAP_STEPS = 1.0, 10.0
_STRETCH_S, _STRETCHES = 1.0, 15  # that the vertical is measured over: at least so long, at most so many
_ROUNDS, _HUBER = 10, 2.0  # of reweighting; a stretch further off, in sigmas of its three axes together, counts less
_MEDIAN_OF_NORM = 1.54  # of three standard normal numbers
_OVERLAP = 1.5  # the mean of white noise under hats has so many times the variance that it had under separate ones
_REST_S, _REST_SAMPLES = 0.5, 10  # that the vehicle must be at rest for, and IMU samples within that show it
_MOST_GYRO_STD_RADPS, _MOST_ACC_STD_MPS2, _MOST_GYRO_MEAN_RADPS = 0.05, 0.5, 0.1  # of an IMU at rest
_MOST_OFF_GRAVITY_MPS2 = 0.5  # ten sigmas of its bias


@dataclass(frozen=True)
class StartSigmas:
    """Standard deviations of the initial state, one per axis of each block.

    Where the vehicle starts and heads is the origin of what is estimated, and so nearly exact by definition; which way
    is up is not. Truth's own noise comes on top (``gpvo.evaluation.flights.start_sigmas``).
    """

    position_m: float = 1e-4
    velocity_mps: float = 0.02
    tilt_rad: float = 5e-4
    yaw_rad: float = 1e-4
    acc_bias_mps2: float = 0.05
    gyro_bias_radps: float = 5e-3
    turn_rate_radps: float = 0.5  # constant-velocity model: nothing is known about the turn rate


@dataclass(frozen=True)
class Start:
    """An initial estimate (one member) with its covariance (15, 15) and a line that says where it came from.

    ``world_tilt`` (3, 3): covariance of the angles [rad] by which its vertical may differ from the truth's.
    """

    nominal: Nominal
    covariance: Array
    note: str = ""
    world_tilt: Array = field(default_factory=lambda: np.zeros((3, 3)))


def _member(p: Array, v: Array, R: Array, ba: Array, bg: Array) -> Nominal:
    return Nominal(*(np.asarray(a, dtype=np.float64)[None].copy() for a in (p, v, R, ba, bg)))


def from_truth(
    t_ns: NDArray[np.int64], T_world_imu: Array, sigmas: StartSigmas | None = None, *, with_imu: bool = True
) -> Start:
    """Start on the true pose of the first frame.

    ``t_ns`` (n,), ``T_world_imu`` (n, 4, 4): true poses near the start, the first is the start. The velocity is the
    slope of a parabola through the first poses, and as uncertain as these bend otherwise; the biases start at zero.
    """
    sigmas = sigmas or StartSigmas()
    if len(t_ns) < 2:
        raise GpvoError("a start from truth needs true poses of the first two frames", cure="use --init static")
    n = min(len(t_ns), _SLOPE_POSES)
    s = (np.asarray(t_ns[:n]) - t_ns[0]) * 1e-9
    weights = _slope_weights(s)
    slope = weights @ T_world_imu[:n, :3, 3]
    R = T_world_imu[0, :3, :3]
    rate = np.zeros(3) if with_imu else se3.so3_log(R.T @ T_world_imu[1, :3, :3]) / s[1]
    C = _diagonal(sigmas, with_imu)
    if n > 3:
        # One pose less makes a difference that noise explains, or jerk on some axis, of which it shows a known share.
        less = weights - np.append(_slope_weights(s[:-1]), 0.0)
        share = (less @ s**3) / (weights @ s**3)
        seen = (less @ T_world_imu[:n, :3, 3]) ** 2 - (sigmas.position_m * np.linalg.norm(less)) ** 2
        C[V, V] += np.eye(3) * max(float(seen.max()), 0.0) / share**2
    # Tilt and yaw are about world axes; the error state's attitude is about the body's.
    world = np.diag([sigmas.tilt_rad**2, sigmas.tilt_rad**2, sigmas.yaw_rad**2])
    C[TH, TH] = R.T @ world @ R
    velocity_mps = float(np.sqrt(np.diagonal(C[V, V]).max()))
    note = f"truth: position {sigmas.position_m:g} m, velocity {velocity_mps:.2g} m/s (1 sigma)"
    return Start(_member(T_world_imu[0, :3, 3], slope, R, np.zeros(3), rate), C, note)


def slope_sigma(position_m: float, dt_s: float) -> float:
    """Standard deviation [m/s] per axis of :func:`from_truth`'s velocity: of true poses every ``dt_s``, with white
    noise of ``position_m`` per axis each."""
    return position_m * float(np.linalg.norm(_slope_weights(dt_s * np.arange(_SLOPE_POSES, dtype=np.float64))))


def _slope_weights(t_s: Array) -> Array:
    """(n,) what the slope [1/s] at the first of values at ``t_s`` (n,) takes of each, by the least-squares parabola; by
    the line through two."""
    design = np.vander(t_s, min(3, len(t_s)), increasing=True)
    return np.asarray(np.linalg.lstsq(design, np.eye(len(t_s)), rcond=None)[0][1])


def from_rest(
    imu: ImuLog,
    t_ns: int,
    sigmas: StartSigmas | None = None,
    *,
    T_world_imu: Array | None = None,
    up_world: Array | None = None,
    otherwise: str = "use --init truth",
) -> Start:
    """Start from a vehicle at rest at ``t_ns``: tilt from gravity, gyroscope bias from the mean rate.

    ``T_world_imu`` (4, 4): gives position and heading, zero by default; ``up_world``: unit vector (3,), by default z.
    An accelerometer bias tilts the horizon by bias / g; the covariance carries that correlation. Raises
    ``GpvoError``, with ``otherwise`` for a cure, where the IMU says that the vehicle moves.
    """
    sigmas, span, good = sigmas or StartSigmas(), round(_REST_S * 1e9), usable(imu)
    window = good & (imu.t_ns >= t_ns) & (imu.t_ns <= t_ns + span)
    before = good & (imu.t_ns >= t_ns - span) & (imu.t_ns <= t_ns)
    window = before if before.sum() >= _REST_SAMPLES else window
    if window.sum() < _REST_SAMPLES:
        raise GpvoError(f"a static start needs {_REST_SAMPLES} IMU samples within {_REST_S} s of the first frame")
    gyro, acc = imu.gyro_radps[window], imu.acc_mps2[window]
    _require_rest(gyro, acc, otherwise)

    f = acc.mean(axis=0)
    up = f / np.linalg.norm(f)
    T = np.eye(4) if T_world_imu is None else T_world_imu
    R_level_imu, R_level_world = _leveled(up), np.eye(3) if up_world is None else _leveled(up_world)
    yaw_rad = 0.0 if T_world_imu is None else se3.so3_log(R_level_world @ T[:3, :3] @ R_level_imu.T)[2]
    R = R_level_world.T @ se3.so3_exp(np.array([0.0, 0.0, yaw_rad])) @ R_level_imu
    C = _diagonal(sigmas, with_imu=True)
    U = se3.skew(up) / STANDARD_GRAVITY_MPS2
    cov_acc = C[BA, BA] + np.diag(acc.var(axis=0) / len(acc))
    C[TH, TH] = U @ cov_acc @ U.T + np.outer(up, up) * sigmas.yaw_rad**2
    # A little more than the model says keeps the attitude's covariance positive definite along every axis.
    C[TH, TH] += np.eye(3) * 1e-8
    C[TH, BA] = U @ C[BA, BA]
    C[BA, TH] = C[TH, BA].T
    C[BG, BG] = np.diag(gyro.var(axis=0) / len(gyro) + 1e-10)
    C[V, V] = np.eye(3) * 1e-4
    tilt_rad = np.sqrt(np.linalg.eigvalsh(U @ cov_acc @ U.T)[-1])
    note = f"static: {int(window.sum())} IMU samples at rest, tilt {np.degrees(tilt_rad):.2f} deg (1 sigma)"
    return Start(_member(T[:3, 3], np.zeros(3), R, np.zeros(3), gyro.mean(axis=0)), C, note)


def _require_rest(gyro: Array, acc: Array, cure: str) -> None:
    off_gravity = abs(float(np.linalg.norm(acc.mean(axis=0))) - STANDARD_GRAVITY_MPS2)
    limits = (
        ("gyroscope spread", gyro.std(axis=0).max(), _MOST_GYRO_STD_RADPS, "rad/s"),
        ("accelerometer spread", acc.std(axis=0).max(), _MOST_ACC_STD_MPS2, "m/s^2"),
        ("mean turn rate", np.abs(gyro.mean(axis=0)).max(), _MOST_GYRO_MEAN_RADPS, "rad/s"),
        ("specific force off gravity by", off_gravity, _MOST_OFF_GRAVITY_MPS2, "m/s^2"),
    )
    reasons = ", ".join(f"{what} {value:.2g} {unit}" for what, value, limit, unit in limits if value > limit)
    if reasons:
        raise GpvoError(f"the vehicle is not at rest at the start: {reasons}", cure=cure)


def _leveled(up: Array) -> Array:
    """(3, 3) that turns the vertical (3,) of some axes to +z, and the heading axis into the plane of x and z.

    The heading axis is x, or z where x is nearly vertical (a camera-like mounting).
    """
    axis = np.array([1.0, 0, 0]) if abs(up[0]) < 0.8 else np.array([0.0, 0, 1.0])
    level = axis - up * (axis @ up)
    x = level / np.linalg.norm(level)
    return np.stack([x, np.cross(up, x), up])


def vertical_in_world(
    imu: ImuLog, t_ns: NDArray[np.int64], T_world_imu: Array, acc_bias_mps2: float
) -> tuple[Array, Array]:
    """Unit vector (3,) of the vertical, and the covariance (3, 3) of the angles [rad] about the world's axes by which
    it may be wrong, where a bias of the accelerometer has this standard deviation.

    From one stretch to the next the mean velocity changes by the acceleration under a hat as wide as both: no slope of
    truth's path is needed, which sparse poses do not tell. The specific force under that hat, in the world, less that
    is gravity's reaction plus the bias, turned as the vehicle was: what turns with it is bias, the rest is up. Least
    squares over many hats with Huber's weights, which readings of a failing IMU do not move far.
    """
    imu, t_s = cleaned(imu), (t_ns - t_ns[0]) * 1e-9
    unseen = _gaps(t_s, t_s) | _gaps((imu.t_ns - t_ns[0]) * 1e-9, t_s)
    seen_s = np.append(0.0, np.cumsum(np.where(unseen, 0.0, np.diff(t_s))))
    count = int(np.clip(seen_s[-1] / _STRETCH_S, 2, _STRETCHES))
    ends = np.unique(np.searchsorted(seen_s, np.linspace(0.0, seen_s[-1], count + 1)))
    rising, falling = _under_slopes(imu, t_ns, T_world_imu, ends)
    if len(ends) < 3:  # two poses tell no acceleration: it is taken to be none
        means = (rising + falling) / t_s[-1]
    else:
        means = rising[:-1] + falling[1:]
        means[:, :, 0] -= np.diff(np.diff(T_world_imu[ends, :3, 3], axis=0) / np.diff(t_s[ends])[:, None], axis=0)
        means /= 0.5 * (t_s[ends][2:] - t_s[ends][:-2])[:, None, None]
        whole = np.array([not unseen[first:last].any() for first, last in zip(ends[:-2], ends[2:], strict=True)])
        means = means[whole] if whole.any() else means
    seen, turned = means[:, :, 0], means[:, :, 1:]
    X = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2)
    prior = np.diag(np.repeat([0.0, acc_bias_mps2**-2], 3))
    x = np.append(np.median(seen, axis=0), np.zeros(3))
    density = (imu.noise or DEFAULT_IMU_NOISE).acc_density_mps2_sqrthz
    least = density * float(np.sqrt(_OVERLAP**-1 / seen_s[-1] * count))
    free = seen.size - 3.0
    for _ in range(_ROUNDS):
        off = np.linalg.norm(seen - X @ x, axis=1)
        sigma = max(float(np.median(off)) / _MEDIAN_OF_NORM * np.sqrt(seen.size / max(free, 1.0)), least)
        weight = sigma**-2 / _OVERLAP / np.maximum(off / (_HUBER * sigma), 1.0)
        fitted = np.einsum("n,nij,nik->jk", weight, X, X)
        C = np.linalg.inv(fitted + prior)
        x = C @ np.einsum("n,nij,ni->j", weight, X, seen)
        free = seen.size - float(np.trace(C @ fitted))  # the prior fits what the stretches leave open
    up, g = x[:3] / np.linalg.norm(x[:3]), float(np.linalg.norm(x[:3]))
    turn = se3.skew(up) / g  # an error of the vector turns it by up x error / g
    return up, turn @ C[:3, :3] @ turn.T


def _gaps(s: Array, t_s: Array) -> NDArray[np.bool_]:
    """(N - 1,) which intervals between these stamps ``t_s`` (N,) [s] lie, in part, where stamps ``s`` are missing."""
    step_s = np.diff(s)
    last = np.flatnonzero(step_s > max(_GAP_S, _GAP_STEPS * median(step_s)))  # before each gap
    return np.searchsorted(s[last], t_s[1:]) > np.searchsorted(s[last + 1], t_s[:-1], side="right")


def _under_slopes(
    imu: ImuLog, t_ns: NDArray[np.int64], T_world_imu: Array, ends: NDArray[np.int64]
) -> tuple[Array, Array]:
    """(n, 3, 4) each: integrals over the stretches between these ``ends`` (n + 1,) of specific force and, per unit of
    each axis, bias, both in the world, times a weight that rises from 0 to 1, and one that falls.

    Between the true poses the gyroscope turns the IMU; what it misses until the next pose is spread evenly.
    """
    t_s, imu_s = (t_ns - t_ns[0]) * 1e-9, (imu.t_ns - t_ns[0]) * 1e-9
    R_true, slopes = T_world_imu[:, :3, :3], []
    turned = integral(imu.gyro_radps, imu_s)
    step = np.swapaxes(R_true[:-1], 1, 2) @ R_true[1:]
    by_gyro = se3.so3_exp(np.diff(interpolated(t_s, imu_s, turned), axis=0))
    missed = se3.so3_log(np.swapaxes(by_gyro, 1, 2) @ step)
    for first, last in pairwise(ends.tolist()):
        at_s = np.union1d(t_s[first : last + 1], imu_s[(imu_s > t_s[first]) & (imu_s < t_s[last])])
        k = np.clip(np.searchsorted(t_s, at_s, side="right") - 1, first, last - 1)
        share = (at_s - t_s[k]) / (t_s[k + 1] - t_s[k])
        since = interpolated(at_s, imu_s, turned) - interpolated(t_s[k], imu_s, turned)
        R = R_true[k] @ se3.so3_exp(since) @ se3.so3_exp(share[:, None] * missed[k])
        rates = np.concatenate([R @ interpolated(at_s, imu_s, imu.acc_mps2)[:, :, None], R], axis=2).reshape(-1, 12)
        rise = ((at_s - at_s[0]) / (at_s[-1] - at_s[0]))[:, None]
        slopes.append([integral(rates * weight, at_s)[-1].reshape(3, 4) for weight in (rise, 1.0 - rise)])
    return np.array([s[0] for s in slopes]), np.array([s[1] for s in slopes])


def tilt_of(up: Array) -> tuple[float, Array]:
    """Angle [rad] from z to a unit vector (3,), and the axis (3,) about which to turn; zeros where there is none."""
    across = np.cross([0.0, 0.0, 1.0], up)
    sine = float(np.linalg.norm(across))
    return float(np.arctan2(sine, up[2])), across / max(sine, np.finfo(float).tiny)


def _diagonal(sigmas: StartSigmas, with_imu: bool) -> Array:
    rate = sigmas.gyro_bias_radps if with_imu else sigmas.turn_rate_radps
    blocks = (sigmas.position_m, sigmas.velocity_mps, sigmas.tilt_rad, sigmas.acc_bias_mps2, rate)  # P, V, TH, BA, BG
    return np.diag(np.repeat([sigma**2 for sigma in blocks], 3))
