"""Pointing and matching noise from the residuals of a motion."""

from __future__ import annotations

import numpy as np

from gpvo.types import Array

_START_PX = (0.1, 0.5)
_MEMORY = 0.97  # of the running mean: about thirty frames


def residual_sigmas(residuals: Array, G: Array) -> tuple[float, float]:
    """(sigma_p, sigma_m) [px] that explain the residuals (M, 3) of (u, v, d).

    Method of moments: a residual's covariance is ``G S G^T + S`` with ``S = diag(p^2, p^2, m^2)``, so the sums of
    squares of its image and of its disparity part are two linear equations in p^2 and m^2. Six degrees of freedom go
    to the motion.
    """
    count = len(residuals)
    if count < 8:
        return float("nan"), float("nan")
    g2 = (G**2).sum(axis=2)
    A = np.array([[g2[:2, :2].sum() + 2 * count, g2[:2, 2].sum()], [g2[2, :2].sum(), g2[2, 2] + count]])
    freedom = 1.0 - 6.0 / (3.0 * count)
    sums = (residuals**2).sum(axis=0) / freedom
    p2, m2 = np.linalg.solve(A, [sums[0] + sums[1], sums[2]])
    return float(np.sqrt(max(p2, 1e-6))), float(np.sqrt(max(m2, 1e-6)))


class SigmaEstimator:
    """Fixed sigmas where given, else the running root mean square of what the residuals have shown so far."""

    def __init__(self, sigma_p_px: float | None, sigma_m_px: float | None) -> None:
        self._fixed = (sigma_p_px, sigma_m_px)
        self._running: Array | None = None

    def update(self, sigma_p_px: float, sigma_m_px: float) -> None:
        """Take in one motion's estimates; NaN is ignored."""
        new = np.array([sigma_p_px, sigma_m_px]) ** 2
        if np.isfinite(new).all():
            self._running = new if self._running is None else _MEMORY * self._running + (1 - _MEMORY) * new

    @property
    def values(self) -> tuple[float, float]:
        """(sigma_p, sigma_m) [px] to use now."""
        running = np.array(_START_PX) if self._running is None else np.sqrt(self._running)
        p, m = (float(r) if f is None else f for f, r in zip(self._fixed, running, strict=True))
        return p, m
