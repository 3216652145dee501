"""The noise of a twin: the residuals of each track as a whole, with a random sign.

So noise keeps its dependence on depth, place and time, and its evolution along a track. Patches of neighbouring points
overlap, and points on one moving object are displaced together, so neighbours may err alike; then neighbours get their
signs from one smooth field. Multiplying residuals by dependent random numbers, and how far the dependence must reach:
X. Shao, "The dependent wild bootstrap" (2010).

The residuals are those of a robust bundle adjustment: the path and the landmarks that explain a run's stereo tracks
best. Levenberg-Marquardt on the normal equations (:mod:`gpvo.twin.bundle`). B. Triggs et al., "Bundle adjustment, a
modern synthesis" (2000), sections 6 and 7. A landmark moves in the (u, v, d) of one of its own views, where even far
points are well conditioned.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from gpvo.geometry import se3
from gpvo.twin.bundle import (
    WHITEN,
    Estimate,
    NormalEquations,
    Observations,
    Pieces,
    pose_jacobian,
    projection_jacobian,
    summed,
)
from gpvo.types import Array
from gpvo.vo.motion import CHI2_3_999, CHI2_3_MEDIAN, huber

_MIN_SIGMA_PX = 0.02
# Iterations in which weights may change; then they stand, so that the cost has one minimum.
_CHOOSING = 6


@dataclass(frozen=True)
class Structure(Estimate):
    """What was fitted, and of each observation its ``residual_px`` (M, 3), measured minus projected, and ``weight``
    (M,), 0 for outliers; ``sigma_px`` (F,) noise of each frame."""

    residual_px: Array
    weight: Array
    sigma_px: Array
    converged: bool


def adjust(
    seen: Observations, T_world_cam: Array, *, robust: bool = True, tolerance: float = 1e-4, max_iterations: int = 30
) -> Structure:
    """Fit path and landmarks, from the path (F, 4, 4) that odometry found; the first pose stays.

    ``robust``: each frame has its own noise, from its median residual; observations beyond the 99.9 % ellipsoid of
    their frame are left out, and the rest weighted by Huber's rule. ``tolerance``: relative decrease of the cost
    [-] at which the fit ends.
    """
    pieces, now = Pieces.of(seen), Estimate.begin(seen, T_world_cam)
    weight, sigma = seen.trusted.astype(np.float64), np.ones(len(T_world_cam))
    damping, converged = 1e-4, False
    for iteration in range(1, max_iterations + 1):
        # Not at first: a landmark that begins at an outlier would call all its other views outliers.
        if robust and 1 < iteration <= _CHOOSING:
            weight, sigma = _robust_weights(seen, now, sigma)
        root = np.sqrt(weight) / sigma[seen.frame]
        normal = None  # frees the last one before the next is made
        normal = NormalEquations.of(seen, pieces, now, root)
        cost = _cost(seen, now, root)
        for _ in range(8):
            step_cam, step_uvd = normal.solve(damping)
            candidate = now.moved(step_cam, step_uvd, seen)
            after = _cost(seen, candidate, root)
            if after <= cost:
                break
            damping *= 10.0
        else:
            converged = True
            break
        now, damping = candidate, max(damping / 10.0, 1e-9)
        if iteration > (_CHOOSING if robust else 0) and cost - after <= tolerance * cost:
            converged = True
            break
    return Structure(now.T_world_cam, now.points_world, now.misfit_px(seen), weight, sigma, converged)


def _robust_weights(seen: Observations, now: Estimate, sigma: Array) -> tuple[Array, Array]:
    """Weights (M,) and noise of each frame (F,) [px] from the residuals as they are."""
    m2 = ((now.misfit_px(seen) @ WHITEN.T) ** 2).sum(axis=1)
    usual = float(np.median(m2[seen.trusted])) if seen.trusted.any() else 1.0
    starts = np.searchsorted(seen.frame, np.arange(len(sigma) + 1))
    variance = np.full(len(sigma), usual)
    for k, (i, j) in enumerate(itertools.pairwise(starts)):
        own = m2[i:j][seen.trusted[i:j]]
        if len(own) >= 5:
            variance[k] = np.median(own)
    sigma = np.maximum(np.sqrt(variance / CHI2_3_MEDIAN), _MIN_SIGMA_PX)
    ratio = m2 / sigma[seen.frame] ** 2
    return np.where(seen.trusted & (ratio < CHI2_3_999), huber(ratio), 0.0), sigma


def _cost(seen: Observations, now: Estimate, root_weight: Array) -> float:
    return float((root_weight**2 * ((now.misfit_px(seen) @ WHITEN.T) ** 2).sum(axis=1)).sum())


def without_loose_frames(structure: Structure, seen: Observations, t_ns: NDArray[np.int64]) -> Structure:
    """Frames whose pose nothing determines take one between their neighbours', at the time that they have."""
    T = structure.T_world_cam.copy()
    held = np.bincount(seen.frame, structure.weight > 0, minlength=len(T)) >= 4
    held[0] = True
    known = np.flatnonzero(held)
    for k in np.flatnonzero(~held):
        j = int(np.searchsorted(known, k))
        if j < len(known):
            a, b = known[j - 1], known[j]
            T[k] = se3.interpolate(T[a], T[b], np.asarray((t_ns[k] - t_ns[a]) / (t_ns[b] - t_ns[a])))
    return replace(structure, T_world_cam=T)


