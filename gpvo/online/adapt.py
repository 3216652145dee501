"""Adaptive conformal calibration: late truth keeps the stated intervals honest while the world drifts.

I. Gibbs, E. Candes, "Adaptive Conformal Inference Under Distribution Shift" (2021), equation 2, in the form that moves
the interval itself: A. Angelopoulos, E. Candes, R. Tibshirani, "Conformal PID Control" (2023), equation 4.
"""

from __future__ import annotations

import numpy as np

from gpvo.types import Array

LEVEL = 0.9
_Z = 1.6448536269514722
"""Half width of the central 90 % interval, in standard deviations."""


class AdaptiveScale:
    """A factor on each axis' standard deviation that brings the long-run coverage of the 90 % interval to 90 %.

    Steps are in the log of the scale, so the factor stays positive; it is kept within [1/100, 100].
    """

    def __init__(self, step: float = 0.05, n_axes: int = 6, scale: Array | None = None) -> None:
        self._step = step
        self._log_scale = np.zeros(n_axes) if scale is None else np.log(scale)

    @property
    def scale(self) -> Array:
        """(6,) factor on each standard deviation; ones before any truth."""
        return np.exp(self._log_scale)

    def observe(self, error: Array, sigma: Array) -> None:
        """``error`` (6,) about the mean, and the ``sigma`` (6,) stated for it, including the factor at that time.

        Axes whose error is NaN are left unchanged.
        """
        missed = np.abs(error) > _Z * sigma
        move = np.where(np.isfinite(error), self._step * (missed - (1.0 - LEVEL)), 0.0)
        self._log_scale = np.clip(self._log_scale + move, -np.log(100.0), np.log(100.0))
