"""Robust bundle adjustment: the path and the landmarks that explain a run's stereo tracks best.

Levenberg-Marquardt on the normal equations (:mod:`gpvo.twin.normal`). B. Triggs et al., "Bundle adjustment, a modern
synthesis" (2000), sections 6 and 7. A landmark moves in the (u, v, d) of one of its own views, where also far points
are well conditioned.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.twin.normal import NormalEquations, Pieces
from gpvo.twin.observations import WHITEN, Chart, Estimate, Observations
from gpvo.types import Array

_CHI2_3_MEDIAN, _CHI2_3_999 = 2.366, 16.266
_HUBER_SIGMAS = 3.2
_MIN_SIGMA_PX = 0.02
# Iterations in which weights may change; then they stand, so that the cost has one minimum.
_CHOOSING = 6


@dataclass(frozen=True)
class Structure:
    """What was fitted: ``T_world_cam`` (F, 4, 4); ``points_world`` (N, 3) [m]; of each observation its ``residual_px``
    (M, 3), measured minus projected, and ``weight`` (M,), 0 for outliers; ``sigma_px`` (F,) noise of each frame."""

    T_world_cam: Array
    points_world: Array
    residual_px: Array
    weight: Array
    sigma_px: Array
    iterations: int
    converged: bool


def adjust(
    seen: Observations,
    T_world_cam: Array,
    *,
    robust: bool = True,
    tolerance: float = 1e-4,
    max_iterations: int = 30,
) -> Structure:
    """Fit path and landmarks, from the path (F, 4, 4) that odometry found; the first pose stays.

    ``robust``: each frame has its own noise, from its median residual; observations beyond the 99.9 % ellipsoid of
    their frame are left out, and the rest weighted by Huber's rule. ``tolerance``: relative decrease of the cost
    [-] at which the fit ends.
    """
    chart, pieces = Chart.of(seen), Pieces.of(seen)
    now = Estimate(T_world_cam, chart.begin(seen, T_world_cam))
    weight, sigma = seen.trusted.astype(np.float64), np.ones(len(T_world_cam))
    damping, converged, iteration = 1e-4, False, 0
    for iteration in range(1, max_iterations + 1):
        # Not at first: a landmark that begins at an outlier would call all its other views outliers.
        if robust and 1 < iteration <= _CHOOSING:
            weight, sigma = _robust_weights(seen, now, sigma)
        root = np.sqrt(weight) / sigma[seen.frame]
        normal = None  # frees the last one before the next is made
        normal = NormalEquations.of(seen, pieces, now, chart, root)
        cost = _cost(seen, now, root)
        for _ in range(8):
            step_cam, step_uvd = normal.solve(damping)
            candidate = now.moved(step_cam, step_uvd, chart, seen)
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
    residual = seen.uvd - seen.camera.project(now.in_camera(seen))
    return Structure(now.T_world_cam, now.points_world, residual, weight, sigma, iteration, converged)


def _robust_weights(seen: Observations, now: Estimate, sigma: Array) -> tuple[Array, Array]:
    """Weights (M,) and noise of each frame (F,) [px] from the residuals as they are."""
    m2 = ((seen.uvd - seen.camera.project(now.in_camera(seen))) @ WHITEN.T) ** 2
    m2 = m2.sum(axis=1)
    usual = float(np.median(m2[seen.trusted])) if seen.trusted.any() else 1.0
    starts = np.searchsorted(seen.frame, np.arange(len(sigma) + 1))
    variance = np.full(len(sigma), usual)
    for k, (i, j) in enumerate(itertools.pairwise(starts)):
        own = m2[i:j][seen.trusted[i:j]]
        if len(own) >= 5:
            variance[k] = np.median(own)
    sigma = np.maximum(np.sqrt(variance / _CHI2_3_MEDIAN), _MIN_SIGMA_PX)
    ratio = m2 / sigma[seen.frame] ** 2
    huber = np.minimum(1.0, _HUBER_SIGMAS / np.sqrt(np.maximum(ratio, 1e-12)))
    return np.where(seen.trusted & (ratio < _CHI2_3_999), huber, 0.0), sigma


def _cost(seen: Observations, now: Estimate, root_weight: Array) -> float:
    z = (seen.uvd - seen.camera.project(now.in_camera(seen))) @ WHITEN.T
    return float((root_weight**2 * (z**2).sum(axis=1)).sum())


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
