"""From features to the error's distribution: the arithmetic of the predictor, for one row and for many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.geometry.covariance import correlation as correlation_of
from gpvo.geometry.covariance import turn_first_root
from gpvo.online.base import N_PARTS, RESIDUAL_COLUMN, BaseVariance, feature_noise, motion_noise, positions
from gpvo.online.basis import SharedBasis
from gpvo.online.division import PARTS, divide, ln_faster, of_calibration
from gpvo.online.guard import Domain, Whereabouts, growth
from gpvo.types import Array

_EYE = np.eye(6)
NO_CALIBRATION: Mapping[str, Array] = {
    "calibration_patterns": np.zeros((6, 6, 6)),
    "calibration_tau_s": np.ones(6),
}
"""Arrays of a model without a part of its own for errors of calibration."""
COASTED = (1, 2, 5, 10, 20, 50)
"""Over so many usual motions training tells how much a velocity changes."""
LN_LARGEST = 60.0
"""Geometric log variances [m, rad] above this count as this: nobody means them, and their squares would overflow."""

_SHAPES = {
    "factor": (6,),
    "outside_power": (1,),
    "high": (6,),
    "correlation": (3, 6, 6),
    "geometry_weight": (1,),
    "share": (3, 6),
    "growth": (2, 6),
    "level": (6,),
    "ln_speed": (1,),
    "bias_tau_s": (6,),
    "typical_ln_det": (1,),
    "usual_rate_var": (6,),
    "rate_change_var": (len(COASTED), 6),
    "mean_in_sigma": (1,),
    "steady_mean": (6,),
    "calibration_patterns": (6, 6, 6),
    "calibration_tau_s": (6,),
}
_OWN = ("inputs", *_SHAPES)


@dataclass(frozen=True)
class Estimate:
    """The error's distribution for n rows; see ``gpvo.types.Prediction`` for the words.

    ``mean`` (n, 6); ``covariance`` (n, 6, 6); ``parts``: name to (n, 6, 6); ``calibration_root`` (n, 6, 6);
    ``epistemic`` (n, 6); ``in_domain``, ``confidence``, ``distance`` (n,). For a single row all without the first axis.
    """

    mean: Array
    covariance: Array
    parts: dict[str, Array]
    calibration_root: Array
    epistemic: Array
    in_domain: Array
    confidence: Array
    distance: Array

    @property
    def sigma(self) -> Array:
        """(n, 6) standard deviations."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def row(self, k: int) -> Estimate:
        """One of the rows."""
        parts = {name: C[k] for name, C in self.parts.items()}
        return Estimate(
            self.mean[k],
            self.covariance[k],
            parts,
            self.calibration_root[k],
            self.epistemic[k],
            self.in_domain[k],
            self.confidence[k],
            self.distance[k],
        )


@dataclass(frozen=True)
class Variances:
    """Of n rows, before calibration: ``place``, where they lie; (n, 6) each: ``unit`` of the mean, ``known`` aleatoric
    variance, ``total`` with ignorance of it, ``mean`` and its ``mean_var``; ``limit``, as wrong as a motion can be."""

    place: Whereabouts
    unit: Array
    known: Array
    total: Array
    mean: Array
    mean_var: Array
    limit: Array


