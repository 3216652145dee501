"""Lens models: pinhole with radial-tangential distortion, and Kannala-Brandt fisheye. NumPy only.

Pixel (0, 0) is the centre of the first pixel, as in OpenCV and Kalibr. Rays and points are in the camera's optical
frame (x right, y down, z forward).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

_NEWTON_STEPS = 60


@dataclass(frozen=True)
class CameraModel(ABC):
    """A lens: ``fx_px, fy_px, cx_px, cy_px`` [px], ``width, height`` [px], and the coefficients of its distortion."""

    kind: ClassVar[str]

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    @property
    def intrinsics_px(self) -> list[float]:
        """fx, fy, cx, cy."""
        return [float(v) for v in (self.fx_px, self.fy_px, self.cx_px, self.cy_px)]

    @abstractmethod
    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) points to (N, 2) pixels and (N,) whether the lens can see the point (also outside the image)."""

    @abstractmethod
    def unproject(self, uv: Array) -> Array:
        """(N, 2) pixels to (N, 3) unit rays; NaN where no ray maps to the pixel."""

    def _normalised(self, uv: Array) -> Array:
        """(N, 2) pixels to the plane of unit focal length."""
        return (np.asarray(uv, dtype=np.float64).reshape(-1, 2) - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)


def _smallest_positive_root(coefficients_ascending: tuple[float, ...], default: float) -> float:
    """Smallest positive real root of a polynomial, or ``default`` where there is none."""
    descending = np.asarray(coefficients_ascending[::-1], dtype=np.float64)
    # A vanishing leading coefficient puts its root out of any lens and spoils the others.
    descending[np.abs(descending) < 1e-12] = 0.0
    roots = np.roots(np.trim_zeros(descending, "f"))
    real = roots[np.abs(roots.imag) <= 1e-9 * (1.0 + np.abs(roots.real))].real
    positive = real[real > 1e-9]
    return float(positive.min()) if len(positive) else default


