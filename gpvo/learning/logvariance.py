"""A GP of the log noise variance: started on the log squared residual, finished by Fisher scoring on the likelihood
itself.

The log of a squared Gaussian residual is the log-variance plus log chi^2_1, of mean -1.2704 and variance pi^2 / 2;
taking it for Gaussian noise wastes 60 % of the information. Scoring to the maximum a posteriori under the residual's
own density (Gaussian or Student-t) wins it back: P. Green, B. Silverman, "Nonparametric Regression and Generalized
Linear Models" (1994), section 5.3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.regressors.base import FittedGP
from gpvo.learning.regressors.collapsed import Eigenbasis, Sums, accumulate, chunks
from gpvo.learning.tails import log_fisher, log_scale_score
from gpvo.online.basis import ProjectedGP

Array = NDArray[np.float64]

LOG_CHI2_MEAN = -1.2703628454614782
"""E[log chi^2_1] = digamma(1/2) + log 2."""

_STEPS = 30


@dataclass(frozen=True)
class Residuals:
    """``square`` (n, D): squared out-of-fold residuals. ``base`` (n, D): log of a variance known per row (zeros
    without).

    ``mean_var`` (n, D): variance of the mean they are about. ``count`` (n,): how often a row counts.
    """

    square: Array
    base: Array
    mean_var: Array
    count: Array

    def subset(self, rows: NDArray[np.int64]) -> Residuals:
        """Some of the rows."""
        return Residuals(self.square[rows], self.base[rows], self.mean_var[rows], self.count[rows])

    def log_ratio(self) -> Array:
        """(n, D) log of the squared residual over the base, unbiased; squares floored at 1e-6 of their median."""
        floor = 1e-6 * np.maximum(np.median(self.square, axis=0), 1e-300)
        return np.log(self.square + floor) - self.base - LOG_CHI2_MEAN


def score_log_variance(
    start: FittedGP, X: Array, residuals: Residuals, nu: Array, fold: NDArray[np.int64]
) -> tuple[ProjectedGP, dict[int, ProjectedGP]]:
    """Posterior mode of the log squared scale under Student-t residuals of ``nu`` (D,), given all rows and without
    each fold.

    ``start``: GP of :meth:`Residuals.log_ratio`, whose kernel, points and signal variances are kept.
    """
    U = (X - start.gp.centre) / start.gp.lengthscale
    unit = np.ones(U.shape[1])
    fisher = log_fisher(nu)
    kernel = replace(start.gp, centre=0.0 * unit, lengthscale=unit).kernel(U)
    g0, _ = start.predict(X)
    blank, ones = np.zeros_like(residuals.square), np.ones(len(U))

    def sums_of(rows: NDArray[np.bool_]) -> Sums:
        return accumulate(chunks(U[rows], blank[rows], ones[rows], residuals.count[rows]), start.gp.points, unit)

    parts = {int(f): sums_of(fold == f) for f in np.unique(fold)}
    total = Sums.zero(len(start.gp.points), g0.shape[1])
    for part in parts.values():
        total = total.combined(part, 1.0)
    whole = _mode(start, total, kernel, g0, residuals, residuals.count, fisher, nu)
    if len(parts) == 1:
        return whole, dict.fromkeys(parts, whole)
    without = {
        f: _mode(start, total.combined(part, -1.0), kernel, g0, residuals, residuals.count * (fold != f), fisher, nu)
        for f, part in parts.items()
    }
    return whole, without


def _mode(
    start: FittedGP, sums: Sums, kernel: Array, g: Array, residuals: Residuals, count: Array, fisher: Array, nu: Array
) -> ProjectedGP:
    """Fisher scoring from ``g`` (n, D); rows of zero ``count`` do not take part.

    The working response ``g + score / fisher`` of noise variance ``1 / fisher`` has the mode as its fixed point.
    Where the mean's own variance explains part of a residual the true information is smaller, so steps are cautious,
    never wild.
    """
    gp = start.gp
    basis = Eigenbasis.of(sums, gp.points)
    P, used = basis.P.numpy(), count / count.sum()
    ratio = (gp.signal_var * fisher)[:, None]
    gain = ratio / (1.0 + ratio * basis.eigenvalues[None])
    offset, weights = used @ g, np.zeros((len(gp.signal_var), len(P)))
    for _ in range(_STEPS):
        response = g + _score(g, residuals, nu) / fisher
        offset = offset + used @ (response - g)
        z_y = P @ (kernel.T @ (count[:, None] * (response - offset)))
        weights = gain * z_y.T
        new = offset + kernel @ (P.T @ weights.T)
        moved = float(np.abs((new - g)[count > 0]).max())
        g = new
        if moved < 1e-5:
            break
    return replace(
        gp,
        projection=P.copy(),
        weights=weights,
        reduction=gain * basis.eigenvalues[None] * gp.signal_var[:, None],
        offset=offset,
    )


def _score(g: Array, residuals: Residuals, nu: Array) -> Array:
    """Derivative of the log density of the residuals by g (n, D), the variance of the mean counted in."""
    # A step of the search may lie far off; it is drawn in again by the next.
    noise = np.exp(np.clip(g + residuals.base, -600.0, 600.0))
    total = noise + residuals.mean_var
    return log_scale_score(residuals.square / total, nu) * (noise / total)
