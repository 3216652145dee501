"""The noise of the ground truth itself: how large it is, what it adds to errors, and over what length of path it leaves
odometry's errors visible.

A truth is noisy in two ways that show from one frame to the next: each pose is off by white noise, and its stamp by
jitter, which moves the pose along its way (KITTI's cameras are paired with the nearest of GPS/INS poses 10 ms apart).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import comb

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.errors import MotionErrors, interpolate_truth
from gpvo.geometry import se3
from gpvo.geometry.covariance import compound, symmetrise
from gpvo.stats.series import block_bootstrap, integral, interpolated, moving_sums
from gpvo.types import Array, TruthLog, VoLog

_ORDER = 3
"""Differences of the poses. Vehicles have little of a third one at 10 Hz, where white noise has the most."""
_GAIN = comb(2 * _ORDER, _ORDER)  # of the variance of white noise by so many differences
_MIN_ROWS = 60
_MIN_SHARE = 0.25
"""Share of the truth's high-passed motion that the odometry must lack: an error of its scale lacks a few hundredths."""
_MAX_LAG1 = -0.4
"""White noise has a correlation of -0.75 there; what an odometry smooths away of a real motion has less."""
_EVEN_DT = 0.2
_OUTLIER = 6.0
_ROUNDS, _LEAST_SPREAD = 20, 1e-3
_SAME = 3e-4
"""Of the motion: what odometry and truth differ by from one motion to the next if one was made from the other. Graphs
that close loops leave 1e-5 (on the road, with four decimals, 1e-4); cameras and truths of their own over 5e-3."""
_MIN_WINDOWS = 10
_TOGETHER = 4  # windows of a second whose drifts may be alike


@dataclass(frozen=True)
class TruthNoise:
    """White noise ``sigma`` (6,) [m, rad] of each pose, by axis of the camera, and jitter ``jitter_s`` of its stamp."""

    sigma: Array = field(default_factory=lambda: np.zeros(6))
    jitter_s: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.sigma.any() or self.jitter_s)

    def of_poses(self, rates: Array) -> Array:
        """Covariance (N, 6, 6) of poses, right perturbation, that move at ``rates`` (N, 6) [m/s, rad/s]."""
        way = self.jitter_s * np.asarray(rates)
        return np.asarray(np.diag(self.sigma**2) + way[:, :, None] * way[:, None, :])

    def usual(self, rates: Array) -> Array:
        """(6,) root mean square of it over the poses."""
        way2 = (np.asarray(rates) ** 2).mean(axis=0) if len(rates) else np.zeros(6)
        return np.sqrt(self.sigma**2 + self.jitter_s**2 * way2)


def of_errors(errors: MotionErrors, log: VoLog, of_poses: Array) -> Array:
    """(M, 6, 6) covariance that the noise ``of_poses`` (N, 6, 6) at the frames adds to the errors of motions:
    ``S_end + Ad(T)^-1 S_start Ad(T)^-T``."""
    return compound(errors.T_true, of_poses[log.parent[errors.index]], of_poses[errors.index])


def of_stamps(
    noise: TruthNoise, log: VoLog, truth: TruthLog, t_prev_ns: NDArray[np.int64], t_ns: NDArray[np.int64]
) -> Array:
    """(n, 6, 6) the same for motions between stamps (n,) of frames of the log."""
    T, known = interpolate_truth(truth, log.t_ns)
    of_poses = noise.of_poses(rates_of(T, log.t_ns, known))
    start, end = (np.searchsorted(log.t_ns, t).clip(max=len(T) - 1) for t in (t_prev_ns, t_ns))
    return symmetrise(compound(se3.inverse(T[start]) @ T[end], of_poses[start], of_poses[end]))


def rates_of(T: Array, t_ns: NDArray[np.int64], known: NDArray[np.bool_]) -> Array:
    """(N, 6) velocity of poses (N, 4, 4) [m/s, rad/s, in their own axes] between their neighbours, where these are
    ``known`` (N,); 0 without any."""
    each = np.arange(len(T))
    before, after = np.maximum(each - 1, 0), np.minimum(each + 1, len(T) - 1)
    before, after = np.where(known[before], before, each), np.where(known[after], after, each)
    dt_s = 1e-9 * (t_ns[after] - t_ns[before])
    moved = se3.log(se3.inverse(T[before]) @ T[after])
    return np.where(known[:, None] & (dt_s > 0)[:, None], moved / np.maximum(dt_s, 1e-9)[:, None], 0.0)


