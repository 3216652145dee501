"""What is known before a GP learns anything, from training rows: the base variance, and how fast the vehicle is.

The parts of the variance, not negative, are fitted by the likelihood of a heavy-tailed error.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from gpvo.dataset.build import TrainingSet
from gpvo.learning.rows import Rows
from gpvo.online.base import COASTED, TWIST_COLUMNS, BaseVariance, Velocities, parts
from gpvo.stats.student_t import NU
from gpvo.types import Array

_SMALLEST = np.log(1e-6)
_LARGEST = np.log(1e3)
_LEAST_RATE_VAR = 1e-6


def fit_base(
    columns: Array,
    dt_s: Array,
    error: Array,
    method: str | None,
    weight: Array | None = None,
    *,
    residual: bool = False,
) -> BaseVariance:
    """Coefficients of each axis from errors (n, 6); ``columns`` as :func:`gpvo.online.base.base_columns` says.

    ``weight`` (n,): how much a row counts.
    """
    count = np.ones(len(error)) if weight is None else weight
    theta = _fit_axes(parts(columns, dt_s), error, count)
    plain = _fit_axes(parts(columns[:, :6], dt_s), error, count)
    return BaseVariance(theta, plain, method, residual)


def _fit_axes(terms: Array, error: Array, count: Array) -> Array:
    return np.stack([_fit_axis(terms[:, j], error[:, j] ** 2, count) for j in range(6)])


def _fit_axis(terms: Array, square: Array, count: Array) -> Array:
    """(5,) coefficients: minimises the t's negative log-likelihood over their logs, terms scaled to the mean square."""
    typical = np.maximum(np.average(terms, axis=0, weights=count), 1e-300)
    level = max(float(np.average(np.minimum(square, np.quantile(square, 0.99)), weights=count)), 1e-18)
    scaled = terms / typical * level
    weight = count / count.sum()

    def objective(p: Array) -> tuple[float, Array]:
        theta = np.exp(p)
        v = scaled @ theta
        s = v * (NU - 2.0) / NU
        value = weight @ (0.5 * np.log(s) + 0.5 * (NU + 1.0) * np.log1p(square / (NU * s)))
        # d/dv: half of (1 - (nu + 1) y^2 / (nu s + y^2)) / v.
        slope = 0.5 * weight * (1.0 - (NU + 1.0) * square / (NU * s + square)) / v
        return float(value), (slope @ scaled) * theta

    free = terms.max(axis=0) > 0
    bounds = [(_SMALLEST, _LARGEST) if f else (_SMALLEST, _SMALLEST) for f in free]
    start = np.where(free, np.log(1.0 / max(free.sum(), 1)), _SMALLEST)
    found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds)
    theta = np.where(free, np.exp(found.x), 0.0)
    return theta / typical * level


def learn_velocities(rows: Rows) -> Velocities:
    """Of all sequences alike."""
    return Velocities(usual_rate_var(rows), rate_changes(rows))


def usual_rate_var(rows: Rows) -> Array:
    """(6,) mean square velocity of VO [m^2/s^2, rad^2/s^2], sequences alike."""
    return np.maximum(np.nanmean(rows.weight[:, None] * rows.select(TWIST_COLUMNS) ** 2, axis=0), _LEAST_RATE_VAR)


def rate_changes(rows: Rows) -> Array:
    """(K, 6) mean square [m^2/s^2, rad^2/s^2] by which the true velocity changes over ``COASTED`` usual motions,
    sequences alike; never less than over a shorter time, and that of unrelated velocities where no sequence is long
    enough."""
    out = []
    for m in COASTED:
        seen = [c for s in rows.sets if len(c := _changes(s, m, rows.step_s))]
        out.append(np.mean([np.mean(c**2, axis=0) for c in seen], axis=0) if seen else 2.0 * usual_rate_var(rows))
    return np.maximum(np.maximum.accumulate(np.array(out)), _LEAST_RATE_VAR)


def _changes(s: TrainingSet, m: int, step_s: float) -> Array:
    """(k, 6) changes of the true velocity over m usual motions: of those between rows that lie about so far apart."""
    later = np.searchsorted(s.t_ns, s.t_ns + round((m - 0.5) * step_s * 1e9))
    rate = s.select(TWIST_COLUMNS) - s.Y / s.dt_s[:, None]
    first = np.flatnonzero(later < len(s))
    first = first[s.t_ns[later[first]] - s.t_ns[first] <= (m + 0.5) * step_s * 1e9]
    change = rate[later[first]] - rate[first]
    return np.asarray(change[np.isfinite(change).all(axis=1)])
