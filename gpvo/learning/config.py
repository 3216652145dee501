"""Training settings, and the sets of inputs among which training chooses by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from gpvo.errors import GpvoError
from gpvo.io.run_read import Run
from gpvo.online.base import ACCELERATION_COLUMNS, RESIDUAL_COLUMN, TWIST_COLUMNS
from gpvo.online.features import AXES, GEOMETRIC_METHODS, groups, resolve
from gpvo.types import IMPORTED

if TYPE_CHECKING:
    from gpvo.dataset.build import TrainingSet

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
    """What is learned, from which rows; what ``gpvo train`` has an option for, with its help.

    ``features``: ``auto`` chooses by cross-validation over the sequences. ``inducing``: points of the GP of positions.
    ``time_offset_s`` brings each log to the clock of its truth, None by an estimate. ``jobs``, ``backend`` (``local``
    or ``dask``), ``scheduler``: where folds are fitted. ``keep``: folder for finished folds, which an interrupted
    training does not fit again; None keeps none.
    """

    features: Annotated[str, "auto, thesis, full, or a list of groups and columns."] = "auto"
    target: Annotated[str, "frame, window:1s, length:1m or position."] = "frame"
    regressor: Annotated[str, "Regressor for --target position: auto, exact, sparse, svgp or sklearn."] = "auto"
    seed: Annotated[int, "Random seed."] = 0
    align: Annotated[str, "First fit between log and truth: a fixed rotation, transform (with lever arm) or none."] = (
        "none"
    )
    time_offset_s: float | None = 0.0
    waits: Annotated[str, "--stationary", "--waits", "Motions where truth wanders at rest, or jumps: drop or keep."] = (
        "drop"
    )
    odd: Annotated[str, "Stretches where odometry and truth differ far more than elsewhere: keep or drop."] = "keep"
    inducing: int = 256
    max_rows: Annotated[int, "Rows held in memory; more are streamed in blocks.", {"min": 1000}] = 100_000
    jobs: int = 1
    backend: str = "local"
    scheduler: str | None = None
    keep: str | None = None

    def settings(self) -> dict[str, Any]:
        """Those that determine the model, not where its folds are fitted and kept."""
        left_out = ("jobs", "backend", "scheduler", "keep", *(["time_offset_s"] if self.time_offset_s == 0.0 else []))
        return {k: v for k, v in asdict(self).items() if k not in left_out}

    def refuse_unknown(self) -> None:
        """Raise GpvoError, before rows are made, for features or a regressor that there are not."""
        from gpvo.learning.regressors import get_regressor

        if self.features != "auto":
            resolve(self.features)
        if self.target == "position":
            get_regressor(self.regressor)

    def rows_of(self, run: TrainingSet | Run | str | Path) -> TrainingSet:
        """The training set of a run, or of its folder, under these settings; one that is made already is returned."""
        from gpvo.dataset.build import TrainingSet, build_run  # of odometry, which the options alone do not need

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
