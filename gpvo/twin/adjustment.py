"""Robust bundle adjustment: the path and the landmarks that explain a run's stereo tracks best.

Levenberg-Marquardt on the normal equations with the landmarks eliminated (Schur complement), solved by conjugate
gradients that never form the reduced matrix: memory and time per iteration grow with the observations alone. B. Triggs
et al., "Bundle adjustment, a modern synthesis" (2000), sections 6 and 7; S. Agarwal et al., "Bundle adjustment in the
large" (2010). A landmark moves in the (u, v, d) of one of its own views, where also far points are well conditioned.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.points import point_jacobian, triangulate, triangulation_pixel_covariance

# Rows of (u, v, d) residuals at unit noise of the four image coordinates.
WHITEN = np.linalg.inv(np.linalg.cholesky(triangulation_pixel_covariance(1.0)))
_CHI2_3_MEDIAN, _CHI2_3_999 = 2.366, 16.266
_HUBER_SIGMAS = 3.2
_MIN_DEPTH_M, _MIN_DISPARITY_PX, _MIN_SIGMA_PX = 0.05, 0.05, 0.02
# Iterations in which weights may change; then they stand, so that the cost has one minimum.
_CHOOSING = 6
_PART = 100_000


@dataclass(frozen=True)
class Observations:
    """M observations of N landmarks in F frames, in order of frame.

    ``frame``, ``track`` (M,) indices; ``uvd`` (M, 3) [px]; ``trusted`` (M,) whether it may take part in the fit.
    """

    camera: StereoCamera
    frame: NDArray[np.int64]
    track: NDArray[np.int64]
    uvd: Array
    trusted: NDArray[np.bool_]

    def sums(self, index: NDArray[np.int64], count: int) -> sparse.csr_matrix:
        """(count, M) matrix that adds the rows of equal index."""
        m = len(index)
        return sparse.csr_matrix((np.ones(m), (index, np.arange(m))), shape=(count, m))

    def parts(self) -> Iterator[tuple[slice, Observations]]:
        """A hundred thousand at a time: matrices of each observation would need a gigabyte for a million."""
        for i in range(0, len(self.frame), _PART):
            rows = slice(i, i + _PART)
            yield (
                rows,
                Observations(self.camera, self.frame[rows], self.track[rows], self.uvd[rows], self.trusted[rows]),
            )


@dataclass(frozen=True)
class Structure:
    """What was fitted: ``T_world_cam`` (F, 4, 4); ``points_world`` (N, 3) [m]; of each observation its ``residual_px``
    (M, 3), measured minus projected, and ``weight`` (M,), 0 for outliers; ``sigma_px`` (F,) noise of each frame."""

    T_world_cam: Array
    points_world: Array
    residual_px: Array
    weight: Array
    sigma_px: Array
    iterations: int
    converged: bool


def adjust(
    seen: Observations,
    T_world_cam: Array,
    *,
    robust: bool = True,
    tolerance: float = 1e-4,
    max_iterations: int = 30,
) -> Structure:
    """Fit path and landmarks, from the path (F, 4, 4) that odometry found; the first pose stays.

    ``robust``: each frame has its own noise, from its median residual; observations beyond the 99.9 % ellipsoid of
    their frame are left out, and the rest weighted by Huber's rule. ``tolerance``: relative decrease of the cost
    [-] at which the fit ends.
    """
    chart = _Chart.of(seen)
    now = _Estimate(T_world_cam, chart.begin(seen, T_world_cam))
    weight, sigma = seen.trusted.astype(np.float64), np.ones(len(T_world_cam))
    damping, converged, iteration = 1e-4, False, 0
    for iteration in range(1, max_iterations + 1):
        # Not at first: a landmark that begins at an outlier would call all its other views outliers.
        if robust and 1 < iteration <= _CHOOSING:
            weight, sigma = _robust_weights(seen, now, sigma)
        root = np.sqrt(weight) / sigma[seen.frame]
        normal = None  # frees the last one before the next is made
        normal = _Normal.of(seen, now, chart, root)
        cost = _cost(seen, now, root)
        for _ in range(8):
            step_cam, step_uvd = normal.solve(damping)
            candidate = now.moved(step_cam, step_uvd, chart, seen)
            after = _cost(seen, candidate, root)
            if after <= cost:
                break
            damping *= 10.0
        else:
            converged = True
            break
        now, damping = candidate, max(damping / 10.0, 1e-9)
        if iteration > (_CHOOSING if robust else 0) and cost - after <= tolerance * cost:
            converged = True
            break
    residual = seen.uvd - seen.camera.project(now.in_camera(seen))
    return Structure(now.T_world_cam, now.points_world, residual, weight, sigma, iteration, converged)


@dataclass(frozen=True)
class _Chart:
    """The view (N,) in whose (u, v, d) each landmark moves: its nearest trusted one."""

    view: NDArray[np.int64]

    @classmethod
    def of(cls, seen: Observations) -> _Chart:
        order = np.lexsort((-seen.uvd[:, 2], ~seen.trusted, seen.track))
        first = np.unique(seen.track[order], return_index=True)[1]
        return cls(order[first])

    def begin(self, seen: Observations, T_world_cam: Array) -> Array:
        """Landmarks (N, 3) as triangulated in that view."""
        T = T_world_cam[seen.frame[self.view]]
        return _transform(T, triangulate(seen.uvd[self.view], seen.camera))


@dataclass(frozen=True)
class _Estimate:
    T_world_cam: Array
    points_world: Array

    def in_camera(self, seen: Observations) -> Array:
        """(M, 3) each observation's landmark in its camera, never behind it."""
        T = self.T_world_cam[seen.frame]
        P: Array = np.einsum("mji,mj->mi", T[:, :3, :3], self.points_world[seen.track] - T[:, :3, 3])
        P[:, 2] = np.maximum(P[:, 2], _MIN_DEPTH_M)
        return P

    def uvd(self, chart: _Chart, seen: Observations) -> Array:
        """(N, 3) the landmarks in their own views."""
        T = se3.inverse(self.T_world_cam[seen.frame[chart.view]])
        P = _transform(T, self.points_world)
        P[:, 2] = np.maximum(P[:, 2], _MIN_DEPTH_M)
        return seen.camera.project(P)

    def moved(self, step_cam: Array, step_uvd: Array, chart: _Chart, seen: Observations) -> _Estimate:
        """After steps (F, 6) of the poses, on the right, and (N, 3) [px] of the landmarks."""
        uvd = self.uvd(chart, seen) + step_uvd
        uvd[:, 2] = np.maximum(uvd[:, 2], _MIN_DISPARITY_PX)
        points = _transform(self.T_world_cam[seen.frame[chart.view]], triangulate(uvd, seen.camera))
        return _Estimate(self.T_world_cam @ se3.exp(step_cam), points)