@dataclass(frozen=True)
class ErrorModelArrays:
    """Everything the arithmetic needs; axes in the order of the tangent vector.

    ``columns``: all features, in order; ``inputs``: positions of those the GP sees. ``factor`` (6,): calibration of the
    variance; ``outside_power`` (1,): its growth away from the training domain. ``high`` (6,): log
    ratio to the base that few training rows exceeded. ``correlation`` (3, 6, 6) of jitter, white and bias, the first
    two mixed with the geometry's by ``geometry_weight`` (1,). ``share`` (3, 6): how the variance divides among them at
    the log variance ``level`` (6,) and the typical speed, whose log is ``ln_speed`` (1,) [m/s]; ``growth`` (2, 6) how
    that changes (see :func:`gpvo.online.division.divide`); ``bias_tau_s`` (6,). ``typical_ln_det`` (1,): median over
    the training rows. ``usual_rate_var`` (6,): mean square velocity in training [m^2/s^2, rad^2/s^2];
    ``rate_change_var`` (K, 6): of the true one's changes over ``COASTED`` motions. ``mean_in_sigma`` (1,): whether the
    GP's mean is in units of the base's standard deviation, not the error's own at the usual duration ``dt_s``.
    ``steady_mean`` (6,): see :meth:`steady`; zero but in a model for filters. ``calibration_patterns`` (6, 6, 6):
    the ways of a calibration to be wrong (see :func:`gpvo.online.division.of_calibration`), and ``calibration_tau_s``
    (6,), how long each stays the same.
    """

    columns: tuple[str, ...]
    inputs: NDArray[np.int64]
    basis: SharedBasis
    domain: Domain
    base: BaseVariance
    factor: Array
    outside_power: Array
    high: Array
    correlation: Array
    geometry_weight: Array
    share: Array
    growth: Array
    level: Array
    ln_speed: Array
    bias_tau_s: Array
    typical_ln_det: Array
    usual_rate_var: Array
    rate_change_var: Array
    mean_in_sigma: NDArray[np.bool_]
    steady_mean: Array
    calibration_patterns: Array
    calibration_tau_s: Array
    dt_s: float

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file."""
        left_out = () if self._calibrated else NO_CALIBRATION
        own = {name: np.asarray(getattr(self, name)) for name in _OWN if name not in left_out}
        return {
            **own,
            "theta": self.base.theta,
            "theta_plain": self.base.plain,
            **self.basis.to_arrays("basis."),
            **self.domain.to_arrays("domain."),
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, NDArray[Any]], columns: tuple[str, ...], method: str | None, dt_s: float
    ) -> ErrorModelArrays:
        """The inverse of :meth:`to_arrays`. Raises ModelError where something is missing or of the wrong shape."""
        try:
            # Velocities that have nothing to do with each other, where an older file does not say.
            unrelated = np.tile(2.0 * arrays["usual_rate_var"], (len(COASTED), 1))
            arrays = {"steady_mean": np.zeros(6), "rate_change_var": unrelated, **NO_CALIBRATION, **arrays}
            own = {name: arrays[name] for name in _OWN}
            base = BaseVariance(arrays["theta"], arrays["theta_plain"], method, RESIDUAL_COLUMN in columns)
        except KeyError as missing:
            raise ModelError(f"the model file lacks the array {missing}") from None
        wrong = [n for n, s in _SHAPES.items() if own[n].shape != s]
        domain, basis = Domain.from_arrays(arrays, "domain."), SharedBasis.from_arrays(arrays, "basis.")
        if (
            wrong
            or {base.theta.shape, base.plain.shape} != {(6, N_PARTS)}
            or len(domain.centre) != len(columns)
            or basis.n_inputs != len(own["inputs"])
        ):
            raise ModelError(f"the model file's arrays do not fit its features ({', '.join(wrong) or 'sizes differ'})")
        return cls(columns=columns, basis=basis, domain=domain, base=base, dt_s=dt_s, **own)

    def estimate(self, X: Array, geometry: Array | None = None, dt_s: Array | None = None) -> Estimate:
        """Rows X (n, d) of ``columns``; ``geometry`` (n, 6, 6) covariances of the base's method, NaN where unknown."""
        v = self.variances(X, dt_s)
        place = v.place
        unlimited = v.total + v.mean_var
        variance = within(unlimited * self.factor, v.limit)
        each, root = self.split(variance, X, geometry)
        parts = {name: each[:, i] for i, name in enumerate(PARTS)}
        covariance = each.sum(axis=1)
        _, ln_det = np.linalg.slogdet(covariance)
        # Ratio of the typical to the stated standard deviation, geometric mean over the axes.
        precision = np.minimum(np.exp((self.typical_ln_det - ln_det) / 12.0), 1.0)
        mean = v.mean
        if self._has_steady_mean:
            mean = mean + self.steady(covariance, place.inside) * place.in_domain[:, None]
        return Estimate(
            mean,
            covariance,
            parts,
            root,
            variance * (1.0 - v.known / unlimited),
            place.in_domain,
            place.in_domain * precision,
            place.distance,
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
    def _has_steady_mean(self) -> bool:
        return bool(self.steady_mean.any())

    def locate(self, X: Array, dt_s: Array | None = None) -> Whereabouts:
        """Where rows X (n, d) lie, given how well their motions are known."""
        duration = self._duration(X, dt_s)
        return self._locate(X, self.base(self._base_columns(X), duration), duration)

    def _locate(self, X: Array, base: Array, duration: Array) -> Whereabouts:
        return self.domain.locate(X, feature_noise(self._motion_noise, base, duration))

    @cached_property
    def _motion_noise(self) -> tuple[Array, Array]:
        return motion_noise(self.columns)

    def _duration(self, X: Array, dt_s: Array | None) -> Array:
        return np.full(len(X), self.dt_s) if dt_s is None else dt_s

    def variances(self, X: Array, dt_s: Array | None) -> Variances:
        """Variances of rows X (n, d), before calibration."""
        duration, columns = self._duration(X, dt_s), self._base_columns(X)
        base, plain = self.base.both(columns, duration)
        place = self._locate(X, base, duration)
        said = self.basis.predict(place.inside[:, self.inputs])
        outside = (1.0 - place.in_domain)[:, None]
        # A bias of noise goes with the noise; what VO is wrong by on average of its motion, with the motion's duration.
        unit = np.sqrt(base) if self.mean_in_sigma[0] else np.repeat((duration / self.dt_s)[:, None], 6, axis=1)
        usual = said.mean * unit
        known = said.log_noise_var - 0.5 * said.log_noise_spread
        # Away from the data the GP falls back to its prior; a ratio that few training rows exceeded is safer.
        cautious = said.log_noise_var + outside * np.maximum(self.high - said.log_noise_var, 0.0)
        grown = growth(place.distance, self.outside_power)[:, None]
        mean = usual * place.in_domain[:, None]
        mean_var = (said.epistemic_var * unit**2 + (usual - mean) ** 2) * grown
        # What odometry says of itself means what it meant in training only where the surroundings are alike.
        total = (base + outside * np.maximum(plain - base, 0.0)) * np.exp(cautious) * grown
        # VO's motion less the true one is no longer than both together, whatever is said of its variance.
        moved = (columns[:, :6] ** 2 + self.usual_rate_var) * duration[:, None] ** 2
        return Variances(place, unit, base * np.exp(known), total, mean, mean_var, _block_sums(moved))

    def lost_variance(self, dt_s: float, age_s: float, rate: Array, rate_var: Array, jump: Array) -> Array:
        """(6,) variance of a lost motion of duration ``dt_s``, of which nothing was measured.

        The vehicle has gone on with the velocity ``rate`` (6,) [m/s, rad/s] of ``age_s`` ago, known to ``rate_var``
        (6,), but for what velocities changed in training over such a time, and more if it is faster than was usual
        there; at most, and after longer times than training shows, it is as wrong as the vehicle is fast. ``jump`` (6,)
        [m, rad]: by how much the motion given differs from that velocity's.
        """
        lags = self.dt_s * np.array(COASTED)
        change = np.array([np.interp(age_s, lags, of_axis, right=np.inf) for of_axis in self.rate_change_var.T])
        speed2 = _block_sums(rate**2)
        faster = np.maximum(speed2 / _block_sums(self.usual_rate_var), 1.0)
        changed = np.minimum(change * faster, np.maximum(self.usual_rate_var, speed2))
        return np.asarray((changed + rate_var) * dt_s**2 + _block_sums(jump**2))

    def _base_columns(self, X: Array) -> Array:
        """The base's columns, missing ones typical, geometric log variances never below the training's smallest."""
        at, centre, smallest = self._base_place
        C = X[:, at]
        C = np.where(np.isfinite(C), C, centre)
        C[:, 6:] = np.clip(C[:, 6:], smallest, LN_LARGEST)
        return C

    @cached_property
    def _base_place(self) -> tuple[NDArray[np.int64], Array, Array]:
        """Where the base's columns are, their typical values, and the smallest geometric variances of the training."""
        at = np.array(positions(self.columns, self.base.columns), dtype=np.int64)
        d = self.domain
        return at, d.centre[at], (d.centre + d.scale * d.low)[at][6:]

    def faster(self, X: Array) -> Array:
        """(n, 1) log of the speed over the typical one (see :func:`ln_faster`)."""
        at = self._base_place[0][:3]
        return ln_faster(X[:, at], self.ln_speed)

    def split(self, variance: Array, X: Array, geometry: Array | None) -> tuple[Array, Array]:
        """(n, 3, 6, 6) covariances of jitter, white and bias of rows X, from variances (n, 6); and the root (n, 6, 6)
        of what a wrong calibration has of the bias.

        Pixel noise, which is jitter and white, is correlated as the geometry says; the bias has its own pattern.
        """
        each, root = self.divided(variance, X, geometry)
        if self._calibrated:
            each[:, 2] += root @ np.swapaxes(root, -1, -2)
        return each, root

    @cached_property
    def _calibrated(self) -> bool:
        return bool(self.calibration_patterns.any())

    def divided(self, variance: Array, X: Array, geometry: Array | None) -> tuple[Array, Array]:
        """As :meth:`split`, but the bias without that of calibration."""
        out = np.repeat(self.correlation[None], len(variance), axis=0)
        w = float(self.geometry_weight[0])
        if geometry is not None and w > 0:
            R = correlation_of(geometry)
            known = np.isfinite(R).all(axis=(1, 2))
            out[known, :2] = w * R[known, None] + (1.0 - w) * self.correlation[:2]
        root, rest = np.zeros((len(variance), 6, 6)), variance
        if self._calibrated:
            root, rest = of_calibration(variance, self.calibration_patterns, X[:, self._base_place[0][:6]])
        # One part in a million of the identity keeps a nearly singular geometry positive definite after rounding.
        share = divide(self.share, self.growth, np.log(rest) - self.level, self.faster(X))
        sigma = np.sqrt(share * rest[:, None, :])
        return (out * (1.0 - 1e-6) + 1e-6 * _EYE) * sigma[..., :, None] * sigma[..., None, :], root


def _block_sums(values: Array) -> Array:
    """(..., 6) sums over the axes of the translation, three times, and over those of the rotation."""
    return np.repeat(values.reshape(*values.shape[:-1], 2, 3).sum(axis=-1), 3, axis=-1)


def within(variance: Array, limit: Array) -> Array:
    """The variance where it is small against the limit, the limit where it is far above; it grows all the way."""
    # So far above, the limit it is; the square of what is farther would overflow.
    ratio = np.minimum(variance / limit, 1e8)
    return limit * ratio / np.sqrt(1.0 + ratio**2)
