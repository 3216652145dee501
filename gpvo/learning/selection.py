"""Which groups are left out together, and the one rule by which training leaves a simpler model for another: held-out
gain above its standard error."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.types import Array

Candidate = TypeVar("Candidate", bound=Hashable)


def significant_gain(gain_by_group: ArrayLike) -> bool:
    """Whether the mean of gains (G,), one per held-out group, is more than its standard error.

    L. Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3. Never with fewer than two groups.
    """
    gain = np.asarray(gain_by_group, dtype=np.float64)
    return len(gain) > 1 and bool(gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)))


def simplest_sufficient(loss_by_group: Mapping[Candidate, Array]) -> Candidate:
    """The first candidate that the best one does not beat by a significant gain; ``loss_by_group`` (G,) of each,
    simplest first."""
    best = min(loss_by_group.values(), key=np.mean)
    return next(name for name, loss in loss_by_group.items() if not significant_gain(loss - best))


def group_folds(groups: NDArray, max_folds: int) -> NDArray[np.int64]:
    """(n,) fold of each row: no group is split, and folds are of similar size (largest group first, to the smallest
    fold).

    With one group alone: ``max_folds`` blocks of consecutive rows.
    """
    _, label, count = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    n = len(label)
    if len(count) < 2:
        return np.minimum(np.arange(n) * max_folds // max(n, 1), max_folds - 1).astype(np.int64)
    n_folds = min(max_folds, len(count))
    load, fold_of = np.zeros(n_folds), np.zeros(len(count), dtype=np.int64)
    for group in np.argsort(-count, kind="stable"):
        fold_of[group] = np.argmin(load)
        load[fold_of[group]] += count[group]
    return fold_of[label]
