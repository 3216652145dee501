"""From out-of-fold residuals to the calibrated model: parts, correlation, scale, intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.basefit import learn_domain, learn_velocities
from gpvo.learning.calibrate import (
    LEVELS,
    Scale,
    conformal_quantiles,
    fit_joint_factor,
    fit_outside_power,
    fit_scale,
)
from gpvo.learning.logvariance import log_ratio
from gpvo.learning.parts import MOST_ROWS, Parts, fit_parts, part_correlations
from gpvo.learning.patterns import PERSISTENT_S, Patterns, learn_patterns
from gpvo.learning.poses import Motions, Poses, added_factor, pose_losses, poses_of, with_added
from gpvo.learning.rows import Rows, significant_gain
from gpvo.learning.spans import at_most
from gpvo.online.base import TWIST_COLUMNS, BaseVariance, feature_noise, motion_noise
from gpvo.online.division import Division, ln_faster, of_calibration
from gpvo.online.estimate import ErrorModel
from gpvo.online.projected import ProjectedGP
from gpvo.stats import student_t
from gpvo.stats.consistency import nees
from gpvo.types import Array

_WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_LEAST_KNOWN = 0.5


def assemble(
    rows: Rows,
    base: BaseVariance,
    columns: tuple[str, ...],
    inputs: Sequence[str],
    gp: ProjectedGP | None,
    variance: Array,
) -> tuple[ErrorModel, dict[str, Any]]:
    """The finished error model: parts, correlations and scale fitted to the errors, given their ``variance``
    (n, 6).

    ``base``, and ``gp`` on ``inputs`` if there is one: what will state the variance of a new sequence. Errors of the
    camera's calibration get a part of their own if that makes the poses of left-out flights likelier.
    """
    error = rows.error
    scale = fit_scale(error / np.sqrt(variance), rows.group)
    of = _Residuals(rows, error, variance * scale.factor, rows.select(columns), rows.geometry(base.method))
    z = error / np.sqrt(of.variance)
    noise = feature_noise(motion_noise(columns), variance, rows.dt_s)
    outside_power = fit_outside_power(_distance(of.X, noise, rows.group), (z**2).mean(axis=1), rows.group)
    domain, high = learn_domain(of.X), np.zeros(6)
    places = np.array([columns.index(n) for n in inputs or columns[:1]], dtype=np.int64)
    if gp is not None:
        high = np.quantile(log_ratio(gp, domain.locate(of.X).inside[:, places]), 0.95, axis=0)
    division, parts = _division_of(of)
    model = ErrorModel(
        columns=columns,
        inputs=places,
        gp=gp or ProjectedGP.constant(np.zeros(6)),
        domain=domain,
        base=base,
        division=division,
        velocities=learn_velocities(rows),
        factor=scale.factor,
        outside_power=np.array([outside_power]),
        high=high,
        typical_ln_det=np.zeros(1),
        nu=np.zeros(1),
        dt_s=rows.step_s,
    )
    parts, found = _with_calibration(model, of, (parts, _most_likely(model, of)))
    return found.model, _calibration(rows, scale, found, parts, np.abs(z) / np.sqrt(found.joint))


@dataclass(frozen=True)
class _Residuals:
    """All rows, out of fold: ``error`` (n, 6), its ``variance`` (n, 6), calibrated for each axis, features ``X``
    (n, d), the geometric covariance (n, 6, 6), and ``patterns`` if calibration has a part of its own."""

    rows: Rows
    error: Array
    variance: Array
    X: Array
    geometry: Array | None
    patterns: Patterns | None = None

    def _folds(self) -> list[tuple[NDArray[np.bool_], Array]]:
        """Rows (n,) of each fold, and the patterns learned from the other flights."""
        assert self.patterns is not None
        return [(self.patterns.fold == k, patterns) for k, patterns in enumerate(self.patterns.without)]

    def of_calibration(self) -> tuple[Array | None, Array, Array]:
        """Root (n, 6, 6) of the covariance due to a wrong calibration, by the patterns of other flights; the variance
        and the errors that remain without it."""
        if self.patterns is None:
            return None, self.variance, self.error
        twist, root, rest = self.rows.select(TWIST_COLUMNS), np.empty((len(self.error), 6, 6)), self.variance.copy()
        for fold, patterns in self._folds():
            root[fold], rest[fold] = of_calibration(self.variance[fold], patterns, twist[fold])
        return root, rest, self.error - self.patterns.error

    def divided(self, model: ErrorModel) -> tuple[Array, ...]:
        """Covariances (n, 6, 6) of jitter and white noise, and the root (n, 6, 12) of bias and calibration, by the
        patterns of the other flights."""
        twist, geometry = model.twist(self.X), self.geometry

        def split(of: Any, division: Division) -> tuple[Array, ...]:
            e = division.split(self.variance[of], twist[of], None if geometry is None else geometry[of])
            return e.jitter, e.white, e.persistent_root

        if self.patterns is None:
            return split(slice(None), model.division)
        out = tuple(np.empty((len(twist), 6, k)) for k in (6, 6, 12))
        for fold, patterns in self._folds():
            for whole, part in zip(out, split(fold, replace(model.division, calibration_patterns=patterns))):
                whole[fold] = part
        return out


@dataclass(frozen=True)
class _Consistent:
    """A model calibrated for poses and for all six axes jointly, with the factors of both, and its loss on the poses of
    each sequence (S,)."""

    model: ErrorModel
    added: float
    joint: float
    losses: Array


def _most_likely(model: ErrorModel, of: _Residuals) -> _Consistent:
    """The calibrated model, with the share of the geometry's correlations under which poses and motions are likeliest;
    none if the geometry is mostly unknown."""
    if of.geometry is None or np.isfinite(of.geometry).all(axis=(1, 2)).mean() < _LEAST_KNOWN:
        return _consistent(model, of)
    tried = [_consistent(_with_division(model, geometry_weight=np.array([w])), of) for w in _WEIGHTS]
    return min(tried, key=lambda found: found.losses.mean())


def _consistent(model: ErrorModel, of: _Residuals) -> _Consistent:
    """The model, calibrated for poses and for all six axes jointly."""
    whole, joint, poses = _jointly(model, of)
    added = added_factor(poses, model.division.share)
    if added != 1.0:
        model = _with_division(model, share=with_added(model.division.share, added))
        whole, joint, poses = _jointly(model, of)
    nu = student_t.fit_dof(nees(of.error, whole), of.error.shape[1], of.rows.weight)
    typical = float(np.median(np.linalg.slogdet(whole)[1]))
    model = replace(
        model,
        factor=model.factor * joint,
        typical_ln_det=np.array([typical]),
        nu=np.array([0.0 if np.isinf(nu) else nu]),
    )
    level, patterns = model.division.level + np.log(joint), model.division.calibration_patterns * np.sqrt(joint)
    model = _with_division(model, level=level, calibration_patterns=patterns)
    return _Consistent(model, added, joint, pose_losses(poses))


def _jointly(model: ErrorModel, of: _Residuals) -> tuple[Array, float, list[Poses]]:
    """Covariances (n, 6, 6) of motions, times the factor that makes their joint NEES right; the factor; and poses with
    such covariances."""
    jitter, white, root = of.divided(model)
    whole = jitter + white + root @ np.swapaxes(root, -1, -2)
    joint = fit_joint_factor(of.error, whole, of.rows.group)
    stated = (of.rows.motions(), of.error, jitter * joint, white * joint, root * np.sqrt(joint))
    chosen = at_most(of.rows.chains(np.arange(len(of.error))), MOST_ROWS)
    chains = [Motions(i, *(x[c] for x in stated)) for i, cs in enumerate(chosen) for c in cs]
    phi = np.exp(-of.rows.step_s / model.division.persistent_tau_s)
    return whole * joint, joint, poses_of(chains, phi)


def _with_division(model: ErrorModel, **changed: Array) -> ErrorModel:
    return replace(model, division=replace(model.division, **changed))


_Found = tuple[Parts, _Consistent]


def _with_calibration(bare: ErrorModel, of: _Residuals, plain: _Found) -> _Found:
    """The same with a part for a wrong calibration, if the patterns of other flights make the poses likelier by a
    significant gain."""
    patterns = learn_patterns(of.rows, of.error, of.variance)
    if patterns is None:
        return plain
    of = replace(of, patterns=patterns)
    division, parts = _division_of(of)
    found = _most_likely(replace(bare, division=division), of)
    return (parts, found) if significant_gain(plain[1].losses - found.losses) else plain


def _division_of(of: _Residuals) -> tuple[Division, Parts]:
    """How errors add up, without the geometry's correlations so far."""
    rows = of.rows
    v_mps = rows.select(TWIST_COLUMNS[:3])
    ln_speed = np.log(np.maximum(np.nanmedian(np.linalg.norm(v_mps, axis=1), keepdims=True), 1e-6))
    faster = ln_faster(v_mps, ln_speed)
    root, rest, left = of.of_calibration()
    sigma = np.sqrt(rest)
    errors, sigmas = rows.chains(left), rows.chains(sigma)
    lasting = None if root is None else rows.chains(root)
    parts = fit_parts(rows.chains(of.error), sigmas, rows.chains(faster), rows.step_s, lasting)
    division = Division(
        share=parts.share,
        growth=parts.growth,
        level=parts.level,
        ln_speed=ln_speed,
        correlation=part_correlations(errors, sigmas, parts, rows.step_s),
        geometry_weight=np.zeros(1),
        bias_tau_s=parts.tau_s,
    )
    if of.patterns is not None:
        usual = of.patterns.usual
        division = replace(division, calibration_patterns=usual, calibration_tau_s=np.full(6, PERSISTENT_S))
    return division, parts


