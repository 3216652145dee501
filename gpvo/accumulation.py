"""How the errors of single motions add up along a path: the one recursion that filters, messages and learning share.

The error of a pose is ``e_k = Ad(T_k)^-1 e_(k-1) + xi_k``, right perturbation, in the axes of the last camera, and that
of a motion ``xi_k = n_k - Ad(T_k)^-1 n_(k-1) + w_k + L_k u_k``. Two-frame VO shares the pixel noise n of each frame
between two motions, with opposite sign, as if that frame's pose were off by n; w is white; what persists (errors of
calibration, bias of depth) is ``L u`` with u first-order Gauss-Markov of unit variance (A. Gelb, "Applied Optimal
Estimation" (1974), section 3.8). So jitter never adds up: a pose contains that of the last frame
and, transported along the path, that of the first.

A ``lost`` motion was not computed from any frame's pixels: it adds its covariance and shares nothing, and the next
motion brings in the noise of the frame where it starts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from gpvo.geometry import se3
from gpvo.geometry.covariance import change_body, scaled_root, symmetrise
from gpvo.types import Array, MotionError, VoRecord

_E, _N = slice(0, 6), slice(6, 12)
_U = 12


def carry(T_prev_cur: Array) -> Array:
    """(..., 6, 6) ``Ad(T)^-1``: takes an error of the pose before a motion to the pose after it."""
    return se3.adjoint(se3.inverse(T_prev_cur))


def frame_jitter(jitter: Array) -> Array:
    """Covariance (..., 6, 6) of the noise of the frame where a motion of this jitter ends, in that frame's axes."""
    return 0.5 * jitter


def first_jitter(T_prev_cur: Array, jitter: Array) -> Array:
    """The same of the frame where a motion starts, if no motion before it has ended there: the motion's other half."""
    return change_body(T_prev_cur, frame_jitter(jitter))


def from_start(error: MotionError, carried: Array) -> Array | float:
    """d(error of a motion) / d(noise of the frame where it starts), with its ``Ad(T)^-1`` (..., 6, 6)."""
    return 0.0 if error.lost else -carried


def from_end(error: MotionError) -> Array | float:
    """Covariance (..., 6, 6) of the noise that a motion shares with those that start where it ends."""
    return 0.0 if error.lost else frame_jitter(error.jitter)


def independent_part(error: MotionError) -> Array:
    """Covariance (..., 6, 6) of what a motion shares with no other."""
    return error.white + error.jitter if error.lost else error.white


def between_ends(T_last_cur: Array, last: MotionError, error: MotionError, dt_s: float) -> Array:
    """Covariance (6, 6) of the motion ``T_last_cur`` between the ends, ``dt_s`` apart, of motions from one reference.

    The reference's noise is in neither; of what persists there remains the difference, as of a scale that is wrong.
    """
    both, moved = stacked([last, error]), carry(T_last_cur)
    own = frame_jitter(both.jitter) + both.white
    kept = persistence(dt_s, both.persistent_tau_s)
    before, now = both.persistent_root
    changed, new = now * kept - moved @ before, now * np.sqrt(1.0 - kept**2)
    return np.asarray(own[1] + moved @ own[0] @ moved.T + changed @ changed.T + new @ new.T)


def measured(record: VoRecord, method: str) -> MotionError:
    """The error of a record's motion by one of its covariances. Raises KeyError where it has none of this name."""
    if not record.shared:
        return MotionError.independent(record.covariances[method], dt_s=record.dt_s)
    shared = sum(record.shared.values(), np.zeros((6, 6)))
    return with_shared(record.covariances[method], shared, record.T_prev_cur, dt_s=record.dt_s)


def with_shared(covariance: Array, shared: Array, T_prev_cur: Array, *, dt_s: float | Array = 0.0) -> MotionError:
    """Errors of this covariance (..., 6, 6), of which ``shared`` (..., 6, 6) comes from what motions have in common.

    A wrong calibration makes the same error of all motions in one direction, and the opposite one of the way back: to
    first order it bends the scene, and motion is in proportion. So the translation's shared error has a vector for each
    direction of motion, and the rotation's goes with it; the rest of the rotation's counts as white.
    """
    t = T_prev_cur[..., :3, 3]
    length = np.linalg.norm(t, axis=-1)[..., None]
    way = t / np.where(length > 0.0, length, 1.0)  # none at rest
    # The root of the translation's part, and the turn that goes with it; without axes in which it is as good as none.
    both = shared[..., :3] @ np.swapaxes(np.linalg.pinv(scaled_root(shared[..., :3, :3]), 1e-3), -1, -2)
    by_way = (both[..., :, None, :] * way[..., None, :, None]).reshape(*both.shape[:-1], 9)
    return MotionError(
        mean=np.zeros(t.shape[:-1] + (6,)),
        jitter=np.zeros_like(covariance),
        white=symmetrise(covariance - by_way @ np.swapaxes(by_way, -1, -2)),
        persistent_root=by_way,
        persistent_tau_s=np.full(9, np.inf),
        dt_s=dt_s,
    )


