"""How a motion's variance divides into jitter, white and bias: the same arithmetic in training and in flight."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from gpvo.geometry.covariance import correlation, is_positive_definite, scaled_root, symmetrise
from gpvo.online.stored import Stored
from gpvo.types import Array, MotionError

PARTS = ("jitter", "white", "bias")
LN_FASTEST = float(np.log(20.0))
LEAST_LEFT = 1e-6  # Of a variance, whatever a wrong calibration takes.
_RIDGE = 1e-6 * np.eye(6)


@dataclass(frozen=True, kw_only=True)
class Division(Stored):
    """What is needed to divide a variance into the parts of the error; axes in the order of the tangent vector.

    ``share`` (3, 6): how the variance divides among jitter, white and bias at the log variance ``level`` (6,) and the
    typical speed, whose log is ``ln_speed`` (1,) [m/s]; ``growth`` (2, 6): how that changes (see :func:`divide`).
    ``correlation`` (3, 6, 6) of the parts, the first two mixed with the geometry's by ``geometry_weight`` (1,).
    ``bias_tau_s`` (6,): of the bias. ``calibration_patterns`` (6, 6, 6): the ways a calibration can be wrong (see
    :func:`of_calibration`), and ``calibration_tau_s`` (6,): how long each stays the same.
    """

    share: Array
    growth: Array
    level: Array
    ln_speed: Array
    correlation: Array
    geometry_weight: Array
    bias_tau_s: Array
    calibration_patterns: Array = field(default_factory=lambda: np.zeros((6, 6, 6)))
    calibration_tau_s: Array = field(default_factory=lambda: np.ones(6))

    @cached_property
    def persistent_tau_s(self) -> Array:
        """(12,) time constants of the bias and of errors of calibration."""
        return np.concatenate([self.bias_tau_s, self.calibration_tau_s])

    def split(self, variance: Array, twist: Array, geometry: Array | None, steps: Array) -> MotionError:
        """The errors of motions by their parts, without a mean, from variances (n, 6).

        ``twist`` (n, 6): velocities. ``geometry`` (n, 6, 6): covariances, NaN where unknown. ``steps`` (n,): durations,
        in usual ones. Pixel noise, which is jitter and white, is correlated as the geometry says; the bias has its own
        pattern.
        """
        root, rest = np.zeros((len(variance), 6, 6)), variance
        if self._calibrated:
            root, rest = of_calibration(variance, self.calibration_patterns, twist * steps[:, None])
        share = divide(self.share, self.growth, np.log(rest) - self.level, ln_faster(twist[:, :3], self.ln_speed))
        sigma = np.sqrt(share * rest[:, None, :])
        noise = self._correlations(len(variance), geometry) * sigma[:, :2, :, None] * sigma[:, :2, None, :]
        return MotionError(
            mean=np.zeros((len(variance), 6)),
            jitter=noise[:, 0],
            white=noise[:, 1],
            persistent_root=np.concatenate([sigma[:, 2, :, None] * self._bias_root, root], axis=-1),
            persistent_tau_s=self.persistent_tau_s,
        )

    def _correlations(self, n: int, geometry: Array | None) -> Array:
        """(n, 2, 6, 6) of jitter and white."""
        own, w = self.correlation[:2], float(self.geometry_weight[0])
        if geometry is None or w == 0.0:
            return np.broadcast_to(_regular(own), (n, 2, 6, 6))
        mixed = w * _correlations(geometry)[:, None] + (1.0 - w) * own
        unknown = np.isnan(mixed[:, 0, 0, 0])
        if unknown.any():
            mixed[unknown] = own
        return _regular(mixed)

    @cached_property
    def _calibrated(self) -> bool:
        return bool(self.calibration_patterns.any())

    @cached_property
    def _bias_root(self) -> Array:
        return scaled_root(_regular(self.correlation[2]))


def divide(share: Array, growth: Array, above: Array, faster: Array) -> Array:
    """(n, 3, D) shares of jitter, white and bias, summing to one.

    ``share`` (3, D) holds at the typical speed and variance. White and bias gain on the jitter by the power
    ``growth[0]`` of the speed, whose log over the typical one is ``faster`` (n, 1), and the bias by the power
    ``growth[1]`` of the variance, whose log over the typical one is ``above`` (n, D); ``growth`` (2, D).
    """
    out = np.empty((len(above), *share.shape))
    by_speed = growth[0] * faster
    out[:, 0] = share[0]
    out[:, 1] = share[1] * np.exp(by_speed)
    # The exponent is bounded where the bias is all there is, or nothing.
    out[:, 2] = share[2] * np.exp(by_speed + np.minimum(np.maximum(growth[1] * above, -60.0), 60.0))
    return out / out.sum(axis=1, keepdims=True)


def of_calibration(variance: Array, patterns: Array, twist: Array) -> tuple[Array, Array]:
    """The share of a wrong calibration in variances (n, D): its root (n, D, P), and what is left of them (n, D).

    A wrong baseline, focal length or rectification makes errors that are linear in the motion and reverse with it: a
    scale that is 1 % off adds on the way out what it takes back on the way home. Each of ``patterns`` (P, D, 6) is one
    way to be wrong, by its usual amount: the error of a motion of the usual duration at unit velocities. ``twist``
    (n, 6) [m/s, rad/s]: velocities, times the duration over the usual one; unknown ones contribute nothing. However
    fast the motion, a millionth of the variance is left.
    """
    P, D, _ = patterns.shape
    known = np.where(np.isfinite(twist), twist, 0.0)
    root = (known @ patterns.reshape(P * D, 6).T).reshape(-1, P, D).swapaxes(1, 2)
    left = variance / (variance + (root**2).sum(axis=-1))
    return root * np.sqrt(left)[..., None], variance * np.maximum(left, LEAST_LEFT)


def ln_faster(v_mps: Array, ln_typical: ArrayLike) -> Array:
    """(n, 1) log of the speed of (n, 3) over the typical one, from 0 to that of twenty times it; 0 where unknown.

    Slower than typical counts as typical: if errors grew only with distance, none would add up at rest, but they do
    with time, and a filter that is told otherwise absorbs them into its biases.
    """
    speed = np.sqrt((v_mps**2).sum(axis=1, keepdims=True))
    ratio = np.log(np.maximum(speed, 1e-9)) - ln_typical
    return np.where(np.isfinite(ratio), np.minimum(np.maximum(ratio, 0.0), LN_FASTEST), 0.0)


def _regular(correlation: Array) -> Array:
    """One part in a million of the identity keeps a nearly singular geometry positive definite after rounding."""
    return correlation * (1.0 - 1e-6) + _RIDGE


def _correlations(geometry: Array) -> Array:
    """(n, 6, 6) correlations of covariances; NaN throughout where one is not positive semidefinite."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        R = symmetrise(correlation(geometry))
    ridge = R + _RIDGE
    try:
        good = np.isfinite(np.linalg.cholesky(ridge)).all()
    except np.linalg.LinAlgError:
        good = np.False_
    if not good:
        R[[not is_positive_definite(C) for C in ridge]] = np.nan
    return R
