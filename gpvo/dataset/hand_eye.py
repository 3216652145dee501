"""The fixed transform between the frame of a log and that of its truth, from their motions alone.

Both describe one rigid body, so their motions A (log) and B (truth) over the same times satisfy ``A X = X B`` with the
unknown ``X = T_log_truth`` (Y. Shiu, S. Ahmad, "Calibration of wrist-mounted robotic sensors by solving homogeneous
transform equations of the form AX = XB", 1989).

A ground truth may itself have a constant error: if its positions and its attitudes come from different instruments, as
in motion capture, each may have a world of its own, rotated relative to the other. No X corrects that: the turns
require one, the directions of travel another. The rotation between the two worlds is then fitted as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.clock import estimate_time_offset, on_clock_of_log
from gpvo.dataset.errors import interpolate_truth, turn_without_truth_deg
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoLog

# Over a second a hand-held or flying camera turns enough for its lever arm to show; its drift does not matter yet.
WINDOW_S = 1.0
# What a lever arm is believed to be before the motions speak: an axis about which nothing turns stays near zero.
PRIOR_LEVER_M = 1.0
# And by how much attitudes and positions of a truth are turned against each other.
PRIOR_WORLDS_RAD = 0.03
_MIN_MOTIONS = 10
_ITERATIONS = 30


@dataclass(frozen=True)
class FixedTransform:
    """``T_log_truth`` (4, 4) and the robust spread of the translations that it leaves, per axis: ``residual_m``.

    ``R_position_attitude`` (3, 3): from the world of the truth's attitudes to that of its positions, the identity where
    it was not fitted.
    """

    T_log_truth: Array
    residual_m: float
    R_position_attitude: Array = field(default_factory=lambda: np.eye(3))

    @property
    def angle_deg(self) -> float:
        """Angle between the two frames [deg]."""
        return float(np.rad2deg(np.linalg.norm(se3.so3_log(self.T_log_truth[:3, :3]))))

    @property
    def lever_m(self) -> float:
        """Distance of the two origins [m]."""
        return float(np.linalg.norm(self.T_log_truth[:3, 3]))

    @property
    def worlds_deg(self) -> float:
        """Angle between the worlds of the truth's attitudes and positions [deg]."""
        return float(np.rad2deg(np.linalg.norm(se3.so3_log(self.R_position_attitude))))

    def in_log_frame(self, T_world_truth: Array) -> Array:
        """Poses of the truth (N, 4, 4) as those of the log's frame, in the world of its positions."""
        T = np.array(T_world_truth)
        T[:, :3, :3] = self.R_position_attitude @ T[:, :3, :3]
        return T @ se3.inverse(self.T_log_truth)


def windowed_motions(log: VoLog, truth: TruthLog) -> tuple[Array, Array, Array]:
    """Motions (M, 4, 4) of the log and (M, 4, 4) of the truth over windows of :data:`WINDOW_S`, by half-windows; and
    the truth's attitudes (M, 3, 3) at their ends.

    Windows that hold a lost frame or lack truth at an end are left out.
    """
    start, end, T, T_world = _windows(log, truth)
    return _between(T, start, end), _between(T_world, start, end), T_world[end, :3, :3]


