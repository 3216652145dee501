"""Training sets as training needs them: those that belong together, and nothing in them that it cannot learn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gpvo.dataset.build import TrainingSet
from gpvo.errors import GpvoError
from gpvo.geometry.covariance import where_stated
from gpvo.online.features import AXES
from gpvo.stats.consistency import SEEN, least_seen, rms

_STRETCH, _CLEARLY = 10, 100.0


def checked(sets: Sequence[TrainingSet], target: str) -> list[TrainingSet]:
    """With different names, errors on every axis, and covariances that errors can be held against. Raises GpvoError
    where they do not belong together."""
    if not sets:
        raise GpvoError("there is no run to train on", cure="gpvo train RUN... -o MODEL")
    other = next((s for s in sets if s.target != target), None)
    if other is not None:
        raise GpvoError(
            f"holds rows of the target '{other.target}', not '{target}'",
            where=other.name,
            cure=f"--target {other.target}",
        )
    names = [s.name for s in sets]
    if len(set(names)) < len(names):
        sets = [replace(s, name=f"{s.name}#{i}") if names.count(s.name) > 1 else s for i, s in enumerate(sets)]
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
