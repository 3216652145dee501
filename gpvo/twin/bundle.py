"""A bundle adjustment: what it sees, the path and landmarks that it moves, and its normal equations, with the landmarks
eliminated, solved in time linear in the length.

The reduced matrix of the poses couples two frames that see a common landmark. Tracks are short, so it is banded, and
its Cholesky factor costs no more than its band. A landmark that is seen for longer would widen the band for all: it is
cut into pieces, each a landmark of its own, which makes a band of :data:`REACH` frames. The factor of this system
preconditions conjugate gradients on the full equations: one step if no track was cut, a few if some were.
S. Agarwal et al., "Bundle adjustment in the large" (2010), section 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded

from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.points import no_farther_than, point_jacobian, triangulate, triangulation_pixel_covariance

# Rows of (u, v, d) residuals at unit noise of the four image coordinates.
WHITEN = np.linalg.inv(np.linalg.cholesky(triangulation_pixel_covariance(1.0)))
_MIN_DISPARITY_PX = 0.05
_PART = 100_000
REACH = 20
"""Frames of a piece of a track."""


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

    @cached_property
    def own_view(self) -> NDArray[np.int64]:
        """The view (N,) in whose (u, v, d) each landmark moves: its nearest trusted one."""
        order = np.lexsort((-self.uvd[:, 2], ~self.trusted, self.track))
        return order[np.unique(self.track[order], return_index=True)[1]]

    def parts(self) -> Iterator[tuple[slice, Observations]]:
        """A hundred thousand at a time: matrices of each observation would need a gigabyte for a million."""
        for i in range(0, len(self.frame), _PART):
            rows = slice(i, i + _PART)
            part = Observations(self.camera, self.frame[rows], self.track[rows], self.uvd[rows], self.trusted[rows])
            yield rows, part


@dataclass(frozen=True)
class Estimate:
    """Poses ``T_world_cam`` (F, 4, 4) and landmarks ``points_world`` (N, 3) [m]."""

    T_world_cam: Array
    points_world: Array

    @classmethod
    def begin(cls, seen: Observations, T_world_cam: Array) -> Estimate:
        """Landmarks as triangulated in their own views."""
        return cls(T_world_cam, _triangulated(seen.uvd[seen.own_view], seen, T_world_cam))

    def in_camera(self, seen: Observations) -> Array:
        """(M, 3) each observation's landmark in its camera, never behind it."""
        T = self.T_world_cam[seen.frame]
        P: Array = np.einsum("mji,mj->mi", T[:, :3, :3], self.points_world[seen.track] - T[:, :3, 3])
        P[:, 2] = np.maximum(P[:, 2], _least_depth_m(seen.camera))
        return P

    def misfit_px(self, seen: Observations) -> Array:
        """(M, 3) what was measured, less the landmark projected."""
        return seen.uvd - seen.camera.project(self.in_camera(seen))

    def uvd(self, seen: Observations) -> Array:
        """(N, 3) the landmarks in their own views."""
        T = se3.inverse(self.T_world_cam[seen.frame[seen.own_view]])
        P = transform(T, self.points_world)
        P[:, 2] = np.maximum(P[:, 2], _least_depth_m(seen.camera))
        return seen.camera.project(P)

    def moved(self, step_cam: Array, step_uvd: Array, seen: Observations) -> Estimate:
        """After steps (F, 6) of the poses, on the right, and (N, 3) [px] of the landmarks."""
        points = _triangulated(self.uvd(seen) + step_uvd, seen, self.T_world_cam)
        return Estimate(self.T_world_cam @ se3.exp(step_cam), points)


def _triangulated(uvd: Array, seen: Observations, T_world_cam: Array) -> Array:
    """Landmarks (N, 3) in the world from (u, v, d) in their own views."""
    points = triangulate(no_farther_than(uvd, _MIN_DISPARITY_PX), seen.camera)
    return transform(T_world_cam[seen.frame[seen.own_view]], points)


def _least_depth_m(camera: StereoCamera) -> float:
    """Where a landmark is put that would come nearer, or behind the camera: half a baseline, 5 cm at most."""
    return min(0.05, 0.5 * camera.baseline_m)


