"""NEES of poses, for filters that state the covariance of a pose and not of a motion.

Errors are of the pose after one rigid alignment of all positions (Umeyama, no scale), which a filter's choice of world
frame leaves free. Position and orientation are scored apart and together, as Z. Zhang and D. Scaramuzza, "A tutorial on
quantitative trajectory evaluation for visual(-inertial) odometry" (2018), section V, and the toolbox of OpenVINS do.

The error is the right perturbation ``Log(T_true^-1 T_est)`` in the body's axes. An alignment acts on the left, so it
leaves the body's covariance as it is. Covariances in world axes are turned into the body's when they are read; to first
order NEES is the same in both conventions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.filters.metrics import umeyama
from gpvo.geometry import se3
from gpvo.stats.bootstrap import Interval, block_bootstrap
from gpvo.stats.consistency import nees
from gpvo.types import IMPORTED_POSE, Array, VoLog

BLOCKS = {"position": slice(0, 3), "orientation": slice(3, 6), "joint": slice(0, 6)}


@dataclass(frozen=True)
class PoseConsistency:
    """NEES per degree of freedom of ``count`` poses, by block of the error, with block-bootstrap intervals."""

    count: int
    nees_dof: dict[str, Interval]
    nees_dof_median: dict[str, float]


def pose_consistency(log: VoLog, T_est: Array, T_true: Array, known: NDArray[np.bool_]) -> PoseConsistency | None:
    """Scores of the pose covariances that a log holds; None where it holds none.

    ``T_est`` and ``T_true`` (N, 4, 4) in any two world frames; ``known`` (N,): which poses have truth.
    """
    if IMPORTED_POSE not in log.methods:
        return None
    C = log.covariance(IMPORTED_POSE)
    stated = known & np.isfinite(C).all(axis=(1, 2))
    if stated.sum() < 3:
        return None
    R, t = umeyama(T_est[stated, :3, 3], T_true[stated, :3, 3])
    aligned = se3.from_rt(R, t) @ T_est[stated]
    error, C = se3.log(se3.inverse(T_true[stated]) @ aligned), C[stated]
    by_block = {n: nees(error[:, b], C[:, b, b]) / (b.stop - b.start) for n, b in BLOCKS.items()}
    return PoseConsistency(
        count=int(stated.sum()),
        nees_dof={n: block_bootstrap(v) for n, v in by_block.items()},
        nees_dof_median={n: float(np.median(v)) for n, v in by_block.items()},
    )


def pose_document(found: PoseConsistency | None) -> dict[str, object] | None:
    """The same for scripts: by block the mean, its 95 % ``interval`` and the ``median``."""
    if found is None:
        return None
    blocks = {
        name: {"nees_dof": i.mean, "interval": [i.low, i.high], "median": found.nees_dof_median[name]}
        for name, i in found.nees_dof.items()
    }
    return {"count": found.count, **blocks}
