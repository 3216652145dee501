"""From out-of-fold residuals to the calibrated model: parts, correlation, scale, intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import group_folds
from gpvo.learning.basefit import learn_domain, rate_changes, usual_rate_var
from gpvo.learning.calibrate import LEVELS, Scale, conformal_quantiles, fit_joint_factor, fit_outside_power, fit_scale
from gpvo.learning.logvariance import log_ratio
from gpvo.learning.parts import MOST_ROWS, Parts, fit_parts, part_correlations
from gpvo.learning.patterns import PERSISTENT_S, Patterns, learn_patterns
from gpvo.learning.poses import Poses, Windows, added_factor, pose_losses, windows_of, with_added
from gpvo.learning.rows import Rows, significant_gain, simplest_sufficient
from gpvo.learning.spans import at_most
from gpvo.online.base import TWIST_COLUMNS, BaseVariance, Velocities, feature_noise, motion_noise
from gpvo.online.division import Division, ln_faster, of_calibration
from gpvo.online.estimate import ErrorModel
from gpvo.online.projected import ProjectedGP
from gpvo.stats import student_t
from gpvo.stats.consistency import nees
from gpvo.types import Array

_WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_LEAST_KNOWN = 0.5
_MOST_FOLDS = 5


@dataclass(frozen=True)
class VarianceModel:
    """The variance of a motion: ``base``, times the exponential of ``gp`` on ``inputs`` where it has any.

    ``oof`` (n, 6): the variance of each training row by a fit without its group. ``means``: coefficients (6, 5) of the
    base fitted without a GP, to all rows and to those outside of each fold.
    """

    inputs: tuple[str, ...]
    base: BaseVariance
    gp: ProjectedGP | None
    oof: Array
    means: Sequence[Array]


def assemble(rows: Rows, columns: tuple[str, ...], learned: VarianceModel) -> tuple[ErrorModel, dict[str, Any]]:
    """The finished error model on ``columns``: parts, correlations and scale fitted to the errors, given their variance
    out of fold.

    Errors of the camera's calibration get a part of their own if that makes the poses of left-out flights likelier.
    """
    error, variance, base, gp = rows.error, learned.oof, learned.base, learned.gp
    scale = fit_scale(error / np.sqrt(variance), rows.group)
    of = _Residuals(
        rows,
        variance * scale.factor,
        rows.geometry(base.method),
        group_folds(rows.group, _MOST_FOLDS),
        windows_of(at_most(rows.chains(np.arange(len(error))), MOST_ROWS), rows.motions()),
    )
    X = rows.select(columns)
    z = error / np.sqrt(of.variance)
    noise = feature_noise(motion_noise(columns), variance, rows.dt_s)
    outside_power = fit_outside_power(_distance(X, noise, rows.group), (z**2).mean(axis=1), rows.group)
    domain, high = learn_domain(X), np.zeros(6)
    places = np.array([columns.index(n) for n in learned.inputs or columns[:1]], dtype=np.int64)
    if gp is not None:
        high = np.quantile(log_ratio(gp, domain.locate(X).inside[:, places]), 0.95, axis=0)
    divided = _divided(of)
    model = ErrorModel(
        columns=columns,
        inputs=places,
        gp=gp or ProjectedGP.constant(np.zeros(6)),
        domain=domain,
        base=base,
        division=divided[0].whole,
        velocities=Velocities(usual_rate_var(rows), rate_changes(rows)),
        factor=scale.factor,
        outside_power=np.array([outside_power]),
        high=high,
        typical_ln_det=np.zeros(1),
        nu=np.zeros(1),
        dt_s=rows.step_s,
    )
    found = _with_calibration(model, of, _most_likely(model, of, divided))
    return found.model, _calibration(rows, scale, found, np.abs(z) / np.sqrt(found.joint))


@dataclass(frozen=True)
class _Residuals:
    """All rows, the ``variance`` (n, 6) of their errors out of fold, calibrated for each axis, the geometric covariance
    (n, 6, 6), the ``fold`` (n,) that is left out with each row, the ``windows`` whose poses are looked at, and
    ``patterns`` if calibration has a part of its own."""

    rows: Rows
    variance: Array
    geometry: Array | None
    fold: NDArray[np.int64]
    windows: Sequence[Windows]
    patterns: Patterns | None = None

    def of_calibration(self) -> tuple[Array | None, Array, Array]:
        """Root (n, 6, 6) of the covariance due to a wrong calibration, by the patterns of other flights; the variance
        and the errors that remain without it."""
        if self.patterns is None:
            return None, self.variance, self.rows.error
        twist = self.rows.select(TWIST_COLUMNS) * self.rows.steps[:, None]
        root, rest = np.empty((len(self.fold), 6, 6)), self.variance.copy()
        for k, patterns in enumerate(self.patterns.without):
            of = self.fold == k
            root[of], rest[of] = of_calibration(self.variance[of], patterns, twist[of])
        return root, rest, self.rows.error - self.patterns.error


@dataclass(frozen=True)
class _Divided:
    """How errors add up, learned from all flights, with the ``parts`` that it rests on, and from those ``without`` each
    fold: by the latter, poses show what is stated of a flight that nothing was learned from."""

    whole: Division
    parts: Parts
    without: Sequence[Division]

    def changed(self, change: Callable[[Division], Division]) -> _Divided:
        """All of them, with the same change."""
        return replace(self, whole=change(self.whole), without=[change(d) for d in self.without])

    def split(self, of: _Residuals) -> tuple[Array, ...]:
        """Covariances (n, 6, 6) of jitter and white noise, and the root (n, 6, 12) of bias and calibration, by what the
        other flights show."""
        twist, steps = of.rows.select(TWIST_COLUMNS), of.rows.steps
        out = tuple(np.empty((len(of.fold), 6, k)) for k in (6, 6, 12))
        for k, division in enumerate(self.without):
            i = of.fold == k
            e = division.split(of.variance[i], twist[i], None if of.geometry is None else of.geometry[i], steps[i])
            for every, part in zip(out, (e.jitter, e.white, e.persistent_root)):
                every[i] = part
        return out


@dataclass(frozen=True)
class _Consistent:
    """A model calibrated for poses and for all six axes jointly, with the factors of both, the parts that its division
    rests on, and its loss on the poses of each sequence (S,)."""

    model: ErrorModel
    added: float
    joint: float
    parts: Parts
    losses: Array


def _most_likely(model: ErrorModel, of: _Residuals, divided: Sequence[_Divided]) -> _Consistent:
    """The calibrated model, with the strongest prior of the parts' correlations, and the least share of the geometry's,
    that no other beats by a significant gain in the poses; none if the geometry is mostly unknown."""
    first = [_consistent(model, of, d) for d in divided]
    best = simplest_sufficient({k: found.losses for k, found in enumerate(first)})
    if of.geometry is None or np.isfinite(of.geometry).all(axis=(1, 2)).mean() < _LEAST_KNOWN:
        return first[best]
    weighted = (divided[best].changed(partial(replace, geometry_weight=np.array([w]))) for w in _WEIGHTS[1:])
    tried = [first[best], *(_consistent(model, of, d) for d in weighted)]
    return tried[simplest_sufficient({k: found.losses for k, found in enumerate(tried)})]


def _consistent(model: ErrorModel, of: _Residuals, divided: _Divided) -> _Consistent:
    whole, joint, poses = _jointly(of, divided)
    added = added_factor(poses, divided.whole.share)
    if added != 1.0:
        divided = divided.changed(lambda d: replace(d, share=with_added(d.share, added)))
        whole, joint, poses = _jointly(of, divided)
    nu = student_t.fit_dof(nees(of.rows.error, whole), of.rows.error.shape[1], of.rows.weight)
    typical, division = float(np.median(np.linalg.slogdet(whole)[1])), divided.whole
    model = replace(
        model,
        division=replace(
            division,
            level=division.level + np.log(joint),
            calibration_patterns=division.calibration_patterns * np.sqrt(joint),
        ),
        factor=model.factor * joint,
        typical_ln_det=np.array([typical]),
        nu=np.array([0.0 if np.isinf(nu) else nu]),
    )
    return _Consistent(model, added, joint, divided.parts, pose_losses(poses))


def _jointly(of: _Residuals, divided: _Divided) -> tuple[Array, float, list[Poses]]:
    """Covariances (n, 6, 6) of motions, times the factor that makes their joint NEES right; the factor; and poses with
    such covariances."""
    jitter, white, root = divided.split(of)
    whole = jitter + white + root @ np.swapaxes(root, -1, -2)
    joint = fit_joint_factor(of.rows.error, whole, of.rows.group)
    phi = np.exp(-of.rows.step_s / divided.whole.persistent_tau_s)
    motions = of.rows.error, jitter * joint, white * joint, root * np.sqrt(joint)
    return whole * joint, joint, [Poses.over(w, *motions, phi) for w in of.windows]


def _with_calibration(bare: ErrorModel, of: _Residuals, plain: _Consistent) -> _Consistent:
    """The same with a part for a wrong calibration, if the patterns of other flights make the poses likelier by a
    significant gain."""
    patterns = learn_patterns(of.rows, of.rows.error, of.variance, of.fold)
    if patterns is None:
        return plain
    of = replace(of, patterns=patterns)
    found = _most_likely(bare, of, _divided(of))
    return found if significant_gain(plain.losses - found.losses) else plain


def _divided(of: _Residuals) -> list[_Divided]:
    """How errors add up, without the geometry's correlations so far: for each prior of the parts' correlations."""
    root, rest, left = of.of_calibration()
    usual = None if of.patterns is None else of.patterns.usual
    whole, parts = _divisions(of.rows, (of.rows.error, rest, left, root), usual)
    without = []
    for k in np.unique(of.fold):
        kept = of.fold != k
        some = of.rows.error[kept], rest[kept], left[kept], None if root is None else root[kept]
        patterns = None if of.patterns is None else of.patterns.without[k]
        without.append(_divisions(of.rows.only(kept), some, patterns, parts)[0])
    return [_Divided(of_all, parts, others) for of_all, *others in zip(whole, *without)]


def _divisions(
    rows: Rows, of: tuple[Array, Array, Array, Array | None], patterns: Array | None, like: Parts | None = None
) -> tuple[list[Division], Parts]:
    """From errors (n, 6), the variance without that of a wrong calibration, the errors that remain without it, and its
    root (n, 6, 6); ``like``: see :func:`fit_parts`."""
    error, rest, left, root = of
    v_mps, sigma = rows.select(TWIST_COLUMNS[:3]), np.sqrt(rest)
    ln_speed = np.log(np.maximum(np.nanmedian(np.linalg.norm(v_mps, axis=1), keepdims=True), 1e-6))
    sigmas, faster = rows.chains(sigma), rows.chains(ln_faster(v_mps, ln_speed))
    lasting = None if root is None else rows.chains(root)
    parts = fit_parts(rows.chains(error), sigmas, faster, rows.step_s, lasting, like)
    R = part_correlations(rows.chains(left), sigmas, parts)
    division = Division(
        share=parts.share,
        growth=parts.growth,
        level=parts.level,
        ln_speed=ln_speed,
        correlation=R[0],
        geometry_weight=np.zeros(1),
        bias_tau_s=parts.tau_s,
    )
    if patterns is not None:
        division = replace(division, calibration_patterns=patterns, calibration_tau_s=np.full(6, PERSISTENT_S))
    return [replace(division, correlation=of_prior) for of_prior in R], parts


def _distance(X: Array, noise: Array, group: NDArray[np.int64]) -> Array:
    """(n,) distance of each row from the domain of the other groups, given the noise of its features."""
    out = np.zeros(len(X))
    labels = np.unique(group)
    for g in labels if len(labels) > 1 else ():
        out[group == g] = learn_domain(X[group != g]).locate(X[group == g], noise[group == g]).distance
    return out


def _calibration(rows: Rows, scale: Scale, found: _Consistent, score: Array) -> dict[str, Any]:
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
        # Blocks of a flight are no sample of flights.
        "interval_guaranteed": [[known and rows.grouped_by == "sequences" for known in sure] for _, sure in axes],
        "parts": {"spans_frames": found.parts.spans, "seen_over_stated": found.parts.ratio},
    }
