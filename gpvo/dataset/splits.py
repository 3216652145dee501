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