def persistence(dt_s: ArrayLike, tau_s: Array) -> Array:
    """(..., P) correlation ``exp(-dt / tau)`` of the persistent vector over ``dt_s`` (...)."""
    return np.asarray(np.exp(-np.maximum(dt_s, 0.0)[..., None] / np.maximum(tau_s, 1e-9)))


class PoseError:
    """Mean and covariance of the error of a pose, or of a batch of poses, motion by motion.

    The joint state is (e, n, u): error of the pose, noise of its frame, and the persistent vector, so that a part
    whose size or sign changes stays correlated with what it was.
    """

    def __init__(self, *batch: int) -> None:
        self._mean = np.zeros((*batch, 6))
        self._P = np.zeros((*batch, _U, _U))
        self._jitter_known = False
        self._unaged_s: Array = np.zeros(batch)

    @property
    def mean(self) -> Array:
        """(..., 6) of the pose."""
        return self._mean

    @property
    def covariance(self) -> Array:
        """(..., 6, 6) of the pose."""
        return symmetrise(self._P[..., _E, _E])

    def head(self, n: int) -> PoseError:
        """The first ``n`` of a batch."""
        few = PoseError()
        few._mean, few._P, few._unaged_s = self._mean[:n], self._P[:n], self._unaged_s[:n]
        few._jitter_known = self._jitter_known
        return few

    def after(self, T_prev_cur: Array, error: MotionError) -> PoseError:
        """The error of the pose after a motion ``T_prev_cur`` (..., 4, 4) of this error; several may start here."""
        if not (self._jitter_known or error.lost):
            # The first motion that starts here says how noisy this frame is.
            self._P[..., _N, _N] = first_jitter(T_prev_cur, error.jitter)
            self._jitter_known = True
        further = PoseError()
        further._P, further._unaged_s = self._P, self._unaged_s
        root, phi = further._aged(error)
        own, P, moved = from_end(error), further._P, carry(T_prev_cur)
        kept, U = phi[..., None, :], slice(_U, P.shape[-1])
        A = np.zeros_like(P)
        A[..., _E, _E] = moved
        A[..., _E, _N] = from_start(error, moved)
        A[..., _E, U] = root * kept
        A[..., U, U] = kept * np.eye(phi.shape[-1])
        P = A @ P @ np.swapaxes(A, -1, -2)
        # What is new: the frame's noise enters the error and its own place, and so does the innovation of u.
        innovation = 1.0 - kept**2
        new = root * innovation
        P[..., _E, _E] += independent_part(error) + own + new @ np.swapaxes(root, -1, -2)
        for row, column in ((_E, _N), (_N, _E), (_N, _N)):
            P[..., row, column] += own
        P[..., _E, U] += new
        P[..., U, _E] += np.swapaxes(new, -1, -2)
        P[..., U, U] += innovation * np.eye(phi.shape[-1])
        further._P, further._jitter_known = P, not error.lost
        further._mean = (moved @ self._mean[..., None])[..., 0] + error.mean
        return further

    def _aged(self, error: MotionError) -> tuple[Array, Array]:
        """Root (..., 6, P) and correlation (..., P) since the vector last aged; an error without one lets time pass."""
        known, P = self._P.shape[-1] - _U, len(error.persistent_tau_s)
        elapsed_s = self._unaged_s + error.dt_s
        if P == 0:
            self._unaged_s = elapsed_s
            return np.zeros((6, known)), np.ones(known)
        if known != P:
            # It starts in its steady state; of another one, as of another model, what it did to the pose remains.
            joint = np.zeros((*self._P.shape[:-2], _U + P, _U + P))
            joint[..., :_U, :_U] = self._P[..., :_U, :_U]
            joint[..., range(_U, _U + P), range(_U, _U + P)] = 1.0
            self._P = joint
        self._unaged_s = np.zeros_like(elapsed_s)
        return error.persistent_root, persistence(elapsed_s, error.persistent_tau_s)


