"""Student-t residuals: likelihood, weights, and a fit of scale and degrees of freedom. NumPy only.

K. Lange, R. Little, J. Taylor, "Robust Statistical Modeling Using the t Distribution" (1989), section 3 and appendix B.
``nu = inf`` is the Gaussian throughout.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from gpvo.types import Array

NU = 5.0
"""Degrees of freedom of the t that judges a fit: a few gross errors must not set the scale of all."""

NU_MIN = 3.0
"""Below this the second moment of a fit says more about the fit than about the data."""

LEAST_NU = 2.5
"""Of a stated density: with fewer, nearly all of its second moment lies in errors that are hardly ever seen."""

NU_GAUSSIAN = 60.0
"""From here on a Gaussian is taken: the second moments differ by 3 %."""

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


def negative_log_likelihood(square: Array, variance: Array, nu: float = NU) -> Array:
    """Of a t with second moment ``variance`` at the squared error, without the constant of ``nu`` [nats]."""
    scale = variance * (nu - 2.0) / nu
    return 0.5 * np.log(scale) + 0.5 * (nu + 1.0) * np.log1p(square / (nu * scale))


def log_fisher(nu: ArrayLike) -> Array:
    """Fisher information of a residual on its log squared scale: ``nu / (2 (nu + 3))``, 1/2 for a Gaussian."""
    nu = np.asarray(nu, dtype=np.float64)
    return np.where(np.isinf(nu), 0.5, 0.5 / (1.0 + 3.0 / nu))


def row_weight(ratio: Array, nu: ArrayLike) -> Array:
    """``(nu + 1) / (nu + ratio)``, weight of a row of squared standardised residual ``ratio``; 1 for a Gaussian."""
    inverse = 1.0 / np.asarray(nu, dtype=np.float64)
    return (1.0 + inverse) / (1.0 + ratio * inverse)


def log_scale_score(ratio: Array, nu: ArrayLike) -> Array:
    """Derivative of the log density by the log of the squared scale: ``(weight * ratio - 1) / 2``."""
    return 0.5 * (row_weight(ratio, nu) * ratio - 1.0)


def log_second_moment(nu: ArrayLike) -> Array:
    """``log(nu / (nu - 2))``: from squared scale to variance."""
    return -np.log1p(-2.0 / np.asarray(nu, dtype=np.float64))


def fit(ratio: Array, count: Array | None = None, *, heavy: bool = True) -> tuple[float, float]:
    """Degrees of freedom and log of the squared scale of residuals whose squares over stated squared scales are
    ``ratio`` (n,).

    ``count`` (n,): how often each row counts. ``heavy`` False: the Gaussian and its scale. The t is taken only where it
    explains the residuals better.
    """
    count = np.full(len(ratio), 1.0 / len(ratio)) if count is None else count / count.sum()
    gaussian = (np.inf, math.log(max(float(count @ ratio), 1e-300)))
    if not heavy:
        return gaussian
    log_nu = _minimum(lambda x: _loss(ratio, count, math.exp(x)), math.log(NU_MIN), math.log(2 * NU_GAUSSIAN))
    nu = math.exp(log_nu)
    if nu >= NU_GAUSSIAN or _loss(ratio, count, nu) >= 0.5 * (gaussian[1] + 1.0 + math.log(2 * np.pi)):
        return gaussian
    return nu, _log_scale(ratio, count, nu)


def joint_nll(squared: Array, d: int, nu: float) -> Array:
    """Negative log density [nats] of a d-variate t of unit second moment, from squared Mahalanobis distances (...).

    S. Kotz, S. Nadarajah, "Multivariate t Distributions and Their Applications" (2004), equation 1.1, whose scale
    matrix has the second moment ``nu / (nu - 2)``.
    """
    if math.isinf(nu):
        return np.asarray(0.5 * (squared + d * math.log(2.0 * math.pi)))
    constant = math.lgamma(0.5 * nu) - math.lgamma(0.5 * (nu + d)) + 0.5 * d * math.log((nu - 2.0) * math.pi)
    return np.asarray(constant + 0.5 * (nu + d) * np.log1p(squared / (nu - 2.0)))


def fit_dof(squared: Array, d: int, count: Array) -> float:
    """Degrees of freedom of a d-variate t of unit second moment, by squared Mahalanobis distances (n,).

    ``count`` (n,): how often each row counts. The tails alone are fitted: the second moment is given.
    """

    def loss(ln_excess: float) -> float:
        return float(count @ joint_nll(squared, d, 2.0 + math.exp(ln_excess)))

    ln_excess = _minimum(loss, math.log(LEAST_NU - 2.0), math.log(2.0 * NU_GAUSSIAN))
    nu = 2.0 + math.exp(ln_excess)
    return math.inf if nu >= NU_GAUSSIAN or loss(ln_excess) >= count @ joint_nll(squared, d, math.inf) else nu


def second_moment(square: Array) -> float:
    """Second moment of residuals (n,), given their squares, by the best t: a few gross errors hardly move it."""
    nu, log_scale = fit(np.maximum(square, 1e-300))
    return math.exp(log_scale + float(log_second_moment(nu)))


def _minimum(loss: Callable[[float], float], low: float, high: float, tolerance: float = 1e-3) -> float:
    """By golden sections."""
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = loss(a), loss(b)
    while high - low > tolerance:
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - _GOLDEN * (high - low)
            at_a = loss(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + _GOLDEN * (high - low)
            at_b = loss(b)
    return 0.5 * (low + high)


def _log_scale(ratio: Array, count: Array, nu: float) -> float:
    """Maximum-likelihood log squared scale by Newton with the expected information; monotone in practice."""
    log_scale = math.log(max(float(np.median(ratio)) / 0.455, 1e-300))
    for _ in range(60):
        score = float(count @ log_scale_score(ratio * math.exp(-log_scale), nu))
        step = score / float(log_fisher(nu))
        log_scale += min(max(step, -2.0), 2.0)
        if abs(step) < 1e-10:
            break
    return log_scale


def _loss(ratio: Array, count: Array, nu: float) -> float:
    """Negative log-likelihood at the best scale."""
    log_scale = _log_scale(ratio, count, nu)
    constant = math.lgamma(nu / 2) - math.lgamma((nu + 1) / 2) + 0.5 * math.log(nu * np.pi)
    tail = 0.5 * (nu + 1) * np.log1p(ratio * math.exp(-log_scale) / nu)
    return constant + 0.5 * log_scale + float(count @ tail)
