"""The mean that a filter may take off: the part of the error that is the same, per axis, in good frames and bad."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as t_distribution

from gpvo.geometry.covariance import turn_first_root
from gpvo.learning.rows import Rows
from gpvo.online.estimate import ErrorModel
from gpvo.types import Array

_MOST_SIGMAS = 4.0


def steady_mean(rows: Rows, model: ErrorModel, variance: Array) -> Array:
    """(6,) of :meth:`gpvo.online.estimate.ErrorModel.steady`, zero on axes where it may be chance.

    From the errors and their out-of-fold variances (n, 6) before calibration. Least squares over all motions, errors
    in units of their own root of the covariance; kept where those of a left-out sequence surely lean the same way.
    """
    if rows.grouped_by != "sequences":
        return np.zeros(6)
    X = rows.select(model.columns)
    covariance = model.split(variance * model.factor, X, rows.geometry(model.base.method)).covariance
    z = np.linalg.solve(turn_first_root(covariance), rows.error[:, :, None])[:, :, 0]
    noise = model.residual_px(model.domain.locate(X).inside)[:, None]
    # Per sequence, the sums of the normal equations.
    right = rows.by_group(noise * np.clip(z, -_MOST_SIGMAS, _MOST_SIGMAS))
    left = rows.by_group(noise**2)
    same_way = np.sign(right.sum(axis=0) - right) * right / left
    # The mean may lean either way, so that half of the risk is that of each.
    return np.where(significantly_positive(same_way, risk=0.025), right.sum(axis=0) / left.sum(axis=0), 0.0)


def significantly_positive(gain: Array, risk: float = 0.05) -> NDArray[np.bool_]:
    """(D,) whether the mean over groups of gain (G, D) is positive: one-sided t-test, risk shared among the D axes."""
    groups, axes = gain.shape
    if groups < 2:
        return np.zeros(axes, dtype=bool)
    statistic = gain.mean(axis=0) / np.maximum(gain.std(axis=0, ddof=1) / np.sqrt(groups), 1e-300)
    return np.asarray(statistic > t_distribution.ppf(1.0 - risk / axes, groups - 1))
