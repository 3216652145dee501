"""The covariance of a motion, by each geometric method.

Full 6x6: ``(sum H_i^T W_i H_i)^-1`` with ``H_i = R [I, -[P_i]x]`` and ``W_i = (R U_i R^T + V_i)^-1``, U_i and V_i the
covariances of the point in the current and in the reference frame (L. Matthies, S. Shafer 1987, eqs. 12-17; D. Ross,
thesis, section 3.3), here in its equal form over (u, v, d). ``V_T = (sum W_i)^-1`` treats the rotation as known: its
lateral variance is 2 to 10 times too small when the rotation is estimated too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpvo.geometry import se3
from gpvo.geometry.covariance import symmetrise
from gpvo.types import Array, StereoCamera
from gpvo.vo.config import KNOWN_DEPTH_PX, VoConfig, pair_method
from gpvo.vo.motion import Transfer, apply_whitener, residual_covariance, transfer, whitener
from gpvo.vo.points import (
    no_farther_than,
    point_covariance,
    pointing_matching_pixel_covariance,
    triangulate,
    triangulation_pixel_covariance,
)


@dataclass(frozen=True)
class MotionCovariance:
    """``full`` (6, 6) of a right perturbation of ``T_prev_cur``; ``v_t`` (3, 3) of its translation, rotation known,
    in the axes of the reference camera [m^2]."""

    full: Array
    v_t: Array


def motion_covariance(
    T_prev_cur: Array,
    uvd_prev: Array,
    camera: StereoCamera,
    S_uvd: Array,
    *,
    exact_points: bool = False,
    moved: Transfer | None = None,
) -> MotionCovariance:
    """Covariance of the motion from the (3, 3) covariance of a measurement (u, v, d) [px^2].

    Parameters
    ----------
    uvd_prev : (N, 3) inlier measurements in the reference frame.
    exact_points : treat the reference points as exact, as PnP does: 2 to 4 times overconfident in NEES.
    moved : the transfer of the same points by the same motion, if already computed.

    Raises numpy.linalg.LinAlgError if the points do not determine the motion.
    """
    moved = moved or transfer(T_prev_cur, uvd_prev, camera)
    C = residual_covariance(moved.G, np.zeros((3, 3)) if exact_points else S_uvd, S_uvd)
    A = apply_whitener(whitener(C), moved.H).transpose(0, 2, 1).reshape(-1, 6)
    return _from_information(A.T @ A, T_prev_cur[:3, :3])


def spherical_covariance(
    T_prev_cur: Array, uvd_prev: Array, uvd_cur: Array, camera: StereoCamera, S_uvd: Array
) -> MotionCovariance:
    """The same with each point's covariance replaced by a sphere of equal mean variance (thesis, chapter 3).

    Depth is by far the worst axis, so a sphere wastes the accuracy that the image has sideways.
    """
    P = triangulate(uvd_cur, camera)
    U, V = (point_covariance(uvd, camera, S_uvd) for uvd in (uvd_cur, uvd_prev))
    weight = 3.0 / (np.trace(U, axis1=1, axis2=2) + np.trace(V, axis1=1, axis2=2))
    # R drops out of H^T W H for a scalar W.
    H = np.concatenate([np.broadcast_to(np.eye(3), (len(P), 3, 3)), -se3.skew(P)], axis=2)
    A = (H * np.sqrt(weight)[:, None, None]).reshape(-1, 6)
    return _from_information(A.T @ A, T_prev_cur[:3, :3])


def _from_information(information: Array, R_prev_cur: Array) -> MotionCovariance:
    # Lengths and angles differ by orders of magnitude: scale before inverting.
    s = 1.0 / np.sqrt(np.diagonal(information))
    if not np.isfinite(s).all():
        raise np.linalg.LinAlgError("the points do not determine the motion")
    L = np.linalg.cholesky(information * s[:, None] * s)
    inverse_L = np.linalg.inv(L)
    full = symmetrise((inverse_L.T @ inverse_L) * s[:, None] * s)
    v_t = R_prev_cur @ np.linalg.inv(information[:3, :3]) @ R_prev_cur.T
    return MotionCovariance(full, symmetrise(v_t))


def covariances_by_method(
    config: VoConfig,
    sigmas_px: tuple[float, float],
    T_prev_cur: Array,
    uvd_prev: Array,
    uvd_cur: Array,
    camera: StereoCamera,
    *,
    moved: Transfer | None = None,
    information: Callable[[Array], Array] | None = None,
) -> dict[str, MotionCovariance]:
    """Every method and pair of sigmas of ``config`` over the same inliers, sharing the derivatives.

    ``sigmas_px``: pointing and matching as they are now. ``moved``: the transfer of the same points by the same motion,
    if at hand. ``information``: (6, 6) of the motion for a (3, 3) covariance of a measurement, where it is known from
    more than two frames; a sphere knows two.
    """
    moved = moved or transfer(T_prev_cur, uvd_prev, camera)
    triangulation = triangulation_pixel_covariance(config.sigma_px)
    S = {"triangulation": triangulation, "pointing_matching": pointing_matching_pixel_covariance(*sigmas_px)}
    S |= {pair_method(*pair): pointing_matching_pixel_covariance(*pair) for pair in config.sigma_pairs_px}
    out: dict[str, MotionCovariance] = {}
    for method in config.stated:
        if method == "spherical":
            # A sphere has a place: those of far points are put where depth begins to be known.
            prev, cur = (no_farther_than(a, KNOWN_DEPTH_PX) for a in (uvd_prev, uvd_cur))
            out[method] = spherical_covariance(T_prev_cur, prev, cur, camera, triangulation)
        elif information is not None:
            out[method] = _from_information(information(S[method]), T_prev_cur[:3, :3])
        else:
            out[method] = motion_covariance(T_prev_cur, uvd_prev, camera, S[method], moved=moved)
    return out
