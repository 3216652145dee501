"""Flights of one row, pooled over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpvo.reproduce.bounds import Bounds
from gpvo.types import Array

_DRAWS = 4000


@dataclass(frozen=True)
class Pooled:
    """The root of a mean of squares, or a ratio of two, over seeds, with the 95 % interval of a bootstrap by seed.

    ``low`` and ``high`` are None with fewer than three seeds: nothing can be said.
    """

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Scores:
    """One way of one row [m]. ``ratio``: predicted over actual final error. ``vector``: position error after the
    predicted mean is taken off; ``magnitude``: |error| minus its predicted expectation, the thesis' residual; both as
    root mean squares, and over the RMSE. ``coverage``: share of position errors inside 3 sigma, per axis."""

    flights: int
    rmse_m: Pooled
    final_m: Pooled
    predicted_m: Pooled
    ratio: Pooled
    vector_m: Pooled
    magnitude_m: Pooled
    vector_over_rmse: Pooled
    magnitude_over_rmse: Pooled
    coverage: float


def score(flights: Sequence[Bounds]) -> Scores:
    """Scores over flights; each flight counts alike."""
    squared_error = np.array([(b.error_m**2).sum(1).mean() for b in flights])
    final = np.array([(b.error_m[-1] ** 2).sum() for b in flights])
    predicted = np.array([b.predicted_m[-1] ** 2 for b in flights])
    vector = np.array([((b.error_m - b.mean_m) ** 2).sum(1).mean() for b in flights])
    magnitude = np.array([(magnitude_residual(b) ** 2).mean() for b in flights])
    inside = [(np.abs(b.error_m - b.mean_m) <= 3 * b.sigma_m + 1e-9).mean() for b in flights]
    one = np.ones(len(flights))
    return Scores(
        flights=len(flights),
        rmse_m=pooled(squared_error, one),
        final_m=pooled(final, one),
        predicted_m=pooled(predicted, one),
        ratio=pooled(predicted, final),
        vector_m=pooled(vector, one),
        magnitude_m=pooled(magnitude, one),
        vector_over_rmse=pooled(vector, squared_error),
        magnitude_over_rmse=pooled(magnitude, squared_error),
        coverage=float(np.mean(inside)),
    )


def magnitude_residual(b: Bounds) -> Array:
    """(N,) length of the error minus the length that is expected of it [m]."""
    return np.linalg.norm(b.error_m, axis=1) - expected_length(b.mean_m, b.covariance_m2)


def expected_length(mean: Array, covariance: Array) -> Array:
    """E|x| of x ~ N(mean (N, 3), covariance (N, 3, 3)).

    ``E sqrt(q) = (4 pi)^-1/2 int_0^inf t^-3/2 (1 - E exp(-t q)) dt`` for q >= 0, with the Laplace transform of a
    quadratic form of normal variables (A. Mathai, S. Provost, "Quadratic forms in random variables", 1992, theorem
    3.2a.2), by the trapezium rule in ln t.
    """
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.0)
    along = (np.swapaxes(vectors, 1, 2) @ mean[:, :, None])[:, :, 0] ** 2
    scale = np.maximum(values.sum(1) + along.sum(1), 1e-300)
    values, along = values / scale[:, None], along / scale[:, None]
    u = np.linspace(-32.0, 32.0, 401)
    t = np.exp(u)
    spread = 1.0 + 2.0 * values[:, None, :] * t[:, None]
    log_laplace = -(0.5 * np.log(spread) + along[:, None, :] * t[:, None] / spread).sum(2)
    return np.sqrt(scale) * (-np.expm1(log_laplace) / np.sqrt(t)).sum(1) * (u[1] - u[0]) / np.sqrt(4 * np.pi)


def pooled(above: Array, below: Array, draws: int = _DRAWS) -> Pooled:
    """``sqrt(mean(above) / mean(below))`` of squares (n,), with an interval over seeds, drawn in pairs."""
    n = len(above)
    value = _root_ratio(above.mean(), below.mean())
    if n < 3:
        return Pooled(float(value), None, None)
    pick = np.random.default_rng(0).integers(0, n, (draws, n))
    low, high = np.quantile(_root_ratio(above[pick].mean(1), below[pick].mean(1)), [0.025, 0.975])
    return Pooled(float(value), float(low), float(high))


def _root_ratio(above: Array, below: Array) -> Array:
    return np.sqrt(np.asarray(above) / np.maximum(below, 1e-300))
