"""Where the measurement noise of VO comes from: the policies that are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpvo.accumulation import measured
from gpvo.geometry.covariance import is_positive_definite
from gpvo.types import IMPORTED, Array, MotionError, Prediction, VoRecord

CONSTANT, CONSTANT_BEST, CONSTANT_HINDSIGHT = "constant", "constant_best", "constant_hindsight"
TRIANGULATION, POINTING_MATCHING, LEARNED = "triangulation", "pointing_matching", "learned"
POLICIES = (CONSTANT, CONSTANT_BEST, CONSTANT_HINDSIGHT, TRIANGULATION, POINTING_MATCHING, LEARNED)
STATED = (TRIANGULATION, POINTING_MATCHING, IMPORTED)
"""Covariances that the records themselves hold: of VO's geometry, or another odometry's own."""


class Policy(Protocol):
    """States the error of one measured motion, for B members or one, None where it has nothing to say about it."""

    @property
    def name(self) -> str:
        """By which it is chosen and shown."""
        ...

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError | None:
        """The error stated of the record's motion."""
        ...


@dataclass(frozen=True)
class ConstantPolicy:
    """One diagonal covariance for every motion.

    ``mean_squares`` (6,) [m^2, rad^2] per motion of ``dt_s`` seconds; ``scalars`` (b, 2) multiply the translation
    and the rotation variances, b > 1 to filter under many at once. A motion that spans more frames (its reference is
    older) gets proportionally more, as a walk would.
    """

    mean_squares: Array
    dt_s: float
    scalars: Array | None = None
    name: str = CONSTANT

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError:
        """The constant, widened for a motion over several frames."""
        scalars = np.ones((1, 2)) if self.scalars is None else np.atleast_2d(self.scalars)
        frames = max(1.0, round(record.dt_s / self.dt_s)) if self.dt_s > 0 else 1.0
        diagonal = np.repeat(scalars, 3, axis=1) * (np.asarray(self.mean_squares) * frames)
        return MotionError.independent(diagonal[:, :, None] * np.eye(6), dt_s=record.dt_s)


@dataclass(frozen=True)
class GeometricPolicy:
    """The covariance that a record holds by one method, as it stands: of VO's geometry, or imported."""

    name: str

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError | None:
        """The record's own covariance; None where the method has none for this frame."""
        covariance = record.covariances.get(self.name)
        if covariance is None or not is_positive_definite(covariance):
            return None
        return measured(record, self.name).row(None)


@dataclass(frozen=True)
class LearnedPolicy:
    """The predicted error: its covariance in the parts by which it accumulates.

    ``use_parts`` False treats the total as independent from motion to motion, to show what the parts are worth.
    """

    name: str = LEARNED
    use_parts: bool = True

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError | None:
        """The prediction in its parts; None without a prediction for this frame."""
        if prediction is None or not is_positive_definite(prediction.covariance):
            return None
        error: MotionError = prediction
        if not self.use_parts:
            error = MotionError.independent(error.covariance, error.mean, dt_s=error.dt_s, status=error.status)
        return error.row(None)
