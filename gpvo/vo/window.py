"""Several frames adjusted together: a sliding-window bundle adjustment, the setting ``window``.

This is :func:`gpvo.vo.motion.refine` over more than two frames. The points of a motion move in the (u, v, d) of its
reference, and earlier frames in which they were seen say more about where they are::

    min  sum_i |x_i + p_i - m_i|^2_S + sum_ij w_ij |f(T_ref_j, x_i) + p_i - m_ij|^2_S + p_i^2 / q

over the positions x_i, the poses T_ref_j of the current and earlier frames, and the disparity error p_i that a point
keeps, with variance q. The points are eliminated (B. Triggs et al., "Bundle adjustment, a modern synthesis", 2000,
section 6.1); with two frames alone this is the estimate of ``refine``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.stats.series import median
from gpvo.types import Array, StereoCamera
from gpvo.vo.frontend import Matches, keys
from gpvo.vo.motion import CHI2_3_999, CHI2_3_MEDIAN, Motion, huber, transfer
from gpvo.vo.points import PointNoise
from gpvo.vo.rig_error import RigError

_CHOOSING = 3  # iterations in which weights may change
_LEAST = 12  # points that a frame before the reference must share
_CHI2_6_999 = 22.458


@dataclass(frozen=True)
class Views:
    """What V frames beside the reference saw of its N points.

    ``uvd_ref`` (N, 3) measurements in the reference, ``uvd`` (V, N, 3) in the others, the current one last, [px];
    ``seen`` (V, N) where there is one; ``T_ref`` (V, 4, 4) the poses of these frames in the reference.
    """

    uvd_ref: Array
    uvd: Array
    seen: NDArray[np.bool_]
    T_ref: Array
    camera: StereoCamera


@dataclass(frozen=True)
class Adjusted:
    """Poses ``T_ref`` (V, 4, 4), places ``uvd`` (N, 3) of the points in the reference, the weight (V + 1, N) of each
    measurement, those of the reference first, and the derivatives ``G`` (V, N, 3, 3) by the places and ``H``
    (V, N, 3, 6) by the poses."""

    T_ref: Array
    uvd: Array
    weight: Array
    G: Array
    H: Array

    def information(self, S_uvd: Array) -> Array:
        """(6, 6) of the last pose, all others and the points being unknown, for measurements of covariance (3, 3)."""
        zero = np.zeros((*self.weight.shape, 3))
        used = np.where(self.weight > 0.5, 1.0, self.weight)  # counted whole, as in a single motion
        reduced = _Reduced.of(S_uvd, used, zero, self.G, self.H).information
        others, last = slice(0, -6), slice(-6, None)
        coupling = reduced[others, last]
        own: Array = reduced[last, last] - coupling.T @ np.linalg.solve(reduced[others, others], coupling)
        return own


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of the poses: ``information`` (6 V, 6 V) and ``gradient`` (6 V,), with the points eliminated;
    theirs are ``C_inverse`` (N, k, k), ``E`` (N, k, 6 V) and ``b`` (N, k)."""

    information: Array
    gradient: Array
    C_inverse: Array
    E: Array
    b: Array

    @classmethod
    def of(cls, S: Array, weight: Array, r: Array, G: Array, H: Array, kept: NDArray[np.float64] | None = None,
           persistent: float = 0.0) -> _Reduced:  # fmt: skip
        """From weights (W, N), residuals (W, N, 3) and derivatives (V, N, 3, 3) and (V, N, 3, 6); ``kept`` (N,): errors
        of disparity that points keep, of variance ``persistent``."""
        whiten, root = np.linalg.inv(np.linalg.cholesky(S)), np.sqrt(weight)
        n_views, n = len(G), len(r[0])
        D = np.empty((n_views + 1, n, 3, 4 if persistent else 3))
        D[0, :, :, :3], D[1:, :, :, :3] = whiten, whiten @ G
        if persistent:
            D[..., 3] = whiten[:, 2]
        D *= root[:, :, None, None]
        A, z = (whiten @ H) * root[1:, :, None, None], (r @ whiten.T) * root[:, :, None]
        Dt = np.swapaxes(D, 2, 3)
        C, b = (Dt @ D).sum(axis=0), (Dt @ z[..., None])[..., 0].sum(axis=0)
        if persistent and kept is not None:
            C[:, 3, 3] += 1.0 / persistent
            b[:, 3] -= kept / persistent
        E = (Dt[1:] @ A).transpose(1, 2, 0, 3).reshape(n, -1, 6 * n_views)
        C_inverse = np.asarray(np.linalg.inv(C), np.float64)
        taken = (C_inverse @ E).reshape(-1, 6 * n_views)
        information, gradient = -E.reshape(taken.shape).T @ taken, -taken.T @ b.ravel()
        for v in range(n_views):
            own, rows = slice(6 * v, 6 * v + 6), A[v].reshape(-1, 6)
            information[own, own] += rows.T @ rows
            gradient[own] += rows.T @ z[v + 1].ravel()
        return cls(information, gradient, C_inverse, E, b)

    def solve(self) -> tuple[Array, Array]:
        """Steps (V, 6) of the poses and (N, k) of the points; LinAlgError where a pose has lost all its points."""
        diagonal = np.diagonal(self.information)
        if not (diagonal > 0.0).all():
            raise np.linalg.LinAlgError("a pose without points")
        s = 1.0 / np.sqrt(diagonal)
        step = s * np.linalg.solve(self.information * s[:, None] * s, s * self.gradient)
        back = (self.C_inverse @ (self.b - self.E @ step)[:, :, None])[:, :, 0]
        return step.reshape(-1, 6), back