@dataclass(frozen=True)
class _Normal:
    """Normal equations ``[[B, E], [E^T, C]]`` of poses and landmarks, with the gradients."""

    B: Array  # (F, 6, 6)
    C: Array  # (N, 3, 3)
    E: sparse.bsr_matrix  # (6 F, 3 N), a block for each observation
    seen: Observations
    pose_gradient: Array  # (F, 6)
    point_gradient: Array  # (N, 3)

    @classmethod
    def of(cls, seen: Observations, now: _Estimate, chart: _Chart, root_weight: Array) -> _Normal:
        n_frames, n_tracks = len(now.T_world_cam), len(now.points_world)
        B, C = np.zeros((n_frames, 6, 6)), np.zeros((n_tracks, 3, 3))
        by_pose, by_point = np.zeros((n_frames, 6)), np.zeros((n_tracks, 3))
        blocks = np.empty((len(seen.frame), 6, 3))
        R = now.T_world_cam[:, :3, :3]
        lift = R[seen.frame[chart.view]] @ point_jacobian(now.uvd(chart, seen), seen.camera)
        for rows, part in seen.parts():
            P, root = now.in_camera(part), root_weight[rows]
            r = (root[:, None] * ((part.uvd - seen.camera.project(P)) @ WHITEN.T))[:, :, None]
            slope = root[:, None, None] * (WHITEN @ _projection_jacobian(P, seen.camera))
            A = slope @ np.concatenate([-np.broadcast_to(np.eye(3), (len(P), 3, 3)), se3.skew(P)], axis=2)
            A[part.frame == 0] = 0.0  # the first pose stays
            D = slope @ np.swapaxes(R[part.frame], 1, 2) @ lift[part.track]
            At, Dt = np.swapaxes(A, 1, 2), np.swapaxes(D, 1, 2)
            by_frame, by_track = part.sums(part.frame, n_frames), part.sums(part.track, n_tracks)
            B += _summed(by_frame, At @ A)
            C += _summed(by_track, Dt @ D)
            by_pose += _summed(by_frame, (At @ r)[:, :, 0])
            by_point += _summed(by_track, (Dt @ r)[:, :, 0])
            blocks[rows] = At @ D
        starts = np.searchsorted(seen.frame, np.arange(n_frames + 1))
        E = sparse.bsr_matrix((blocks, seen.track, starts), shape=(6 * n_frames, 3 * n_tracks))
        return cls(B, C, E, seen, by_pose, by_point)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Steps (F, 6) and (N, 3) of the damped equations."""
        B = _damped(self.B, damping)
        C_inverse = np.asarray(np.linalg.inv(_damped(self.C, damping)), np.float64)
        E_rows, E_columns = self.E, self.E.T
        eliminated = (C_inverse @ self.point_gradient[:, :, None])[:, :, 0]
        right = self.pose_gradient - (E_rows @ eliminated.ravel()).reshape(-1, 6)
        inverse_diagonal = np.asarray(np.linalg.inv(B - self._taken(C_inverse)), np.float64)

        def reduced(x: Array) -> Array:
            y = (C_inverse @ (E_columns @ x.ravel()).reshape(-1, 3, 1)).ravel()
            return (B @ x[:, :, None])[:, :, 0] - (E_rows @ y).reshape(-1, 6)

        pose_step = _conjugate_gradients(reduced, right, inverse_diagonal)
        back = self.point_gradient - (E_columns @ pose_step.ravel()).reshape(-1, 3)
        return pose_step, (C_inverse @ back[:, :, None])[:, :, 0]

    def _taken(self, C_inverse: Array) -> Array:
        """(F, 6, 6) diagonal blocks of ``E C^-1 E^T``, a part of the observations at a time."""
        total = np.zeros_like(self.B)
        for rows, part in self.seen.parts():
            blocks = self.E.data[rows]
            taken = blocks @ C_inverse[part.track] @ np.swapaxes(blocks, 1, 2)
            total += _summed(part.sums(part.frame, len(total)), taken)
        return total


def _conjugate_gradients(
    apply: Callable[[Array], Array], right: Array, preconditioner: Array, tolerance: float = 1e-2
) -> Array:
    """Solution (F, 6) of ``apply(x) = right``, with (F, 6, 6) inverse diagonal blocks; at most 300 products, as what
    is left after them, slow drift over the whole run, moves no pixel."""
    x, r = np.zeros_like(right), right.copy()
    z = (preconditioner @ r[:, :, None])[:, :, 0]
    p, rz = z, float((r * z).sum())
    goal = tolerance**2 * rz
    for _ in range(300):
        if not rz > goal:
            break
        Ap = apply(p)
        alpha = rz / float((p * Ap).sum())
        x, r = x + alpha * p, r - alpha * Ap
        z = (preconditioner @ r[:, :, None])[:, :, 0]
        rz, before = float((r * z).sum()), rz
        p = z + (rz / before) * p
    return x


def _damped(H: Array, damping: float) -> Array:
    """Blocks with Marquardt's damping; an empty block becomes the identity, so that its step is zero."""
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    empty = diagonal.max(axis=1, keepdims=True) <= 0
    extra = np.where(empty, 1.0, damping * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True))
    return H + extra[:, :, None] * np.eye(H.shape[1])


