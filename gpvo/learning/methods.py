"""The ways of stating the uncertainty of a motion, fitted to the same sequences, and the scores of one on a sequence:
what ``learned`` is compared with, and the columns of the training table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.geometry.covariance import variances
from gpvo.stats.consistency import (
    BLOCKS,
    counted_axes,
    coverage,
    crps_gaussian,
    marginal,
    nees_by_block,
    nees_median,
    nll_per_dim,
)
from gpvo.types import IMPORTED, Array

GEOMETRIC = ("triangulation", "pointing_matching")
STATED = (*GEOMETRIC, IMPORTED)
METHODS = (
    "constant",
    *STATED,
    *(f"{m}_scaled" for m in STATED),
    *(f"{m}_vt" for m in GEOMETRIC),
    "gp_thesis",
    "base",
    "learned",
)


def best_scale(sets: Sequence[TrainingSet], method: str) -> Array | None:
    """(6,) factor per axis on the variance with the best joint likelihood on all rows.

    With ``D = diag(1 / a)`` the negative log-likelihood of ``D C D`` is ``a^T M a / 2 - sum ln a`` up to a constant,
    where M is the mean of ``e e^T * C^-1`` (element by element): convex, solved by damped Newton steps.
    """
    M, rows = np.zeros((6, 6)), 0
    for s in sets:
        if method in s.covariances:
            known = np.isfinite(s.covariances[method]).all(axis=(1, 2))
            e = s.Y[known]
            M += (e[:, :, None] * e[:, None, :] * np.linalg.inv(s.covariances[method][known])).sum(axis=0)
            rows += int(known.sum())
    if rows == 0:
        return None
    M /= rows
    a = 1.0 / np.sqrt(np.maximum(np.diagonal(M), 1e-300))
    for _ in range(100):
        slope = M @ a - 1.0 / a
        step = np.linalg.solve(M + np.diag(1.0 / a**2), slope)
        a = np.maximum(a - step, 0.1 * a)
        if np.abs(step / a).max() < 1e-12:
            break
    return 1.0 / a**2


def method_arrays(sets: Sequence[TrainingSet]) -> dict[str, NDArray[Any]]:
    """What a model file keeps of the simple methods: ``method.constant`` (6, 6), the mean square of the training
    errors, and ``method.<stated>.scale`` (6,)."""
    Y = np.concatenate([s.Y for s in sets])
    out: dict[str, NDArray[Any]] = {"method.constant": Y.T @ Y / len(Y) + 1e-15 * np.eye(6)}
    for method in STATED:
        scale = best_scale(sets, method)
        if scale is not None:
            out[f"method.{method}.scale"] = scale
    return out


def simple_covariances(
    arrays: Mapping[str, NDArray[Any]], covariances: Mapping[str, Array], v_t: Mapping[str, Array], n: int
) -> dict[str, Array]:
    """What all methods but ``gp_thesis``, ``base`` and ``learned`` state of n motions: (n, 6, 6), of ``_vt`` (n, 3, 3).

    ``arrays``: of a model file. ``covariances`` (n, 6, 6) and ``v_t`` (n, 3, 3): what geometry says of them, by
    method. A method that lacks what it needs is absent.
    """
    out, constant = {}, arrays.get("method.constant")
    if constant is not None and constant.shape == (6, 6):
        out["constant"] = np.broadcast_to(constant, (n, 6, 6))
    for method in dict.fromkeys((*covariances, *v_t)):
        scale = arrays.get(f"method.{method}.scale")
        if method in covariances:
            out[method] = covariances[method]
        if method in covariances and scale is not None:
            out[f"{method}_scaled"] = covariances[method] * np.outer(np.sqrt(scale), np.sqrt(scale))
        if method in v_t:
            out[f"{method}_vt"] = v_t[method]
    return out


def score(
    error: Array, mean: Array, covariance: Array, nu: float = math.inf, axes: ArrayLike | None = None
) -> dict[str, Any]:
    """Of errors (n, 6), predicted means (n, 6) and covariances (n, 6, 6) about them, and the stated degrees of freedom.

    ``nll_per_dim`` is that of the Gaussian of these covariances, ``nll_stated_per_dim`` that of the stated Student-t;
    ``nees_dof_median_stated`` the median that the latter expects of NEES.

    A covariance of the translation alone is (n, 3, 3): fields that need the rotation are then None.
    Rows whose covariance is not finite are left out; with none left every field is None. ``axes``: those that count.
    """
    known, d = np.isfinite(covariance).all(axis=(1, 2)), covariance.shape[-1]
    if known.sum() < 2:
        return empty()
    if not known.all():  # else as they are: copies of a long run take hundreds of megabytes
        error, mean, covariance = error[known], mean[known], covariance[known]
    whole = d == 6
    counted = counted_axes(axes, d)
    per_block = nees_by_block((error - mean)[:, :d], covariance, counted)
    residual, covariance = (error - mean)[:, counted], marginal(covariance, counted)
    sigma = np.sqrt(variances(covariance))
    crps, level = crps_gaussian(residual, sigma), coverage(residual, sigma)
    return {
        "nees_dof": {n: None if n not in per_block else float(per_block[n].mean()) for n in BLOCKS},
        "nees_dof_median": {n: None if n not in per_block else float(np.median(per_block[n])) for n in BLOCKS},
        "coverage": {str(k + 1): float(c) for k, c in enumerate(level)},
        "nll_per_dim": float(np.mean(nll_per_dim(residual, covariance))) if whole else None,
        "nll_stated_per_dim": float(np.mean(nll_per_dim(residual, covariance, nu))) if whole else None,
        "nees_dof_median_stated": nees_median(len(counted), nu) / len(counted),
        "crps": {
            "translation_m": float(crps[:, counted < 3].mean()) if (counted < 3).any() else None,
            "rotation_rad": float(crps[:, counted > 2].mean()) if (counted > 2).any() else None,
        },
        "rmse_raw": _rmse(error, whole),
        "rmse_corrected": _rmse(error - mean, whole),
    }


def stated_and_actual(error: Array, mean: Array, covariance: Array) -> dict[str, list[tuple[float, float]]]:
    """By kind of axis, over tenths of the motions by rising stated variance: the root mean stated variance and the root
    mean squared error of an axis [m or rad]. Arguments as in :func:`score`, (n, 6) and (n, 6, 6)."""
    variance, square = variances(covariance), (error - mean) ** 2
    out = {}
    for kind, block in (("translation_m", slice(0, 3)), ("rotation_rad", slice(3, 6))):
        order = np.argsort(variance[:, block].sum(1), kind="stable")
        tenths = [rows for rows in np.array_split(order, 10) if len(rows)]
        out[kind] = [tuple(float(np.sqrt(v[rows, block].mean())) for v in (variance, square)) for rows in tenths]
    return out  # type: ignore[return-value]


def empty() -> dict[str, Any]:
    """The same document if nothing could be computed."""

    def blank(document: dict[str, Any]) -> dict[str, Any]:
        return {key: blank(v) if isinstance(v, dict) else None for key, v in document.items()}

    return blank(score(np.zeros((2, 6)), np.zeros((2, 6)), np.stack([np.eye(6)] * 2)))


def average(values: Sequence[Any]) -> Any:
    """Documents of one form averaged number by number; None where none has a number; text from the first."""
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


def _rmse(error: Array, whole: bool) -> dict[str, float | None]:
    """Of the length of the translation and of the rotation."""
    rotation = float(np.sqrt((error[:, 3:] ** 2).sum(1).mean())) if whole else None
    return {"translation_m": float(np.sqrt((error[:, :3] ** 2).sum(1).mean())), "rotation_rad": rotation}
