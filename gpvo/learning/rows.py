"""Stacked training rows of several sequences, with the groups that cross-validation leaves out, and the single rule
by which training replaces a simpler model by another: held-out gain above its standard error."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.dataset.build import TrainingSet, group_labels
from gpvo.geometry import se3
from gpvo.learning.spans import chains
from gpvo.online.base import TWIST_COLUMNS
from gpvo.types import Array


@dataclass(frozen=True)
class Rows:
    """All training rows of several sequences, stacked, with the groups that cross-validation leaves out."""

    sets: Sequence[TrainingSet]
    error: Array
    dt_s: Array
    group: NDArray[np.int64]
    grouped_by: str
    weight: Array

    @classmethod
    def stack(cls, sets: Sequence[TrainingSet]) -> Rows:
        """The rows of all sequences, one after the other."""
        group, by = group_labels([len(s) for s in sets])
        # Every sequence counts alike, however long: a new sequence is what the model will meet.
        weight = np.concatenate([np.full(len(s), 1.0 / len(s)) for s in sets])
        error, dt = np.concatenate([s.Y for s in sets]), np.concatenate([s.dt_s for s in sets])
        return cls(sets, error, dt, group, by, weight / weight.mean())

    def only(self, kept: NDArray[np.bool_]) -> Rows:
        """Those of the rows (n,) that are kept."""
        return Rows.stack([s.rows(of) for s, of in self._by_set(kept) if of.any()])

    @property
    def step_s(self) -> float:
        """Usual duration of a motion."""
        return float(np.median(self.dt_s))

    def select(self, names: Sequence[str]) -> Array:
        """(n, d) values of the named features."""
        return np.concatenate([s.select(names) for s in self.sets])

    @property
    def steps(self) -> Array:
        """(n,) durations in usual ones."""
        return self.dt_s / self.step_s

    def motions(self) -> Array:
        """(n, 4, 4) VO's motions ``T_prev_cur``; the identity where the velocity is unknown."""
        twist = self.select(TWIST_COLUMNS) * self.dt_s[:, None]
        return se3.exp(np.where(np.isfinite(twist), twist, 0.0))

    def geometry(self, method: str | None) -> Array | None:
        """(n, 6, 6) covariances by a method, NaN where unknown; None for no method."""
        return None if method is None else np.concatenate([s.covariances[method] for s in self.sets])

    def by_group(self, values: Array) -> Array:
        """Means of (n, ...) over each group, (G, ...)."""
        return np.array([values[self.group == g].mean(axis=0) for g in np.unique(self.group)])

    def chains(self, values: NDArray[Any]) -> list[list[NDArray[Any]]]:
        """Rows of (n, ...) of each sequence, in unbroken chains of motions."""
        return [[own[rows] for rows in chains(s.t_ns, s.dt_s)] for s, own in self._by_set(values)]

    def _by_set(self, values: NDArray[Any]) -> Iterator[tuple[TrainingSet, NDArray[Any]]]:
        return zip(self.sets, np.split(values, np.cumsum([len(s) for s in self.sets])[:-1]))


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
