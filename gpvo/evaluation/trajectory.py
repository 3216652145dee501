"""Errors of a trajectory against truth: ATE, RPE, the segments of the KITTI benchmark, and the NEES of stated poses.

Poses are (N, 4, 4), estimate and truth of the same frame at the same times. Definitions: J. Sturm et al., "A
benchmark for the evaluation of RGB-D SLAM systems" (2012), eqs. 1-5; A. Geiger, P. Lenz, R. Urtasun, "Are we ready
for autonomous driving?" (2012), section 3.1; alignment by S. Umeyama (1991), without scale: a stereo rig knows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.evaluation.consistency import TOO_FAR, Consistency
from gpvo.filters.metrics import ate_rmse, umeyama
from gpvo.geometry import se3
from gpvo.stats.consistency import marginal, nees_by_block, seen_axes
from gpvo.stats.series import Interval, block_bootstrap
from gpvo.types import IMPORTED_POSE, Array, VoLog

SHORT_M, LONG_M = (10.0, 20.0, 50.0, 100.0), tuple(100.0 * k for k in range(1, 9))
_LONG_PATH_M = 800.0
_EVERY = 10  # frames between the starts of segments, as in the benchmark
_ALIGNING = 20  # iterations at most


@dataclass(frozen=True)
class Statistics:
    """Of a set of non-negative errors, in their unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    count: int

    @classmethod
    def of(cls, values: Array) -> Statistics:
        """All NaN for an empty set."""
        if len(values) == 0:
            nan = float("nan")
            return cls(nan, nan, nan, nan, nan, nan, 0)
        return cls(
            rmse=float(np.sqrt((values**2).mean())),
            mean=float(values.mean()),
            median=float(np.median(values)),
            std=float(values.std()),
            min=float(values.min()),
            max=float(values.max()),
            count=len(values),
        )


@dataclass(frozen=True)
class RelativeError:
    """Error of relative motions: translation [m] and rotation [rad]."""

    translation_m: Statistics
    rotation_rad: Statistics


@dataclass(frozen=True)
class Segment:
    """Mean error of all segments of one length, as a share of it; NaN where there is none."""

    length_m: float
    translation_percent: float
    rotation_deg_per_m: float
    count: int


@dataclass(frozen=True)
class TrajectoryErrors:
    """Every trajectory error of one run. ``rmse_origin_m`` and ``final_error_m`` have the first poses made equal and
    nothing fitted; ``ate_rmse_m`` is after SE(3) alignment."""

    path_length_m: float
    ate_rmse_m: float
    rmse_origin_m: float
    final_error_m: float
    rpe_frame: RelativeError
    rpe_second: RelativeError
    rpe_10m: RelativeError
    segments: tuple[Segment, ...]

    @classmethod
    def of_positions(cls, path_length_m: float, ate_rmse_m: float = float("nan")) -> TrajectoryErrors:
        """What a truth without attitudes tells, or without an ATE none at all; the rest is NaN."""
        nan, none = float("nan"), RelativeError(Statistics.of(np.zeros(0)), Statistics.of(np.zeros(0)))
        return cls(path_length_m, ate_rmse_m, nan, nan, none, none, none, ())


def rpe(T_est: Array, T_true: Array, start: NDArray[np.int64], end: NDArray[np.int64]) -> RelativeError:
    """Of ``(dT_true)^-1 dT_est`` between the poses ``start`` and ``end`` (M,)."""
    d_est, d_true = (se3.inverse(T[start]) @ T[end] for T in (T_est, T_true))
    E = se3.inverse(d_true) @ d_est
    angle = np.linalg.norm(se3.so3_log(E[:, :3, :3]), axis=1)
    return RelativeError(Statistics.of(np.linalg.norm(E[:, :3, 3], axis=1)), Statistics.of(angle))


