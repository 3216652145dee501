"""From out-of-fold residuals to the calibrated model: parts, correlation, scale, intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.calibrate import (
    LEVELS,
    Scale,
    conformal_quantiles,
    fit_joint_factor,
    fit_outside_power,
    fit_scale,
)
from gpvo.learning.geometryweight import choose_geometry_weight, divided
from gpvo.learning.meanfit import no_mean
from gpvo.learning.noise import HeteroscedasticFit
from gpvo.learning.partcorrelation import part_correlations
from gpvo.learning.parts import MOST_ROWS, Parts, fit_parts
from gpvo.learning.poses import Motions, added_factor, with_added
from gpvo.learning.rows import Rows
from gpvo.learning.spans import at_most
from gpvo.learning.velocities import rate_changes, usual_rate_var
from gpvo.online.base import TWIST_COLUMNS, BaseVariance, feature_noise, motion_noise
from gpvo.online.basis import SharedBasis
from gpvo.online.division import divide, ln_faster, of_calibration
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
    *,
    mean_in_sigma: bool = True,
    calibration: bool = False,
) -> tuple[ErrorModelArrays, dict[str, Any]]:
    """Parts, correlation and calibration from the out-of-fold residuals; then everything in one place.

    ``calibration``: whether errors of the camera's calibration are to have a part of their own.
    """
    scale = fit_scale(error / np.sqrt(variance), rows.group)
    sigma = np.sqrt(variance * scale.factor)
    z = error / sigma
    geometry = rows.geometry(base.method)
    sums = _sums_of(rows, error, sigma, geometry, calibration)
    X = rows.select(columns)
    noise = feature_noise(motion_noise(columns), variance, rows.dt_s)
    # Out of the domain no mean is taken off, so what is left of one says nothing of how wrong VO is there.
    plain = np.ones(6, dtype=bool)
    if fitted is None:
        inputs, basis = (columns[0],), SharedBasis(no_mean(1, 6), None, np.zeros(6))
        high = np.zeros(6)
    else:
        basis, plain = fitted.basis, ~fitted.use_mean if not fitted.use_mean.all() else plain
        high = np.quantile(fitted.oof_log_noise_var, 0.95, axis=0)
    outside_power = fit_outside_power(_distance(X, noise, rows.group), (z[:, plain] ** 2).mean(axis=1), rows.group)
    model = ErrorModelArrays(
        columns=columns,
        inputs=np.array([columns.index(n) for n in inputs], dtype=np.int64),
        basis=basis,
        domain=Domain.learn(X),
        base=base,
        factor=scale.factor,
        outside_power=np.array([outside_power]),
        high=high,
        correlation=sums.correlation[:3],
        geometry_weight=np.array([sums.geometry_weight]),
        share=sums.parts.share,
        growth=sums.parts.growth,
        level=sums.parts.level,
        ln_speed=sums.ln_speed,
        bias_tau_s=sums.parts.tau_s,
        typical_ln_det=np.zeros(1),
        usual_rate_var=usual_rate_var(rows),
        rate_change_var=rate_changes(rows),
        mean_in_sigma=np.array([mean_in_sigma]),
        steady_mean=np.zeros(6),
        calibration_follows=sums.parts.calibration.follows,
        calibration_tau_s=sums.parts.calibration.tau_s,
        calibration_correlation=sums.correlation[3],
        dt_s=rows.step_s,
    )
    model, added, joint = _consistent(model, rows, error, sigma**2, X, geometry)
    return model, _calibration(rows, scale, joint, added, sums, np.abs(z) / np.sqrt(joint))


def _consistent(
    model: ErrorModelArrays, rows: Rows, error: Array, variance: Array, X: Array, geometry: Array | None
) -> tuple[ErrorModelArrays, float, float]:
    """The model made right of poses and of all six axes together, and the factors of both."""
    added = _added_factor(model, rows, error, variance, X, geometry)
    model = replace(model, share=with_added(model.share, added))
    whole = model.split(variance, X, geometry)[0].sum(axis=1)
    joint = fit_joint_factor(error, whole, rows.group)
    typical = float(np.median(np.linalg.slogdet(whole * joint)[1]))
    level = model.level + np.log(joint)
    model = replace(model, factor=model.factor * joint, level=level, typical_ln_det=np.array([typical]))
    return model, added, joint


@dataclass(frozen=True)
class _Sums:
    """How errors add up: their parts, the correlation (4, 6, 6) of each, how much of the geometry's to believe, and the
    log of the typical speed (1,)."""

    parts: Parts
    correlation: Array
    geometry_weight: float
    ln_speed: Array


def _sums_of(rows: Rows, error: Array, sigma: Array, geometry: Array | None, calibration: bool) -> _Sums:
    twist = rows.select(TWIST_COLUMNS)
    v_mps = twist[:, :3]
    ln_speed = np.log(np.maximum(np.nanmedian(np.linalg.norm(v_mps, axis=1), keepdims=True), 1e-6))
    faster = ln_faster(v_mps, ln_speed)
    errors, sigmas = rows.chains(error), rows.chains(sigma)
    parts = fit_parts(errors, sigmas, rows.chains(faster), rows.step_s, rows.chains(twist) if calibration else None)
    correlation = part_correlations(errors, sigmas, parts, rows.step_s)
    share = divide(parts.share, parts.growth, 2.0 * np.log(sigma) - parts.level, faster)
    wrong, rest = of_calibration(sigma**2, parts.calibration.follows, twist)
    deviation = np.concatenate([np.sqrt(share * rest[:, None]), wrong[:, None]], axis=1)
    weight = 0.0
    if geometry is not None:
        each = divided(errors, rows.chains(deviation), rows.chains(geometry))
        phi = np.exp(-rows.step_s / np.array([parts.tau_s, parts.calibration.tau_s]))
        weight = choose_geometry_weight(each, correlation, phi)
    return _Sums(parts, correlation, weight, ln_speed)


def _distance(X: Array, noise: Array, group: NDArray[np.int64]) -> Array:
    """(n,) how far each row, with the noise of its features, lies from what the other groups know."""
    out = np.zeros(len(X))
    labels = np.unique(group)
    for g in labels if len(labels) > 1 else ():
        out[group == g] = Domain.learn(X[group != g]).locate(X[group == g], noise[group == g]).distance
    return out


def _added_factor(
    model: ErrorModelArrays, rows: Rows, error: Array, variance: Array, X: Array, geometry: Array | None
) -> float:
    """What the poses show of white and bias, ``variance`` (n, 6) being right up to a common factor."""
    parts, root = model.divided(variance, X, geometry)
    factor = fit_joint_factor(error, parts.sum(axis=1) + root @ np.swapaxes(root, -1, -2), rows.group)
    parts, root = parts * factor, root * np.sqrt(factor)
    T_prev_cur = rows.motions()
    chosen = at_most(rows.chains(np.arange(len(error))), MOST_ROWS)
    chains = [Motions(i, T_prev_cur[c], error[c], parts[c], root[c]) for i, cs in enumerate(chosen) for c in cs]
    phi = np.exp(-rows.step_s / np.array([model.bias_tau_s, model.calibration_tau_s]))
    return added_factor(chains, model.share, phi)


def _calibration(rows: Rows, scale: Scale, joint: float, added: float, sums: _Sums, score: Array) -> dict[str, Any]:
    axes = [conformal_quantiles(score[:, j], rows.group) for j in range(6)]
    return {
        "by": rows.grouped_by,
        "groups": len(np.unique(rows.group)),
        "scale_of_groups": scale.by_group,
        "log_scale_spread": scale.spread,
        "joint_factor": joint,
        "added_factor": added,
        "geometry_correlation_weight": sums.geometry_weight,
        "interval_levels": LEVELS,
        "interval_sigmas": [widths for widths, _ in axes],
        "interval_guaranteed": [sure for _, sure in axes],
        "parts": {"spans_frames": sums.parts.spans, "seen_over_stated": sums.parts.ratio},
    }