def adjust(
    views: Views, noise: PointNoise, *, robust: bool = True, tolerance: float = 1e-4, max_iterations: int = 8
) -> Adjusted | None:
    """Poses and points that explain all views best, by Gauss-Newton; None where that leads nowhere.

    ``robust``: measurements beyond the 99.9 % ellipsoid are left out, the rest weighted by Huber's rule, as in the
    motion of two frames. ``tolerance``: step of the poses [m, rad] at which it ends.
    """
    T, uvd, kept = views.T_ref, views.uvd_ref, np.zeros(len(views.uvd_ref))
    seen = np.concatenate([np.ones((1, len(uvd)), bool), views.seen])
    measured = np.concatenate([views.uvd_ref[None], views.uvd])
    weight = seen.astype(np.float64)
    whiten = np.linalg.inv(np.linalg.cholesky(noise.S))
    for iteration in range(1, max_iterations + 1):
        predicted, G, H, in_front = _predict(T, uvd, views.camera)
        r = np.where(seen[..., None], measured - np.concatenate([uvd[None], predicted]), 0.0)
        r[..., 2] -= kept * seen
        if robust and 1 < iteration <= _CHOOSING:
            m2 = ((r @ whiten.T) ** 2).sum(axis=2)
            ratio = m2 * CHI2_3_MEDIAN / max(median(m2[seen]), 0.02**2)
            weight = np.where(seen & (ratio < CHI2_3_999), huber(ratio), 0.0)
        weight[1:] *= in_front
        weight[0] = np.maximum(weight[0], 1e-6)  # no place is without any hold
        try:
            step, change = _Reduced.of(noise.S, weight, r, G, H, kept, noise.persistent).solve()
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all() or np.abs(step[:, 3:]).max() > 1.0:
            return None
        T, uvd = T @ se3.exp(step), uvd + change[:, :3]
        if noise.persistent:
            kept = kept + change[:, 3]
        if iteration > (_CHOOSING if robust else 0) and np.abs(step).max() < tolerance:
            break
    return Adjusted(T, uvd, weight, G, H)