def estimate_truth_noise(errors: MotionErrors, log: VoLog) -> TruthNoise:
    """What noise of the truth shows beside odometry; none where none does.

    Jitter of stamps, GPS/INS and motion capture put noise n_k on each pose, so that a true motion m_k is reported
    as ``u_k = m_k + n_k - n_(k-1)``. Odometry reports ``m_k`` with errors of its own. High-passed until little is left
    of m_k, what the truth has and the odometry lacks is the truth's noise: ``Cov(u, u - odometry)`` gives its variance,
    whatever noise, jitter included, the odometry itself has (two instruments for one quantity: F. E. Grubbs, "On
    estimating precision of measuring instruments and product variability", 1948). An axis counts where the 95 %
    interval of its variance, by blocks of time, lies above zero.

    Of these axes, what grows with the square of the velocity, alike on all, is jitter of the stamps if its interval
    lies above zero too; it then holds for every axis along which the camera moves. The rest is white.
    """
    told, lacks, first = _high_passed(errors, log)
    if len(told) < _MIN_ROWS:
        return TruthNoise()
    good = np.abs(lacks) <= _OUTLIER * 1.4826 * np.median(np.abs(lacks), axis=0)  # a slip of the odometry is no noise
    products, follow = told * lacks / _GAIN, np.diff(first) == 1
    shown = [k for k in range(6) if _shows(told[:, k], lacks[:, k], good[:, k], follow)]
    way2 = (se3.log(errors.T_est) / errors.dt_s[:, None]) ** 2  # the truth's own velocities hold its noise
    way2 = np.mean([way2[first + k] for k in range(_ORDER)], axis=0)
    jitter2 = _jitter_variance(told[:, shown], lacks[:, shown], way2[:, shown], good[:, shown]) if shown else 0.0
    sigma = np.zeros(6)
    for k in shown:
        rest = block_bootstrap((products - jitter2 * way2)[good[:, k], k])
        sigma[k] = np.sqrt(rest.mean) if rest.low > 0 else 0.0
    return TruthNoise(sigma, float(np.sqrt(jitter2)))


def _shows(told: Array, lacks: Array, good: NDArray[np.bool_], follow: NDArray[np.bool_]) -> bool:
    """Whether what odometry ``lacks`` (n,) of what the truth has ``told`` (n,) is the truth's noise, and not odometry's
    scale or smoothing; of rows that are ``good`` (n,) and, but the last, followed by the next motion's (n - 1,)."""
    variance = block_bootstrap(told[good] * lacks[good])
    pairs = good[:-1] & good[1:] & follow
    neighbours = 0.5 * np.mean(told[:-1][pairs] * lacks[1:][pairs] + told[1:][pairs] * lacks[:-1][pairs])
    enough = variance.low > 0 and variance.mean > _MIN_SHARE * np.mean(told[good] ** 2)
    return bool(enough and neighbours < _MAX_LAG1 * variance.mean)


def _non_negative(A: Array, y: Array) -> Array:
    """(k,) least squares of (n, k) for (n,), without what would be negative; 0 for a column of zeros."""
    size, theta = np.linalg.norm(A, axis=0), np.zeros(A.shape[1])
    free = size > 0
    while free.any():
        found = np.linalg.lstsq(A[:, free] / size[free], y, rcond=None)[0] / size[free]
        if (found >= 0).all():
            theta[free] = found
            break
        free[np.flatnonzero(free)[found < 0]] = False
    return theta


def _jitter_variance(told: Array, lacks: Array, way2: Array, good: NDArray[np.bool_]) -> float:
    """Variance of the stamps [s^2] from k axes (n, k): what of the variance goes with the squared velocities ``way2``,
    beside a constant of each axis; 0 if the 95 % interval holds it.

    Least squares, weighted by the variance of a product of two Gaussians, ``E a^2 E b^2 + (E a b)^2``, of which the
    part that truth and odometry share changes with the velocity.
    """
    n, k = told.shape
    told, lacks = (np.where(good, x, 0.0) for x in (told, lacks))
    product = told * lacks / _GAIN
    X = np.concatenate([way2[:, :, None], np.broadcast_to(np.eye(k), (n, k, k))], axis=2)
    X, stated, kept = np.where(good[:, :, None], X, 0.0), np.zeros((n, k)), np.maximum(good.sum(axis=0), 1)
    for _ in range(_ROUNDS):
        both = _GAIN * stated
        usual = (good * both).sum(axis=0) / kept
        own = [np.maximum((x**2).sum(axis=0) / kept - usual, 0.0) for x in (told, lacks)]
        spread = np.sqrt((both + own[0]) * (both + own[1]) + both**2) / _GAIN
        spread = np.maximum(spread, _LEAST_SPREAD * spread.mean(axis=0))
        A, y = (X / spread[:, :, None]).reshape(n * k, k + 1), (product / spread).ravel()
        theta = _non_negative(A, y)
        stated = theta[0] * way2 + theta[1:]
    free = theta > 0
    if not free[0]:
        return 0.0
    by = np.linalg.pinv(A[:, free])[0] * y
    found = block_bootstrap(len(told) * by.reshape(n, k).sum(axis=1))
    return float(theta[0]) if found.low > 0 else 0.0


