"""Poses that are not what they are taken for: of another frame, inverse, with other quaternions, on another clock or
of another flight; from how alike the motions of a log and its truth are over a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.clock import estimate_time_offset, on_clock_of_log
from gpvo.dataset.errors import sizes, turn_without_truth_deg
from gpvo.dataset.hand_eye import MIN_MOTIONS, between, fit_fixed_transform, residuals, windowed_motions, windows
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoLog


@dataclass(frozen=True)
class FixedRotation:
    """``rotvec_rad`` (3,) from the truth's camera to the log's, and ``lever_m`` between their origins, 0 where a lever
    arm does not matter; ``scale``: size of the odometry's motions relative to the truth's, likewise 1;
    ``error_change``: relative change without them of the median error over a second, on the halves of the run that they
    were not fitted to; ``align_change``: the same where no scale is fitted, as by ``--align``, 0 where that does not
    matter."""

    angle_deg: float
    rotvec_rad: tuple[float, ...]
    error_change: float
    lever_m: float = 0.0
    scale: float = 1.0
    align_change: float = 0.0


MATTERS = -0.1
"""Change of the error from which a fixed rotation, or a lever arm, is reported."""


def fixed_rotation(log: VoLog, truth: TruthLog) -> FixedRotation | None:
    """A fixed rotation between truth and odometry, a lever arm if it matters beside that, and a scale if it matters
    beside both, which they may only stand in for; None where none shows or matters."""
    A, B, _ = windowed_motions(log, truth)
    half, found, aligned = len(A) // 2, None, 0.0
    if half < MIN_MOTIONS:
        return None
    parts = slice(None, half), slice(half, None)
    plain = least = _errors_of_halves(A, B)
    for by_scale in (False, True):
        for fit in ("none", "rotation", "transform")[1 - by_scale :]:
            try:
                fits = [_fitted(A[p], B[p], fit, by_scale) for p in (slice(None), *parts[::-1])]
            except GpvoError:  # a path too straight to tell
                continue
            left = np.array([np.median(_errors(_sized(A[p], s), B[p], X)[0]) for p, (X, s) in zip(parts, fits[1:])])
            if _change(left, least, B).max() <= MATTERS:
                (X, scale), change = fits[0], float(_change(left, plain, B).mean())
                rotvec, lever_m = se3.so3_log(X[:3, :3]), float(np.linalg.norm(X[:3, 3]))
                angle_deg = float(np.rad2deg(np.linalg.norm(rotvec)))
                aligned = aligned if by_scale else change
                found, least = FixedRotation(angle_deg, tuple(rotvec.tolist()), change, lever_m, scale, aligned), left
    return found


_ROUNDS = 5


def _fitted(A: Array, B: Array, fit: str, by_scale: bool) -> tuple[Array, float]:
    """The fixed transform (4, 4) between motions, and the scale of A, 1 if it is not fitted: in turns, as a lever arm
    changes the size of motions too."""
    X, scale = np.eye(4), 1.0
    for _ in range(_ROUNDS if by_scale else 1):
        before, scale = scale, _scale(A, X @ B @ se3.inverse(X)) if by_scale else 1.0
        if fit == "none" or (abs(scale - before) < _SLIGHT and not np.array_equal(X, np.eye(4))):
            break
        X = fit_fixed_transform(_sized(A, scale), B, lever_arm=fit == "transform").T_log_truth
    return X, scale


def _sized(A: Array, scale: float) -> Array:
    """Motions (M, 4, 4) of another scale."""
    return se3.from_rt(A[:, :3, :3], A[:, :3, 3] / max(scale, 1e-12))


def _scale(A: Array, B: Array) -> float:
    """Size of the motions A (M, 4, 4) relative to B: the median over those that travel; 0 where none do."""
    own, true = sizes(A)[0], sizes(B)[0]
    moving = true > 0.5 * np.sqrt((true**2).mean())
    return float(np.median(own[moving] / true[moving])) if moving.any() else 0.0


@dataclass(frozen=True)
class InversePoses:
    """``of``: "odometry", or "truth or odometry", as a log in the world of its truth cannot be told from it.
    ``or_backwards``: the turns do not show it, so that one of the two may as well look backwards. ``error_change``: see
    :class:`FixedRotation`.
    """

    of: str
    error_change: float
    or_backwards: bool


_EXPLAINS = -0.5
"""Change of the error from which poses are called inverse."""


def inverse_poses(log: VoLog, truth: TruthLog) -> InversePoses | None:
    """Whether one of both holds ``T_cam_world`` for ``T_world_cam``: inverted, it agrees far better with the other.

    A log is known from its first pose only, which counts as the origin of its world.
    """
    start, end, T, T_world = windows(log, truth)
    if len(start) < MIN_MOTIONS:
        return None
    A, B = between(T, start, end), between(T_world, start, end)
    pairs = {
        "as they are": (A, B),
        "odometry": (between(se3.inverse(T), start, end), B),
        "truth or odometry": (A, between(se3.inverse(T_world), start, end)),
    }
    error = {of: _errors_of_halves(*pair) for of, pair in pairs.items()}
    plain = error.pop("as they are")
    best = min(error, key=lambda of: error[of].sum())
    change = _change(error[best], plain, B)
    if change.max() > _EXPLAINS:
        return None
    before, after = (np.median(_errors(*pairs[of], np.eye(4))[1]) for of in ("as they are", best))
    return InversePoses(best, float(change.mean()), bool(after > (1 + _EXPLAINS) * before))


_UNLIKE, _MISMATCH, _SAME_PATH = 0.5, 0.1, 0.3  # on correct data, errors are a tenth of the motion at most
_MOVES, _LEAST_MOVES = 1.6, np.array([1e-3, 1e-2])  # noise grows over twice the time by 1.4 at most; [m], [rad]
_TIMES_REST = 10.0


@dataclass(frozen=True)
class Resemblance:
    """How alike odometry and truth move over a second. ``scale``: size of the odometry's motions relative to the
    truth's. ``motion``, ``turn``: median error relative to the motion, or the turn, that remains with this scale and
    the best fixed transform between their frames taken off, in the better half of the run; ``turn`` is 0 where one of
    both does not turn, ``motion`` 1 where one does not travel. ``path``: the same of the steps of the position alone,
    in the worse half.
    """

    scale: float
    motion: float
    turn: float
    path: float

    @property
    def alike(self) -> bool:
        """Whether one fixed transform, and a scale, explain the difference between the two."""
        return max(self.motion, self.turn) < _UNLIKE and not self.in_path_alone

    @property
    def in_path_alone(self) -> bool:
        """Whether their positions agree, so that the attitudes of one, or its axes, must be others."""
        return self.motion > _MISMATCH and self.path < _SAME_PATH * min(self.motion, 1.0)


def resemblance(log: VoLog, truth: TruthLog) -> Resemblance | None:
    """None where there is too little to compare, or both are at rest."""
    start, end, T, T_world = windows(log, truth)
    if len(start) < MIN_MOTIONS:
        return None
    A, B = between(T, start, end), between(T_world, start, end)
    moves, true_moves = _moves(T, start, end), _moves(T_world, start, end)
    size = sizes(B)
    if not (moves[0] and true_moves[0]):
        ratio = float(np.sqrt((sizes(A)[0] ** 2).sum() / max((size[0] ** 2).sum(), _WRITTEN_M**2)))
        one_rests = (moves[0] and ratio > _TIMES_REST) or (true_moves[0] and ratio < 1 / _TIMES_REST)
        return Resemblance(ratio, 1.0, 0.0, 1.0) if one_rests else None
    moving = size > 0.5 * np.sqrt((size**2).mean(axis=1, keepdims=True))
    scale = _scale(A, B)
    A = _sized(A, scale)
    try:
        X = fit_fixed_transform(A, B).T_log_truth
    except GpvoError:  # a path too straight to tell
        X = np.eye(4)
    steps, true_steps = (P[end, :3, 3] - P[start, :3, 3] for P in (T, T_world))
    motion, turn, path = list[float](), list[float](), list[float]()
    for h in np.array_split(np.arange(len(A)), 2):
        U, _, Vt = np.linalg.svd(steps[h].T @ true_steps[h])  # a mirrored path is the same one
        left = np.linalg.norm(steps[h] / max(scale, 1e-12) - true_steps[h] @ (U @ Vt).T, axis=1)
        share = np.vstack([_errors(A[h], B[h], X), left]) / np.maximum(size[[0, 1, 0]][:, h], 1e-12)
        for found, of, among in zip((motion, turn, path), share, moving[[0, 1, 0]][:, h], strict=True):
            found += [float(np.median(of[among]))] if among.any() else []
    return Resemblance(scale, min(motion), min(turn) if (moves & true_moves)[1] else 0.0, max(path))


def _moves(T: Array, start: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(2,) whether poses (N, 4, 4) travel, and turn, over windows of more than one frame by more than their noise."""
    half = (start + end) // 2
    whole, part = (np.sqrt((sizes(between(T, start, e)) ** 2).mean(axis=1)) for e in (end, half))
    return np.asarray((half > start).all() & (whole > np.maximum(_MOVES * part, _LEAST_MOVES)))


