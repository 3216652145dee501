"""Student-t residuals: likelihood, weights, and a fit of scale and degrees of freedom. NumPy only.

K. Lange, R. Little, J. Taylor, "Robust Statistical Modeling Using the t Distribution" (1989), section 3 and appendix B.
``nu = inf`` is the Gaussian throughout.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

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


def negative_log_likelihood(square: Array, variance: Array) -> Array:
    """Of a t with second moment ``variance`` at the squared error, without the constant of :data:`NU` [nats]."""
    scale = variance * (NU - 2.0) / NU
    return 0.5 * np.log(scale) + 0.5 * (NU + 1.0) * np.log1p(square / (NU * scale))


def log_fisher(nu: ArrayLike) -> Array:
    """Fisher information of a residual on its log squared scale: ``nu / (2 (nu + 3))``, 1/2 for a Gaussian."""
    nu = np.asarray(nu, dtype=np.float64)
    return np.where(np.isinf(nu), 0.5, 0.5 / (1.0 + 3.0 / nu))


def log_scale_score(ratio: Array, nu: ArrayLike) -> Array:
    """Derivative of the log density by the log of the squared scale, at squared standardised residuals ``ratio``:
    ``(weight * ratio - 1) / 2`` with the weight ``(nu + 1) / (nu + ratio)``, 1 for a Gaussian."""
    inverse = 1.0 / np.asarray(nu, dtype=np.float64)
    return 0.5 * ((1.0 + inverse) / (1.0 + ratio * inverse) * ratio - 1.0)


def fit(ratio: Array) -> tuple[Array, Array]:
    """Degrees of freedom (D,) and log of the squared scale (D,) of each column of residuals, whose squares over stated
    squared scales are ``ratio`` (n, D).

    The t is taken only where it explains the residuals better than the Gaussian.
    """
    # Where most residuals are zero, as at rest, the median is no start.
    mean = ratio.mean(axis=0)
    start = np.log(np.maximum(np.maximum(np.median(ratio, axis=0) / 0.455, 1e-12 * mean), 1e-300))
    low, high = np.broadcast_to([[math.log(NU_MIN)], [math.log(2 * NU_GAUSSIAN)]], (2, len(start)))
    nu = np.exp(_minimum(lambda ln_nu: _loss(ratio, np.exp(ln_nu), start), low, high))
    gaussian = np.log(np.maximum(mean, 1e-300))
    light = (nu >= NU_GAUSSIAN) | (_loss(ratio, nu, start) >= 0.5 * (gaussian + 1.0 + math.log(2 * np.pi)))
    return np.where(light, np.inf, nu), np.where(light, gaussian, _log_scale(ratio, nu, start))


def joint_nll(squared: Array, d: int, nu: float) -> Array:
    """Negative log density [nats] of a d-variate t of unit second moment, from squared Mahalanobis distances (...).

    S. Kotz, S. Nadarajah, "Multivariate t Distributions and Their Applications" (2004), equation 1.1, whose scale
    matrix has the second moment ``nu / (nu - 2)``.
    """
    if math.isinf(nu):
        return np.asarray(0.5 * (squared + d * math.log(2.0 * math.pi)))
    constant = math.lgamma(0.5 * nu) - math.lgamma(0.5 * (nu + d)) + 0.5 * d * math.log((nu - 2.0) * math.pi)
    return np.asarray(constant + 0.5 * (nu + d) * np.log1p(squared / (nu - 2.0)))


@cache
def half_width(level: float, nu: float) -> float:
    """Half of the central interval that holds a share ``level`` of a t of unit second moment: its density, summed up by
    the trapezoidal rule."""
    x = np.linspace(0.0, 100.0, 100_001)
    density = np.exp(-joint_nll(x**2, 1, nu))
    return float(np.interp(level * 0.5e3, np.cumsum(density) - 0.5 * (density + density[0]), x))


def quantile(level: float, nu: int) -> float:
    """Half of the central interval that holds a share ``level`` of Student's t, from two degrees of freedom on."""
    if nu == 2:
        return level * math.sqrt(2.0 / (1.0 - level**2))
    return half_width(level, nu) * math.sqrt(nu / (nu - 2.0))


