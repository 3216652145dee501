"""From features to the error's distribution: the arithmetic of the predictor, for one row and for many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.geometry.covariance import turn_first_root
from gpvo.online.base import RESIDUAL_COLUMN, BaseVariance, Velocities, feature_noise, motion_noise, positions
from gpvo.online.basis import SharedBasis
from gpvo.online.division import Division
from gpvo.online.guard import Domain, DomainCheck, growth
from gpvo.online.validation import LARGEST, check_arrays, check_related
from gpvo.types import Array, MotionError, Prediction

LN_LARGEST = 60.0
"""Log variances [m, rad] above this count as this: nobody means them, and their squares would overflow."""
LEAST_VAR = 1e-24
"""No motion is known better [m^2, rad^2]."""
DURATIONS_S = (1e-6, 1e4)
"""A motion whose stated duration lies outside has the usual one."""

_OWN = (
    "inputs",
    "factor",
    "outside_power",
    "high",
    "typical_ln_det",
    "mean_in_sigma",
    "steady_mean",
    "nu",
)


@dataclass(frozen=True)
class Variances:
    """Of n rows, before calibration: ``place``, where they lie; (n, 6) each: ``unit`` of the mean, ``known`` aleatoric
    variance, ``total`` with ignorance of it, ``mean`` and its ``mean_var``; ``limit``, as wrong as a motion can be.
    ``dt_s`` (n,): durations that were used."""

    place: DomainCheck
    unit: Array
    known: Array
    total: Array
    mean: Array
    mean_var: Array
    limit: Array
    dt_s: Array


@dataclass(frozen=True)
class ErrorModel:
    """Everything the arithmetic needs; axes in the order of the tangent vector.

    ``columns``: all features, in order; ``inputs``: positions of those the GP sees. ``factor`` (6,): calibration of the
    variance; ``outside_power`` (1,): its growth away from the training domain. ``high`` (6,): log
    ratio to the base that few training rows exceeded. ``typical_ln_det`` (1,): median over the training rows.
    ``mean_in_sigma`` (1,): whether the GP's mean is in units of the base's standard deviation, not the error's own at
    the usual duration ``dt_s``. ``steady_mean`` (6,): see :meth:`steady`; zero but in a model for filters. ``nu`` (1,):
    degrees of freedom of a single motion's error, 0 for a Gaussian.
    """

    columns: tuple[str, ...]
    inputs: NDArray[np.int64]
    basis: SharedBasis
    domain: Domain
    base: BaseVariance
    division: Division
    velocities: Velocities
    factor: Array
    outside_power: Array
    high: Array
    typical_ln_det: Array
    mean_in_sigma: NDArray[np.bool_]
    steady_mean: Array
    nu: Array
    dt_s: float

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file."""
        return {
            **{name: np.asarray(getattr(self, name)) for name in _OWN},
            **self.division.to_arrays(),
            **self.velocities.to_arrays(),
            "theta": self.base.theta,
            "theta_plain": self.base.plain,
            **self.basis.to_arrays("basis."),
            **self.domain.to_arrays("domain."),
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, NDArray[Any]], columns: tuple[str, ...], method: str | None, dt_s: float
    ) -> ErrorModel:
        """The inverse of :meth:`to_arrays`. Raises ModelError where something is missing or is not what the schema of
        :mod:`gpvo.online.validation` says."""
        check_arrays(arrays, len(columns))
        try:
            arrays = {"nu": np.zeros(1), "steady_mean": np.zeros(6), **arrays}
            own = {name: arrays[name] for name in _OWN}
            division, velocities = Division.from_arrays(arrays), Velocities.from_arrays(arrays)
            base = BaseVariance(arrays["theta"], arrays["theta_plain"], method, RESIDUAL_COLUMN in columns)
        except KeyError as missing:
            raise ModelError(f"the model file lacks the array {missing}") from None
        check_related(arrays, len(columns))
        if unknown := set(base.columns) - set(columns):
            raise ModelError(f"its base variance needs {min(unknown)}, which is none of its features")
        domain, basis = Domain.from_arrays(arrays, "domain."), SharedBasis.from_arrays(arrays, "basis.")
        if basis.n_inputs != len(own["inputs"]) or basis.n_outputs != 6:
            raise ModelError("the model file's GPs do not fit its inputs and the six axes")
        return cls(
            columns=columns,
            basis=basis,
            domain=domain,
            base=base,
            division=division,
            velocities=velocities,
            dt_s=dt_s,
            **own,
        )

    def estimate(self, X: Array, geometry: Array | None = None, dt_s: Array | None = None) -> Prediction:
        """Rows X (n, d) of ``columns``; ``geometry`` (n, 6, 6) covariances of the base's method, NaN where unknown.

        Whatever the numbers, the covariance is finite and positive definite: what is not finite, or beyond all measure,
        counts as missing.
        """
        X = np.where(np.abs(X) < LARGEST, X, np.nan)
        v = self.variances(X, dt_s)
        place = v.place
        unlimited = v.total + v.mean_var
        variance = within(unlimited * self.factor, v.limit)
        stated = self.split(variance, X, geometry)
        _, ln_det = np.linalg.slogdet(stated.covariance)
        # Ratio of the typical to the stated standard deviation, geometric mean over the axes.
        precision = np.minimum(np.exp((self.typical_ln_det - ln_det) / 12.0), 1.0)
        mean = v.mean
        if self._has_steady_mean:
            mean = mean + self.steady(stated.covariance, place.inside) * place.in_domain[:, None]
        return Prediction(
            mean=mean,
            jitter=stated.jitter,
            white=stated.white,
            persistent_root=stated.persistent_root,
            persistent_tau_s=stated.persistent_tau_s,
            dt_s=v.dt_s,
            nu=self.degrees_of_freedom,
            epistemic=variance * (1.0 - v.known / unlimited),
            confidence=place.in_domain * precision,
            in_domain=place.in_domain,
        )

    def steady(self, covariance: Array, inside: Array) -> Array:
        """(n, 6) mean error ``r U c`` of covariances ``U U^T`` (n, 6, 6): what noise biases in an estimate.

        That bias goes with the variance of the noise (M. Box, "Bias in nonlinear estimation" (1971)): with its
        deviation, of which U is the root, times the noise r that the residuals show. It is seen along an axis when what
        the turn and the other axes explain is taken off (:func:`gpvo.geometry.covariance.turn_first_root`): then
        ``c``, which is ``steady_mean``, is the same in good frames and bad. ``inside``: rows drawn into the domain.
        """
        return np.asarray((turn_first_root(covariance) @ self.steady_mean) * self.residual_px(inside)[:, None])

    def residual_px(self, inside: Array) -> Array:
        """(n,) noise [px] that the residuals show; 1 where the base does not look at it."""
        if not self.base.residual:
            return np.ones(len(inside))
        k = self._base_place[0][-1]
        return np.asarray(np.exp(inside[:, k] * self.domain.scale[k] + self.domain.centre[k]))

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Of the Student-t that a single motion's error has; infinite for a Gaussian."""
        return float(self.nu[0]) or np.inf

    @cached_property
    def _has_steady_mean(self) -> bool:
        return bool(self.steady_mean.any())

    def locate(self, X: Array, dt_s: Array | None = None) -> DomainCheck:
        """Where rows X (n, d) lie, given how well their motions are known."""
        duration = self._duration(X, dt_s)
        return self._locate(X, self.base(self._base_columns(X), duration), duration)

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

    def variances(self, X: Array, dt_s: Array | None) -> Variances:
        """Variances of rows X (n, d), before calibration."""
        duration, columns = self._duration(X, dt_s), self._base_columns(X)
        base, plain = (np.maximum(v, LEAST_VAR) for v in self.base.both(columns, duration))
        place = self._locate(X, base, duration)
        predicted = self.basis.predict(place.inside[:, self.inputs])
        outside = (1.0 - place.in_domain)[:, None]
        # A bias of noise goes with the noise; what VO is wrong by on average of its motion, with the motion's duration.
        unit = np.sqrt(base) if self.mean_in_sigma[0] else np.repeat((duration / self.dt_s)[:, None], 6, axis=1)
        usual = predicted.mean * unit
        log_noise = np.maximum(np.minimum(predicted.log_noise_var, LN_LARGEST), -LN_LARGEST)
        known = log_noise - 0.5 * predicted.log_noise_spread
        # Away from the data the GP falls back to its prior; a ratio that few training rows exceeded is safer.
        cautious = log_noise + outside * np.maximum(self.high - log_noise, 0.0)
        grown = growth(place.distance, self.outside_power)[:, None]
        mean = usual * place.in_domain[:, None]
        mean_var = (predicted.epistemic_var * unit**2 + (usual - mean) ** 2) * grown
        # What odometry says of itself means what it meant in training only where the surroundings are alike.
        total = (base + outside * np.maximum(plain - base, 0.0)) * np.exp(cautious) * grown
        limit = self.velocities.largest_error_var(columns[:, :6], duration)
        return Variances(place, unit, base * np.exp(known), total, mean, mean_var, limit, duration)

    def _base_columns(self, X: Array) -> Array:
        """The base's columns, missing ones by :attr:`absent`, geometric log variances never below the training's
        smallest."""
        at, _, smallest = self._base_place
        C = X[:, at]
        C = np.where(np.isfinite(C), C, self.absent)
        C[:, 6:] = np.minimum(np.maximum(C[:, 6:], smallest), LN_LARGEST)
        return C

    @cached_property
    def _base_place(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Where the base's columns are, their typical values, and the smallest geometric variances of the training."""
        at = np.array(positions(self.columns, self.base.columns), dtype=np.int64)
        d = self.domain
        return at, d.centre[at], (d.centre + d.scale * d.low)[at][6:]

    @cached_property
    def absent(self) -> Array:
        """What stands for the base's columns where they are missing: the worst of the training, the fastest motion and
        the largest geometric variance; where training missed them too, their typical value."""
        at, d = self._base_place[0], self.domain
        low, high = (side[at] for side in d.reach)
        worst = np.where(np.abs(low) > np.abs(high), low, high)
        worst[6:] = high[6:]
        return np.where(d.may_miss[at], d.centre[at], worst)

    def twist(self, X: Array) -> Array:
        """(n, 6) velocities of rows X (n, d)."""
        return X[:, self._base_place[0][:6]]

    def split(self, variance: Array, X: Array, geometry: Array | None) -> MotionError:
        """The errors of rows X by their parts, without a mean, from variances (n, 6)."""
        return self.division.split(variance, self.twist(X), geometry)


def within(variance: Array, limit: Array) -> Array:
    """The variance where it is small against the limit, the limit where it is far above; it grows all the way."""
    # So far above, the limit it is; the square of what is farther would overflow.
    ratio = np.minimum(variance / limit, 1e8)
    return limit * ratio / np.sqrt(1.0 + ratio**2)
