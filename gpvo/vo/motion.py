"""The motion between two stereo frames: how a measurement moves, and the weighted least-squares estimate.

Everything is written in (u, v, d), where pixel noise is Gaussian even for far points, and never divides by the
disparity: with ``m = ((u - cx)/fx, (v - cy)/fy, 1)`` and the inverse depth ``r = d / (fx b)``, a point moves as
``m' ~ R m + t r``. To first order this equals weighting 3-D points with ``W = (R U R^T + V)^-1`` (L. Matthies, S.
Shafer, "Error modeling in stereo navigation", 1987, eq. 16).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.stats.series import median
from gpvo.types import Array, StereoCamera
from gpvo.vo.config import TELLING_PX
from gpvo.vo.points import PointNoise

# Quantiles of chi-square with 3 degrees of freedom.
CHI2_3_MEDIAN = 2.366
CHI2_3_999 = 16.266
_OFF2 = 9.0  # squared residual of a point that may belong to another body
_LEAST_APART = 8  # points of each: through a few, a motion is found by chance
_APART = 0.8  # of the sum of squares: two motions through noise alone leave 0.82 to 0.9 on average
_APART_MEMORY = 0.8  # of a motion


@dataclass(frozen=True)
class Transfer:
    """Measurements of the reference frame moved into the current one, with derivatives. Axes last for speed.

    ``uvd`` (3, N) prediction; ``H`` (3, 6, N) by a right perturbation of ``T_prev_cur``; ``G`` (3, 3, N) by the
    reference measurement; ``depth`` (N,) over that in the reference frame; ``in_front`` (N,) whether the point lies in
    front of the camera.
    """

    uvd: Array
    H: Array
    G: Array
    depth: Array
    in_front: NDArray[np.bool_]


# What nine directions do to a point (9, 3), divided by its depth in the current frame: a right perturbation (tau, phi)
# of T_prev_cur moves it by -tau + p x phi, and each part of a measurement along a vector that is filled in. As factors
# (5,) of the point over its depth (x, y, 1), of one over its depth, and of its depth in the reference frame over that.
_DIRECTIONS = np.zeros((9, 3, 5))
_DIRECTIONS[[0, 1, 2], [0, 1, 2], 3] = -1.0
_DIRECTIONS[[3, 4, 5], [1, 2, 0], [2, 0, 1]] = 1.0
_DIRECTIONS[[3, 4, 5], [2, 0, 1], [1, 2, 0]] = -1.0


def predict_uvd(T_prev_cur: Array, uvd_prev: Array, camera: StereoCamera) -> tuple[Array, NDArray[np.bool_]]:
    """Prediction (3, N) of (u, v, d) in the current frame from (N, 3) in the reference frame; which are in front."""
    uvd, in_front, *_ = _placed(T_prev_cur, uvd_prev, camera)
    return uvd, in_front


def _placed(
    T_prev_cur: Array, uvd_prev: Array, camera: StereoCamera
) -> tuple[Array, NDArray[np.bool_], Array, Array, Array]:
    """:func:`predict_uvd`; the points (3, N) in the current frame, divided by their depth in the reference frame, their
    derivative (3, 3) by the measurement, and one over the third of them."""
    f, c = np.array([[camera.fx_px, camera.fy_px], [camera.cx_px, camera.cy_px]])
    R, by = T_prev_cur[:3, :3].T, np.empty((3, 3))
    by[:, :2] = R[:, :2] / f
    by[:, 2] = R @ T_prev_cur[:3, 3] / (-camera.fx_px * camera.baseline_m)
    m = by @ uvd_prev.T
    m += (R[:, 2] - by[:, :2] @ c)[:, None]
    in_front = m[2] > 1e-6
    w = 1.0 / np.where(in_front, m[2], 1.0)
    uvd = m * w
    uvd[:2] *= f[:, None]
    uvd[:2] += c[:, None]
    uvd[2] = uvd_prev[:, 2] * w
    return uvd, in_front, m, by, w


def transfer(T_prev_cur: Array, uvd_prev: Array, camera: StereoCamera) -> Transfer:
    """:func:`predict_uvd`, with its derivatives."""
    uvd, in_front, m, by, w = _placed(T_prev_cur, uvd_prev, camera)
    factors = np.empty((5, len(uvd_prev)))
    factors[:3], factors[3], factors[4] = m, uvd_prev[:, 2] / (camera.fx_px * camera.baseline_m), 1.0
    factors *= w
    directions = _DIRECTIONS.copy()
    directions[6:, :, 4] = by.T
    dm = (directions.reshape(27, 5) @ factors).reshape(9, 3, -1)
    D, back = np.empty((3, 9, len(uvd_prev))), dm[:, 2]
    D[0] = camera.fx_px * (dm[:, 0] - factors[0] * back)
    D[1] = camera.fy_px * (dm[:, 1] - factors[1] * back)
    D[2] = -uvd[2] * back
    D[2, 8] += w
    return Transfer(uvd, D[:, :6], D[:, 6:], m[2], in_front)


NO_TWIST = np.zeros(6)


def right_velocity(twist: Array, uvd: Array, camera: StereoCamera, late_s: float = 0.0) -> Array:
    """(2, N) per second, in normalised coordinates of the right image: velocity of points (N, 3) that stand still,
    seen by a camera that moves with ``twist`` (6,) per second, or (6, N); its mean over the ``late_s`` that follow."""
    rho = uvd[:, 2] / (camera.fx_px * camera.baseline_m)
    x, y = (uvd[:, 0] - camera.cx_px) / camera.fx_px, (uvd[:, 1] - camera.cy_px) / camera.fy_px
    (tx, ty, tz), (wx, wy, wz) = twist[:3], twist[3:]
    ahead = wy * x - wx * y - tz * rho
    out = np.empty((2, len(uvd)))
    out[0] = wz * y - wy - tx * rho - (x - camera.baseline_m * rho) * ahead
    out[1] = wx - wz * x - ty * rho - y * ahead
    return out / (1.0 + late_s * ahead) if late_s else out


def residual_covariance(G: Array, S_prev: Array, S_cur: Array, persistent: float = 0.0) -> Array:
    """Covariance (3, 3, N) of (measured - predicted): ``G S_prev G^T + S_cur + persistent g g^T``.

    ``persistent``: variance of the error of disparity that a point has in both frames alike, ``g`` the residual's
    derivative by it, :func:`persistent_direction`.
    """
    g = persistent_direction(G)
    C: Array = ((S_prev.T @ G)[:, None] * G).sum(axis=2)
    C += S_cur[:, :, None]
    C += (persistent * g)[:, None] * g
    return C


def persistent_direction(G: Array) -> Array:
    """Derivative (3, N) of the residuals by an error of disparity that a point has in both frames: ``e_d - G e_d``."""
    g = -G[:, 2]
    g[2] += 1.0
    return g


def whitener(C: Array) -> Array:
    """Inverse Cholesky factors (3, 3, N): ``L^-1`` with ``L L^T = C``, in closed form."""
    a = 1.0 / np.sqrt(C[0, 0])
    l10, l20 = C[1, 0] * a, C[2, 0] * a
    b = 1.0 / np.sqrt(C[1, 1] - l10**2)
    l21 = (C[2, 1] - l20 * l10) * b
    c = 1.0 / np.sqrt(C[2, 2] - l20**2 - l21**2)
    W = np.zeros_like(C)
    W[0, 0], W[1, 1], W[2, 2] = a, b, c
    W[1, 0] = -l10 * a * b
    W[2, 1] = -l21 * b * c
    W[2, 0] = -(l20 * a + l21 * W[1, 0]) * c
    return W


def apply_whitener(W: Array, M: Array) -> Array:
    """Lower-triangular (3, 3, N) times (3, k, N) or (3, N)."""
    w = W if M.ndim == 2 else W[:, :, None]
    out: Array = w[:, 0] * M[0]
    out[1:] += w[1:, 1] * M[1]
    out[2] += w[2, 2] * M[2]
    return out


@dataclass(frozen=True)
class Motion:
    """A solved motion.

    ``T_prev_cur`` (4, 4); ``inliers`` (N,); ``scale_px``: robust standard deviation of one image coordinate;
    ``residuals`` (M, 3) of (u, v, d) [px] of the inliers; ``uvd_prev`` (M, 3) their measurements in the reference
    frame, smoothed by those in the current one; ``information`` (6, 6) at unit pixel noise; ``converged``;
    ``noise`` as given to :func:`refine`.
    """

    T_prev_cur: Array
    inliers: NDArray[np.bool_]
    scale_px: float
    residuals: Array
    uvd_prev: Array
    information: Array
    converged: bool
    noise: PointNoise

    @cached_property
    def worst_translation_sigma_m(self) -> float:
        """Largest standard deviation of the translation in any direction [m], at the noise that the residuals show."""
        info = self.information
        marginal = info[:3, :3] - info[:3, 3:] @ np.linalg.pinv(info[3:, 3:]) @ info[3:, :3]
        smallest = float(np.linalg.eigvalsh(marginal)[0])
        return self.scale_px / np.sqrt(smallest) if smallest > 0 else np.inf

    def __str__(self) -> str:
        t = np.linalg.norm(self.T_prev_cur[:3, 3])
        return f"motion of {t:.4f} m, {self.inliers.sum()} of {len(self.inliers)} inliers, noise {self.scale_px:.3f} px"


@dataclass(frozen=True)
class Whitened:
    """The residuals of a motion, whitened to unit covariance for unit pixel noise.

    ``moved``: the transfer of its smoothed points; ``C`` (3, 3, M) the covariance of its residuals, ``W`` its whitener;
    ``z`` (3, M) residuals; ``A`` (3, 6, M) their derivatives by a right perturbation of the motion.
    """

    moved: Transfer
    C: Array
    W: Array
    z: Array
    A: Array


def whitened(motion: Motion, camera: StereoCamera) -> Whitened:
    """The residuals of a motion, whitened as when it was estimated."""
    moved = transfer(motion.T_prev_cur, motion.uvd_prev, camera)
    C = residual_covariance(moved.G, motion.noise.S, motion.noise.S, motion.noise.persistent)
    W = whitener(C)
    return Whitened(moved, C, W, apply_whitener(W, motion.residuals.T), apply_whitener(W, moved.H))


def mistakable(motion: Motion, white: Whitened) -> list[Array]:
    """(3, N) each: covariance of a point's smoothed disparity and its residual where a part of the noise is not there,
    though stated: what persists, then the variances of column and row. It would be zero if the noise were as stated."""
    G, S, persistent = white.moved.G, motion.noise.S, motion.noise.persistent
    g = persistent_direction(G)
    gain = np.einsum("k,ikn->in", S[2], G) - persistent * g
    gain = np.einsum("jin,jn->in", white.W, apply_whitener(white.W, gain))
    out = [persistent * g]
    for k in range(2):
        q = G[:, k] * (gain * G[:, k]).sum(0)
        q[k] += gain[k]
        out.append(S[k, k] * q)
    return out


# Iterations in which the inliers may change; then they stand, or a point on the fence would keep the estimate moving.
_CHOOSING = 6
# Of the motion's standard deviation: a step so small has come to rest. With few or noisy points, each leaves most of
# what the one before had left: from the twelfth on, that is enough, and a step as large as the deviation leads away.
_AT_REST, _PATIENCE = 0.01, 12
# In the first of them, points that tell the translation choose alone: far ones agree with any, and would make good near
# ones look like outliers.
_NEAR_FIRST, _ENOUGH = 2, 8
_PLAIN = PointNoise()


@np.errstate(divide="ignore", invalid="ignore")  # a point at the camera's centre has no weight, and is no inlier
def refine(
    T_start: Array,
    uvd_prev: Array,
    uvd_cur: Array,
    camera: StereoCamera,
    *,
    max_iterations: int = 40,
    robust: bool = True,
    noise: PointNoise = _PLAIN,
    tolerance_px: float = np.inf,
    chosen_px: float | None = None,
) -> Motion | None:
    """Weighted reprojection error in left and right of the new frame, by Gauss-Newton.

    Each point's stacked residual is weighted with the full inverse of its covariance at unit pixel noise of the form
    ``noise``, which may include a disparity error that a point keeps while it is followed: a patch that looks
    different in the right image is misplaced by the same amount in each frame. The derivatives are evaluated at the
    points smoothed over both frames, not as measured in the first: otherwise the noise of far points enters the
    derivative and biases the motion (errors in variables; B. Triggs et al., "Bundle adjustment, a modern synthesis",
    2000, section 6.1: this is the two-frame problem with the points eliminated).

    If ``robust``, points within ``tolerance_px`` of the prediction are candidates. The noise scale is taken from their
    median residual, those beyond its 99.9 % ellipsoid are left out, and the rest are weighted by Huber's rule. They are
    chosen anew at each of the first six steps: a first motion from four noisy points disagrees with good ones, and
    without these the estimate would be biased towards it. With a noise scale ``chosen_px`` all are kept: they were
    chosen before, and ``T_start`` is near the end.

    Returns None where the geometry leaves the motion undetermined.
    """
    S, persistent = noise.S, noise.persistent
    T, smoothed, converged = T_start, uvd_prev, False
    for iteration in range(1, max_iterations + 1):
        moved = transfer(T, smoothed, camera)
        back = (uvd_prev - smoothed).T
        r = uvd_cur.T - moved.uvd - np.einsum("ikn,kn->in", moved.G, back)
        W = whitener(residual_covariance(moved.G, S, S, persistent))
        z = apply_whitener(W, r)
        if chosen_px is not None:
            keep, scale, weight = moved.in_front, chosen_px, huber((z**2).sum(0) / chosen_px**2)
        elif not robust:
            keep, scale, weight = moved.in_front, 1.0, np.ones(r.shape[1])
        elif iteration <= _CHOOSING:
            close = moved.in_front & within(r, tolerance_px)
            if iteration <= _NEAR_FIRST and (near := close & (uvd_prev[:, 2] > TELLING_PX)).sum() >= _ENOUGH:
                close = near
            keep, scale, weight = _robust_weights((z**2).sum(0), close)
        if keep.sum() < 3:
            return None
        A = apply_whitener(W, moved.H)
        kept = np.flatnonzero(keep)
        information, step = _solve_step(A.take(kept, axis=2), z.take(kept, axis=1), weight[kept])
        if step is None:
            return None
        T = T @ se3.exp(step)
        # What is left of the residual is shared between the two frames: S G^T C^-1 (r - H step).
        left = z - np.einsum("ijn,j->in", A, step)
        smoothed = uvd_prev + _smoothing(S, moved.G, W, left, persistent)
        deviations = float(np.sqrt(step @ information @ step)) / scale
        stands = iteration > _CHOOSING or chosen_px is not None
        done = bool(np.abs(step).max() < (1e-6 if stands else 1e-9))
        converged = done or deviations < _AT_REST
        if done or (iteration >= _PATIENCE and not _AT_REST <= deviations < 1.0):
            break
    return Motion(T, keep, scale, r[:, keep].T, smoothed[keep], information, converged, noise)


def _solve_step(A: Array, z: Array, weight: Array) -> tuple[Array, Array | None]:
    """Information (6, 6) and Gauss-Newton step (6,), None if undetermined, from whitened rows (3, 6, M) and (3, M)."""
    root = np.sqrt(weight)
    rows = (A * root).transpose(0, 2, 1).reshape(-1, 6)
    information: Array = rows.T @ rows
    try:
        step = np.asarray(np.linalg.solve(information, rows.T @ (z * root).reshape(-1)), np.float64)
    except np.linalg.LinAlgError:
        return information, None
    # A turn beyond 2 rad in one step means that the problem, not the motion, is large.
    return information, step if np.isfinite(step).all() and np.abs(step[3:]).max() < 2.0 else None


def _smoothing(S: Array, G: Array, W: Array, left: Array, persistent: float) -> Array:
    """Correction (N, 3) of the reference measurements for whitened residuals z (3, N).

    Less the expected noise of the reference given the residual: ``(S G^T - persistent e_d g^T) W^T z``.
    """
    lifted = np.empty(left.shape)
    lifted[0] = W[0, 0] * left[0] + W[1, 0] * left[1] + W[2, 0] * left[2]
    lifted[1] = W[1, 1] * left[1] + W[2, 1] * left[2]
    lifted[2] = W[2, 2] * left[2]
    out = np.einsum("ikn,in->nk", G, lifted) @ S
    out[:, 2] -= persistent * (persistent_direction(G) * lifted).sum(0)
    return out


def within(r: Array, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) whether residuals (3, N) of (u, v, d) are within a tolerance in the left image, and within one and a half in
    the disparity."""
    return (np.hypot(r[0], r[1]) < tolerance_px) & (np.abs(r[2]) < 1.5 * tolerance_px)


