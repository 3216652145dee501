"""Lens models: pinhole with radial-tangential distortion, also rational, and Kannala-Brandt fisheye. NumPy only.

Pixel (0, 0) is the centre of the first pixel, as in OpenCV and Kalibr. Rays and points are in the camera's optical
frame (x right, y down, z forward).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.polynomial.polynomial import polyadd, polyder, polymul, polysub, polyval
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

    @property
    def coefficients(self) -> list[float]:
        """The distortion as files hold it: all of four, five or eight coefficients up to the last that is not zero."""
        count = next((n for n in (4, 5) if not any(self.distortion[n:])), len(self.distortion))
        return [float(k) for k in self.distortion[:count]]

    @property
    def distortion_model(self) -> str:
        """What Kalibr calls the distortion, or ROS that of eight coefficients."""
        if self.kind == "kannala-brandt":
            return "equidistant"
        return "rational_polynomial" if len(self.coefficients) > 5 else "radtan"

    def project(self, points: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) points to (N, 2) pixels and (N,) whether the lens can see the point (also outside the image)."""
        xy, valid = self._to_plane(np.asarray(points, dtype=np.float64).reshape(-1, 3))
        uv = xy * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)
        return np.where(valid[:, None], uv, np.nan), valid

    def unproject(self, uv: Array) -> Array:
        """(N, 2) pixels to (N, 3) unit rays; NaN where no ray maps to the pixel."""
        uv = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
        return self._from_plane((uv - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px))

    @abstractmethod
    def _to_plane(self, P: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(N, 3) points to the plane of unit focal length (N, 2), distorted, and (N,) validity."""

    @abstractmethod
    def _from_plane(self, distorted: Array) -> Array:
        """The way back, to unit rays; NaN where there is none."""


@dataclass(frozen=True)
class _Radial:
    """What a radius or an angle x is distorted to, ``x (1 + k_1 x^2 + k_2 x^4 + ...)``, of the rational model divided
    by ``1 + d_1 x^2 + d_2 x^4 + ...``."""

    k: tuple[float, ...]
    d: tuple[float, ...] = ()

    def __call__(self, x: Array) -> Array:
        return np.asarray(x * self.factor(x * x))

    def factor(self, squared: Array) -> Array:
        """What multiplies x, by its square."""
        return np.asarray(polyval(squared, (1.0, *self.k)) / polyval(squared, (1.0, *self.d)))

    def slope(self, squared: Array) -> Array:
        """Derivative of the factor by the square."""
        above, below = (1.0, *self.k), (1.0, *self.d)
        rise = polyval(squared, polyder(above)) - self.factor(squared) * polyval(squared, polyder(below))
        return np.asarray(rise / polyval(squared, below))

    @property
    def limit(self) -> float:
        """Up to where it grows; infinite if it never folds back.

        With N above and D below, functions of the square s, its derivative is ``(N D + 2 s (N' D - N D')) / D^2``.
        """
        above, below = (1.0, *self.k), (1.0, *self.d)
        bend = polysub(polymul(polyder(above), below), polymul(above, polyder(below)))
        ends = (polyadd(polymul(above, below), polymul((0.0, 2.0), bend)), np.array(below))
        return float(np.sqrt(min(map(_first_root, ends))))

    def invert(self, target: Array, upper: float) -> Array:
        """Solve for x in [0, upper], where it grows, by Newton steps kept inside a bracket.

        A step that is not half as long as the one before is replaced by halving the bracket: near a turning point of
        the slope, Newton's steps may go to and fro for ever. Steps of the size of rounding are left alone, since the
        bracket may still be wide open on the other side. Returns NaN where the target is out of range. (N,) -> (N,).
        """
        low, high = np.zeros_like(target), np.full_like(target, upper)
        x = np.clip(target, 0.0, upper)
        last_step = np.full_like(target, np.inf)
        for _ in range(_NEWTON_STEPS):
            residual = self(x) - target
            low, high = np.where(residual <= 0, x, low), np.where(residual >= 0, x, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = x - residual / (self.factor(x * x) + 2 * x * x * self.slope(x * x))
            step = np.abs(new - x)
            rounding = step <= 1e-12 * (1.0 + x)
            good = rounding | ((new >= low) & (new <= high) & (step <= 0.5 * last_step))
            new = np.where(good, new, 0.5 * (low + high))
            last_step, x = np.abs(new - x), new
            if np.nanmax(last_step, initial=0.0) <= 1e-16:
                break
        return np.where((target >= 0) & (target <= self(np.array(upper))), x, np.nan)


def _first_root(ascending: Array) -> float:
    """The smallest positive root of a polynomial, infinite where there is none."""
    descending = ascending[::-1].copy()
    # A vanishing leading coefficient puts its root out of any lens and spoils the others.
    descending[np.abs(descending) < 1e-12] = 0.0
    roots = np.roots(np.trim_zeros(descending, "f"))
    real = roots[np.abs(roots.imag) <= 1e-9 * (1.0 + np.abs(roots.real))].real
    return float(real[real > 1e-9].min(initial=np.inf))


@dataclass(frozen=True)
class PinholeRadtan(CameraModel):
    """Pinhole with radial-tangential distortion ``(k1, k2, p1, p2[, k3[, k4, k5, k6]])`` (D. Brown, 1966; OpenCV's
    order): ``1 + k1 r^2 + k2 r^4 + k3 r^6`` times the radius, divided by ``1 + k4 r^2 + k5 r^4 + k6 r^6`` (OpenCV's and
    ROS's rational model).

    Points at or behind the lens plane, and those beyond the radius where the radial part folds back, are not valid.
    """

    kind: ClassVar[str] = "pinhole-radtan"

    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def _radial(self) -> _Radial:
        return _Radial((*self.distortion[:2], *self.distortion[4:5]), self.distortion[5:8])

    @property
    def max_radius(self) -> float:
        """Largest undistorted radius (tangent of the angle) up to which the radial part grows."""
        return self._radial.limit

    def _distort(self, xy: Array) -> Array:
        p1, p2 = self.distortion[2:4]
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = self._radial.factor(r2)
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], axis=1)

    def _jacobian(self, xy: Array) -> tuple[Array, Array, Array]:
        """Derivatives of the distorted x by x and y by y, (N,) each, and of each by the other, which are equal."""
        p1, p2 = self.distortion[2:4]
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial, slope = self._radial.factor(r2), 2 * self._radial.slope(r2)
        x_by_x = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
        y_by_y = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
        return x_by_x, y_by_y, x * y * slope + 2 * p1 * x + 2 * p2 * y

    def _to_plane(self, P: Array) -> tuple[Array, NDArray[np.bool_]]:
        front = P[:, 2] > 1e-12
        xy = P[:, :2] / np.where(front, P[:, 2], 1.0)[:, None]
        return self._distort(xy), front & (np.hypot(xy[:, 0], xy[:, 1]) < self.max_radius)

    def _from_plane(self, distorted: Array) -> Array:
        """By Newton's method in two dimensions."""
        xy = self._undistort_radially(distorted)
        for _ in range(20):
            residual = self._distort(xy) - distorted
            x_by_x, y_by_y, mixed = self._jacobian(xy)
            det = x_by_x * y_by_y - mixed**2
            with np.errstate(divide="ignore", invalid="ignore"):
                step_x = (y_by_y * residual[:, 0] - mixed * residual[:, 1]) / det
                step_y = (x_by_x * residual[:, 1] - mixed * residual[:, 0]) / det
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
        limit = 0.999 * (self.max_radius if np.isfinite(self.max_radius) else 1e3)
        r_d = np.linalg.norm(distorted, axis=1)
        r = self._radial.invert(np.minimum(r_d, self._radial(np.array(limit))), limit)
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
        return min(_Radial(self.distortion).limit, np.pi)

    def _to_plane(self, P: Array) -> tuple[Array, NDArray[np.bool_]]:
        r = np.hypot(P[:, 0], P[:, 1])
        theta = np.arctan2(r, P[:, 2])
        on_axis = r == 0
        valid = (theta <= self.max_angle_rad) & ~(on_axis & (P[:, 2] <= 0))
        direction = P[:, :2] / np.where(on_axis, 1.0, r)[:, None]
        return _Radial(self.distortion)(theta)[:, None] * direction, valid

    def _from_plane(self, distorted: Array) -> Array:
        r = np.linalg.norm(distorted, axis=1)
        theta = _Radial(self.distortion).invert(r, self.max_angle_rad)
        direction = distorted / np.where(r > 0, r, 1.0)[:, None]
        return np.concatenate([np.sin(theta)[:, None] * direction, np.cos(theta)[:, None]], axis=1)
