"""The mean that a filter may take off: the part of the error that is the same, per axis, in good frames and bad."""

from __future__ import annotations

import numpy as np

from gpvo.geometry.covariance import turn_first_root
from gpvo.learning.rows import Rows
from gpvo.learning.selection import significantly_positive
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
