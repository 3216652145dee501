"""Where each pixel looks, and the way back: tables made from a lens model's ``project`` and ``unproject``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel, PinholeRadtan
from gpvo.types import Array

LANES = 8  # pixels of a row that are worked on at once
_GRID = 192
_MARGIN = 1.12
_PINHOLE_LIMIT_RAD = 1.45  # a pinhole's tangent runs away near 90 degrees; no image reaches that far


@dataclass(frozen=True)
class RayTable:
    """Rays of all pixels, and pixels of all directions.

    ``rays`` (H, C, 3, 8) float32: unit rays of the pixels of a row in groups of eight, zero where there is none.
    ``valid`` (H, W). ``plane`` (G, G, 2) float32: pixel (u, v) of directions given in the stereographic plane
    ``p = (x, y) / (z + |xyz|)``, on an even grid over ``|p_x| <= reach[0], |p_y| <= reach[1]``; it only has to
    bound triangles. ``bend`` [1/px]: straight edges of length L bulge by at most ``bend L^2`` pixels.
    """

    rays: NDArray[np.float32]
    valid: NDArray[np.bool_]
    plane: NDArray[np.float32]
    reach: NDArray[np.float32]
    max_angle_rad: float
    bend: float

    @classmethod
    def of(cls, model: CameraModel, max_angle_rad: float) -> RayTable:
        """Tables of a lens; pixels whose ray leaves the cone of ``max_angle_rad`` see nothing."""
        H, W = model.height, model.width
        v, u = np.mgrid[0:H, 0:W].astype(np.float64)
        rays = model.unproject(np.stack([u.ravel(), v.ravel()], axis=1))
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(rays).all(axis=1) & (rays[:, 2] >= np.cos(max_angle_rad))
        rays = np.where(valid[:, None], rays, 0.0)
        angle = float(np.arccos(np.clip(rays[valid, 2].min(), -1, 1)))
        p = np.abs(rays[valid, :2] / (1 + rays[valid, 2:])).max(axis=0)
        reach = (p * _MARGIN + 0.02).astype(np.float32)
        groups = -(-W // LANES)
        packed = np.zeros((H, groups * LANES, 3), np.float32)
        packed[:, :W] = rays.reshape(H, W, 3)
        straight = isinstance(model, PinholeRadtan) and not any(model.distortion)
        return cls(
            rays=np.ascontiguousarray(packed.reshape(H, groups, LANES, 3).transpose(0, 1, 3, 2)),
            valid=valid.reshape(H, W),
            plane=_pixel_plane(model, reach),
            reach=reach,
            max_angle_rad=angle,
            bend=0.0 if straight else 1.0 / (8.0 * min(model.fx_px, model.fy_px)),
        )

    @property
    def height(self) -> int:
        """Rows of the image."""
        return self.valid.shape[0]

    @property
    def width(self) -> int:
        """Columns of the image."""
        return self.valid.shape[1]


def _pixel_plane(model: CameraModel, reach: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels over the stereographic plane, continued outwards evenly where the lens model ends."""
    px, py = np.meshgrid(*(np.linspace(-r, r, _GRID) for r in reach.astype(np.float64)))
    radius = np.hypot(px, py).ravel()
    theta = 2 * np.arctan(radius)
    direction = np.stack([px.ravel(), py.ravel()], 1) / np.maximum(radius, 1e-12)[:, None]
    limit = _largest_angle(model)
    inside = np.minimum(theta, limit)
    points = np.concatenate([direction * np.sin(inside)[:, None], np.cos(inside)[:, None]], axis=1)
    uv, _ = model.project(points)
    focal: Array = np.array([model.fx_px, model.fy_px])
    uv = uv + np.maximum(theta - limit, 0.0)[:, None] * direction * focal
    return np.ascontiguousarray(uv.reshape(_GRID, _GRID, 2).astype(np.float32))


def _largest_angle(model: CameraModel) -> float:
    """Angle up to which the model projects every direction."""
    theta = np.linspace(0.0, np.pi * 0.95, 400)
    azimuth = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    t, a = np.meshgrid(theta, azimuth, indexing="ij")
    points = np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=-1).reshape(-1, 3)
    uv, valid = model.project(points)
    good = (valid & np.isfinite(uv).all(axis=1)).reshape(t.shape).all(axis=1)
    last = len(theta) - 1 if good.all() else int(np.argmin(good)) - 1
    limit = _PINHOLE_LIMIT_RAD if isinstance(model, PinholeRadtan) else np.pi
    return min(float(theta[max(last - 1, 1)]), limit)
