"""Stereo points: triangulation, the covariance of a point from that of its pixels, and theirs from residuals.

A measurement is ``(u, v, d)``: left column, row (mean of both images) and disparity [px].

Sources: L. Matthies, S. Shafer, "Error modeling in stereo navigation" (1987), eqs. 3-8; D. Ross, thesis, eq. 3.4 and
section 3.2. Two errata of the thesis are corrected as intended: eq. 3.4's coordinates are in focal lengths
with the origin midway between the cameras and a baseline of 2 b; the pointing/matching covariance holds squares of
sigma_p and sigma_m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpvo.types import Array, StereoCamera

# (uL, vL, uR, vR) to (u, v, d): the row is the mean of both images.
_PIXELS_TO_UVD = np.array([[1.0, 0, 0, 0], [0, 0.5, 0, 0.5], [1.0, 0, -1.0, 0]])
_RATIO2 = 0.1**2, 2.0**2  # what the square of pointing over matching may be


def no_farther_than(uvd: Array, disparity_px: float) -> Array:
    """(N, 3) the same measurements, those of farther points with this disparity."""
    return np.column_stack([uvd[:, :2], np.maximum(uvd[:, 2], disparity_px)])


def triangulate(uvd: Array, camera: StereoCamera) -> Array:
    """Points (N, 3) in ``cam`` [m] of measurements (N, 3); disparity must not be zero."""
    u, v, d = np.asarray(uvd, dtype=np.float64).T
    b = camera.baseline_m
    return np.stack(
        [(u - camera.cx_px) * b / d, (v - camera.cy_px) * (camera.fx_px / camera.fy_px) * b / d, camera.fx_px * b / d],
        1,
    )


def point_jacobian(uvd: Array, camera: StereoCamera) -> Array:
    """Derivative (N, 3, 3) of the point [m] by (u, v, d) [px]."""
    u, v, d = np.asarray(uvd, dtype=np.float64).T
    b, aspect = camera.baseline_m, camera.fx_px / camera.fy_px
    J = np.zeros((len(u), 3, 3))
    J[:, 0, 0] = b / d
    J[:, 0, 2] = -(u - camera.cx_px) * b / d**2
    J[:, 1, 1] = aspect * b / d
    J[:, 1, 2] = -(v - camera.cy_px) * aspect * b / d**2
    J[:, 2, 2] = -camera.fx_px * b / d**2
    return J


def triangulation_pixel_covariance(sigma_px: float = 1.0) -> Array:
    """Covariance (3, 3) of (u, v, d) from four image coordinates of equal, independent noise [px^2]:
    ``s^2 [[1, 0, 1], [0, 1/2, 0], [1, 0, 2]]``, never diagonal, as u takes part in d."""
    return _PIXELS_TO_UVD @ (np.eye(4) * sigma_px**2) @ _PIXELS_TO_UVD.T


@dataclass(frozen=True)
class PointNoise:
    """Form of the noise of a measurement (u, v, d), for unit noise of an image coordinate.

    ``shared``: covariance of u and d, 1 where the left coordinate is one and the same in both. Where patches are
    matched it is less: the left image's noise displaces a patch by one amount when the patch is followed and by another
    when it is sought on the right, since each search weighs the pixels by the gradients of its own template.
    ``persistent``: variance of an error of disparity that a point keeps from frame to frame.
    """

    shared: float = 1.0
    persistent: float = 0.0

    @property
    def S(self) -> Array:
        """(3, 3) covariance of (u, v, d) without what persists."""
        return np.array([[1.0, 0.0, self.shared], [0.0, 0.5, 0.0], [self.shared, 0.0, 2.0]])


def pointing_matching_pixel_covariance(sigma_p_px: float, sigma_m_px: float) -> Array:
    """Covariance (3, 3) of (u, v, d): ``diag(sigma_p^2, sigma_p^2, sigma_m^2)`` [px^2]."""
    return np.diag([sigma_p_px**2, sigma_p_px**2, sigma_m_px**2])


def point_covariance(uvd: Array, camera: StereoCamera, S_uvd: Array) -> Array:
    """Covariance (N, 3, 3) of triangulated points [m^2]: ``J S J^T``."""
    J = point_jacobian(uvd, camera)
    return J @ S_uvd @ np.swapaxes(J, -1, -2)


@dataclass(frozen=True)
class ResidualMoments:
    """Two linear equations ``A [p^2, m^2] = sums`` for the variances of pointing and matching [px^2].

    A residual's covariance is ``G S G^T + S``, ``S = diag(p^2, p^2, m^2)``: the mean square of each part is ``a p^2 + b
    m^2``. As that of a square scatters by as much, least squares weighs it by ``1 / (a + b)^2``, near enough: after a
    step of several baselines, most parts are all disparity's, and must not outvote the few that show pointing.
    ``freedom``: degrees of freedom of the residuals, after six went to the motion.
    """

    A: Array
    sums: Array
    freedom: float

    @classmethod
    def of(cls, residuals: Array, G: Array) -> ResidualMoments:
        """Of the residuals (M, 3) of one motion, and their derivatives (3, 3, M) by the reference measurement."""
        by_u, by_v, by_d = (G**2 + np.eye(3)[:, :, None]).transpose(1, 0, 2)
        by = np.stack([by_u + by_v, by_d]).reshape(2, -1)
        weighed = 2.0 * by / by.sum(axis=0) ** 2  # at rest 1
        freedom = max(residuals.size - 6.0, 0.0)
        return cls(weighed @ by.T * (freedom / residuals.size), weighed @ (residuals.T**2).ravel(), freedom)

    def plus(self, other: ResidualMoments, memory: float = 1.0) -> ResidualMoments:
        """Both together, this one fading."""
        return ResidualMoments(*(memory * a + b for a, b in zip(vars(self).values(), vars(other).values())))

    @property
    def sigmas(self) -> tuple[float, float]:
        """(sigma_p, sigma_m) [px] that explain the residuals."""
        p2, m2 = np.linalg.solve(self.A, self.sums)
        # Few points tell the sum of both better than the share of each, which may come out negative.
        least, most = _RATIO2
        ratio2 = float(np.clip(max(p2, 0.0) / max(m2, 1e-9), least, most))
        m_px = float(np.sqrt(max(self.sums.sum() / (self.A @ [ratio2, 1.0]).sum(), 1e-6)))
        return m_px * ratio2**0.5, m_px
