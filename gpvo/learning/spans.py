"""Errors in unbroken chains of motions, and how they add up over 1, 2, 5, ... of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.stats.series import moving_sums
from gpvo.types import Array

Chains = Sequence[Sequence[NDArray[Any]]]
"""Per sequence its unbroken chains of motions, (n_i, D) each."""

SPANS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
_MIN_WINDOWS, _MAX_DOUBT = 3.0, 1.0
_SAME_NS, _LEAST = 1000, 12


@dataclass(frozen=True)
class SpanVariances:
    """``spans`` (S,) that occur; ``mean_square`` (S, D) of sums over each; ``doubt`` (S, D): squared relative standard
    error of that, by which sequences differ or, where they are few, by the number of separate windows."""

    spans: NDArray[np.int64]
    mean_square: Array
    doubt: Array

    def widening(self, tau: float) -> Array:
        """(S, D) factor on the stated variance of an unseen sequence, errors being correlated over ``tau`` frames.

        A square over an uncertain variance ``v`` is too large by ``1 + var(v) / v^2`` on average. Sums over more than
        two time constants consist of shorter ones, which are known better, and have the relative doubt of those.
        """
        last = max(int((self.spans <= 2.0 * tau).sum()) - 1, 0)
        return np.asarray(1.0 + self.doubt[np.minimum(np.arange(len(self.spans)), last)])


def at_most(values: Chains, limit: int) -> Chains:
    """At most that many rows, equally many from the beginning of each sequence, so that every place and scenario is
    represented."""
    out = []
    for chains in values:
        kept, left = [], max(limit // len(values), 1)
        for chain in chains:
            kept.append(chain[:left])
            left -= len(kept[-1])
        out.append(kept)
    return out


def cut(values: NDArray[Any], m: int) -> NDArray[Any]:
    """(w, m, ...) separate windows of m rows; what is left over is dropped."""
    return values[: len(values) // m * m].reshape(-1, m, *values.shape[1:])


def span_variances(z: Chains) -> SpanVariances:
    """Of the sums over each of :data:`SPANS` that occurs three times at least; sequences count by their length.

    Raises GpvoError for fewer motions than tell how six axes are correlated.
    """
    if sum(len(chain) for chains in z for chain in chains) < _LEAST:
        what = "too few motions begin where one before ends, as of a vehicle that hardly moves"
        raise GpvoError(what, cure="train on runs in which it moves")
    spans, mean_square, doubt = [], [], []
    for m in SPANS:
        long = [[chain for chain in chains if len(chain) >= m] for chains in z]
        squares = np.array(
            [np.concatenate([moving_sums(c, m) ** 2 for c in some]).mean(axis=0) for some in long if some]
        )
        windows = np.array([sum(len(c) for c in some) / m for some in long if some])
        if windows.sum() >= _MIN_WINDOWS:
            weight = windows / windows.sum()
            mean = np.maximum(weight @ squares, 1e-12)
            between = (weight**2) @ (squares / mean - 1.0) ** 2
            spans.append(m)
            mean_square.append(mean)
            doubt.append(np.clip(by_block(between), 2.0 / windows.sum(), _MAX_DOUBT))
    return SpanVariances(np.array(spans), np.array(mean_square), np.array(doubt))


def by_block(values: Array) -> Array:
    """(D,) each block of three axes at its mean: three axes show better than one how much sequences differ."""
    out = values.copy()
    for start in range(0, len(out), 3):
        out[start : start + 3] = out[start : start + 3].mean()
    return out


def chains(t_ns: NDArray[np.int64], dt_s: Array) -> list[NDArray[np.int64]]:
    """Rows of the motions that add up to the path, in unbroken chains: each starts where the one before ended.

    A vehicle that hardly moves keeps its reference, and several motions start there; only the last of them leads on.
    """
    if len(t_ns) == 0:
        return []
    begins = t_ns - np.round(dt_s * 1e9).astype(np.int64)
    last_of_reference = np.append(np.abs(np.diff(begins)) > _SAME_NS, True)
    rows = np.flatnonzero(last_of_reference)
    breaks = np.flatnonzero(np.abs(begins[rows[1:]] - t_ns[rows[:-1]]) > _SAME_NS) + 1
    return list(np.split(rows, breaks))