def late_by(log: VoLog, truth: TruthLog) -> float | None:
    """Seconds to add to the log's stamps, if without such an offset errors over a second are smaller by what matters,
    in both halves of the run; else None."""
    try:
        offset_s = estimate_time_offset(log, truth)
    except GpvoError:  # too short, or motions unlike each other
        return None
    found = []
    for against in (truth, on_clock_of_log(truth, offset_s)):
        A, B, _ = windowed_motions(log, against)
        if len(A) < MIN_MOTIONS:
            return None
        found.append(_errors_of_halves(A, B))
    change = _change(found[1], found[0], B)
    return offset_s if change.max() < MATTERS else None


def _errors(A: Array, B: Array, X: Array) -> Array:
    """(2, M) sizes of the residuals, [m] and [rad]."""
    return np.linalg.norm(residuals(A, B, X)[0].reshape(-1, 2, 3), axis=2).T


def _errors_of_halves(A: Array, B: Array) -> Array:
    """(2,) median error [m] in the first and the second half of the run."""
    return np.array([np.median(half) for half in np.array_split(_errors(A, B, np.eye(4))[0], 2)])


GROSS_DEG = 90.0
"""A fixed rotation beyond is rarely a mounting's: a quaternion with w first read as x first, or a body's poses as a
camera's."""


