"""Training settings, and the sets of inputs among which training chooses by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gpvo.dataset.build import TrainingSet, build_run
from gpvo.errors import GpvoError
from gpvo.io.run_read import Run
from gpvo.online.base import ACCELERATION_COLUMNS, RESIDUAL_COLUMN, TWIST_COLUMNS
from gpvo.online.features import AXES, GEOMETRIC_METHODS, groups, resolve
from gpvo.types import IMPORTED

AGILITY = ("ln_speed", "ln_turn_rate", "ln_jerk", "ln_angular_jerk", "ln_jerk_lately", "ln_angular_jerk_lately")
TRACKING = ("n_inliers", "inlier_ratio", "ln_disparity_p50", "spread_u", "spread_v", "ln_reproj_rms")
IMAGE = ("sharpness", "noise_level", "brightness", "contrast")

FAMILIES: dict[str, tuple[str, ...]] = {
    "speed": AGILITY[:2],
    "agility": AGILITY,
    "tracking": TRACKING,
    "image": IMAGE,
    "all": (*AGILITY, *TRACKING, *IMAGE),
}
"""What ``features="auto"`` chooses among, simplest first, besides no inputs at all: the base variance alone."""

GUARDED = (*TWIST_COLUMNS, *TRACKING, *ACCELERATION_COLUMNS, *IMAGE[:2])
"""Columns by which a model recognises familiar surroundings, even if no GP needs them: unfamiliar ones show here
first."""


@dataclass(frozen=True)
class TrainConfig:
    """``features``: ``auto`` (by cross-validation over the sequences), ``thesis``, ``full`` or names with commas.

    ``target``: ``frame``, ``window:1s``, ``length:1m`` or ``position``. ``regressor``, ``inducing``: of positions, the
    latter the points of its GP. ``align``: ``rotation`` or ``transform`` first fits that between each log and its
    truth, to whose clock ``time_offset_s`` brings the log, None by an estimate. ``waits``: ``drop`` leaves out waits in
    which the truth moves; ``odd`` does the same for stretches in which odometry and truth differ far more than
    elsewhere. ``max_rows``: held in memory; the rest of larger files is streamed. ``jobs``, ``backend`` (``local`` or
    ``dask``), ``scheduler``: where folds are fitted. ``keep``: folder for finished folds, which an interrupted training
    does not fit again; None keeps none.
    """

    features: str = "auto"
    target: str = "frame"
    regressor: str = "auto"
    seed: int = 0
    align: str = "none"
    time_offset_s: float | None = 0.0
    waits: str = "drop"
    odd: str = "keep"
    inducing: int = 256
    max_rows: int = 100_000
    jobs: int = 1
    backend: str = "local"
    scheduler: str | None = None
    keep: str | None = None

    def settings(self) -> dict[str, Any]:
        """Those that determine the model, not where its folds are fitted and kept."""
        left_out = ("jobs", "backend", "scheduler", "keep", *(["time_offset_s"] if self.time_offset_s == 0.0 else []))
        return {k: v for k, v in asdict(self).items() if k not in left_out}

    def rows_of(self, run: TrainingSet | Run | str | Path) -> TrainingSet:
        """The training set of a run, or of its folder, under these settings; one that is made already is returned."""
        if isinstance(run, TrainingSet):
            return run
        how: dict[str, Any] = {k: getattr(self, k) for k in ("target", "align", "time_offset_s", "waits", "odd")}
        return build_run(run, **how)


def known_to_all(sets: Sequence[TrainingSet]) -> set[str]:
    """Columns that every log knows in 95 of 100 rows."""
    return set.intersection(*(s.supported() for s in sets))


def supported_columns(sets: Sequence[TrainingSet], wanted: Sequence[str]) -> tuple[str, ...]:
    """Those of the wanted columns that every log knows and that are not constant."""
    known = known_to_all(sets)

    def varies(name: str) -> bool:
        values = [s.select((name,)) for s in sets]
        return max(float(abs(v[v == v] - v[v == v][0]).max()) for v in values if (v == v).any()) > 1e-9

    return tuple(n for n in wanted if n in known and varies(n))


def candidates(sets: Sequence[TrainingSet], config: TrainConfig) -> dict[str, tuple[str, ...]]:
    """Named sets of inputs to try, each without what the logs lack. Raises GpvoError if nothing is left."""
    asked = FAMILIES if config.features == "auto" else {config.features: config.features}
    out: dict[str, tuple[str, ...]] = {}
    for name, selection in asked.items():
        columns = supported_columns(sets, resolve(selection))
        if columns and columns not in out.values():
            out[name] = columns
    if not out:
        raise GpvoError(f"the logs hold none of the features '{config.features}'", cure="choose others with --features")
    return out


def guarded(sets: Sequence[TrainingSet], config: TrainConfig) -> tuple[str, ...]:
    """Those of :data:`GUARDED` that the logs know; none besides those that were asked for by name. One that never
    varied is among them: nothing was learned at any other value."""
    known = known_to_all(sets)
    return tuple(n for n in GUARDED if n in known) if config.features == "auto" else ()


def lacking(sets: Sequence[TrainingSet], config: TrainConfig) -> dict[str, list[str]]:
    """By sequence, the groups of features that other sequences know and it does not, for which no model learns from
    them: a base covariance or an input of the settings, or what tells other surroundings."""
    asked = GUARDED if config.features == "auto" else resolve(config.features)
    wanted = {*asked, RESIDUAL_COLUMN, *(f"ln_var_{m}_{a}" for m in (*GEOMETRIC_METHODS, IMPORTED) for a in AXES)}
    known = set.union(*(s.supported() for s in sets)) & wanted
    of = {c.name: name for name, parts in groups().items() for group in parts for c in group.columns}
    out = {s.name: sorted({of[column] for column in known - s.supported()}) for s in sets}
    return {name: missing for name, missing in out.items() if missing}


def base_candidates(sets: Sequence[TrainingSet]) -> list[tuple[str | None, bool]]:
    """Bases to choose among, from columns that every log knows in 95 of 100 rows: geometric and imported covariances,
    at one pixel and at the noise of the residuals, and the motion alone. A covariance that never changes says nothing
    about a motion."""
    known = known_to_all(sets)
    columns = {m: {f"ln_var_{m}_{a}" for a in AXES} for m in (*GEOMETRIC_METHODS, IMPORTED)}
    tell = supported_columns(sets, sorted(set.union(*columns.values())))
    methods = [m for m, own in columns.items() if own <= known and own.intersection(tell)]
    noise = (False, True) if RESIDUAL_COLUMN in known else (False,)
    return [*((m, residual) for m in methods for residual in noise), (None, False)]