def _distance(X: Array, noise: Array, group: NDArray[np.int64]) -> Array:
    """(n,) distance of each row from the domain of the other groups, given the noise of its features."""
    out = np.zeros(len(X))
    labels = np.unique(group)
    for g in labels if len(labels) > 1 else ():
        out[group == g] = learn_domain(X[group != g]).locate(X[group == g], noise[group == g]).distance
    return out


def _calibration(rows: Rows, scale: Scale, found: _Consistent, parts: Parts, score: Array) -> dict[str, Any]:
    axes = [conformal_quantiles(score[:, j], rows.group) for j in range(6)]
    return {
        "by": rows.grouped_by,
        "groups": len(np.unique(rows.group)),
        "scale_of_groups": scale.by_group,
        "log_scale_spread": scale.spread,
        "joint_factor": found.joint,
        "added_factor": found.added,
        "nu": float(found.model.nu[0]) or None,
        "calibration_part": bool(found.model.division.calibration_patterns.any()),
        "geometry_correlation_weight": float(found.model.division.geometry_weight[0]),
        "interval_levels": LEVELS,
        "interval_sigmas": [widths for widths, _ in axes],
        "interval_guaranteed": [sure for _, sure in axes],
        "parts": {"spans_frames": parts.spans, "seen_over_stated": parts.ratio},
    }