def _predict(T_ref: Array, uvd: Array, camera: StereoCamera) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Of points (N, 3) in the reference, for each view: (V, N, 3) predictions, derivatives (V, N, 3, 3) by the point
    and (V, N, 3, 6) by the pose, and (V, N) whether they lie in front."""
    moved = [transfer(T, uvd, camera) for T in T_ref]
    G, H = (np.stack([np.moveaxis(a, 2, 0) for a in of]) for of in ([m.G for m in moved], [m.H for m in moved]))
    return np.stack([m.uvd.T for m in moved]), G, H, np.stack([m.in_front for m in moved])


@dataclass(frozen=True)
class _Frame:
    """A frame before the reference: its pose (4, 4) in the reference, its velocity (6,) per second, and the
    measurements (n, 3) of tracks (n,)."""

    T_ref: Array
    twist: Array
    track: NDArray[np.int64]
    uvd: Array


class Window:
    """The references before the present one, and what they saw of the points that are still followed.

    Parameters
    ----------
    camera : the rectified pair.
    size : frames that are adjusted together; with two there is nothing to do.
    rig_error : what is known of the calibration's errors.

    Measurements are kept as made, and freed from the rig's errors as these are known when they are used.
    """

    def __init__(self, camera: StereoCamera, size: int, rig_error: RigError) -> None:
        self._camera, self._size, self._rig_error = camera, size, rig_error
        self._frames: tuple[_Frame, ...] = ()
        self._tracks: dict[bytes, int] = {}  # of the reference's points, by measurement
        self._begun = 0
        self._next: tuple[tuple[_Frame, ...], dict[bytes, int]] = ((), {})

    def adjust(self, matches: Matches, motion: Motion, twists: tuple[Array, Array]) -> Adjusted | None:
        """The motion adjusted with the frames before it; None where it stands as it is: there are none, or they
        contradict it beyond its own noise. ``matches`` as measured; ``twists``: velocities at begin and end."""
        if self._size <= 2:
            return None
        before, now = matches.uvd_prev[motion.inliers], matches.uvd_cur[motion.inliers]
        track = np.array([self._tracks.get(k, self._begun + i) for i, k in enumerate(keys(before))], np.int64)
        self._begun += len(track)
        frames = [f for f in self._frames if np.isin(track, f.track).sum() >= _LEAST]
        T_ref = np.stack([*(f.T_ref for f in frames), motion.T_prev_cur])
        free = self._rig_error.correct(before, twists[0]), self._rig_error.correct(now, twists[1])
        found = self._solve(*free, track, frames, T_ref, motion.noise) if frames else None
        if found is not None:
            off = se3.log(se3.inverse(motion.T_prev_cur) @ found.T_ref[-1])
            if off @ motion.information @ off > _CHI2_6_999 * motion.scale_px**2:
                found = None
        T_cur = se3.inverse(T_ref[-1] if found is None else found.T_ref[-1])
        T_ref = T_cur @ (T_ref if found is None else found.T_ref)
        older = [replace(f, T_ref=T) for T, f in zip(T_ref[:-1], frames, strict=True)]
        kept = (*older, _Frame(T_cur, twists[0], track, before))[-(self._size - 2) :]
        self._next = kept, dict(zip(keys(now), track.tolist(), strict=True))
        return found

    def _solve(
        self, before: Array, now: Array, track: NDArray[np.int64], frames: list[_Frame], T_ref: Array, noise: PointNoise
    ) -> Adjusted | None:
        uvd, seen = np.zeros((len(T_ref), len(track), 3)), np.ones((len(T_ref), len(track)), bool)
        for v, frame in enumerate(frames):
            _, i, j = np.intersect1d(track, frame.track, return_indices=True)
            uvd[v, i] = self._rig_error.correct(frame.uvd[j], frame.twist)
            seen[v] = np.isin(np.arange(len(track)), i)
        uvd[-1] = now
        return adjust(Views(before, uvd, seen, T_ref, self._camera), noise)

    def advance(self, is_reference: bool) -> None:
        """The last frame is the new reference or not; if it had no motion, all begins anew with it."""
        if is_reference:
            self._frames, self._tracks = self._next
        self._next = (), {}
