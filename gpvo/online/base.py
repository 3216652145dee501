"""What is known before a GP learns anything: the variance of a motion, and how fast the vehicle is.

The variance is, per axis, a sum of physical parts:

``v_j = a_j g_j + b_j + c_j |t|^2 + d_j |phi|^2 + e_j r^2 g_j``: the geometric variance g (noise of one pixel carried
through the geometry) or the one that another odometry states for its motions, a floor, parts that grow with the motion
(S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics" (2005), section 5.4), and the geometry at the noise r that the
motion's own residuals show (the variance of unit weight in least squares: W. Foerstner, B. Wrobel, "Photogrammetric
Computer Vision" (2016), equation 4.90).
Coefficients are never negative, so the variance never shrinks when a part grows. The GP learns the log ratio to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpvo.geometry import se3
from gpvo.online.features import AXES
from gpvo.online.stored import Stored
from gpvo.types import Array

TWIST_COLUMNS = ("v_x_mps", "v_y_mps", "v_z_mps", "w_x_radps", "w_y_radps", "w_z_radps")
ACCELERATION_COLUMNS = ("acceleration_mps2", "angular_acceleration_radps2")
RESIDUAL_COLUMN = "ln_residual_px"
N_PARTS = 5
OF_MOTION = np.array([0.0, 1.0, 1.0, 1.0, 0.0])
"""Which parts of the base variance depend on the motion alone."""
COASTED = (1, 2, 5, 10, 20, 50)
"""Numbers of usual motions over which training shows how much a velocity changes."""


def base_columns(method: str | None, residual: bool = False) -> tuple[str, ...]:
    """Feature columns that the base variance needs; ``method`` None if there is no geometric covariance."""
    geometry = () if method is None else tuple(f"ln_var_{method}_{a}" for a in AXES)
    return TWIST_COLUMNS + geometry + ((RESIDUAL_COLUMN,) if residual else ())


@dataclass(frozen=True)
class BaseVariance(Stored):
    """``theta`` (6, 5): coefficients of geometry, floor, squared translation and rotation of the motion, and geometry
    at the residuals' noise.

    ``theta_plain`` (6, 5): the same fitted to the motion alone, because what odometry says about itself means the same
    as in training only in similar surroundings. ``method``: name of that covariance, None without one (its
    coefficients are then 0). ``residual``: whether it uses the residuals.
    """

    theta: Array
    theta_plain: Array
    method: str | None
    residual: bool = False

    @property
    def columns(self) -> tuple[str, ...]:
        """Feature columns that it needs, in order."""
        return base_columns(self.method, self.residual)

    def __call__(self, columns: Array, dt_s: Array) -> tuple[Array, Array]:
        """(n, 6) variance, and the plain one, from (n, c) values of its columns and durations of the motions (n,)."""
        terms = parts(columns, dt_s)
        return (terms * self.theta).sum(-1), (terms * self.theta_plain).sum(-1)


def parts(columns: Array, dt_s: Array) -> Array:
    """(n, 6, 5) geometry, one, squared translation [m^2], squared rotation [rad^2], geometry at r."""
    out = np.ones((len(columns), 6, N_PARTS))
    out[:, :, 0] = np.exp(columns[:, 6:12]) if columns.shape[1] >= 12 else 0.0
    square = (columns[:, :6] * dt_s[:, None]) ** 2
    out[:, :, 2:4] = square.reshape(-1, 2, 3).sum(-1)[:, None]
    out[:, :, 4] = out[:, :, 0] * np.exp(2.0 * columns[:, 12:13]) if columns.shape[1] > 12 else 0.0
    return out


def positions(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Where each wanted column is among ``names``."""
    place = {n: i for i, n in enumerate(names)}
    return [place[w] for w in wanted]


def motion_noise(names: Sequence[str]) -> tuple[Array, Array]:
    """(6, d) each: which features ``names`` have the variance of the motion, over dt^2 and dt^4, as their own.

    They are VO's velocities and accelerations; an acceleration is the difference of two velocities, taken to be equally
    uncertain.
    """
    by_velocity, by_acceleration = np.zeros((6, len(names))), np.zeros((6, len(names)))
    for i, name in enumerate(names):
        if name in TWIST_COLUMNS:
            by_velocity[TWIST_COLUMNS.index(name), i] = 1.0
        if name in ACCELERATION_COLUMNS:
            block = ACCELERATION_COLUMNS.index(name)
            by_acceleration[3 * block : 3 * block + 3, i] = 2.0
    return by_velocity, by_acceleration


def feature_noise(carry: tuple[Array, Array], variance: Array, dt_s: Array) -> Array:
    """(n, d) variance of the features, by :func:`motion_noise`, for motions of given variance (n, 6), duration (n,)."""
    by_velocity, by_acceleration = carry
    squared = dt_s[:, None] ** 2
    return np.asarray((variance @ by_velocity + variance @ by_acceleration / squared) / squared)


@dataclass(frozen=True)
class Velocities(Stored):
    """``usual_rate_var`` (6,): mean square velocity in training [m^2/s^2, rad^2/s^2]. ``rate_change_var`` (K, 6): of
    the true one's changes over :data:`COASTED` motions."""

    usual_rate_var: Array
    rate_change_var: Array

    def largest_error_var(self, rate: Array, duration_s: Array) -> Array:
        """(n, 6) as wrong as a motion of velocity (n, 6) and duration (n,) can be: VO's motion less the true one is no
        longer than both together, whatever is said of its variance."""
        return _block_sums((rate**2 + self.usual_rate_var) * duration_s[:, None] ** 2)

    def lost_covariance(
        self, step_s: float, dt_s: float, age_s: float, rate: Array, rate_var: Array, jump: Array
    ) -> Array:
        """(6, 6) mean square error of a lost motion of duration ``dt_s``, about which nothing was measured.

        The vehicle is assumed to keep the velocity ``rate`` (6,) [m/s, rad/s] of ``age_s`` ago, known to ``rate_var``
        (6,), give or take how much velocities changed in training over such a time, or more if it is faster than usual
        there; at most, and after longer times than in training, the error is as large as the velocity. ``jump`` (6,)
        [m, rad]: by how much the motion given differs from that velocity's; the error has its direction, and is at most
        as long. ``step_s``: the usual duration.
        """
        lags = step_s * np.array(COASTED)
        change = np.array([np.interp(age_s, lags, of_axis, right=np.inf) for of_axis in self.rate_change_var.T])
        speed2 = _block_sums(rate**2)
        faster = np.maximum(speed2 / _block_sums(self.usual_rate_var), 1.0)
        changed = np.minimum(change * faster, np.maximum(self.usual_rate_var, speed2))
        # What is wrong with the velocity acts at the end of the jump, of which a turn is a lever.
        A = se3.right_jacobian_inverse(-jump)
        return A * ((changed + rate_var) * dt_s**2) @ A.T + np.outer(jump, jump)


def _block_sums(values: Array) -> Array:
    """(..., 6) sums over the axes of the translation, three times, and over those of the rotation."""
    return np.repeat(values.reshape(*values.shape[:-1], 2, 3).sum(axis=-1), 3, axis=-1)