def made_from_odometry(errors: MotionErrors, log: VoLog) -> bool:
    """Whether the truth seems to be the odometry's own path, as closing loops bends it.

    That spreads a drift evenly over the motions, so that the errors show it, but none of the odometry's noise: from one
    motion to the next, the two agree better than any two measurements do.
    """
    lacks = _high_passed(errors, log)[1][:, :3]
    if len(lacks) < _MIN_ROWS:
        return False
    differ = np.median(np.linalg.norm(lacks, axis=1)) / np.sqrt(comb(2 * (_ORDER - 1), _ORDER - 1))
    return bool(differ < _SAME * np.median(np.linalg.norm(errors.T_true[:, :3, 3], axis=1)))


def _high_passed(errors: MotionErrors, log: VoLog) -> tuple[Array, Array, NDArray[np.int64]]:
    """Second differences (n, 6) of the truth's motions and of what odometry lacks of them, and their first rows (n,),
    over motions from the frame before of one length in time."""
    steps = _ORDER - 1
    if len(errors.index) <= steps:
        return np.zeros((0, 6)), np.zeros((0, 6)), np.zeros(0, dtype=np.int64)
    told, lacks = (np.diff(x, n=steps, axis=0) for x in (se3.log(errors.T_true), -errors.xi))
    usual = np.median(errors.dt_s)
    even = (np.abs(errors.dt_s - usual) <= _EVEN_DT * usual) & (log.parent[errors.index] == errors.index - 1)
    whole = moving_sums(even, steps + 1) == steps + 1
    whole &= errors.index[steps:] - errors.index[: len(errors.index) - steps] == steps
    rows = np.flatnonzero(whole).astype(np.int64)
    return told[rows], lacks[rows], rows


def telling_distance_m(log: VoLog, T_true: Array, known: NDArray[np.bool_], sigma: Array) -> float:
    """Length of path [m] from which odometry's errors of position outweigh the truth's noise ``sigma`` (6,).

    0 where each single motion tells, inf where no stretch of the run does. ``T_true`` (N, 4, 4), ``known`` (N,).
    """
    if not sigma.any():
        return 0.0
    T_est, whole = log.trajectory(), known & (log.usable | (np.arange(len(log)) == 0))
    broken, path_m = np.cumsum(~whole), se3.path_length_m(T_true[:, :3, 3])
    span = 1
    while span < len(log) - _MIN_WINDOWS:
        start = np.flatnonzero(broken[span:] == broken[:-span])
        start = start[whole[start]]
        if len(start) < _MIN_WINDOWS:
            break
        true, said = (se3.inverse(T[start]) @ T[start + span] for T in (T_true, T_est))
        error = (se3.inverse(true) @ said)[:, :3, 3]
        # Both errors, of odometry and of two poses of truth, are in there; a slip shall not speak for all.
        if np.median((error**2).sum(axis=1)) > 2 * 2 * (sigma[:3] ** 2).sum():
            return 0.0 if span == 1 else float(np.median(path_m[start + span] - path_m[start]))
        span *= 2
    return float("inf")


def velocity_path(truth: TruthLog, t_ns: NDArray[np.int64]) -> Array | None:
    """(N, 3) where the truth's own velocities lead until the stamps (N,) [m, world]; None where it has none."""
    if truth.v_world_mps is None:
        return None
    t_s = (truth.t_ns - truth.t_ns[0]) * 1e-9
    at_s = (np.asarray(t_ns) - truth.t_ns[0]) * 1e-9
    return interpolated(at_s, t_s, integral(truth.v_world_mps, t_s))


def drift_variance(contradiction: Array, error: Array) -> Array:
    """(3,) variance of the truth's displacements over windows (W, 3) [m^2]; 0 where the 95 % interval holds zero.

    GPS/INS positions drift, by decimetres within seconds, where satellites are hidden. High-passing cannot show this,
    but a third instrument can: a truth that also measures velocities gives each displacement twice, and where the two
    differ, one is wrong. ``Cov(positions - velocities, positions - odometry)`` is the variance of the positions.

    ``contradiction``: displacements by the truth's positions less those by its velocities; ``error``: those by odometry
    less those by the positions; both in axes of the camera.
    """
    found = [block_bootstrap(product, _TOGETHER) for product in -(contradiction * error).T]
    return np.array([v.mean if v.low > 0 else 0.0 for v in found])
