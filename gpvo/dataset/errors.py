"""Ground truth beside a log, and what the model learns from it: the error of each motion, of a window of motions, or
the residual of a position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.stats.consistency import rms
from gpvo.types import Array, TruthLog, VoLog, VoRecord

MAX_GAP_S = 0.5
_GAP_STEPS = 3.0
"""Usual steps, of truth or frames, that the truth is interpolated over, if at most ``MAX_GAP_S``: a pose must be
exact enough to judge a motion by, which the filter's guesses over a gap of the IMU need not (``filters.plausible``)."""
_NO_TURN_DEG, _TURN_DEG, _STRAIGHT = 1e-3, 5.0, 0.05  # the last: of a path's extent, what it has across
_LEAPS, _MOVING = 1.5, 0.25


def sizes(motions: Array) -> Array:
    """(2, M) lengths [m] and angles [rad] of motions (M, 4, 4)."""
    return np.stack([np.linalg.norm(v, axis=1) for v in (motions[:, :3, 3], se3.so3_log(motions[:, :3, :3]))])


def held_poses(t_ns: NDArray[np.int64], T: Array) -> NDArray[np.bool_]:
    """(N,) which poses (N, 4, 4) repeat the one before, to the last digit, while the vehicle moves: motion capture or
    odometry that stalls, and slow poses logged at a higher rate, hold the last one.

    Such a pose ends by a leap: at more than ``_LEAPS`` times the pace around it, but over the whole time that it was
    held, at no less than ``_MOVING`` of the usual one. From true rest a vehicle starts slowly. A pose held to the end
    counts likewise if the vehicle got there at such a pace. Where most poses are held, all that repeat are.
    """
    t_s = (t_ns - t_ns[:1]) * 1e-9
    repeats = np.append(np.zeros(len(T[:1]), bool), (T[1:] == T[:-1]).all(axis=(1, 2)))
    new = np.flatnonzero(~repeats)
    if len(new) == len(T) or len(new) < 3:
        return np.zeros(len(T), dtype=bool)
    moved = se3.inverse(T[new[:-1]]) @ T[new[1:]]
    held, judged = np.zeros((2, len(new)), dtype=bool)
    for size in sizes(moved):
        pace, leap = size / np.diff(t_s[new]), size / (t_s[new[1:]] - t_s[new[1:] - 1])
        around = np.maximum(np.append(0.0, pace[:-1]), np.append(pace[1:], 0.0))
        moving = pace > _MOVING * np.quantile(pace, 0.75)
        judged |= np.append(moving, moving[-1])
        held |= np.append(moving & (leap > _LEAPS * around), moving[-1])
    held |= held.sum() > 0.5 * judged.sum()
    return np.asarray(repeats & held[np.cumsum(~repeats) - 1], dtype=np.bool_)


def without_held(truth: TruthLog) -> TruthLog:
    """The truth without its :func:`held_poses`."""
    held = held_poses(truth.t_ns, truth.T_world_cam)
    if not held.any():
        return truth
    v = truth.v_world_mps
    moved = None if v is None else v[~held]
    return replace(truth, t_ns=truth.t_ns[~held], T_world_cam=truth.T_world_cam[~held], v_world_mps=moved)


