"""The covariance of a motion, by each geometric method.

Full 6x6: ``(sum H_i^T W_i H_i)^-1`` with ``H_i = R [I, -[P_i]x]`` and ``W_i = (R U_i R^T + V_i)^-1``, U_i and V_i the
covariances of the point in the current and in the reference frame (L. Matthies, S. Shafer 1987, eqs. 12-17; D. Ross,
thesis, section 3.3), here in its equal form over (u, v, d). ``V_T = (sum W_i)^-1`` treats the rotation as known: its
lateral variance is 2 to 10 times too small when the rotation is estimated too. The sigmas of the points, where they are
not given, are estimated from the residuals of motions.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gpvo.geometry import se3
from gpvo.geometry.covariance import symmetrise
from gpvo.stats.series import median
from gpvo.types import Array, StereoCamera
from gpvo.vo.config import KNOWN_DEPTH_PX, VoConfig, pair_method
from gpvo.vo.motion import (
    Motion,
    Transfer,
    Whitened,
    apply_whitener,
    persistent_direction,
    residual_covariance,
    transfer,
    whitener,
)
from gpvo.vo.points import (
    PointNoise,
    ResidualMoments,
    no_farther_than,
    point_covariance,
    pointing_matching_pixel_covariance,
    triangulate,
    triangulation_pixel_covariance,
)

_MEMORY = 0.97  # of the running mean: about thirty frames
_MOTIONS = 15  # of which the scale of the noise is the median: one bad one does not count
_PARTS = 4, 2  # columns and rows of the image: finer ones see less of what neighbours share, coarser ones the same
_LATELY = 0.9  # of a sum over the last motions: about ten, as long as most features are followed
_CHANCE = 0.1  # standard deviation of what they say of noise without memory
_CUT = 12.0  # squares of three degrees of freedom: against outliers
_TEXTBOOK = 100.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])  # prior of equal variance and covariance, worth 300 points
# Of squares with one degree of freedom, cut off at four; of means of two, at 6.6 medians.
_CUT_ALONG, _LEFT_ALONG = 4.0, 0.9195
_CUT_ACROSS, _LEFT_ACROSS = 6.644, 0.99
_USUAL_RATIO = 10.0  # prior deviation: an error of disparity three times the noise of an image coordinate


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


# To begin with 0.1 and 0.5 px, worth two points.
_START = ResidualMoments(np.diag([8.0, 4.0]), np.array([8.0 * 0.1**2, 4.0 * 0.5**2]), 6.0)


class SigmaEstimator:
    """Fixed sigmas where given, else those of the residuals so far, fading."""

    def __init__(self, sigma_p_px: float | None, sigma_m_px: float | None) -> None:
        self._fixed = (sigma_p_px, sigma_m_px)
        self._running = _START
        self.design = DesignEffect()

    def update(self, moments: ResidualMoments) -> None:
        """Take in one motion's residuals."""
        self._running = self._running.plus(moments, _MEMORY)

    @property
    def estimates(self) -> bool:
        """Whether any sigma is not given."""
        return None in self._fixed

    @property
    def values(self) -> tuple[float, float]:
        """(sigma_p, sigma_m) [px] to use now.

        Estimated ones are those of independent points that tell a motion as well as the points do: the residuals' own,
        by the design effect. They are those of the second moment: the predictive of a motion is a Student-t with the
        degrees of freedom of the residuals, whose variance is ``nu / (nu - 2)`` times as large.
        """
        nu = self._running.freedom
        running = np.array(self._running.sigmas) * np.sqrt(nu / (nu - 2.0) * self.design.ratio)
        p, m = (float(r) if f is None else f for f, r in zip(self._fixed, running, strict=True))
        return p, m


class DesignEffect:
    """How many times the variance of a motion is that of one from independent points, in independent frames.

    L. Kish, "Survey sampling", 1965; clusters of a regression: K.-Y. Liang, S. Zeger, 1986. Points near each other
    err alike, on one surface or one moving object, and may go on to do so. The motion's score, summed over each of
    :data:`_PARTS` parts of the image, then scatters more than its information says, and still more if summed over the
    last motions. The larger counts: noise of a point that enters two motions with opposite signs cancels in sums.
    """

    def __init__(self) -> None:
        # Sums of scores, and the squares expected of them: up to the reference frame, and up to the last one.
        self._before = self._lately = np.zeros((_PARTS[0] * _PARTS[1], 6)), 0.0
        self._t_ref_ns: int | None = None
        self._scatter, self._expected = np.ones(2), np.ones(2)

    def update(self, motion: Motion, white: Whitened, camera: StereoCamera, t_ref_ns: int) -> None:
        """Take in a motion since ``t_ref_ns``, and its whitened residuals."""
        z, A = white.z, white.A
        share = motion.uvd_prev[:, :2] / [camera.width, camera.height]
        column, row = np.clip((share * _PARTS).astype(np.int64), 0, np.array(_PARTS) - 1).T
        part = row * _PARTS[0] + column == np.arange(_PARTS[0] * _PARTS[1])[:, None]
        information = (part @ np.einsum("ikn,iln->nkl", A, A).reshape(-1, 36)).reshape(-1, 6, 6)
        total = information.sum(axis=0)
        told = information @ np.linalg.inv(total)  # by each part; the motion takes the square of it off
        expected = float(np.trace(told, axis1=1, axis2=2).sum() - (told * told.transpose(0, 2, 1)).sum())
        variance = max(float((z**2).sum()) / max(z.size - 6.0, 1.0), 1e-12)
        # Rotation first, which is known best: sums over motions need axes that stay.
        root, scores = np.linalg.cholesky(total[::-1, ::-1]), part @ np.einsum("ikn,in->nk", A[:, ::-1], z)
        scores = np.linalg.solve(root, scores.T).T / variance**0.5
        if t_ref_ns != self._t_ref_ns:  # of motions since one frame, only the last adds to what follows
            self._before, self._t_ref_ns = self._lately, t_ref_ns
        sums, squares = self._before
        self._lately = sums, squares = _LATELY * sums + scores, _LATELY**2 * squares + expected
        self._scatter = _MEMORY * self._scatter + [(scores**2).sum(), (sums**2).sum()]
        self._expected = _MEMORY * self._expected + [expected, squares]

    @property
    def ratio(self) -> float:
        """1 for independent points in independent frames."""
        alone, lately = self._scatter / self._expected
        excess, chance = lately - alone, 2.0 * _CHANCE * lately
        return float(alone + (excess - chance**2 / excess if excess > chance else 0.0))


