"""Does the model know this place? The training domain, what to believe outside it, and what late truth teaches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.errors import GpvoError
from gpvo.online.stored import Stored
from gpvo.stats import student_t
from gpvo.types import Array, StereoCamera

_CAMERA = 0.25
_LEVEL, _STEP = 0.9, 0.05
_MISSING = 2.0  # Standard deviations outside, where training never missed the value.
DEGRADED_BELOW = 0.5
"""``in_domain`` below which a prediction is called ``degraded``."""


@dataclass(frozen=True)
class DomainCheck:
    """Of n rows: ``inside`` (n, d) standardised features drawn into the domain; ``distance`` (n,) to it, in training
    standard deviations; ``in_domain`` (n,) in [0, 1], 1 inside."""

    inside: Array
    distance: Array
    in_domain: Array


@dataclass(frozen=True)
class Domain(Stored):
    """Where the training data lay, per feature and jointly.

    ``centre``, ``scale`` (d,): robust, in the features' units. ``low``, ``high`` (d,): range of the standardised
    features without rare ones, where a model can have learned something; ``least``, ``most`` (d,): of all rows, because
    no training row is outside. ``whitening`` (d, d): ``|u W|`` is the Mahalanobis distance, with ``radius`` (1,) its
    training maximum. ``may_miss`` (d,) bool: features that were absent from some training rows.
    """

    centre: Array
    scale: Array
    low: Array
    high: Array
    least: Array
    most: Array
    whitening: Array
    radius: Array
    may_miss: NDArray[np.bool_]

    def locate(self, X: Array, noise: Array | float = 0.0) -> DomainCheck:
        """Rows (n, d) in the features' units. A missing value is typical, but far off if training never missed it.

        ``noise`` (n, d): variance with which the features themselves are known. A value that this explains does not
        count as outside: the distance is measured in training deviations combined with this one.
        """
        U = (X - self.centre) / self.scale
        missing = ~np.isfinite(U)
        U = np.where(missing, 0.0, U)
        # np.clip takes five times as long for a row.
        inside = np.minimum(np.maximum(U, self.low), self.high)
        away = (U - np.minimum(np.maximum(U, self.least), self.most)) ** 2 / (1.0 + noise / self.scale**2)
        beyond = away.sum(1) + self.charge_of_missing @ missing.T
        length = np.sqrt(((inside @ self.whitening) ** 2).sum(axis=1))
        joint = np.maximum(length - self.radius[0], 0.0)
        distance = np.sqrt(beyond + joint**2)
        return DomainCheck(inside, distance, np.exp(-0.5 * distance**2))

    @cached_property
    def charge_of_missing(self) -> Array:
        """(d,) what a missing value adds to the squared distance from the domain."""
        return np.where(self.may_miss, 0.0, _MISSING**2)

    def outside(self, X: Array) -> Array:
        """How far each value of rows (n, d), or of one (d,), lies beyond all of the training, in training standard
        deviations; 0 where it is missing."""
        U = (X - self.centre) / self.scale
        return np.nan_to_num(np.abs(U - np.clip(U, self.least, self.most)))

    @property
    def reach(self) -> tuple[Array, Array]:
        """Least and most (d,) of the training, in the features' units."""
        return self.centre + self.scale * self.least, self.centre + self.scale * self.most


def growth(distance: Array, power: Array | float) -> Array:
    """Factor on the variance: a power of one plus the distance from the domain; the power one is that of a Brownian
    motion's variance away from data."""
    return (1.0 + distance) ** power


def camera_problems(trained: StereoCamera | None, here: StereoCamera | None) -> list[str]:
    """How a camera differs from the one that a model was trained with, one line each."""
    if trained is None or here is None:
        return []
    pairs = (
        ("baseline", trained.baseline_m, here.baseline_m),
        ("focal length over image width", trained.fx_px / trained.width, here.fx_px / here.width),
    )
    far = [pair for pair in pairs if abs(pair[2] / pair[1] - 1.0) > _CAMERA]
    return [f"{name} is {b:.4g}, the model was trained with {a:.4g}" for name, a, b in far]


class AdaptiveScale:
    """A factor on each axis' standard deviation that brings the long-run coverage of the 90 % interval to 90 %.

    Steps are in the log of the scale, so the factor stays positive; it is kept within [1/100, 100]. I. Gibbs, E.
    Candes, "Adaptive Conformal Inference Under Distribution Shift" (2021), equation 2, in the form that moves the
    interval itself: A. Angelopoulos, E. Candes, R. Tibshirani, "Conformal PID Control" (2023), equation 4.
    ``scale`` (6,): where to begin, by default ones. Raises GpvoError unless it is six positive numbers.
    """

    def __init__(self, scale: ArrayLike | None = None) -> None:
        start = np.ones(6) if scale is None else np.asarray(scale, dtype=np.float64)
        if start.shape != (6,) or not ((start > 0) & (start < np.inf)).all():
            raise GpvoError(f"a scale of {start.tolist()} is not possible", cure="give six positive factors")
        self._log_scale = np.log(start)

    @property
    def scale(self) -> Array:
        """(6,) factor on each standard deviation; ones before any truth."""
        return np.exp(self._log_scale)

    def observe(self, error: Array, sigma: Array, nu: float = np.inf) -> None:
        """``error`` (6,) about the mean, and the ``sigma`` (6,) stated for it, including the factor at that time.

        The interval is that of a t with ``nu`` degrees of freedom: by a Gaussian's, the standard deviations of heavy
        tails would shrink. Axes whose error is NaN are left unchanged.
        """
        missed = np.abs(error) > student_t.half_width(_LEVEL, nu) * sigma
        move = np.where(np.isfinite(error), _STEP * (missed - (1.0 - _LEVEL)), 0.0)
        self._log_scale = np.clip(self._log_scale + move, -np.log(100.0), np.log(100.0))