def projection_jacobian(P: Array, camera: StereoCamera) -> Array:
    """Derivative (M, 3, 3) of (u, v, d) [px] by points (M, 3) in the camera [m]."""
    X, Y, Z = P.T
    J = np.zeros((len(P), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx_px / Z, -camera.fx_px * X / Z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy_px / Z, -camera.fy_px * Y / Z**2
    J[:, 2, 2] = -camera.fx_px * camera.baseline_m / Z**2
    return J


def pose_jacobian(P: Array) -> Array:
    """Derivative (M, 3, 6) of points (M, 3) in the camera by a right perturbation of its pose."""
    return np.concatenate([-np.broadcast_to(np.eye(3), (len(P), 3, 3)), se3.skew(P)], axis=2)


def summed(blocks: Array, index: NDArray[np.int64], count: int) -> Array:
    """(count, ...) blocks (M, ...), those of equal ``index`` (M,) added."""
    m = len(index)
    adding = sparse.csr_matrix((np.ones(m), (index, np.arange(m))), shape=(count, m))
    return np.asarray(adding @ blocks.reshape(m, -1)).reshape(-1, *blocks.shape[1:])


def transform(T: Array, points: Array) -> Array:
    """Each of the poses (n, 4, 4) applied to its own point (n, 3)."""
    moved: Array = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    return moved


@dataclass(frozen=True)
class Pieces:
    """Tracks cut into pieces of at most :data:`REACH` frames: ``piece`` (M,) of each observation, ``track`` (P,) of
    each piece, and ``order`` (M,) of the observations by piece, then frame."""

    piece: NDArray[np.int64]
    track: NDArray[np.int64]
    order: NDArray[np.int64]

    @classmethod
    def of(cls, seen: Observations) -> Pieces:
        """Where long tracks begin together, their cuts are spread, so that no frame loses all of them."""
        n = int(seen.track.max(initial=-1)) + 1
        first, last = np.full(n, np.iinfo(np.int64).max), np.zeros(n, np.int64)
        np.minimum.at(first, seen.track, seen.frame)
        np.maximum.at(last, seen.track, seen.frame)
        shift = np.where(last - first < REACH, 0, np.arange(n) % REACH)
        number = (seen.frame - first[seen.track] + shift[seen.track]) // REACH
        keys, piece = np.unique(np.stack([seen.track, number]), axis=1, return_inverse=True)
        piece = piece.ravel()
        return cls(piece, keys[0], np.lexsort((seen.frame, piece)))


@dataclass(frozen=True)
class NormalEquations:
    """``[[B, E], [E^T, C]]`` of poses and landmarks, with the gradients; ``C`` by pieces of landmarks."""

    B: Array  # (F, 6, 6)
    C: Array  # (P, 3, 3)
    E: sparse.bsr_matrix  # (6 F, 3 N), a block for each observation
    seen: Observations
    pieces: Pieces
    pose_gradient: Array  # (F, 6)
    point_gradient: Array  # (N, 3)

    @classmethod
    def of(cls, seen: Observations, pieces: Pieces, now: Estimate, root_weight: Array) -> NormalEquations:
        """At an estimate; ``root_weight`` (M,) of the observations [1/px]."""
        n_frames, n_tracks = len(now.T_world_cam), len(now.points_world)
        B, C = np.zeros((n_frames, 6, 6)), np.zeros((len(pieces.track), 3, 3))
        by_pose, by_point = np.zeros((n_frames, 6)), np.zeros((n_tracks, 3))
        blocks = np.empty((len(seen.frame), 6, 3))
        R = now.T_world_cam[:, :3, :3]
        lift = R[seen.frame[seen.own_view]] @ point_jacobian(now.uvd(seen), seen.camera)
        for rows, part in seen.parts():
            P, root = now.in_camera(part), root_weight[rows]
            r = (root[:, None] * ((part.uvd - seen.camera.project(P)) @ WHITEN.T))[:, :, None]
            slope = root[:, None, None] * (WHITEN @ projection_jacobian(P, seen.camera))
            A = slope @ pose_jacobian(P)
            A[part.frame == 0] = 0.0  # the first pose stays
            D = slope @ np.swapaxes(R[part.frame], 1, 2) @ lift[part.track]
            At, Dt = np.swapaxes(A, 1, 2), np.swapaxes(D, 1, 2)
            B += summed(At @ A, part.frame, n_frames)
            by_pose += summed((At @ r)[:, :, 0], part.frame, n_frames)
            C += summed(Dt @ D, pieces.piece[rows], len(C))
            by_point += summed((Dt @ r)[:, :, 0], part.track, n_tracks)
            blocks[rows] = At @ D
        starts = np.searchsorted(seen.frame, np.arange(n_frames + 1))
        E = sparse.bsr_matrix((blocks, seen.track, starts), shape=(6 * n_frames, 3 * n_tracks))
        return cls(B, C, E, seen, pieces, by_pose, by_point)

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Steps (F, 6) and (N, 3) of the damped equations."""
        B, whole = damped(self.B, damping), summed(self.C, self.pieces.track, len(self.point_gradient))
        C_inverse, of_pieces = (np.asarray(np.linalg.inv(damped(C, damping)), np.float64) for C in (whole, self.C))
        E_rows, E_columns = self.E, self.E.T
        eliminated = (C_inverse @ self.point_gradient[:, :, None])[:, :, 0]
        right = self.pose_gradient - (E_rows @ eliminated.ravel()).reshape(-1, 6)
        factor = cholesky_banded(self._band(B, of_pieces), lower=True)

        def reduced(x: Array) -> Array:
            y = (C_inverse @ (E_columns @ x.ravel()).reshape(-1, 3, 1)).ravel()
            return (B @ x[:, :, None])[:, :, 0] - (E_rows @ y).reshape(-1, 6)

        def precondition(x: Array) -> Array:
            return np.asarray(cho_solve_banded((factor, True), x.ravel(), check_finite=False)).reshape(-1, 6)

        pose_step = _conjugate_gradients(reduced, right, precondition)
        back = self.point_gradient - (E_columns @ pose_step.ravel()).reshape(-1, 3)
        return pose_step, (C_inverse @ back[:, :, None])[:, :, 0]

    def _band(self, B: Array, C_inverse: Array) -> Array:
        """``B - E C^-1 E^T`` with the landmarks in pieces, as (6 REACH, 6 F) lower diagonals."""
        n, order, piece = len(B), self.pieces.order, self.pieces.piece
        blocks = np.zeros((REACH * n, 6, 6))  # by distance of the two frames, then the earlier frame
        blocks[:n] = B
        for i in range(0, len(order), _PART):
            rows = order[i : i + _PART + REACH]
            frame, of_piece, E = self.seen.frame[rows], piece[rows], self.E.data[rows]
            # Small matrices are multiplied twice as fast where they lie in memory as they are.
            EC, Et = E @ C_inverse[of_piece], np.ascontiguousarray(np.swapaxes(E, 1, 2))
            for lag in range(REACH):
                a = np.flatnonzero(of_piece[: len(rows) - lag] == of_piece[lag:])
                a = a[a < _PART]  # later ones begin the next part
                if not len(a):
                    break
                near, far = frame[a], frame[a + lag]
                places, place = np.unique((far - near) * n + near, return_inverse=True)
                blocks[places] -= summed(EC[a + lag] @ Et[a], place, len(places))
        band = np.zeros((6 * REACH, 6 * n))
        by_distance = blocks.reshape(REACH, n, 6, 6)
        for d in range(REACH):
            for row in range(6):
                for column in range(6):
                    if (diagonal := 6 * d + row - column) >= 0:
                        band[diagonal, column::6] = by_distance[d, :, row, column]
        return band


def _conjugate_gradients(
    apply: Callable[[Array], Array], right: Array, precondition: Callable[[Array], Array]
) -> Array:
    """Solution (F, 6) of ``apply(x) = right``, to a hundredth; at most 300 products."""
    x, r = np.zeros_like(right), right.copy()
    z = precondition(r)
    p, rz = z, float((r * z).sum())
    goal = 1e-2**2 * rz
    for _ in range(300):
        if not rz > goal:
            break
        Ap = apply(p)
        alpha = rz / float((p * Ap).sum())
        x, r = x + alpha * p, r - alpha * Ap
        z = precondition(r)
        rz, before = float((r * z).sum()), rz
        p = z + (rz / before) * p
    return x


def damped(H: Array, damping: float) -> Array:
    """Blocks with Marquardt's damping; an empty block becomes the identity, so that its step is zero."""
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    empty = diagonal.max(axis=1, keepdims=True) <= 0
    extra = np.where(empty, 1.0, damping * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True))
    return H + extra[:, :, None] * np.eye(H.shape[1])