def huber(ratio: Array) -> Array:
    """Huber's weights for squared distances over the variance of the noise."""
    return np.minimum(1.0, 3.2 / np.sqrt(np.maximum(ratio, 1e-12)))


def _robust_weights(m2: Array, close: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float, Array]:
    """Inliers among the ``close`` points (N,), noise scale [px] and Huber weights from squared Mahalanobis distances at
    unit noise."""
    # Floor: below a fiftieth of a pixel the residual is rounding, and everything would look like an outlier.
    # Six of the residuals' degrees of freedom went to the motion.
    freedom = max(1.0 - 2.0 / max(int(close.sum()), 1), 1 / 3)
    scale2 = max(median(m2[close]) / CHI2_3_MEDIAN / freedom if close.any() else 1.0, 0.02**2)
    ratio = m2 / scale2
    return close & (ratio < CHI2_3_999), float(np.sqrt(scale2)), huber(ratio)


@dataclass
class Apart:
    """Whether two bodies move in the image, by less than would make two motions of them: two motions then explain
    their points far better than one does with any error of the rig. An error of the rig never does: what it leaves is
    noise, whatever the depth. Either may be the scene's.

    ``left`` (2,): running sums of squares, with two motions, and with an error of the rig. ``otherwise`` (6, 6): second
    moment of the two about the last motion, each by its share of the points; zero where no two bodies move.
    """

    left: Array = field(default_factory=lambda: np.zeros(2))
    otherwise: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def see(self, A: Array, z: Array, by_rig: float) -> bool:
        """Take in a motion: whitened derivatives (3 M, 6) by it and residuals (3 M,), coordinate by coordinate, of
        which an error of the rig would leave this sum of squares; whether two bodies move."""
        by_two, moment = _by_two(A.reshape(3, -1, 6), z.reshape(3, -1))
        self.left = _APART_MEMORY * self.left + (min(by_two, by_rig), by_rig)
        is_apart = bool(self.left[0] < _APART * self.left[1])
        self.otherwise = moment if is_apart else np.zeros((6, 6))
        return is_apart


def _by_two(A: Array, z: Array) -> tuple[float, Array]:
    """Sum of squares that two motions leave of residuals (3, M) with derivatives (3, M, 6), each point with the one
    that suits it, infinite where there are none; second moment (6, 6) of the two."""
    squares, steps = np.zeros((2, z.shape[1])), np.zeros((2, 6))
    other = (z**2).sum(axis=0) > _OFF2
    for _ in range(4):
        if min(other.sum(), (~other).sum()) < _LEAST_APART:
            return np.inf, np.zeros((6, 6))
        for i, among in enumerate((~other, other)):
            a, b = A[:, among].reshape(-1, 6), z[:, among].reshape(-1)
            steps[i] = np.linalg.lstsq(a.T @ a, a.T @ b, rcond=1e-12)[0]
            squares[i] = ((z - A @ steps[i]) ** 2).sum(axis=0)
        other = squares[1] < squares[0]
    share = other.mean()
    return float(squares.min(axis=0).sum()), steps.T @ ([[1.0 - share], [share]] * steps)
