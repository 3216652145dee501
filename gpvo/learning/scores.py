"""Scores of one stated uncertainty on one sequence: the columns of the training table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gpvo.stats.consistency import BLOCKS, coverage, crps_gaussian, nees_by_block, nees_median, nll_per_dim
from gpvo.types import Array


def score(error: Array, mean: Array, covariance: Array, nu: float = math.inf) -> dict[str, Any]:
    """Of errors (n, 6), predicted means (n, 6) and covariances (n, 6, 6) about them, and the stated degrees of freedom.

    ``nll_per_dim`` is that of the Gaussian of these covariances, ``nll_stated_per_dim`` that of the stated Student-t;
    ``nees_dof_median_stated`` the median that the latter expects of NEES.

    A covariance that speaks of the translation alone is (n, 3, 3): fields that need the rotation are then None.
    Rows whose covariance is not finite are left out; with none left every field is None.
    """
    known = np.isfinite(covariance).all(axis=(1, 2))
    d = covariance.shape[-1]
    if known.sum() < 2:
        return empty()
    error, mean, covariance = error[known], mean[known], covariance[known]
    residual = error - mean
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    per_block = nees_by_block(residual[:, :d], covariance)
    crps = crps_gaussian(residual[:, :d], sigma)
    level = coverage(residual[:, :d], sigma)
    return {
        "nees_dof": {n: None if n not in per_block else float(per_block[n].mean()) for n in BLOCKS},
        "nees_dof_median": {n: None if n not in per_block else float(np.median(per_block[n])) for n in BLOCKS},
        "coverage": {str(k + 1): float(c) for k, c in enumerate(level)},
        "nll_per_dim": float(np.mean(nll_per_dim(residual, covariance))) if d == 6 else None,
        "nll_stated_per_dim": float(np.mean(nll_per_dim(residual, covariance, nu))) if d == 6 else None,
        "nees_dof_median_stated": nees_median(d, nu) / d,
        "crps": {
            "translation_m": float(crps[:, :3].mean()),
            "rotation_rad": float(crps[:, 3:].mean()) if d == 6 else None,
        },
        "rmse_raw": _rmse(error, d),
        "rmse_corrected": _rmse(residual, d),
    }


def stated_and_actual(error: Array, mean: Array, covariance: Array) -> dict[str, list[tuple[float, float]]]:
    """By kind of axis, over tenths of the motions by rising stated variance: the root mean stated variance and the root
    mean squared error of an axis [m or rad]. Arguments as in :func:`score`, (n, 6) and (n, 6, 6)."""
    variance, square = np.diagonal(covariance, axis1=1, axis2=2), (error - mean) ** 2
    out = {}
    for kind, block in (("translation_m", slice(0, 3)), ("rotation_rad", slice(3, 6))):
        order = np.argsort(variance[:, block].sum(1), kind="stable")
        tenths = [rows for rows in np.array_split(order, 10) if len(rows)]
        out[kind] = [tuple(float(np.sqrt(v[rows, block].mean())) for v in (variance, square)) for rows in tenths]
    return out  # type: ignore[return-value]


def empty() -> dict[str, Any]:
    """The same document where nothing could be computed."""
    return {
        "nees_dof": dict.fromkeys(BLOCKS),
        "nees_dof_median": dict.fromkeys(BLOCKS),
        "coverage": dict.fromkeys("123"),
        "nll_per_dim": None,
        "nll_stated_per_dim": None,
        "nees_dof_median_stated": None,
        "crps": dict.fromkeys(("translation_m", "rotation_rad")),
        "rmse_raw": dict.fromkeys(("translation_m", "rotation_rad")),
        "rmse_corrected": dict.fromkeys(("translation_m", "rotation_rad")),
    }


def average(values: Sequence[Any]) -> Any:
    """Documents of one form averaged number by number; None where none has a number, text from the first."""
    values = [v for v in values if v is not None] or [None]
    first = values[0]
    if isinstance(first, dict):
        return {key: average([v[key] for v in values if key in v]) for key in first}
    if isinstance(first, (list, tuple)):
        return [average(entries) for entries in zip(*values)]
    numbers = [v for v in values if isinstance(v, (int, float)) and np.isfinite(v)]
    if len(set(numbers)) == 1:
        return numbers[0]
    return float(np.mean(numbers)) if numbers else first


def _rmse(error: Array, d: int) -> dict[str, float | None]:
    """Of the length of the translation and of the rotation."""
    rotation = float(np.sqrt((error[:, 3:] ** 2).sum(1).mean())) if d == 6 else None
    return {"translation_m": float(np.sqrt((error[:, :3] ** 2).sum(1).mean())), "rotation_rad": rotation}
