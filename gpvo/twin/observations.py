"""What a bundle adjustment sees, and the path and landmarks that it moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.points import triangulate, triangulation_pixel_covariance

# Rows of (u, v, d) residuals at unit noise of the four image coordinates.
WHITEN = np.linalg.inv(np.linalg.cholesky(triangulation_pixel_covariance(1.0)))
_MIN_DEPTH_M, _MIN_DISPARITY_PX = 0.05, 0.05
PART = 100_000


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
        for i in range(0, len(self.frame), PART):
            rows = slice(i, i + PART)
            yield (
                rows,
                Observations(self.camera, self.frame[rows], self.track[rows], self.uvd[rows], self.trusted[rows]),
            )


@dataclass(frozen=True)
class Chart:
    """The view (N,) in whose (u, v, d) each landmark moves: its nearest trusted one."""

    view: NDArray[np.int64]

    @classmethod
    def of(cls, seen: Observations) -> Chart:
        """The chart of all landmarks that are seen."""
        order = np.lexsort((-seen.uvd[:, 2], ~seen.trusted, seen.track))
        first = np.unique(seen.track[order], return_index=True)[1]
        return cls(order[first])

    def begin(self, seen: Observations, T_world_cam: Array) -> Array:
        """Landmarks (N, 3) as triangulated in that view."""
        T = T_world_cam[seen.frame[self.view]]
        return transform(T, triangulate(seen.uvd[self.view], seen.camera))


@dataclass(frozen=True)
class Estimate:
    """Poses ``T_world_cam`` (F, 4, 4) and landmarks ``points_world`` (N, 3) [m]."""

    T_world_cam: Array
    points_world: Array

    def in_camera(self, seen: Observations) -> Array:
        """(M, 3) each observation's landmark in its camera, never behind it."""
        T = self.T_world_cam[seen.frame]
        P: Array = np.einsum("mji,mj->mi", T[:, :3, :3], self.points_world[seen.track] - T[:, :3, 3])
        P[:, 2] = np.maximum(P[:, 2], _MIN_DEPTH_M)
        return P

    def misfit_px(self, seen: Observations) -> Array:
        """(M, 3) what was measured, less the landmark projected."""
        return seen.uvd - seen.camera.project(self.in_camera(seen))

    def uvd(self, chart: Chart, seen: Observations) -> Array:
        """(N, 3) the landmarks in their own views."""
        T = se3.inverse(self.T_world_cam[seen.frame[chart.view]])
        P = transform(T, self.points_world)
        P[:, 2] = np.maximum(P[:, 2], _MIN_DEPTH_M)
        return seen.camera.project(P)

    def moved(self, step_cam: Array, step_uvd: Array, chart: Chart, seen: Observations) -> Estimate:
        """After steps (F, 6) of the poses, on the right, and (N, 3) [px] of the landmarks."""
        uvd = self.uvd(chart, seen) + step_uvd
        uvd[:, 2] = np.maximum(uvd[:, 2], _MIN_DISPARITY_PX)
        points = transform(self.T_world_cam[seen.frame[chart.view]], triangulate(uvd, seen.camera))
        return Estimate(self.T_world_cam @ se3.exp(step_cam), points)


def projection_jacobian(P: Array, camera: StereoCamera) -> Array:
    """Derivative (M, 3, 3) of (u, v, d) [px] by points (M, 3) in the camera [m]."""
    X, Y, Z = P.T
    J = np.zeros((len(P), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx_px / Z, -camera.fx_px * X / Z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy_px / Z, -camera.fy_px * Y / Z**2
    J[:, 2, 2] = -camera.fx_px * camera.baseline_m / Z**2
    return J


def summed(sums: sparse.csr_matrix, blocks: Array) -> Array:
    """Blocks (M, ...) added by rows of equal index."""
    total = sums @ blocks.reshape(len(blocks), -1)
    return np.asarray(total).reshape(-1, *blocks.shape[1:])


def transform(T: Array, points: Array) -> Array:
    """Each of the poses (n, 4, 4) applied to its own point (n, 3)."""
    moved: Array = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
    return moved