def fit_dof(squared: Array, d: int, count: Array) -> float:
    """Degrees of freedom of a d-variate t of unit second moment, by squared Mahalanobis distances (n,).

    ``count`` (n,): how often each row counts. The tails alone are fitted: the second moment is given.
    """

    def loss(ln_excess: Array) -> Array:
        return np.array([count @ joint_nll(squared, d, 2.0 + math.exp(x)) for x in ln_excess])

    (nu,) = 2.0 + np.exp(_minimum(loss, np.log([LEAST_NU - 2.0]), np.log([2.0 * NU_GAUSSIAN])))
    worse = count @ joint_nll(squared, d, nu) >= count @ joint_nll(squared, d, math.inf)
    return math.inf if nu >= NU_GAUSSIAN or worse else float(nu)


def second_moment(square: Array) -> Array:
    """Second moment (D,) of each column of residuals, given their squares (n, D), by the best t: a few gross errors
    hardly move it."""
    nu, log_scale = fit(np.maximum(square, 1e-300))
    return np.exp(log_scale - np.log1p(-2.0 / nu))  # from squared scale to variance: nu / (nu - 2)


def scatter(z: Array) -> Array:
    """Scatter matrix (D, D) of residuals (n, D) by a multivariate t: iterated weights (Lange et al., section 3)."""
    d = z.shape[1]
    C = np.eye(d)
    for _ in range(20):
        w = (NU + d) / (NU + ((z @ np.linalg.inv(C)) * z).sum(axis=1))
        C_new = (z * w[:, None]).T @ z / len(z) + 1e-9 * np.eye(d)
        done = np.abs(C_new - C).max() < 1e-6
        C = C_new
        if done:
            break
    return C


def _minimum(loss: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Of functions of one variable each, to a thousandth, by golden sections."""
    a, b = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_a, at_b = loss(a), loss(b)
    while (high - low).max() > 1e-3:
        left = at_a < at_b
        low, high = np.where(left, low, a), np.where(left, b, high)
        kept, at_kept = np.where(left, a, b), np.where(left, at_a, at_b)
        new = np.where(left, high - _GOLDEN * (high - low), low + _GOLDEN * (high - low))
        at_new = loss(new)
        a, b = np.where(left, new, kept), np.where(left, kept, new)
        at_a, at_b = np.where(left, at_new, at_kept), np.where(left, at_kept, at_new)
    return 0.5 * (low + high)


def _log_scale(ratio: Array, nu: Array, log_scale: Array) -> Array:
    """Maximum-likelihood log squared scale (D,) by Newton from ``log_scale`` (D,): the loss is convex in it."""
    for _ in range(60):
        r = ratio * np.exp(-log_scale)
        weight = (nu + 1.0) / (nu + r)
        score = 0.5 * ((weight * r).mean(axis=0) - 1.0)
        information = 0.5 * (weight * r * nu / (nu + r)).mean(axis=0)
        step = np.clip(score / np.maximum(information, 1e-12), -2.0, 2.0)
        log_scale = log_scale + step
        if np.abs(step).max() < 1e-10:
            break
    return log_scale


def _loss(ratio: Array, nu: Array, start: Array) -> Array:
    """Negative log-likelihood of each column at its best scale."""
    log_scale = _log_scale(ratio, nu, start)
    constant = np.array([math.lgamma(n / 2) - math.lgamma((n + 1) / 2) for n in nu]) + 0.5 * np.log(nu * np.pi)
    tail = 0.5 * (nu + 1) * np.log1p(ratio * np.exp(-log_scale) / nu).mean(axis=0)
    return constant + 0.5 * log_scale + tail
