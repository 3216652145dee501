"""The ray of every pixel, which is all the renderer knows of a lens when it decides what a pixel sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.models import CameraModel, KannalaBrandt, PinholeRadtan
from gpvo.errors import CalibrationError

_ALIGN = 16
PINHOLE, FISHEYE = 0, 1


@dataclass(frozen=True)
class RayTable:
    """Rays of a lens and the bounds that culling needs.

    ``rays`` (3, H, P) float32 unit rays with rows padded to a multiple of 16; ``valid`` (H, W) whether a pixel has a
    ray; ``lens`` is PINHOLE or FISHEYE, ``coefficients`` (10,): fx, fy, cx, cy, five of the distortion, largest valid
    radius (tangent) or angle. ``max_angle`` [rad] from the axis over all rays; ``slope_x, slope_y``: largest |x/z|,
    |y/z|, 0 where rays reach 90 degrees; ``px_per_rad``: finest resolution in the image.
    """

    width: int
    height: int
    rays: NDArray[np.float32]
    valid: NDArray[np.bool_]
    lens: int
    coefficients: NDArray[np.float64]
    max_angle: float
    slope_x: float
    slope_y: float
    px_per_rad: float

    @classmethod
    def of(cls, model: CameraModel, max_angle_rad: float) -> RayTable:
        """Rays of a model up to ``max_angle_rad`` from the axis.

        Raises
        ------
        CalibrationError
            Where no pixel of the model has a ray, or the lens is of an unknown kind.
        """
        H, W = model.height, model.width
        v, u = np.mgrid[:H, :W]
        rays = model.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)).reshape(H, W, 3)
        valid = np.isfinite(rays).all(axis=2) & (np.nan_to_num(rays[..., 2], nan=-2.0) >= np.cos(max_angle_rad))
        if not valid.any():
            raise CalibrationError("no pixel of this lens sees anything", cure="check focal length and distortion")
        rays = np.where(valid[..., None], rays, 0.0)
        padded = np.zeros((3, H, -(-W // _ALIGN) * _ALIGN), dtype=np.float32)
        padded[:, :, :W] = rays.transpose(2, 0, 1)
        seen = rays[valid]
        wide = seen[:, 2].min() < 0.1
        slopes = (0.0, 0.0) if wide else np.abs(seen[:, :2] / seen[:, 2:]).max(axis=0)
        lens, coefficients = _coefficients(model)
        return cls(
            width=W,
            height=H,
            rays=padded,
            valid=valid,
            lens=lens,
            coefficients=coefficients,
            max_angle=float(np.arccos(np.clip(seen[:, 2].min(), -1, 1))),
            slope_x=float(slopes[0]),
            slope_y=float(slopes[1]),
            px_per_rad=_finest_resolution(rays, valid),
        )


def _finest_resolution(rays: NDArray[np.float64], valid: NDArray[np.bool_]) -> float:
    """Pixels per radian where neighbouring rays lie closest together."""
    smallest = np.inf
    for axis in (0, 1):
        gap = np.linalg.norm(np.diff(rays, axis=axis), axis=2)
        both = np.delete(valid, 0, axis=axis) & np.delete(valid, -1, axis=axis)
        smallest = min(smallest, float(gap[both].min(initial=np.inf)))
    return 1.0 / max(smallest, 1e-6)


def _coefficients(model: CameraModel) -> tuple[int, NDArray[np.float64]]:
    k = np.zeros(10)
    k[:4] = model.fx_px, model.fy_px, model.cx_px, model.cy_px
    k[4 : 4 + len(model.distortion)] = model.distortion
    if isinstance(model, PinholeRadtan):
        k[9] = min(model.max_radius, 1e3)
        return PINHOLE, k
    if isinstance(model, KannalaBrandt):
        k[9] = model.max_angle_rad
        return FISHEYE, k
    raise CalibrationError(f"the renderer does not know the lens '{model.kind}'")
