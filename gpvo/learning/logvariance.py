"""The log-variance GP: how much noisier than its base variance a motion is, in the conditions that its inputs show.

The squared error over the base is a Student-t's; the log of its scale is a GP, found by Fisher scoring on that density
(P. Green, B. Silverman, "Nonparametric Regression and Generalized Linear Models" (1994), section 5.3).

The kernel is a prior and is not learned: the marginal likelihood of few sequences, whose rows are alike, mistakes
differences between sequences for structure and ends at length scales of a tenth of the data's width. A separate level
for each sequence (a random effect) is removed for the same reason: the GP learns only from changes within sequences,
unless all rows are given as one group, because sequences left out gain by it (:func:`gpvo.learning.fit.choose_inputs`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.regressors.numerics import greedy_points
from gpvo.online.projected import ProjectedGP
from gpvo.stats.student_t import NU, log_fisher, log_scale_score
from gpvo.types import Array

POINTS = 64
LENGTH = 1.5
"""Length scale over the root of the number of inputs, in robust standard deviations of an input."""

_COMMON, _BLOCKS, _OWN = 0.15, 0.05, 0.05
"""Prior variances of the log variance: what the axes share, how translation and rotation differ, and the axes."""

_STEPS, _ENOUGH = 30, 1e-4
_FAR_ASTRAY = 20.0
_LEAST_EIGENVALUE = 1e-9

_CONTRASTS = np.array(
    [
        [1, 1, 1, 1, 1, 1],
        [1, 1, 1, -1, -1, -1],
        [1, -1, 0, 0, 0, 0],
        [1, 1, -2, 0, 0, 0],
        [0, 0, 0, 1, -1, 0],
        [0, 0, 0, 1, 1, -2],
    ]
)
_ROTATION = _CONTRASTS / np.linalg.norm(_CONTRASTS, axis=1, keepdims=True)
"""(6, 6) orthonormal: the axes as their sum, translation against rotation, and differences within the blocks."""
_PRIOR_VAR = np.array([6.0 * _COMMON, 6.0 * _BLOCKS, _OWN, _OWN, _OWN, _OWN])


def fit_log_variance(inputs: Array, ratio: Array, weight: Array, group: NDArray[np.int64]) -> ProjectedGP:
    """Posterior of the log variance ratio of six axes, of mean zero over the rows of each group.

    ``inputs`` (n, d) in standard deviations; ``ratio`` (n, 6) squared errors over their base variances; ``weight`` (n,)
    how much a row counts; ``group`` (n,) the sequence of each row.
    """
    length = np.full(inputs.shape[1], LENGTH * np.sqrt(inputs.shape[1]))
    points = greedy_points(inputs / length, POINTS)
    whitening = _whitening(points)
    zeros = np.zeros((6, len(whitening)))
    prior = ProjectedGP(
        centre=np.zeros(len(length)),
        lengthscale=length,
        points=points,
        projection=whitening,
        weights=zeros,
        reduction=zeros,
        signal_var=_PRIOR_VAR @ _ROTATION**2,
        offset=np.zeros(6),
    )
    return _mode(prior, prior.kernel(inputs) @ prior.projection.T, ratio, weight, group)


def _whitening(points: Array) -> Array:
    """(r, m) that gives the kernel's values directions of unit prior variance."""
    square = (points**2).sum(axis=1)
    values, vectors = np.linalg.eigh(np.exp(np.minimum(points @ points.T - 0.5 * (square[:, None] + square), 0.0)))
    kept = values > _LEAST_EIGENVALUE * values[-1]
    return np.asarray(vectors[:, kept].T / np.sqrt(values[kept])[:, None])


def _mode(prior: ProjectedGP, Z: Array, ratio: Array, weight: Array, group: NDArray[np.int64]) -> ProjectedGP:
    """The posterior's mode, and the variance about it, by the directions Z (n, r) of unit prior variance: the fixed
    point of the working response ``g + score / fisher`` of noise variance ``1 / fisher``."""
    fisher = float(log_fisher(NU))
    labels, place = np.unique(group, return_inverse=True)
    total = np.bincount(place, weight, len(labels))

    def of_group(values: Array) -> Array:
        """(n, ...) weighted means over the groups, at each row."""
        means = [np.bincount(place, weight * column, len(labels)) / total for column in values.T]
        return np.stack(means, axis=1)[place]

    centred = Z - of_group(Z)
    information, V = np.linalg.eigh((centred * (weight * fisher)[:, None]).T @ centred)
    information = np.maximum(information, 0.0)
    Z, centred = Z @ V, centred @ V
    precision = information[:, None] + 1.0 / _PRIOR_VAR
    along, g = np.zeros_like(ratio), np.zeros_like(ratio)
    # A Student-t's scale is smaller than its second moment, of which the ratio is.
    scale_ratio = ratio * NU / (NU - 2.0)
    for _ in range(_STEPS):
        score = log_scale_score(scale_ratio * np.exp(-np.clip(g, -_FAR_ASTRAY, _FAR_ASTRAY)), NU)
        response = g + score / fisher
        level = of_group(response - along)
        A = (centred.T @ (response * (weight * fisher)[:, None]) @ _ROTATION.T / precision) @ _ROTATION
        along = Z @ A
        moved, g = g, along + level
        if np.abs(g - moved).max() < _ENOUGH:
            break
    explained = _PRIOR_VAR - 1.0 / precision
    return replace(
        prior, projection=V.T @ prior.projection, weights=A.T.copy(), reduction=(explained @ _ROTATION**2).T.copy()
    )


def log_ratio(gp: ProjectedGP, inputs: Array) -> Array:
    """(n, 6) log of the expected variance ratio: the mean of a log-normal adds half the posterior's variance."""
    mean, variance = gp.evaluate(inputs)
    return mean + 0.5 * variance
