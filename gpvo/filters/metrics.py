"""How good a filtered run is: its error against truth, and whether the filter knew its own error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpvo.geometry import se3
from gpvo.stats.consistency import nees
from gpvo.stats.series import Interval, block_bootstrap
from gpvo.types import Array

# A run counts as diverged where the position error passes this share of the path and this many metres.
DIVERGED_PATH_SHARE, DIVERGED_M = 0.2, 2.0


@dataclass(frozen=True)
class Scores:
    """Scores of one run under one policy; NaN, of ``diverged`` None, where truth is missing. ``nis_interval`` by block
    bootstrap; ``frames`` that have truth."""

    nis_dof: float
    nis_interval: Interval
    rejected: int
    ate_rmse_m: float = math.nan
    final_error_m: float = math.nan
    drift_percent: float = math.nan
    nees_position: float = math.nan
    nees_attitude: float = math.nan
    diverged: bool | None = None
    frames: int = 0

    @property
    def nees_dof(self) -> dict[str, float]:
        """NEES per degree of freedom of position and attitude: 1 where the stated covariance is right."""
        return {"position": self.nees_position, "attitude": self.nees_attitude}


def umeyama(source: Array, target: Array) -> tuple[Array, Array]:
    """Rotation and translation that bring ``source`` (N, 3) nearest to ``target`` (N, 3), without scale.

    S. Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991), eq. 40-42.
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - b).T @ (source - a))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt)) or 1.0])
    R = U @ D @ Vt
    return R, b - R @ a


def ate_rmse(estimate: Array, truth: Array) -> float:
    """Root mean square position error [m] after SE(3) Umeyama alignment. (N, 3) both."""
    if len(estimate) < 3 or not np.isfinite(estimate).all():
        return float("nan")
    R, t = umeyama(estimate, truth)
    return float(np.sqrt(((estimate @ R.T + t - truth) ** 2).sum(1).mean()))


def position_nees(estimate: Array, truth: Array, covariance: Array) -> Array:
    """NEES per degree of freedom (N,) of positions (N, 3) with covariances (N, 3, 3)."""
    return nees(truth - estimate, covariance) / 3.0


def attitude_nees(R_estimate: Array, R_truth: Array, covariance: Array) -> Array:
    """NEES per degree of freedom (N,) of attitudes (N, 3, 3), error ``Log(R_est^T R_true)`` in the body's axes."""
    error = se3.so3_log(np.swapaxes(R_estimate, -1, -2) @ R_truth)
    return nees(error, covariance) / 3.0


def diverged(errors_m: Array, path_m: float) -> bool:
    """Whether the position error left every sensible bound, or is no number."""
    if not np.isfinite(errors_m).all():
        return True
    return bool(errors_m.max(initial=0.0) > max(DIVERGED_M, DIVERGED_PATH_SHARE * path_m))


def without_truth(nis: Array, rejected: int) -> Scores:
    """What a run can say by itself: NIS (n,) of its updates, NaN where there was none, and rejections."""
    measured = nis[np.isfinite(nis)] / 6.0
    interval = block_bootstrap(measured)
    return Scores(nis_dof=interval.mean, nis_interval=interval, rejected=rejected)