_LEAST_LEFT = 0.25  # of the variance of a residual that the pose took most of


def restored(seen: Observations, structure: Structure) -> Array:
    """Residuals (M, 3) [px] as large as the noise behind them.

    What two frames say of their motion does not depend on where the landmarks are, so residuals keep it whole (of a
    point seen twice they hold the difference of both measurements, exactly). What the pose took is given back: the
    most where a few near points decide it, as there the fit follows the noise (leverage; "HC2" of J. MacKinnon,
    H. White, 1985). Spread evenly over a frame, it would leave the errors of twins too small.
    """
    used = structure.weight > 0
    length = np.bincount(seen.track, used, minlength=len(structure.points_world))[seen.track]
    root = np.sqrt(structure.weight * (1.0 - 1.0 / np.maximum(length, 1.0))) / structure.sigma_px[seen.frame]
    information = np.zeros((len(structure.T_world_cam), 6, 6))
    for rows, part in seen.parts():
        A = _pose_slopes(part, structure, root[rows])
        information += summed(np.swapaxes(A, 1, 2) @ A, part.frame, len(information))
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-12))
    outer = scale[:, :, None] * scale[:, None, :]
    covariance = outer * np.linalg.inv(outer * information + 1e-9 * np.eye(6))
    noise = np.empty_like(structure.residual_px)
    for rows, part in seen.parts():
        A = _pose_slopes(part, structure, root[rows])
        taken, axes = np.linalg.eigh(A @ covariance[part.frame] @ np.swapaxes(A, 1, 2))
        z = np.einsum("mij,mi->mj", axes, structure.residual_px[rows] @ WHITEN.T)
        z /= np.sqrt(np.maximum(1.0 - taken, _LEAST_LEFT))
        noise[rows] = np.einsum("mij,mj->mi", axes, z) @ np.linalg.inv(WHITEN).T
    return np.where(used[:, None], noise, structure.residual_px)


def _pose_slopes(seen: Observations, structure: Structure, root_weight: Array) -> Array:
    """(M, 3, 6) derivatives of whitened (u, v, d), times ``root_weight`` (M,), by the pose of the frame."""
    P = structure.in_camera(seen)
    slopes: Array = root_weight[:, None, None] * (WHITEN @ projection_jacobian(P, seen.camera) @ pose_jacobian(P))
    return slopes


_EDGES_PX = (0.0, 10.0, 20.0, 40.0)
_AGREE, _SURE = 0.1, 3.0
_PAIRS = 1_000_000  # of observations at a time: an hour has a hundred million
_LARGEST = 4.0  # whitened residuals count no more