@dataclass(frozen=True)
class Misread:
    """What makes the poses of odometry or truth mean something else than they are taken for: at most one, the one that
    explains most; all None where nothing does. ``unlike``: what no fixed rotation and no inverse explains."""

    turned: FixedRotation | None = None
    inverse: InversePoses | None = None
    unlike: Resemblance | None = None

    @property
    def grossly(self) -> bool:
        """Whether something is wrong that no mounting explains."""
        turned = self.turned is not None and self.turned.angle_deg > GROSS_DEG
        return turned or self.inverse is not None or self.unlike is not None

    @classmethod
    def of(cls, log: VoLog, truth: TruthLog) -> Misread:
        """Of a log against its truth on its clock."""
        turned, inverse, like = fixed_rotation(log, truth), inverse_poses(log, truth), resemblance(log, truth)
        if inverse and not (turned and turned.error_change <= inverse.error_change):
            return cls(inverse=inverse)
        if like is not None and not like.alike and not turn_without_truth_deg(log, truth):
            return cls(unlike=like)
        return cls(turned=turned)


_SLIGHT, _WRITTEN_M = 1e-3, 1e-6


def _change(new: Array, old: Array, B: Array) -> Array:
    """Relative change of errors [m] of motions B (M, 4, 4), where those below a thousandth of the usual motion, and
    below the digits of a file, count as none: a vehicle that mostly rests errs by rounding."""
    least = max(_SLIGHT * float(np.sqrt((B[:, :3, 3] ** 2).sum(axis=1).mean())), _WRITTEN_M)
    return np.asarray(np.maximum(new, least) / np.maximum(old, least) - 1)
