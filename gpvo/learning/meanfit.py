"""Posterior of the mean under given row weights, and the same out of fold, from sums per fold: nothing is refitted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import Eigenbasis, Sums, accumulate, chunks
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.numerics import Scaling
from gpvo.online.basis import NEVER, ProjectedGP

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FoldedMean:
    """``gp``: posterior given all rows. ``oof_mean``, ``oof_var`` (n, D): at each row, given the other folds."""

    gp: ProjectedGP
    oof_mean: Array
    oof_var: Array


def fit_folded_mean(
    fitted: FittedGP,
    X: Array,
    Y: Array,
    precision: Array,
    count: Array,
    fold: NDArray[np.int64],
    inducing: int,
    seed: int,
) -> FoldedMean:
    """Posterior of the mean with the kernel of ``fitted`` on at most ``inducing`` points.

    ``precision`` (n, 1): one profile for all outputs; (n, D): one per output, each then gets its own projection. Its
    scale is arbitrary: signal and noise variances are learnt anew, per output, on all rows. ``count`` (n,): how often
    a row counts.
    """
    gp = fitted.gp
    U = (X - gp.centre) / gp.lengthscale
    points = gp.points if len(gp.points) <= inducing else greedy_points(gp.points, inducing, seed=seed)
    scaling = Scaling.of(U, Y, count)
    scaling = Scaling(gp.centre, gp.lengthscale, np.zeros(Y.shape[1]), scaling.y_scale)
    if precision.shape[1] == 1:
        return _one_profile(scaling, fitted.hyper, points, U, Y, precision[:, 0], count, fold)
    parts = []
    for j in range(Y.shape[1]):
        hyper = Hyperparameters(fitted.hyper.lengthscale, fitted.hyper.signal_var[[j]], fitted.hyper.noise_var[[j]])
        one = replace(scaling, y_centre=scaling.y_centre[[j]], y_scale=scaling.y_scale[[j]])
        parts.append(_one_profile(one, hyper, points, U, Y[:, [j]], precision[:, j], count, fold))
    return _stacked(parts)


def _one_profile(
    scaling: Scaling,
    hyper: Hyperparameters,
    points: Array,
    U: Array,
    Y: Array,
    precision: Array,
    count: Array,
    fold: NDArray[np.int64],
) -> FoldedMean:
    precision = precision / np.exp(np.mean(np.log(precision)))
    unit = np.ones(U.shape[1])
    Ys, y2 = Y / scaling.y_scale, scaling.y_scale**2
    hyper = Hyperparameters(unit, hyper.signal_var / y2, hyper.noise_var / y2)

    def sums_of(rows: NDArray[np.bool_]) -> Sums:
        return accumulate(chunks(U[rows], Ys[rows], precision[rows], count[rows]), points, unit)

    parts = {f: sums_of(fold == f) for f in np.unique(fold)}
    total = Sums.zero(len(points), Y.shape[1])
    for part in parts.values():
        total = total.combined(part, 1.0)
    gp, hyper = _posterior(total, hyper, scaling, points, learn=True)
    oof_mean, oof_var = np.empty_like(Y), np.empty_like(Y)
    for f, part in parts.items():
        if len(parts) == 1:
            other = gp
        else:
            other, _ = _posterior(total.combined(part, -1.0), hyper, scaling, points, learn=False)
        rows = fold == f
        oof_mean[rows], oof_var[rows] = replace(other, centre=unit * 0.0, lengthscale=unit).evaluate(U[rows])
    return FoldedMean(gp, oof_mean, oof_var)


def _posterior(
    sums: Sums, hyper: Hyperparameters, scaling: Scaling, points: Array, *, learn: bool
) -> tuple[ProjectedGP, Hyperparameters]:
    """Posterior about the rows' own weighted mean, in the units of the data."""
    centre = sums.y.numpy() / sums.c
    centred = sums.centred(centre)
    basis = Eigenbasis.of(centred, points)
    if learn:
        hyper = basis.maximise(centred, hyper)
    at = replace(scaling, y_centre=centre * scaling.y_scale)
    return basis.posterior(hyper, at, points), hyper


def _stacked(parts: list[FoldedMean]) -> FoldedMean:
    """Fits of one output each as one fit with a projection per output."""
    gps = [part.gp for part in parts]
    gp = replace(
        gps[0],
        projection=np.stack([g.projection for g in gps]),
        **{
            name: np.concatenate([getattr(g, name) for g in gps])
            for name in ("weights", "reduction", "signal_var", "offset")
        },
    )
    return FoldedMean(gp, np.hstack([p.oof_mean for p in parts]), np.hstack([p.oof_var for p in parts]))


def no_mean(d: int, D: int) -> ProjectedGP:
    """A GP that is zero everywhere, with certainty."""
    none = np.zeros((D, 1))
    return ProjectedGP(np.zeros(d), np.ones(d), np.zeros((1, d)), np.zeros((1, 1)), none, none, none[:, 0], none[:, 0])


def only_outputs(gp: ProjectedGP, use: NDArray[np.bool_]) -> ProjectedGP:
    """Outputs of ``gp`` spread over the True places of ``use`` (D,), zero at the others."""
    D = len(use)

    def spread(values: Array) -> Array:
        out = np.zeros((D, *values.shape[1:]))
        out[use] = values
        return out

    projection = gp.projection if gp.projection.ndim == 2 else spread(gp.projection)
    named = {name: spread(getattr(gp, name)) for name in ("weights", "reduction", "signal_var", "offset")}
    return replace(gp, projection=projection, **named)


def only_inputs(gp: ProjectedGP, seen: NDArray[np.int64], d: int) -> ProjectedGP:
    """A GP of some of d inputs, their places ``seen``, as one of all of them: the others change nothing."""
    centre, lengthscale, points = np.zeros(d), np.full(d, NEVER), np.zeros((len(gp.points), d))
    centre[seen], lengthscale[seen], points[:, seen] = gp.centre, gp.lengthscale, gp.points
    return replace(gp, centre=centre, lengthscale=lengthscale, points=points)
