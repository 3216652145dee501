"""Adaptive conformal calibration: late truth keeps the stated intervals honest while the world drifts.

I. Gibbs, E. Candes, "Adaptive Conformal Inference Under Distribution Shift" (2021), equation 2, in the form that moves
the interval itself: A. Angelopoulos, E. Candes, R. Tibshirani, "Conformal PID Control" (2023), equation 4.
"""

from __future__ import annotations

import numpy as np

from gpvo.stats import student_t
from gpvo.types import Array

LEVEL, _STEP = 0.9, 0.05


class AdaptiveScale:
    """A factor on each axis' standard deviation that brings the long-run coverage of the 90 % interval to 90 %.

    Steps are in the log of the scale, so the factor stays positive; it is kept within [1/100, 100].
    """

    def __init__(self, scale: Array | None = None) -> None:
        self._log_scale = np.zeros(6) if scale is None else np.log(scale)

    @property
    def scale(self) -> Array:
        """(6,) factor on each standard deviation; ones before any truth."""
        return np.exp(self._log_scale)

    def observe(self, error: Array, sigma: Array, nu: float = np.inf) -> None:
        """``error`` (6,) about the mean, and the ``sigma`` (6,) stated for it, including the factor at that time.

        The interval is that of a t with ``nu`` degrees of freedom: by a Gaussian's, the standard deviations of heavy
        tails would shrink. Axes whose error is NaN are left unchanged.
        """
        missed = np.abs(error) > student_t.half_width(LEVEL, nu) * sigma
        move = np.where(np.isfinite(error), _STEP * (missed - (1.0 - LEVEL)), 0.0)
        self._log_scale = np.clip(self._log_scale + move, -np.log(100.0), np.log(100.0))
