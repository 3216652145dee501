"""Calibration from residuals of sequences that the model has not seen: scale, growth outside, conformal intervals.

A new sequence is a new draw: the spread of the scale between sequences enters the stated variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.spans import by_block
from gpvo.online.guard import growth
from gpvo.stats import student_t
from gpvo.stats.consistency import nees
from gpvo.types import Array

LEVELS = (0.5, 0.6827, 0.8, 0.9, 0.95)
# Standard deviation of the log variance between flights of one vehicle, and how many groups that guess is worth.
_PRIOR_SPREAD, _PRIOR_GROUPS = 0.3, 2
_FAR_BELOW = 3.0  # of the log variance: ten prior spreads
_OUTSIDE, _MOST_OUTSIDE = 0.5, 5.0
_POWERS = (1.0, 1.25, 1.5, 2.0)


@dataclass(frozen=True)
class Scale:
    """The scale of the variance of a new group, a random effect.

    ``factor`` (D,) on the stated variance; ``spread`` (D,): standard deviation of the log scale between groups;
    ``by_group`` (G, D): the scale of each.
    """

    factor: Array
    spread: Array
    by_group: Array

    @classmethod
    def of_new_group(cls, by_group: Array) -> Scale:
        """From the scales (G, D) of groups that no fit has seen.

        The log scale of a group is taken as normal; the mean of its log-normal over a new group, whose centre is itself
        known from G groups, is ``exp(m + s^2 (1 + 1/G) / 2)``. The spread is that of each block of three axes, drawn
        towards the prior: few groups cannot show how much groups differ. One whose errors vanish, as of a vehicle at
        rest, counts as ``_FAR_BELOW`` under the median: it does not show how large they can be.
        """
        logs, G = np.log(np.maximum(by_group, 1e-300)), len(by_group)
        logs = np.maximum(logs, np.median(logs, axis=0) - _FAR_BELOW)
        seen = by_block(logs.var(axis=0, ddof=1)) if G > 1 else np.zeros(logs.shape[1])
        spread = np.sqrt((_PRIOR_GROUPS * _PRIOR_SPREAD**2 + (G - 1) * seen) / (_PRIOR_GROUPS + G - 1))
        return cls(np.exp(logs.mean(axis=0) + 0.5 * spread**2 * (1.0 + 1.0 / G)), spread, by_group)


def fit_scale(z: Array, group: NDArray) -> Scale:
    """Scale of the variance of each axis, from normalised residuals z (n, D)."""
    of = [z[group == g] ** 2 for g in np.unique(group)]
    return Scale.of_new_group(np.array([student_t.second_moment(square) for square in of]))


def fit_outside_power(distance: Array, square: Array, group: NDArray) -> float:
    """Power of the growth (see ``guard.growth``) with the ``distance`` (n,) from the domain of the other groups.

    ``square`` (n,): mean over the axes of the squared normalised residuals. The power is at least one, the expected
    value: other surroundings differ in more ways than flights of one kind can show. A group's rows outside count as
    five at most, because they are correlated.
    """
    outside = distance > _OUTSIDE
    d, q, g = distance[outside], square[outside], group[outside]
    count = np.minimum(_MOST_OUTSIDE / np.maximum([(g == of).sum() for of in g], 1), 1.0)

    def loss(power: float) -> float:
        stated = growth(d, power)
        ratio = np.minimum(q / stated, 16.0)
        return float(3.0 * count @ (np.log(stated) + ratio) + 0.5 * np.log(power / _POWERS[0]) ** 2)

    return min(_POWERS, key=loss)


def fit_joint_factor(error: Array, covariance: Array, group: NDArray) -> float:
    """One more factor, which makes the joint NEES of all six axes right for a new group."""
    squared = nees(error, covariance) / error.shape[1]
    by_group = (squared[group == g] for g in np.unique(group))
    # Robust: the upper half per cent is replaced by the quantile there.
    means = np.array([[np.minimum(of, np.quantile(of, 0.995)).mean()] for of in by_group])
    return float(Scale.of_new_group(means).factor[0])


def conformal_quantiles(score: Array, group: NDArray) -> tuple[list[float], list[bool]]:
    """Half widths, in sigma, that cover a new group's frame at each of ``LEVELS``, and whether that is guaranteed.

    All groups count equally, and a new one counts too, as an unknown: Y. Lee, R. Barber, R. Willett, "Distribution-free
    inference with hierarchical data" (2023), equation 5. Where G groups are too few for a level (level > G / (G + 1))
    there is no finite guarantee: the pooled quantile is used and marked as such, never below that of a lower level.
    """
    labels, inverse, counts = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(score, kind="stable")
    weight = (1.0 / counts[inverse])[order]
    widths, sure = [], []
    for level in LEVELS:
        reached = np.cumsum(weight) / (len(labels) + 1)
        guaranteed = bool(reached[-1] >= level - 1e-12)
        if not guaranteed:
            reached = np.cumsum(weight) / len(labels)
        at = min(int(np.searchsorted(reached, level - 1e-12)), len(score) - 1)
        widths.append(float(score[order][at]))
        sure.append(guaranteed)
    return np.maximum.accumulate(widths).tolist(), sure
