"""How good a filtered run is: its error against truth, and whether the filter knew its own error."""

from __future__ import annotations

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

    ate_rmse_m: float
    final_error_m: float
    drift_percent: float
    nees_position: float
    nees_attitude: float
    nis_dof: float
    nis_interval: Interval
    rejected: int
    diverged: bool | None
    frames: int

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
    measured, unknown = nis[np.isfinite(nis)] / 6.0, float("nan")
    return Scores(
        ate_rmse_m=unknown,
        final_error_m=unknown,
        drift_percent=unknown,
        nees_position=unknown,
        nees_attitude=unknown,
        nis_dof=float(measured.mean()) if len(measured) else unknown,
        nis_interval=block_bootstrap(measured),
        rejected=rejected,
        diverged=None,
        frames=0,
    )
