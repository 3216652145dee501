"""From out-of-fold residuals to the calibrated model: parts, correlation, scale, intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.learning.calibrate import (
    LEVELS,
    Scale,
    choose_geometry_weight,
    conformal_quantiles,
    fit_joint_factor,
    fit_scale,
    residual_correlation,
)
from gpvo.learning.meanfit import no_mean
from gpvo.learning.noise import HeteroscedasticFit
from gpvo.learning.parts import Parts, fit_parts
from gpvo.learning.rows import Rows
from gpvo.online.base import BaseVariance
from gpvo.online.basis import SharedBasis
from gpvo.online.estimate import ErrorModelArrays
from gpvo.online.guard import Domain
from gpvo.types import Array


def assemble(
    rows: Rows,
    base: BaseVariance,
    columns: tuple[str, ...],
    inputs: Sequence[str],
    fitted: HeteroscedasticFit | None,
    error: Array,
    variance: Array,
) -> tuple[ErrorModelArrays, dict[str, Any]]:
    """Parts, correlation and calibration from the out-of-fold residuals; then everything in one place."""
    scale = fit_scale(error / np.sqrt(variance), rows.group)
    sigma = np.sqrt(variance * scale.factor)
    z = error / sigma
    split = fit_parts(rows.chains(z), float(np.median(rows.dt_s)))
    correlation = residual_correlation(z)
    geometry = rows.geometry(base.method)
    weight = choose_geometry_weight(error, sigma, correlation, geometry, split.share)
    X = rows.select(columns)
    if fitted is None:
        inputs, basis = (columns[0],), SharedBasis(no_mean(1, 6), None, np.zeros(6))
        high = np.zeros(6)
    else:
        basis = fitted.basis
        high = np.quantile(fitted.oof_log_noise_var, 0.95, axis=0)
    at = np.array([columns.index(n) for n in inputs], dtype=np.int64)
    model = ErrorModelArrays(
        columns=columns,
        inputs=at,
        basis=basis,
        domain=Domain.learn(X),
        base=base,
        factor=scale.factor,
        high=high,
        correlation=correlation,
        geometry_weight=np.array([weight]),
        share=split.share,
        bias_tau_s=split.tau_s,
        typical_ln_det=np.zeros(1),
        dt_s=float(np.median(rows.dt_s)),
    )
    whole = _covariance(model, sigma, geometry)
    joint = fit_joint_factor(error, whole, rows.group)
    typical = float(np.median(np.linalg.slogdet(whole * joint)[1]))
    model = replace(model, factor=scale.factor * joint, typical_ln_det=np.array([typical]))
    return model, _calibration(rows, scale, joint, split, weight, np.abs(z) / np.sqrt(joint))


def _covariance(model: ErrorModelArrays, sigma: Array, geometry: Array | None) -> Array:
    root = np.sqrt(model.share)
    kept = sum(np.outer(r, r) for r in root)
    return sigma[:, :, None] * model.correlations(len(sigma), geometry) * sigma[:, None, :] * kept


def _calibration(rows: Rows, scale: Scale, joint: float, split: Parts, weight: float, score: Array) -> dict[str, Any]:
    axes = [conformal_quantiles(score[:, j], rows.group) for j in range(6)]
    return {
        "by": rows.grouped_by,
        "groups": len(np.unique(rows.group)),
        "scale_of_groups": scale.by_group,
        "log_scale_spread": scale.spread,
        "joint_factor": joint,
        "geometry_correlation_weight": weight,
        "interval_levels": LEVELS,
        "interval_sigmas": [widths for widths, _ in axes],
        "interval_guaranteed": [sure for _, sure in axes],
        "parts": {"spans_frames": split.spans, "measured": split.measured, "fitted": split.fitted},
    }
