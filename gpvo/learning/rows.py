"""Training sets that belong together, with nothing in them that training cannot learn from; their rows, stacked, with
the groups that cross-validation leaves out; and the single rule by which training replaces a simpler model by another:
held-out gain above its standard error.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.dataset.build import TrainingSet, group_labels
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.covariance import where_stated
from gpvo.learning.spans import chains
from gpvo.online.base import TWIST_COLUMNS
from gpvo.online.features import AXES
from gpvo.stats.consistency import SEEN, least_seen, rms
from gpvo.types import Array

_STRETCH, _CLEARLY = 10, 100.0


def of_target(sets: Sequence[TrainingSet], target: str) -> list[TrainingSet]:
    """With different names. Raises GpvoError where there is none, or one of another target."""
    if not sets:
        raise GpvoError("there is no run to train on", cure="gpvo train RUN... -o MODEL")
    other = next((s for s in sets if s.target != target), None)
    if other is not None:
        cure = f"--target {other.target}"
        raise GpvoError(f"holds rows of the target '{other.target}', not '{target}'", where=other.name, cure=cure)
    names = [s.name for s in sets]
    return [replace(s, name=f"{s.name}#{i}") if names.count(s.name) > 1 else s for i, s in enumerate(sets)]


def checked(sets: Sequence[TrainingSet], target: str) -> list[TrainingSet]:
    """With different names, errors on every axis, and covariances that errors can be held against. Raises GpvoError
    where they do not belong together."""
    names = [s.name for s in sets]
    sets = of_target(sets, target)
    # A motion spans several frames where odometry kept its reference; the shortest ones span one. How long a window
    # of path takes is a matter of speed.
    steps = [float(np.quantile(s.dt_s, 0.1)) for s in sets]
    if target == "frame" and max(steps) > 1.5 * min(steps):
        raise GpvoError(
            f"the runs differ in rate: {1 / max(steps):.3g} Hz ({names[int(np.argmax(steps))]}) and "
            f"{1 / min(steps):.3g} Hz ({names[int(np.argmin(steps))]})",
            cure="train one model per rate, or with --target window:1s",
        )
    _refuse_planar_among_others(sets)
    return [_where_stated(s) for s in _with_all_axes(sets)]


def _where_stated(s: TrainingSet) -> TrainingSet:
    """Without covariances that an error cannot be held against."""
    covariances, v_t = ({m: where_stated(C) for m, C in of.items()} for of in (s.covariances, s.v_t))
    return replace(s, covariances=covariances, v_t=v_t)


def _refuse_planar_among_others(sets: Sequence[TrainingSet]) -> None:
    """No feature tells a robot in a plane from one that is not. One that never moved is no matter."""
    size = np.array([rms(s.Y) for s in sets])
    least = np.array([least_seen(of) for of in size])
    flat = (size < least) & (size >= SEEN).any(axis=1, keepdims=True) & (size.max(axis=0) > _CLEARLY * least)
    for s, axes in zip(sets, flat, strict=True):
        if axes.any():
            names, other = [AXES[k] for k in np.flatnonzero(axes)], sets[int(size[:, axes].max(axis=1).argmax())].name
            raise GpvoError(
                f"log and truth never differ in {', '.join(names)} (planar?), but those of '{other}' do",
                where=s.name,
                cure="train one model for each kind of vehicle",
            )


def _with_all_axes(sets: Sequence[TrainingSet]) -> list[TrainingSet]:
    """Where errors of an axis are zero but for rounding for ``_STRETCH`` motions, as at rest or of a robot in a plane,
    noise too small to be seen stands for what the truth cannot show; seeded: the same rows give the same bytes."""
    unseen = 0.5 * least_seen(rms(np.concatenate([s.Y for s in sets])))
    rng, out = np.random.default_rng(0), []
    for s in sets:
        blocks = np.array_split(s.Y, max(len(s) // _STRETCH, 1))
        quiet = np.repeat([rms(b) < 0.1 * unseen for b in blocks], [len(b) for b in blocks], axis=0)
        out.append(replace(s, Y=s.Y + quiet * rng.normal(0.0, unseen, s.Y.shape)) if quiet.any() else s)
    return out


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


def significant_gain(gain_by_group: ArrayLike, errors: float = 1.0) -> bool:
    """Whether the mean of gains (G,), one per held-out group, is more than its standard error, or so many of them.

    L. Breiman et al., "Classification and Regression Trees" (1984), section 3.4.3. Never with fewer than two groups.
    """
    gain = np.asarray(gain_by_group, dtype=np.float64)
    return len(gain) > 1 and bool(gain.mean() > errors * gain.std(ddof=1) / np.sqrt(len(gain)))


def simplest_sufficient(loss_by_group: Mapping[Candidate, Array]) -> Candidate:
    """The first candidate that the best one does not beat by a significant gain; ``loss_by_group`` (G,) of each,
    simplest first."""
    best = min(loss_by_group.values(), key=np.mean)
    return next(name for name, loss in loss_by_group.items() if not significant_gain(loss - best))
