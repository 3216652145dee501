"""The third stage: models, each a file named by what it was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gpvo.dataset.build import TrainingSet, build_run
from gpvo.io.run import read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.position import train_position
from gpvo.learning.train import train_sets
from gpvo.online import modelfile
from gpvo.online.features import resolve
from gpvo.reproduce.store import Store, digest_of

Lacking = Literal["", "imu", "geometry"]


@dataclass(frozen=True)
class ModelJob:
    """A model to fit: ``kind`` of target, from runs, on logs that lack a group of inputs (for the ablation)."""

    name: str
    kind: Literal["learned", "position"]
    runs: tuple[Path, ...]
    features: str = "auto"
    lacking: Lacking = ""

    def path(self, store: Store) -> Path:
        """Where the model lies; the names of runs hold the digests of their flights."""
        key = digest_of(self.kind, [p.name for p in self.runs], self.features, self.lacking)
        return store.folder("models") / f"{self.name}-{key}.gpvo"


def fit(job: ModelJob, store: Store) -> Path:
    """Fit and save, unless it is there."""
    path = job.path(store)
    if path.is_file():
        return path
    if job.kind == "position":
        config = TrainConfig(features="thesis", target="position")
        trained = train_position([build_run(read_run(p), target="position") for p in job.runs], config, judge=False)
    else:
        sets = sets_of(job.runs, job.lacking)
        trained = train_sets(sets, TrainConfig(features=job.features), judge=False)
    modelfile.save(path, trained.arrays, trained.header)
    return path


def without(s: TrainingSet, lacking: Lacking) -> TrainingSet:
    """The same rows as of a vehicle without IMU, or of an odometry without geometric covariance."""
    if not lacking:
        return s
    if lacking == "imu":
        gone = set(resolve("imu"))
        kept = s.covariances
    else:
        gone = {c for c in s.columns if c.startswith(("ln_var_", "ln_det_"))}
        kept = {}
    X = s.X.copy()
    X[:, [c in gone for c in s.columns]] = np.nan
    return replace(s, X=X, covariances=kept)


def sets_of(runs: Sequence[Path], lacking: Lacking = "") -> list[TrainingSet]:
    """Training sets of runs."""
    return [without(build_run(read_run(p)), lacking) for p in runs]
