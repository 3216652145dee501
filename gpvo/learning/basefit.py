"""What training rows say before a GP learns from them: the base variance, the speeds of the vehicle, and the domain."""

from __future__ import annotations

import numpy as np

from gpvo.dataset.build import TrainingSet
from gpvo.learning.rows import Rows
from gpvo.online.base import COASTED, TWIST_COLUMNS
from gpvo.online.guard import Domain
from gpvo.stats.student_t import NU, log_fisher, log_scale_score, negative_log_likelihood
from gpvo.types import Array

_SMALLEST, _LARGEST = 1e-6, 1e3
"""Of a term of usual size, over the mean square."""
_STEPS, _HALVINGS, _ENOUGH = 100, 10, 1e-10
_LEAST_RATE_VAR = 1e-6
_RARE = 0.0002


def fit_coefficients(terms: Array, error: Array, weight: Array) -> Array:
    """Non-negative factors (6, 5) on the ``terms`` (n, 6, 5) of a base variance (see :func:`gpvo.online.base.parts`)
    that make errors (n, 6) likeliest, as those of a Student-t; 0 for a term that never occurs.

    ``weight`` (n,): how much a row counts. By Fisher scoring, projected onto the bounds (D. Bertsekas, "Projected
    Newton methods for optimization problems with simple constraints" (1982)), of all axes at a time.
    """
    count, square = weight / weight.sum(), error.T**2
    level = np.maximum(np.minimum(square, np.quantile(square, 0.99, axis=1, keepdims=True)) @ count, 1e-18)
    unit = level[:, None] / np.maximum(np.tensordot(count, terms, 1), 1e-300)
    X = np.ascontiguousarray((terms * unit).transpose(1, 0, 2))
    theta = np.full(unit.shape, 1.0 / unit.shape[1])

    def loss(theta: Array) -> Array:
        return np.asarray(negative_log_likelihood(square, (X @ theta[..., None])[..., 0]) @ count)

    best = loss(theta)
    for _ in range(_STEPS):
        step, before = _scoring_step(X, square, count, theta), best
        for size in 0.5 ** np.arange(_HALVINGS):
            if not step.any():
                break
            tried = np.clip(theta + size * step, _SMALLEST, _LARGEST)
            found = loss(tried)
            better = (found < best)[:, None]
            theta, step, best = np.where(better, tried, theta), np.where(better, 0.0, step), np.minimum(found, best)
        if (before - best).max() < _ENOUGH:
            break
    return np.where((terms > 0).any(axis=0), theta * unit, 0.0)


def _scoring_step(X: Array, square: Array, count: Array, theta: Array) -> Array:
    """(6, 5) Fisher's step from ``theta``: a factor at a bound that would cross it is held there; zero for an axis that
    it would not make likelier by a hundredth of what ends the search."""
    v = (X @ theta[..., None])[..., 0]
    R = X / v[..., None]
    score = ((count * log_scale_score(square * (NU / (NU - 2.0)) / v, NU))[:, None] @ R)[:, 0]
    held = (score == 0) | ((theta <= _SMALLEST) & (score < 0)) | ((theta >= _LARGEST) & (score > 0))
    information = float(log_fisher(NU)) * np.swapaxes(R * count[:, None], 1, 2) @ R
    information = np.where(held[:, :, None] | held[:, None], 0.0, information)
    information += np.eye(theta.shape[1]) * np.where(held, 1.0, 1e-12)[:, None]
    score = np.where(held, 0.0, score)
    step = np.asarray(np.linalg.solve(information, score[..., None])[..., 0])
    gain = 0.5 * (step * score).sum(axis=1, keepdims=True)
    return np.where(gain > 0.01 * _ENOUGH, step, 0.0)


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


def learn_domain(X: Array) -> Domain:
    """Where training rows (n, d) lie, not finite where a value is missing.

    The narrower range leaves out one row in five thousand at either end; both are extended by a fiftieth of its width.
    """
    X = np.where(np.isfinite(X), X, np.nan)
    # Where nothing is missing, the plain ones say the same in a fifth of the time.
    median, quantile = (np.nanmedian, np.nanquantile) if np.isnan(X).any() else (np.median, np.quantile)
    centre = median(X, axis=0)
    q25, q75 = quantile(X, [0.25, 0.75], axis=0)
    spread = np.nanstd(X, axis=0)
    # A feature that mostly rests at one value has no quartiles to speak of.
    scale = np.where((q75 - q25) / 1.349 > 0.1 * spread, (q75 - q25) / 1.349, spread)
    # Of one that never varied, a tenth of its value counts as one deviation, of zero its unit.
    of_constant = np.where(centre == 0.0, 1.0, 0.1 * np.abs(centre))
    scale = np.where(scale > 1e-12 * np.maximum(np.abs(centre), 1.0), scale, of_constant)
    U = (X - centre) / scale
    low, high = quantile(U, [_RARE, 1.0 - _RARE], axis=0)
    pad = 0.02 * (high - low)
    least, most = np.nanmin(U, axis=0), np.nanmax(U, axis=0)
    U = np.clip(np.nan_to_num(U), low - pad, high + pad)
    C = np.cov(U, rowvar=False).reshape(X.shape[1], -1)
    # Shrunk towards its diagonal, so that collinear features do not make a razor-thin domain.
    C = 0.9 * C + 0.1 * np.diag(np.diagonal(C)) + 1e-6 * np.eye(len(C))
    whitening = np.linalg.inv(np.linalg.cholesky(C)).T
    radius = np.linalg.norm(U @ whitening, axis=1).max(keepdims=True)
    low, high, least, most = low - pad, high + pad, least - pad, most + pad
    return Domain(centre, scale, low, high, least, most, whitening, radius, np.asarray(np.isnan(X).any(axis=0)))
