"""Stereo points: triangulation and the covariance of a point from that of its pixels.

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