def over_windows(
    T_prev_cur: Array, errors: Sequence[MotionError] | Mapping[int, MotionError], windows: Sequence[Sequence[int]]
) -> Array:
    """Covariance (W, 6, 6) of the motion over each of several windows of a log, all of them step by step together.

    ``T_prev_cur`` (N, 4, 4) motions with their ``errors``, of one model; ``windows``: the motions in each, none lost.
    """
    order = sorted(range(len(windows)), key=lambda w: -len(windows[w]))
    used = sorted({k for window in windows for k in window})
    T, batch, at = T_prev_cur[used], stacked([errors[k] for k in used]), {k: i for i, k in enumerate(used)}
    pose, covariance = PoseError(len(windows)), np.empty((len(windows), 6, 6))
    for step in range(len(windows[order[0]])):
        going = [w for w in order if len(windows[w]) > step]
        now = [at[windows[w][step]] for w in going]
        pose = pose.head(len(now)).after(T[now], batch.row(now))
        covariance[going] = pose.covariance
    return covariance


def stacked(errors: Sequence[MotionError]) -> MotionError:
    """A batch of the errors, of the worst status among them. One without the persistent vector of the longest has a
    root of zero, and what persists in it counts as white."""
    tau_s = max((e.persistent_tau_s for e in errors), key=len)
    none, has = np.zeros((6, len(tau_s))), [len(e.persistent_tau_s) == len(tau_s) for e in errors]
    return MotionError(
        mean=np.array([e.mean for e in errors]),
        jitter=np.array([e.jitter for e in errors]),
        white=np.array([e.white if own else e.white + e.persistent for e, own in zip(errors, has, strict=True)]),
        persistent_root=np.array([e.persistent_root if own else none for e, own in zip(errors, has, strict=True)]),
        persistent_tau_s=tau_s,
        dt_s=np.array([e.dt_s for e in errors]),
        status=max((e.status for e in errors), key=lambda status: status.severity),
    )


def along(T_prev_cur: Array, errors: Sequence[MotionError], parent: Iterable[int]) -> tuple[Array, Array]:
    """Mean (N, 6) and covariance (N, 6, 6) of the error of every pose of a log.

    ``T_prev_cur`` (N, 4, 4) motions with their ``errors``; ``parent``: the pose that each starts from, -1 for the
    origin, which is known.
    """
    states: dict[int, PoseError] = {}
    parent = list(parent)
    starts = set(parent)  # while a vehicle stands, hours of motions start from one pose, and none from their ends
    mean, covariance = np.zeros((len(errors), 6)), np.zeros((len(errors), 6, 6))
    for k, (T, error, p) in enumerate(zip(T_prev_cur, errors, parent, strict=True)):
        state = PoseError() if p < 0 else states[p].after(T, error)
        mean[k], covariance[k] = state.mean, state.covariance
        if k in starts:
            states[k] = state
        # No motion starts before the reference of this one.
        for old in [j for j in states if j < p]:
            del states[old]
    return mean, covariance


def adjoints_to_end(T_prev_cur: Array) -> Array:
    """(w, m, 6, 6) that carry an error from after each motion to after the last; motions (w, m, 4, 4)."""
    since = np.empty_like(T_prev_cur)
    since[:, -1] = np.eye(4)
    for k in range(T_prev_cur.shape[1] - 2, -1, -1):
        since[:, k] = T_prev_cur[:, k + 1] @ since[:, k + 1]
    return carry(since)


def persistent_sum(root: Array, phi: Array) -> Array:
    """(w, n, n) covariance of ``sum_k L_k u_k`` over windows of m motions.

    ``root`` (w, m, n, P): L, all in the same axes; ``phi`` (w, m, P): correlation of u from the motion before to each.
    """
    before = np.zeros_like(root)
    for k in range(1, root.shape[1]):
        before[:, k] = (before[:, k - 1] + root[:, k - 1]) * phi[:, k, None, :]
    w, m, n, p = root.shape
    # The sum over motions is one product a window.
    A, B = (X.swapaxes(1, 2).reshape(w, n, m * p) for X in (root + 2.0 * before, root))
    return symmetrise(A @ B.swapaxes(1, 2))
