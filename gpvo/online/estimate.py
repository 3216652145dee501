"""From features to the error's distribution: the arithmetic of the predictor, for one row and for many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.online.base import RESIDUAL_COLUMN, BaseVariance, Velocities, feature_noise, motion_noise, positions
from gpvo.online.division import Division
from gpvo.online.guard import Domain, DomainCheck, growth
from gpvo.online.projected import ProjectedGP
from gpvo.online.stored import LARGEST, Stored, arrays_of_base, check_arrays, check_related
from gpvo.types import Array, Prediction

LN_LARGEST = 60.0
"""Log variances [m, rad] are capped here: larger ones are never meant, and their squares would overflow."""
LEAST_VAR = 1e-24
"""No motion is known better than this [m^2, rad^2]."""
DURATIONS_S = (1e-6, 1e4)
"""A motion whose stated duration lies outside is given the usual one."""


@dataclass(frozen=True)
class ErrorModel(Stored):
    """Everything the arithmetic needs; axes in the order of the tangent vector.

    ``columns``: all features, in order; ``inputs``: positions of those seen by the ``gp``, which gives the log of the
    variance over ``base``. ``factor`` (6,): calibration of the variance; ``outside_power`` (1,): its growth away from
    the training domain. ``high`` (6,): log ratio to the base that few training rows exceeded. ``typical_ln_det`` (1,):
    median over the training rows. ``nu`` (1,): degrees of freedom of a single motion's error, above 2, 0 for a
    Gaussian. ``dt_s``: usual duration of a motion.
    """

    columns: tuple[str, ...]
    gp: ProjectedGP
    domain: Domain
    base: BaseVariance
    division: Division
    velocities: Velocities
    inputs: NDArray[np.int64]
    factor: Array
    outside_power: Array
    high: Array
    typical_ln_det: Array
    nu: Array
    dt_s: float

    parts: ClassVar = {
        "gp": (ProjectedGP, "gp."),
        "domain": (Domain, "domain."),
        "base": (BaseVariance, ""),
        "division": (Division, ""),
        "velocities": (Velocities, ""),
    }

    @classmethod
    def of_file(
        cls, arrays: Mapping[str, NDArray[Any]], columns: tuple[str, ...], method: str | None, dt_s: float
    ) -> ErrorModel:
        """From the arrays of a file. Raises ModelError where something is missing or is not what the schema of
        :mod:`gpvo.online.stored` says."""
        check_arrays(arrays, len(columns))
        residual = RESIDUAL_COLUMN in columns
        model = cls.from_arrays(arrays, columns=columns, method=method, residual=residual, dt_s=dt_s)
        for related in (arrays, arrays_of_base(arrays)):
            check_related(related, len(columns))
        if unknown := set(model.base.columns) - set(columns):
            raise ModelError(f"its base variance needs {min(unknown)}, which is not one of its features")
        if (len(model.gp.centre), len(model.gp.offset)) != (len(model.inputs), 6):
            raise ModelError("the model file's GP does not fit its inputs and the six axes")
        return model

    def estimate(self, X: Array, geometry: Array | None = None, dt_s: Array | None = None) -> Prediction:
        """Rows X (n, d) of ``columns``; ``geometry`` (n, 6, 6) covariances of the base's method, NaN where unknown.

        Whatever the numbers, the covariance is finite and positive definite: values that are not finite, or absurdly
        large, count as missing.
        """
        X = np.where(np.abs(X) < LARGEST, X, np.nan)
        duration, columns = self._duration(X, dt_s), self._base_columns(X)
        base, plain = (np.maximum(v, LEAST_VAR) for v in self.base(columns, duration))
        place = self._locate(X, base, duration)
        known, total = self._variances(place, base, plain)
        variance = within(total * self.factor, self.velocities.largest_error_var(columns[:, :6], duration))
        stated = self.division.split(variance, self.twist(X), geometry, duration / self.dt_s)
        _, ln_det = np.linalg.slogdet(stated.covariance)
        # Ratio of the typical to the stated standard deviation, geometric mean over the axes.
        precision = np.minimum(np.exp((self.typical_ln_det - ln_det) / 12.0), 1.0)
        return stated.extended(
            Prediction,
            dt_s=duration,
            nu=self.degrees_of_freedom,
            epistemic=variance * (1.0 - known / total),
            confidence=place.in_domain * precision,
            in_domain=place.in_domain,
        )

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Of the Student-t that a single motion's error has; infinite for a Gaussian."""
        return float(self.nu[0]) or np.inf

    def locate(self, X: Array, dt_s: Array | None = None) -> DomainCheck:
        """Where rows X (n, d) lie, given how well their motions are known."""
        duration = self._duration(X, dt_s)
        return self._locate(X, self.base(self._base_columns(X), duration)[0], duration)

    def _locate(self, X: Array, base: Array, duration: Array) -> DomainCheck:
        return self.domain.locate(X, feature_noise(self._motion_noise, base, duration))

    @cached_property
    def _motion_noise(self) -> tuple[Array, Array]:
        return motion_noise(self.columns)

    def _duration(self, X: Array, dt_s: Array | None) -> Array:
        if dt_s is None:
            return np.full(len(X), self.dt_s)
        shortest, longest = DURATIONS_S
        return np.where((dt_s >= shortest) & (dt_s <= longest), dt_s, self.dt_s)

    def _variances(self, place: DomainCheck, base: Array, plain: Array) -> tuple[Array, Array]:
        """(n, 6) each, before calibration: aleatoric variance, and the total including uncertainty about it."""
        log_ratio, spread = self.gp.evaluate(place.inside[:, self.inputs])
        outside = (1.0 - place.in_domain)[:, None]
        # The mean of a log-normal contains half the variance of the log: that half is epistemic.
        log_noise = np.maximum(np.minimum(log_ratio + 0.5 * spread, LN_LARGEST), -LN_LARGEST)
        known = log_noise - 0.5 * spread
        # Away from the data the GP falls back to its prior; a ratio that few training rows exceeded is safer.
        cautious = log_noise + outside * np.maximum(self.high - log_noise, 0.0)
        grown = growth(place.distance, self.outside_power)[:, None]
        # What odometry says about itself means the same as in training only in similar surroundings.
        total = (base + outside * np.maximum(plain - base, 0.0)) * np.exp(cautious) * grown
        return base * np.exp(known), total

    def _base_columns(self, X: Array) -> Array:
        """The base's columns, missing ones replaced by :attr:`absent`; geometric log variances never below the smallest
        in training."""
        at, smallest = self._base_place
        C = X[:, at]
        C = np.where(np.isfinite(C), C, self.absent)
        C[:, 6:] = np.minimum(np.maximum(C[:, 6:], smallest), LN_LARGEST)
        return C

    @cached_property
    def _base_place(self) -> tuple[NDArray[np.int64], Array]:
        """Where the base's columns are, and the smallest geometric variances of the training."""
        at = np.array(positions(self.columns, self.base.columns), dtype=np.int64)
        d = self.domain
        return at, (d.centre + d.scale * d.low)[at][6:]

    @cached_property
    def absent(self) -> Array:
        """Substitutes for missing base columns: the worst of the training, that is the fastest motion and the largest
        geometric variance; if training missed them too, their typical value."""
        at, d = self._base_place[0], self.domain
        low, high = (side[at] for side in d.reach)
        worst = np.where(np.abs(low) > np.abs(high), low, high)
        worst[6:] = high[6:]
        return np.where(d.may_miss[at], d.centre[at], worst)

    def twist(self, X: Array) -> Array:
        """(n, 6) velocities of rows X (n, d)."""
        return X[:, self._base_place[0][:6]]


def within(variance: Array, limit: Array) -> Array:
    """The variance if small compared with the limit, the limit if far above it; LEAST_VAR at least, never falling."""
    # This far above, the result is the limit; squares of larger values would overflow.
    ratio = np.minimum(variance / limit, 1e8)
    return np.maximum(limit * ratio / np.sqrt(1.0 + ratio**2), LEAST_VAR)