def _robust_weights(seen: Observations, now: _Estimate, sigma: Array) -> tuple[Array, Array]:
    """Weights (M,) and noise of each frame (F,) [px] from the residuals as they are."""
    m2 = ((seen.uvd - seen.camera.project(now.in_camera(seen))) @ WHITEN.T) ** 2
    m2 = m2.sum(axis=1)
    usual = float(np.median(m2[seen.trusted])) if seen.trusted.any() else 1.0
    starts = np.searchsorted(seen.frame, np.arange(len(sigma) + 1))
    variance = np.full(len(sigma), usual)
    for k, (i, j) in enumerate(itertools.pairwise(starts)):
        own = m2[i:j][seen.trusted[i:j]]
        if len(own) >= 5:
            variance[k] = np.median(own)
    sigma = np.maximum(np.sqrt(variance / _CHI2_3_MEDIAN), _MIN_SIGMA_PX)
    ratio = m2 / sigma[seen.frame] ** 2
    huber = np.minimum(1.0, _HUBER_SIGMAS / np.sqrt(np.maximum(ratio, 1e-12)))
    return np.where(seen.trusted & (ratio < _CHI2_3_999), huber, 0.0), sigma


def _cost(seen: Observations, now: _Estimate, root_weight: Array) -> float:
    z = (seen.uvd - seen.camera.project(now.in_camera(seen))) @ WHITEN.T
    return float((root_weight**2 * (z**2).sum(axis=1)).sum())


def _projection_jacobian(P: Array, camera: StereoCamera) -> Array:
    """Derivative (M, 3, 3) of (u, v, d) [px] by points (M, 3) in the camera [m]."""
    X, Y, Z = P.T
    J = np.zeros((len(P), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx_px / Z, -camera.fx_px * X / Z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy_px / Z, -camera.fy_px * Y / Z**2
    J[:, 2, 2] = -camera.fx_px * camera.baseline_m / Z**2
    return J


def _summed(sums: sparse.csr_matrix, blocks: Array) -> Array:
    """Blocks (M, ...) added by rows of equal index."""
    total = sums @ blocks.reshape(len(blocks), -1)
    return np.asarray(total).reshape(-1, *blocks.shape[1:])


def _transform(T: Array, points: Array) -> Array:
    """Each of the poses (n, 4, 4) applied to its own point (n, 3)."""
    moved: Array = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    return moved


def without_loose_frames(structure: Structure, seen: Observations, t_ns: NDArray[np.int64]) -> Structure:
    """Frames whose pose nothing determines take one between their neighbours', at the time that they have."""
    T = structure.T_world_cam.copy()
    held = np.bincount(seen.frame, structure.weight > 0, minlength=len(T)) >= 4
    held[0] = True
    known = np.flatnonzero(held)
    for k in np.flatnonzero(~held):
        j = int(np.searchsorted(known, k))
        if j < len(known):
            a, b = known[j - 1], known[j]
            T[k] = se3.interpolate(T[a], T[b], np.asarray((t_ns[k] - t_ns[a]) / (t_ns[b] - t_ns[a])))
    return replace(structure, T_world_cam=T)
