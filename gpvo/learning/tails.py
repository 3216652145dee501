"""Student-t residuals: degrees of freedom by maximum likelihood, and the score of the log-scale.

K. Lange, R. Little, J. Taylor, "Robust Statistical Modeling Using the t Distribution" (1989), section 3 and appendix B.
``nu = inf`` is the Gaussian throughout.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar
from scipy.special import gammaln

Array = NDArray[np.float64]

NU_MIN = 3.0
"""Below this the second moment of a fit says more about the fit than about the data."""

NU_GAUSSIAN = 60.0
"""From here on a Gaussian is taken: the second moments differ by 3 %."""


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


def fit_tail(ratio: Array, count: Array, *, heavy: bool) -> tuple[float, float]:
    """Degrees of freedom and log of the squared scale of residuals whose squares over stated squared scales are
    ``ratio``.

    ``count`` (n,): how often each row counts. ``heavy`` False: the Gaussian and its scale. The t is taken only where it
    explains the residuals better.
    """
    count = count / count.sum()
    gaussian = (np.inf, float(np.log(max(float(count @ ratio), 1e-300))))
    if not heavy:
        return gaussian

    def nll(log_nu: float) -> float:
        nu = float(np.exp(log_nu))
        return _nll(ratio, count, nu, _log_scale(ratio, count, nu))

    found = minimize_scalar(
        nll, bounds=(np.log(NU_MIN), np.log(2 * NU_GAUSSIAN)), method="bounded", options={"xatol": 1e-4}
    )
    nu = float(np.exp(found.x))
    if nu >= NU_GAUSSIAN or found.fun >= 0.5 * (gaussian[1] + 1.0 + np.log(2 * np.pi)):
        return gaussian
    return nu, _log_scale(ratio, count, nu)


def _log_scale(ratio: Array, count: Array, nu: float) -> float:
    """Maximum-likelihood log squared scale by Newton with the expected information; monotone in practice."""
    log_scale = float(np.log(max(np.median(ratio) / 0.455, 1e-300)))
    for _ in range(60):
        score = float(count @ log_scale_score(ratio * np.exp(-log_scale), nu))
        step = score / float(log_fisher(nu))
        log_scale += float(np.clip(step, -2.0, 2.0))
        if abs(step) < 1e-10:
            break
    return log_scale


def _nll(ratio: Array, count: Array, nu: float, log_scale: float) -> float:
    constant = gammaln(nu / 2) - gammaln((nu + 1) / 2) + 0.5 * np.log(nu * np.pi)
    return float(constant + 0.5 * log_scale + count @ (0.5 * (nu + 1) * np.log1p(ratio * np.exp(-log_scale) / nu)))