def _invert_monotone(
    function: Callable[[Array], Array], derivative: Callable[[Array], Array], target: Array, upper: float
) -> Array:
    """Solve ``function(x) = target`` on [0, upper], where it grows, by Newton steps kept inside a bracket.

    A step that is not half as long as the one before is replaced by halving the bracket: near a turning point of the
    slope, Newton's steps may go to and fro for ever. Steps of the size of rounding are left alone, since the bracket
    may still be wide open on the other side. Returns NaN where the target is out of range. (N,) -> (N,).
    """
    low, high = np.zeros_like(target), np.full_like(target, upper)
    x = np.clip(target, 0.0, upper)
    last_step = np.full_like(target, np.inf)
    for _ in range(_NEWTON_STEPS):
        residual = function(x) - target
        low, high = np.where(residual <= 0, x, low), np.where(residual >= 0, x, high)
        slope = derivative(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            new = x - residual / slope
        step = np.abs(new - x)
        rounding = step <= 1e-12 * (1.0 + x)
        good = rounding | ((new >= low) & (new <= high) & (step <= 0.5 * last_step))
        new = np.where(good, new, 0.5 * (low + high))
        last_step, x = np.abs(new - x), new
        if np.nanmax(last_step, initial=0.0) <= 1e-16:
            break
    return np.where((target >= 0) & (target <= function(np.array(upper))), x, np.nan)


@dataclass(frozen=True)
class PinholeRadtan(CameraModel):
    """Pinhole with radial-tangential distortion ``(k1, k2, p1, p2[, k3])`` (D. Brown, 1966; OpenCV's order).

    Points at or behind the lens plane, and those beyond
    the radius where the radial polynomial folds back, are not valid.
    """

    kind: ClassVar[str] = "pinhole-radtan"

    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def _five(self) -> tuple[float, float, float, float, float]:
        k = (*self.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)
        return k[0], k[1], k[2], k[3], k[4]

    @property
    def max_radius(self) -> float:
        """Largest undistorted radius (tangent of the angle) up to which the radial polynomial grows."""
        k1, k2, _, _, k3 = self._five
        return float(np.sqrt(_smallest_positive_root((1.0, 3 * k1, 5 * k2, 7 * k3), np.inf)))

    def _distort(self, xy: Array) -> Array:
        k1, k2, p1, p2, k3 = self._five
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], axis=1)

    def _jacobian(self, xy: Array) -> Array:
        k1, k2, p1, p2, k3 = self._five
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        off = x * y * slope + 2 * p1 * x + 2 * p2 * y
        J = np.empty((len(xy), 2, 2))
        J[:, 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        J[:, 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        J[:, 0, 1] = J[:, 1, 0] = off
        return J

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) points to (N, 2) pixels and (N,) validity."""
        P = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        front = P[:, 2] > 1e-12
        xy = P[:, :2] / np.where(front, P[:, 2], 1.0)[:, None]
        valid = front & (np.hypot(xy[:, 0], xy[:, 1]) < self.max_radius)
        uv = self._distort(xy) * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)
        return np.where(valid[:, None], uv, np.nan), valid

    def unproject(self, uv: Array) -> Array:
        """(N, 2) pixels to (N, 3) unit rays, by Newton's method in two dimensions; NaN where there is none."""
        distorted = self._normalised(uv)
        xy = self._undistort_radially(distorted)
        for _ in range(20):
            residual = self._distort(xy) - distorted
            J = self._jacobian(xy)
            det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] ** 2
            with np.errstate(divide="ignore", invalid="ignore"):
                step_x = (J[:, 1, 1] * residual[:, 0] - J[:, 0, 1] * residual[:, 1]) / det
                step_y = (J[:, 0, 0] * residual[:, 1] - J[:, 0, 1] * residual[:, 0]) / det
            xy = xy - np.stack([step_x, step_y], axis=1)
            if np.nanmax(np.abs(step_x), initial=0.0) + np.nanmax(np.abs(step_y), initial=0.0) < 1e-15:
                break
        with np.errstate(invalid="ignore"):
            good = (np.abs(self._distort(xy) - distorted).max(axis=1) < 1e-9) & (
                np.hypot(xy[:, 0], xy[:, 1]) < self.max_radius
            )
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return np.where(good[:, None], rays, np.nan)

    def _undistort_radially(self, distorted: Array) -> Array:
        """Start for the full solution: exact for the radial part, clipped to its valid range."""
        k1, k2, _, _, k3 = self._five
        limit = self.max_radius
        if not np.isfinite(limit):
            limit = 1e3
        limit *= 0.999

        def radial(r: Array) -> Array:
            return r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))

        def slope(r: Array) -> Array:
            return 1 + r**2 * (3 * k1 + r**2 * (5 * k2 + r**2 * 7 * k3))

        r_d = np.linalg.norm(distorted, axis=1)
        r = _invert_monotone(radial, slope, np.minimum(r_d, radial(np.array(limit))), limit)
        return distorted * (r / np.where(r_d > 0, r_d, 1.0))[:, None]


@dataclass(frozen=True)
class KannalaBrandt(CameraModel):
    """Fisheye ``r = f theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``, also beyond 90 degrees.

    J. Kannala, S. Brandt, "A generic camera model and calibration method" (2006), equation 6, in the four-coefficient
    form of Kalibr's ``equidistant`` and ``cv2.fisheye``.
    """

    kind: ClassVar[str] = "kannala-brandt"

    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @property
    def max_angle_rad(self) -> float:
        """Largest angle from the optical axis up to which the polynomial grows, at most pi."""
        k1, k2, k3, k4 = self.distortion
        root = _smallest_positive_root((1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4), np.inf)
        return min(float(np.sqrt(root)), np.pi)

    def _radius(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _slope(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        return 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) points to (N, 2) pixels and (N,) validity."""
        P = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        r = np.hypot(P[:, 0], P[:, 1])
        theta = np.arctan2(r, P[:, 2])
        on_axis = r == 0
        valid = (theta <= self.max_angle_rad) & ~(on_axis & (P[:, 2] <= 0))
        direction = P[:, :2] / np.where(on_axis, 1.0, r)[:, None]
        uv = self._radius(theta)[:, None] * direction * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)
        return np.where(valid[:, None], uv, np.nan), valid

    def unproject(self, uv: Array) -> Array:
        """(N, 2) pixels to (N, 3) unit rays; NaN beyond the largest angle."""
        m = self._normalised(uv)
        r = np.linalg.norm(m, axis=1)
        theta = _invert_monotone(self._radius, self._slope, r, self.max_angle_rad)
        direction = m / np.where(r > 0, r, 1.0)[:, None]
        return np.concatenate([np.sin(theta)[:, None] * direction, np.cos(theta)[:, None]], axis=1)