class NoiseEstimator:
    """Running estimate of the points' noise: its form, :class:`gpvo.vo.points.PointNoise`, and its usual ``scale_px``,
    the median of the last motions' (0 before any).

    ``shared`` solves two equations, those of u and d, for the variance of an image coordinate and the covariance of the
    two. What persists shows as the flow that it predicts wrongly: more scatter along ``g``, the residual's derivative
    by it, than across; it is 0 while it is not beyond chance, and drawn towards 0 by a prior.
    """

    def __init__(self) -> None:
        self._normal: Array = np.zeros((2, 2))
        self._moments: Array = np.zeros(2)
        self._sums: Array = np.zeros(3)
        self._scales_px: deque[float] = deque(maxlen=_MOTIONS)
        self.value, self.scale_px = PointNoise(), 0.0

    def update(self, motion: Motion, white: Whitened) -> None:
        """Take in a motion and its whitened residuals."""
        self._scales_px.append(motion.scale_px)
        self.scale_px = median(np.array(self._scales_px))
        self.value = PointNoise(self._shared(motion, white), self.value.persistent)
        self.value = PointNoise(self.value.shared, self._persistent(motion.residuals, white.moved.G))

    def _shared(self, motion: Motion, white: Whitened) -> float:
        """Least squares over the products ``r_u^2``, ``r_d^2`` and ``r_u r_d`` of all points."""
        G, noise, variance = white.moved.G, motion.noise, motion.scale_px**2
        C = white.C
        alone = residual_covariance(G, PointNoise(0.0).S, PointNoise(0.0).S, noise.persistent)
        z2 = (white.z**2).sum(0)
        r = motion.residuals.T * np.sqrt(np.minimum(1.0 / variance, _CUT / np.maximum(z2, 1e-9 * variance)))
        normal, moments = np.zeros((2, 2)), np.zeros(2)
        for i, j in ((0, 0), (2, 2), (0, 2)):
            both = G[i, 0] * G[j, 2] + G[i, 2] * G[j, 0] + float(i != j)
            weight = 1.0 / (C[i, i] * C[j, j] + C[i, j] ** 2)
            X = np.stack([alone[i, j], both])
            normal += (X * weight) @ X.T
            moments += (X * weight) @ (r[i] * r[j])
        self._normal, self._moments = _MEMORY * self._normal + normal, _MEMORY * self._moments + moments
        variance, covariance = np.linalg.solve(self._normal + _TEXTBOOK, self._moments)
        return float(np.clip(covariance / max(variance, 1e-9), 0.0, 1.0))

    def _persistent(self, residuals: Array, G: Array) -> float:
        """Variance over that of an image coordinate, shrunk by its own uncertainty."""
        ratio = self.value.persistent
        W = whitener(residual_covariance(G, self.value.S, self.value.S))
        z, g = apply_whitener(W, residuals.T), apply_whitener(W, persistent_direction(G))
        g2 = (g * g).sum(0)
        along2 = (g * z).sum(0) ** 2 / np.maximum(g2, 1e-12)
        across2 = 0.5 * ((z * z).sum(0) - along2)
        # Squares are cut off against outliers; the divisors are what a Gaussian has left of its variance.
        limit = _CUT_ACROSS * median(across2)
        sigma2 = max(float(np.minimum(across2, limit).mean()) / _LEFT_ACROSS, 1e-6)
        expected = 1.0 + ratio * g2
        along2 = np.minimum(along2 / sigma2, _CUT_ALONG * expected) / _LEFT_ALONG
        weight = g2 / expected**2
        now = np.array([weight @ (along2 - 1.0), weight @ g2, 3.0 * weight @ weight])
        self._sums = _MEMORY * self._sums + now
        excess, information, variance = self._sums
        if excess <= 2.0 * variance**0.5:
            return 0.0
        # Between images of nearly the same place hardly anything tells: then the prior does.
        return float((excess - 4.0 * variance / excess) * information / (information**2 + variance / _USUAL_RATIO**2))
