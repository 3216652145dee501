"""Splits by sequence, and by time block where there are too few sequences; never by random rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")

MIN_SEQUENCES = 3
BLOCKS = 6


def leave_one_out(items: Sequence[T]) -> Iterator[tuple[T, list[T]]]:
    """Each item held out once, with all the others."""
    for k, item in enumerate(items):
        yield item, [other for i, other in enumerate(items) if i != k]


def group_labels(lengths: Sequence[int]) -> tuple[NDArray[np.int64], str]:
    """Labels (sum of lengths,) of the groups that cross-validation leaves out, and what they are.

    Sequences, or with fewer than three of them ``BLOCKS`` blocks of consecutive rows of each.
    """
    if len(lengths) >= MIN_SEQUENCES:
        return np.repeat(np.arange(len(lengths)), lengths), "sequences"
    labels = [i * BLOCKS + np.arange(n) * BLOCKS // max(n, 1) for i, n in enumerate(lengths)]
    return np.concatenate(labels).astype(np.int64), "time blocks"


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
