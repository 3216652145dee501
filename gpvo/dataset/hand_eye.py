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

from gpvo.dataset.errors import interpolate_truth
from gpvo.errors import GpvoError, counted
from gpvo.geometry import se3
from gpvo.types import Array, TruthLog, VoLog

# Over a second a hand-held or flying camera turns enough for its lever arm to show; its drift does not matter yet.
WINDOW_S = 1.0
# What a lever arm is believed to be before the motions speak: an axis about which nothing turns stays near zero.
PRIOR_LEVER_M = 1.0
# And by how much attitudes and positions of a truth are turned against each other.
PRIOR_WORLDS_RAD = 0.03
MIN_MOTIONS = 10
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
    start, end, T, T_world = windows(log, truth)
    return between(T, start, end), between(T_world, start, end), T_world[end, :3, :3]


def windows(log: VoLog, truth: TruthLog) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
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


def between(T: Array, start: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    """(M, 4, 4) motions from the poses ``start`` to ``end`` (M,) of ``T`` (N, 4, 4)."""
    return np.asarray(se3.inverse(T[start]) @ T[end])


def fit_fixed_transform(
    A: Array, B: Array, attitudes: Array | None = None, *, lever_arm: bool = True
) -> FixedTransform:
    """``X`` with ``A X ~ X B``, robust against slips of the log.

    ``A``, ``B`` (M, 4, 4): motions of the log and of the truth over the same times. ``attitudes`` (M, 3, 3) of the
    truth at their ends: fit the rotation between the worlds of its attitudes and of its positions as well.
    ``lever_arm``: estimate the translation as well; else both origins are taken as one. Raises GpvoError for fewer than
    ten motions, or motions that do not determine the rotation.
    """
    if len(A) < MIN_MOTIONS:
        raise GpvoError(
            f"too few to align: {counted(len(A), 'window')} of {WINDOW_S:g} s with truth at both ends, none lost",
            cure="give a longer log, check the stamps, or leave --align out",
        )
    X, R, scale = _start(A, B), np.eye(3), np.array([1.0, 1.0])
    free = np.repeat([lever_arm, True, attitudes is not None], 3)
    ends = B[:, :3, :3] if attitudes is None else attitudes
    for _ in range(_ITERATIONS):
        told, by_R = _in_one_world(B, ends, R)
        r, J = residuals(A, told, X)
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


def residuals(A: Array, B: Array, X: Array) -> tuple[Array, Array]:
    """``r = Log((X B)^-1 A X)`` (M, 6) and its derivative (M, 6, 6) by the right perturbation of X, to first order.

    With X Exp(d) for X it is ``Log(Exp(-Ad(B^-1) d) (X B)^-1 A X Exp(d))``: ``r + d - Ad(B^-1) d`` for small r.
    """
    E = se3.inverse(X @ B) @ A @ X
    return se3.log(E), np.eye(6) - se3.adjoint(se3.inverse(B))


def _spread(r: Array) -> float:
    """Robust standard deviation per axis, never zero: rms of the axes' own, of which planar motions leave some at 0."""
    return max(1.4826 * float(np.sqrt((np.median(np.abs(r), axis=0) ** 2).mean())), 1e-9)


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
