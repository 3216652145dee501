"""Folds for out-of-fold residuals: whole groups, or blocks of consecutive rows where there is only one group."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