def pairs_ahead(
    progress: NDArray[Any], step: float, every: int = 1, frame: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of poses ``step`` apart in a growing quantity (N,): every n-th start, and the first pose at least that
    far on, if that is not :data:`TOO_FAR` times as far. ``frame`` (N,): number of each pose in the run; pairs with a
    left-out pose between them are dropped."""
    start = np.arange(0, len(progress), every)
    # A hair of slack: times that are sums of a frame period must not miss the round number.
    end = np.searchsorted(progress, progress[start] + step * (1 - 1e-9), side="left")
    inside = end < len(progress)
    start, end = start[inside], end[inside]
    near = progress[end] - progress[start] < TOO_FAR * step
    start, end = start[near], end[near]
    whole = slice(None) if frame is None else frame[end] - frame[start] == end - start
    return start[whole], end[whole]


def segments(
    T_est: Array, T_true: Array, lengths_m: Sequence[float], frame: NDArray[np.int64] | None = None
) -> tuple[Segment, ...]:
    """KITTI's segment errors for given lengths of the true path, a start at every tenth frame.

    NaN, and a count of 0, for a length that the path does not reach. ``frame``: as in :func:`trajectory_errors`.
    """
    arc, out = se3.path_length_m(T_true[:, :3, 3]), []
    for length in lengths_m:
        error = rpe(T_est, T_true, *pairs_ahead(arc, length, _EVERY, frame))
        translation, rotation = error.translation_m, float(np.degrees(error.rotation_rad.mean))
        out.append(Segment(length, 100 * translation.mean / length, rotation / length, translation.count))
    return tuple(out)


def trajectory_errors(
    t_ns: NDArray[np.int64],
    T_est: Array,
    T_true: Array,
    lengths_m: Sequence[float] | None = None,
    frame: NDArray[np.int64] | None = None,
) -> TrajectoryErrors:
    """Every error of one run; ``lengths_m`` default to 10 to 100 m, for paths above 800 m to KITTI's 100 to 800 m.

    ``frame`` (N,): number of each pose in the run, where poses without truth were left out. Relative errors are not
    taken across such a gap, over which the path is longer than seen.
    """
    arc = se3.path_length_m(T_true[:, :3, 3])
    lengths = lengths_m or (LONG_M if arc[-1] > _LONG_PATH_M else SHORT_M)
    from_start = se3.inverse(T_true[0]) @ T_true
    drift = (T_est[0] @ from_start)[:, :3, 3] - T_est[:, :3, 3]
    off = np.linalg.norm(drift, axis=1)
    t_s = (t_ns - t_ns[0]) * 1e-9
    # A span, not an instant: a start at every frame, the end one second or ten metres on.
    return TrajectoryErrors(
        path_length_m=float(arc[-1]),
        ate_rmse_m=ate_rmse(T_est[:, :3, 3], T_true[:, :3, 3]),
        rmse_origin_m=float(np.sqrt((off**2).mean())),
        final_error_m=float(off[-1]),
        rpe_frame=rpe(T_est, T_true, *pairs_ahead(np.arange(len(t_ns)), 1.0, frame=frame)),
        rpe_second=rpe(T_est, T_true, *pairs_ahead(t_s, 1.0, frame=frame)),
        rpe_10m=rpe(T_est, T_true, *pairs_ahead(arc, 10.0, frame=frame)),
        segments=segments(T_est, T_true, lengths, frame=frame),
    )


_NAMES = {"translation": "position", "rotation": "orientation", "joint": "joint"}


@dataclass(frozen=True)
class PoseConsistency:
    """NEES per degree of freedom of ``count`` poses, by block of the error, with block-bootstrap intervals.

    For filters, which state the covariance of a pose and not of a motion. Errors are of the pose after one rigid
    alignment, without scale, which a filter's choice of world frame leaves free: of the least squared errors over the
    stated covariances. Where these are alike for all poses it is that of the positions (Umeyama) on a path that bends;
    on a straight one or at rest, where positions do not tell the rotation, orientations do; and poses that are stated
    well, as at the start of odometry, count for more. Position and orientation are scored apart and together, as
    Z. Zhang and D. Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry"
    (2018), section V, and the toolbox of OpenVINS do.

    The error is the right perturbation ``Log(T_true^-1 T_est)`` in the body's axes. An alignment acts on the left, so
    it leaves the body's covariance as it is. Covariances in world axes are turned into the body's when they are read;
    to first order NEES is the same in both conventions. Axes on which odometry and truth never differ do not count; a
    block without any is left out.
    """

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
    C = C[stated]
    error = se3.log(se3.inverse(T_true[stated]) @ aligned(T_est[stated], T_true[stated], C))
    by_block = {_NAMES[n]: values for n, values in nees_by_block(error, C, seen_axes(error)).items()}
    return PoseConsistency(
        count=int(stated.sum()),
        nees_dof={n: block_bootstrap(v) for n, v in by_block.items()},
        nees_dof_median={n: float(np.median(v)) for n, v in by_block.items()},
    )


def aligned(T_est: Array, T_true: Array, covariance: Array) -> Array:
    """Poses (N, 4, 4), moved as one body to where their squared errors over the covariances (N, 6, 6) are least.

    Gauss-Newton, from the better of two starts: by positions alone, and by orientations with the mean position. About
    the middle of the path: turns about an origin thousands of kilometres off, as of UTM, drown in their translations.
    """
    middle = T_true[:, :3, 3].mean(axis=0)
    T_true = se3.from_rt(T_true[:, :3, :3], T_true[:, :3, 3] - middle)
    turn = se3.orthonormalise((T_true @ se3.inverse(T_est)).mean(axis=0))[:3, :3]
    p_est, p_true = T_est[:, :3, 3], T_true[:, :3, 3]
    starts = (umeyama(p_est, p_true), (turn, p_true.mean(axis=0) - turn @ p_est.mean(axis=0)))
    moved = [se3.from_rt(R, t) @ T_est for R, t in starts]
    axes = seen_axes(se3.log(se3.inverse(T_true) @ moved[1]))
    information = np.linalg.pinv(marginal(covariance, axes), hermitian=True)

    def cost(T: Array) -> float:
        xi = se3.log(se3.inverse(T_true) @ T)[:, axes]
        return float(np.einsum("ni,nij,nj", xi, information, xi))

    best, least = min(((T, cost(T)) for T in moved), key=lambda one: one[1])
    for _ in range(_ALIGNING):
        xi, J = se3.log(se3.inverse(T_true) @ best)[:, axes], se3.adjoint(se3.inverse(best))[:, axes]
        WJ = information @ J
        step = np.linalg.lstsq(np.einsum("nij,nik->jk", J, WJ), -np.einsum("nij,ni->j", WJ, xi), rcond=1e-12)[0]
        candidate = se3.exp(step) @ best
        if not (now := cost(candidate)) < least:
            break
        best, least = candidate, now
    return se3.from_rt(best[:, :3, :3], best[:, :3, 3] + middle)


def nees_document(found: PoseConsistency | Consistency | None) -> dict[str, object] | None:
    """NEES of poses or of motions for scripts: by block the mean, its 95 % ``interval`` and the ``median``; None of
    poses where odometry and truth never differ in a block."""
    if found is None:
        return None
    blocks: dict[str, object] = dict.fromkeys(_NAMES.values()) if isinstance(found, PoseConsistency) else {}
    blocks |= {
        name: {"nees_dof": i.mean, "interval": [i.low, i.high], "median": found.nees_dof_median[name]}
        for name, i in found.nees_dof.items()
        if i is not None
    }
    return {"count": found.count, **blocks}