def interpolate_truth(
    truth: TruthLog, t_ns: NDArray[np.int64], max_gap_s: float | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Truth poses at the stamps (N,): (N, 4, 4) and whether each is known (N,).

    A stamp is known where it lies within the truth and the truth's neighbours are no further apart than ``max_gap_s``
    (or one of them is the stamp itself). By default that is three times the usual step of the truth, or of the stamps
    where theirs is longer, and at most ``MAX_GAP_S``: over a longer drop-out, a straight line is no truth. Poses that
    were not measured (:func:`without_held`) are none.
    """
    t, truth = np.asarray(t_ns, dtype=np.int64), without_held(truth)
    if len(truth.t_ns) == 0:
        return np.broadcast_to(np.eye(4), (len(t), 4, 4)).copy(), np.zeros(len(t), dtype=bool)
    max_gap_ns = _usual_gap_ns(truth.t_ns, t) if max_gap_s is None else max_gap_s * 1e9
    right = np.clip(np.searchsorted(truth.t_ns, t), 1, len(truth.t_ns) - 1)
    t_a, t_b = truth.t_ns[right - 1], truth.t_ns[right]
    fraction = np.clip((t - t_a) / np.maximum(t_b - t_a, 1), 0.0, 1.0)
    T = se3.interpolate(truth.T_world_cam[right - 1], truth.T_world_cam[right], fraction)
    exact = (t == t_a) | (t == t_b)
    known = exact | ((t >= t_a) & (t <= t_b) & (t_b - t_a <= max_gap_ns))
    return T, known


def _usual_gap_ns(*stamps: NDArray[np.int64]) -> float:
    """The longest gap [ns] that no drop-out makes: ``_GAP_STEPS`` usual steps of the slower stamps, which may come in
    bursts."""
    steps = (np.diff(np.unique(t)) for t in stamps)
    usual = max((float(np.quantile(s, 0.95)) for s in steps if len(s)), default=np.inf)
    return min(MAX_GAP_S * 1e9, _GAP_STEPS * usual)


def steps_of_slow_truth(truth: TruthLog, t_ns: NDArray[np.int64]) -> tuple[float, float] | None:
    """Usual steps [s] of a truth that comes more slowly than the frames at ``t_ns``, and of these; else None."""
    step_s, frame_s = (1e-9 * float(np.median(np.diff(t))) for t in (without_held(truth).t_ns, t_ns))
    return (step_s, frame_s) if step_s > 1.2 * frame_s else None


_STRAIGHT_M, _FEWEST_KNOTS = 5e-6, 5


def interpolated_between(truth: TruthLog) -> int | None:
    """Every how many poses a truth was measured, if the others lie on straight lines between, to the digits of a file:
    somebody has interpolated it. None for any other truth."""
    steps_s = np.diff((truth.t_ns - truth.t_ns[0]) * 1e-9)
    velocity_mps = np.diff(truth.T_world_cam[:, :3, 3], axis=0) / steps_s[:, None]
    bends = np.flatnonzero(np.linalg.norm(np.diff(velocity_mps, axis=0), axis=1) * steps_s[1:] > _STRAIGHT_M)
    if len(bends) < _FEWEST_KNOTS:
        return None
    apart, count = np.unique(np.diff(bends), return_counts=True)
    usual = int(apart[count.argmax()])
    return usual if usual > 2 and count.max() > 0.5 * count.sum() else None


def interpolation_sigma(truth: TruthLog, t_ns: NDArray[np.int64]) -> Array:
    """(6,) standard deviation [m, rad] of poses interpolated at ``t_ns``, if frames come faster than truth; else 0.

    Half of the truth's own poses tell what interpolation misses midway at twice the step; as for any path smooth at
    that scale, it misses a quarter of it at the step itself, and ``4 f (1 - f)`` of that at the share f of a step.
    """
    truth = without_held(truth)
    if len(truth.t_ns) < 9 or steps_of_slow_truth(truth, t_ns) is None:
        return np.zeros(6)
    half = TruthLog(truth.t_ns[::2], truth.T_world_cam[::2])
    T, known = interpolate_truth(half, truth.t_ns[1::2], 2.0 * MAX_GAP_S)
    missed = se3.log(se3.inverse(T) @ truth.T_world_cam[1::2])[known]
    inside = (t_ns - truth.t_ns[0])[(t_ns >= truth.t_ns[0]) & (t_ns <= truth.t_ns[-1])]
    share = np.interp(inside, truth.t_ns - truth.t_ns[0], np.arange(len(truth.t_ns))) % 1.0
    return rms(missed) * rms(share * (1.0 - share)) if len(missed) and len(inside) else np.zeros(6)


@dataclass(frozen=True)
class MotionErrors:
    """Errors of M motions: ``xi = Log(T_true^-1 T_est)``, right perturbation, in ``cam`` [m, rad].

    ``index`` (M,) into the log; ``xi`` (M, 6); ``T_true``, ``T_est`` (M, 4, 4); ``dt_s`` (M,).
    """

    index: NDArray[np.int64]
    xi: Array
    T_true: Array
    T_est: Array
    dt_s: Array

    @property
    def sizes(self) -> Array:
        """(M, 2) of translation [m] and rotation [rad]."""
        return np.linalg.norm(self.xi.reshape(-1, 2, 3), axis=2)

    def rows(self, keep: NDArray) -> MotionErrors:
        """Some of them."""
        return MotionErrors(self.index[keep], self.xi[keep], self.T_true[keep], self.T_est[keep], self.dt_s[keep])

    def far(self, medians: float) -> NDArray[np.bool_]:
        """(M,) whether translation or rotation is wrong by more than so many times its median error."""
        if not len(self.xi):
            return np.zeros(0, dtype=bool)
        return np.asarray((self.sizes > medians * np.median(self.sizes, axis=0)).any(axis=1))


def motion_errors(log: VoLog, truth: TruthLog) -> MotionErrors:
    """Errors of all ``ok`` and ``degraded`` motions with truth at both ends."""
    t_prev = log.column("t_prev_ns").astype(np.int64)
    start, has_start = interpolate_truth(truth, t_prev)
    end, has_end = interpolate_truth(truth, log.t_ns)
    index = np.flatnonzero(log.usable & has_start & has_end)
    T_true = se3.inverse(start[index]) @ end[index]
    T_est = log.T_prev_cur[index]
    xi = se3.log(se3.inverse(T_true) @ T_est)
    return MotionErrors(index, xi, T_true, T_est, log.column("dt_s")[index])


def turn_without_truth_deg(log: VoLog, truth: TruthLog) -> float:
    """By how much odometry turns [deg] while a truth, as of satellites alone, has one attitude along a path that is not
    straight; else 0.

    Neither rotations nor, in the camera's axes, translations of such a truth are true.
    """
    if len(truth.t_ns) < 2 or _turn_deg(truth.T_world_cam) > _NO_TURN_DEG:
        return 0.0
    p = truth.T_world_cam[:, :3, 3]
    extent = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
    if extent[1] < _STRAIGHT * extent[0]:
        return 0.0
    turned = _turn_deg(log.trajectory())
    return turned if turned > _TURN_DEG else 0.0


def require_attitude(log: VoLog, truth: TruthLog, where: object) -> None:
    """Refuse a truth of positions alone, by which no motion can be judged. Raises GpvoError, naming ``where``."""
    if turn_deg := turn_without_truth_deg(log, truth):
        raise GpvoError(
            f"the ground truth holds no attitude: it never turns, but odometry does, by up to {turn_deg:.0f} deg",
            where=where,
            cure="give one with orientations, or use twins",
        )


def _turn_deg(T: Array) -> float:
    """Largest rotation between the first of poses (N, 4, 4) and another."""
    return float(np.rad2deg(sizes(se3.inverse(T[:1]) @ T)[1].max()))


def motion_targets(records: Sequence[VoRecord], truth: TruthLog) -> tuple[Array, NDArray[np.bool_]]:
    """Errors ``xi = Log(T_true^-1 T_est)`` (N, 6) of records that span ``t_prev_ns`` to ``t_ns``, and which are known.

    Known are usable motions with truth at both ends; the rest is NaN.
    """
    errors = motion_errors(VoLog(records), truth)
    xi, known = np.full((len(records), 6), np.nan), np.zeros(len(records), dtype=bool)
    xi[errors.index], known[errors.index] = errors.xi, True
    return xi, known


def position_targets(log: VoLog, usable: NDArray[np.bool_], truth: TruthLog) -> tuple[Array, NDArray[np.bool_]]:
    """The thesis' target: residual of the position [m] (N, 3) in the axes of the first camera, and which are known.

    The first pose with truth is made equal to the truth there; ``usable`` (N,): the motions as judged.
    """
    trajectory, (T_true, has) = log.trajectory(), interpolate_truth(truth, log.t_ns)
    if not has.any():
        raise GpvoError("no frame has ground truth")
    first = int(np.argmax(has))
    T_first_world = trajectory[first] @ se3.inverse(T_true[first])
    residual = trajectory[:, :3, 3] - (T_first_world @ T_true)[:, :3, 3]
    known = has & usable
    return np.where(known[:, None], residual, np.nan), known