@dataclass(frozen=True)
class Neighbours:
    """Pairs of tracks that were near each other: ``first``, ``second`` (P,) and their mean ``distance_px`` (P,); the
    sums of the products of their whitened residuals, ``product``, and of the mean of their squares, ``square``."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    distance_px: Array
    product: Array
    square: Array

    @classmethod
    def of(cls, seen: Observations, structure: Structure) -> Neighbours:
        """Pairs within twice the largest distance over which residuals may agree."""
        z = (structure.residual_px @ WHITEN.T) / structure.sigma_px[seen.frame][:, None]
        z = np.clip(z, -_LARGEST, _LARGEST)
        used = structure.weight > 0
        starts = np.searchsorted(seen.frame, np.arange(len(structure.T_world_cam) + 1))
        n, parts, held = len(structure.points_world), [], 0
        pairs = [np.zeros((0, 2), np.int64)]
        for i, j in itertools.pairwise(starts):
            rows = i + np.flatnonzero(used[i:j])
            if len(rows) > 1:
                near = cKDTree(seen.uvd[rows, :2]).query_pairs(2 * _EDGES_PX[-1], output_type="ndarray")
                pairs.append(rows[near])
                held += len(near)
            if held > _PAIRS:
                parts.append(_sums_of(np.concatenate(pairs), seen, z, n))
                pairs, held = pairs[:1], 0
        parts.append(_sums_of(np.concatenate(pairs), seen, z, n))
        key, (count, distance, product, square) = _by_key(*(np.concatenate(p, axis=-1) for p in zip(*parts)))
        first, second = np.divmod(key, max(n, 1))
        return cls(first, second, distance / count, product, square)

    @property
    def reach_px(self) -> float:
        """Distance up to which residuals agree: a correlation beyond a tenth and beyond chance. 0 where none does."""
        reach = 0.0
        for low, high in itertools.pairwise(_EDGES_PX):
            own = (self.distance_px >= low) & (self.distance_px < high)
            total, square = self.product[own].sum(), self.square[own].sum()
            if total < max(_AGREE * square, _SURE * float(np.sqrt((self.product[own] ** 2).sum()))) or not square:
                break
            reach = high
        return reach


def _by_key(key: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
    """Distinct keys, and the rows of ``values`` (k, P) summed over equal ones."""
    distinct, place = np.unique(key, return_inverse=True)
    return distinct, np.stack([np.bincount(place, v, minlength=len(distinct)) for v in values]).astype(np.float64)


def _sums_of(pairs: NDArray[np.int64], seen: Observations, z: Array, n: int) -> tuple[NDArray[np.int64], Array]:
    """Of pairs (P, 2) of observations, by their two tracks of ``n``, as one key: their number, and the sums of their
    distances, of the products of whitened residuals ``z`` and of the means of these squares."""
    a, b = pairs.T
    first, second = np.sort(np.stack([seen.track[a], seen.track[b]]), axis=0)
    distance = np.linalg.norm(seen.uvd[a, :2] - seen.uvd[b, :2], axis=1)
    square = 0.5 * ((z[a] ** 2).sum(axis=1) + (z[b] ** 2).sum(axis=1))
    return _by_key(first * n + second, np.stack([np.ones(len(a)), distance, (z[a] * z[b]).sum(axis=1), square]))


def draw_signs(count: int, neighbours: Neighbours, rng: np.random.Generator) -> Array:
    """Signs (count,) of tracks: independent, or of a field that is smooth over twice the reach of the residuals."""
    signs, reach = rng.choice([-1.0, 1.0], size=count), neighbours.reach_px
    if reach == 0.0:
        return signs
    weight = np.maximum(1.0 - neighbours.distance_px / (2 * reach), 0.0)
    mixing = sparse.csr_matrix((weight, (neighbours.first, neighbours.second)), shape=(count, count))
    own = rng.standard_normal(count)
    field = own + mixing @ own + mixing.T @ own
    return np.where(field < 0, -1.0, 1.0)