def _windows(log: VoLog, truth: TruthLog) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
    """First and last frame of each window, and the poses (N, 4, 4) of log and truth."""
    t, T = log.t_ns, log.trajectory()
    dt = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    span = max(1, round(WINDOW_S * 1e9 / dt)) if dt > 0 else 1
    start = np.arange(0, len(t) - span, max(1, span // 2))
    end = start + span
    lost = np.cumsum(~log.usable)
    whole = (lost[end] == lost[start]) & (t[end] - t[start] < 2 * max(WINDOW_S * 1e9, dt))
    T_world, known = interpolate_truth(truth, t)
    keep = whole & known[start] & known[end]
    return start[keep], end[keep], T, T_world


def _between(T: Array, start: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    return np.asarray(se3.inverse(T[start]) @ T[end])


def fit_fixed_transform(
    A: Array, B: Array, attitudes: Array | None = None, *, lever_arm: bool = True
) -> FixedTransform:
    """``X`` with ``A X ~ X B``, robust against slips of the log.

    Parameters
    ----------
    A, B : (M, 4, 4) motions of the log and of the truth over the same times.
    attitudes : (M, 3, 3) of the truth at their ends, to fit the rotation between the worlds of its attitudes and of its
        positions as well.
    lever_arm : estimate the translation as well; else both origins are taken as one.

    Raises
    ------
    GpvoError
        For fewer than ten motions, or motions that do not determine the rotation.
    """
    if len(A) < _MIN_MOTIONS:
        raise GpvoError(
            f"only {len(A)} windows of {WINDOW_S:g} s have truth at both ends and no lost frame, too few to align",
            cure="give a longer log, check the stamps, or leave --align out",
        )
    X, R, scale = _start(A, B), np.eye(3), np.array([1.0, 1.0])
    free = np.repeat([lever_arm, True, attitudes is not None], 3)
    ends = B[:, :3, :3] if attitudes is None else attitudes
    for _ in range(_ITERATIONS):
        told, by_R = _in_one_world(B, ends, R)
        r, J = _residuals(A, told, X)
        J = np.concatenate([J, by_R], axis=2)
        scale = np.array([_spread(r[:, :3]), _spread(r[:, 3:])])
        H, g = _normal_equations(r, J, scale, X, R)
        step = np.zeros(9)
        step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
        X, R = X @ se3.exp(step[:6]), R @ se3.so3_exp(step[6:])
        if not lever_arm:
            X[:3, 3] = 0.0
        if np.abs(step).max() < 1e-10:
            break
    return FixedTransform(se3.orthonormalise(X), float(scale[0]), R)


def align_frames(log: VoLog, truth: TruthLog, align: str) -> FixedTransform:
    """The fixed rotation between the frames of a log and its truth, or with ``align`` "transform" also their lever arm
    and the rotation between the worlds of the truth's attitudes and positions.

    Raises GpvoError for another word, or where the motions do not tell it.
    """
    if align not in ("rotation", "transform"):
        raise GpvoError(f"unknown alignment '{align}'", cure="none, rotation or transform")
    A, B, attitudes = windowed_motions(log, truth)
    whole = align == "transform"
    return fit_fixed_transform(A, B, attitudes if whole else None, lever_arm=whole)


@dataclass(frozen=True)
class FixedRotation:
    """``rotvec_rad`` (3,) from the truth's camera to the log's, and ``lever_m`` between their origins, 0 where a lever
    arm does not matter; ``error_change``: relative change without them of the median error over a second, on the halves
    of the run that they were not fitted to."""

    angle_deg: float
    rotvec_rad: tuple[float, ...]
    error_change: float
    lever_m: float = 0.0


MATTERS = -0.1
"""Change of the error from which a fixed rotation, or a lever arm, is reported."""


def fixed_rotation(log: VoLog, truth: TruthLog) -> FixedRotation | None:
    """A fixed rotation between truth and odometry, and a lever arm if it matters beside that; None where neither shows
    or matters."""
    A, B, _ = windowed_motions(log, truth)
    half, found = len(A) // 2, None
    if half < _MIN_MOTIONS:
        return None
    parts = slice(None, half), slice(half, None)
    try:
        plain = least = np.array([np.median(_errors(A[p], B[p], np.eye(4))[0]) for p in parts])
        for lever_arm in (False, True):
            X = [fit_fixed_transform(A[p], B[p], lever_arm=lever_arm).T_log_truth for p in parts]
            fixed = fit_fixed_transform(A, B, lever_arm=lever_arm)
            left = np.array([np.median(_errors(A[p], B[p], x)[0]) for p, x in zip(parts, X[::-1])])
            if _change(left, least, B).max() <= MATTERS:
                rotvec = tuple(se3.so3_log(fixed.T_log_truth[:3, :3]).tolist())
                change = float(_change(left, plain, B).mean())
                found, least = FixedRotation(fixed.angle_deg, rotvec, change, fixed.lever_m), left
    except GpvoError:  # a path too straight to tell
        pass
    return found


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
    start, end, T, T_world = _windows(log, truth)
    if len(start) < _MIN_MOTIONS:
        return None
    A, B = _between(T, start, end), _between(T_world, start, end)
    pairs = {
        "as they are": (A, B),
        "odometry": (_between(se3.inverse(T), start, end), B),
        "truth or odometry": (A, _between(se3.inverse(T_world), start, end)),
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
    start, end, T, T_world = _windows(log, truth)
    if len(start) < _MIN_MOTIONS:
        return None
    A, B = _between(T, start, end), _between(T_world, start, end)
    moves, true_moves = _moves(T, start, end), _moves(T_world, start, end)
    size = _sizes(B)
    if not (moves[0] and true_moves[0]):
        ratio = float(np.sqrt((_sizes(A)[0] ** 2).sum() / max((size[0] ** 2).sum(), _WRITTEN_M**2)))
        one_rests = (moves[0] and ratio > _TIMES_REST) or (true_moves[0] and ratio < 1 / _TIMES_REST)
        return Resemblance(ratio, 1.0, 0.0, 1.0) if one_rests else None
    moving = size > 0.5 * np.sqrt((size**2).mean(axis=1, keepdims=True))
    scale = float(np.median(_sizes(A)[0, moving[0]] / size[0, moving[0]]))
    A[:, :3, 3] /= max(scale, 1e-12)
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


def _sizes(motions: Array) -> Array:
    """(2, M) lengths [m] and angles [rad] of motions (M, 4, 4)."""
    return np.stack([np.linalg.norm(v, axis=1) for v in (motions[:, :3, 3], se3.so3_log(motions[:, :3, :3]))])


def _moves(T: Array, start: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(2,) whether poses (N, 4, 4) travel, and turn, over windows of more than one frame by more than their noise."""
    half = (start + end) // 2
    whole, part = (np.sqrt((_sizes(_between(T, start, e)) ** 2).mean(axis=1)) for e in (end, half))
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
        if len(A) < _MIN_MOTIONS:
            return None
        found.append(_errors_of_halves(A, B))
    change = _change(found[1], found[0], B)
    return offset_s if change.max() < MATTERS else None


def _errors(A: Array, B: Array, X: Array) -> Array:
    """(2, M) sizes of the residuals, [m] and [rad]."""
    return np.linalg.norm(_residuals(A, B, X)[0].reshape(-1, 2, 3), axis=2).T


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


def _start(A: Array, B: Array) -> Array:
    """Rotation that takes the truth's rotation vectors and directions of travel to the log's (W. Kabsch, 1976)."""
    pairs = []
    for pick in (lambda T: se3.so3_log(T[:, :3, :3]), lambda T: T[:, :3, 3]):
        a, b = pick(A), pick(B)
        size = np.sqrt(np.median((b**2).sum(1)))
        if size > 1e-9:
            # One slip must not turn the start: lengths are limited to thrice the usual one.
            limit = np.minimum(1.0, 3 * size / np.maximum(np.linalg.norm(a, axis=1), 1e-12))
            pairs.append((a * limit[:, None] / size, b / size))
    if not pairs:
        raise GpvoError("the motions do not show how the frames are rotated", cure="use a log that moves")
    M = sum((a.T @ b for a, b in pairs), np.zeros((3, 3)))
    U, S, Vt = np.linalg.svd(M)
    if S[1] < 1e-4 * S[0]:
        raise GpvoError("the motions do not show how the frames are rotated", cure="use a log that turns as well")
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return se3.from_rt(R, np.zeros(3))


def _residuals(A: Array, B: Array, X: Array) -> tuple[Array, Array]:
    """``r = Log((X B)^-1 A X)`` (M, 6) and its derivative (M, 6, 6) by the right perturbation of X, to first order.

    With X Exp(d) for X it is ``Log(Exp(-Ad(B^-1) d) (X B)^-1 A X Exp(d))``: ``r + d - Ad(B^-1) d`` for small r.
    """
    E = se3.inverse(X @ B) @ A @ X
    return se3.log(E), np.eye(6) - se3.adjoint(se3.inverse(B))


def _spread(r: Array) -> float:
    """Robust standard deviation per axis, never zero."""
    return max(1.4826 * float(np.median(np.abs(r))), 1e-9)


def _in_one_world(B: Array, attitudes: Array, R: Array) -> tuple[Array, Array]:
    """The truth's motions (M, 4, 4), its positions told in the world of its attitudes, which ``R`` takes to theirs; and
    the derivative (M, 6, 3) of the residuals by the right perturbation of R.

    Over a window, positions move by p in the world of attitudes; ``R Exp(d)`` turns that to ``p + [p]x d``, and at the
    window's end the residual is less by it.
    """
    start = attitudes @ np.swapaxes(B[:, :3, :3], 1, 2)
    p = np.einsum("kj,mkl,ml->mj", R, start, B[:, :3, 3], optimize=True)
    told, by_R = B.copy(), np.zeros((len(B), 6, 3))
    told[:, :3, 3] = np.einsum("mji,mj->mi", start, p)
    by_R[:, :3] = -np.swapaxes(attitudes, 1, 2) @ se3.skew(p)
    return told, by_R


def _normal_equations(r: Array, J: Array, scale: Array, X: Array, R_worlds: Array) -> tuple[Array, Array]:
    """Weighted by the spread of each kind, each motion by Cauchy's function; and the priors, of the lever arm and of
    the rotation between the truth's worlds."""
    w = np.repeat(1.0 / scale**2, 3)
    q = (r**2 * w).sum(1) / 6.0
    weight = 1.0 / (1.0 + q / 4.0)
    H = np.einsum("m,mki,k,mkj->ij", weight, J, w, J, optimize=True)
    g = np.einsum("m,mki,k,mk->i", weight, J, w, r, optimize=True)
    # The step moves the origin by R d: the prior is on the length of the lever arm.
    R, t = X[:3, :3], X[:3, 3]
    H[:3, :3] += np.eye(3) / PRIOR_LEVER_M**2
    g[:3] += R.T @ t / PRIOR_LEVER_M**2
    H[6:, 6:] += np.eye(3) / PRIOR_WORLDS_RAD**2
    g[6:] += se3.so3_log(R_worlds) / PRIOR_WORLDS_RAD**2
    return H, g
