"""Models of training flights, and how likely they find the errors of other flights."""

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
from gpvo.online.predictor import Predictor
from gpvo.reproduce.stages import Store, digest_of, write_arrays
from gpvo.stats.consistency import nll_per_dim
from gpvo.types import Array

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
        """Where the model lies."""
        key = digest_of(self.kind, [p.name for p in self.runs], self.features, self.lacking)
        return store.folder("models") / f"{self.name}-{key}.gpvo"

    def make(self, path: Path, store: Store) -> None:
        """Fit and save."""
        if self.kind == "position":
            config = TrainConfig(features="thesis", target="position")
            sets = [build_run(read_run(p), target="position") for p in self.runs]
            trained = train_position(sets, config, judge=False)
        else:
            sets = sets_of(self.runs, self.lacking)
            trained = train_sets(sets, TrainConfig(features=self.features), judge=False)
        modelfile.save(path, trained.arrays, trained.header)


@dataclass(frozen=True)
class LikelihoodJob:
    """A learned model over test runs, whose logs lack the group of inputs that those of its training do."""

    model: ModelJob
    runs: tuple[Path, ...]

    def path(self, store: Store) -> Path:
        """Where the result lies."""
        model = self.model.path(store)
        key = digest_of(model.name, [p.name for p in self.runs], self.model.lacking)
        return store.folder("likelihoods") / f"{model.stem}-{key}.npz"

    def make(self, path: Path, store: Store) -> None:
        """Mean negative log-likelihood per axis [nats] of every flight, saved."""
        model = Predictor.load(self.model.path(store)).model
        found = []
        for s in sets_of(self.runs, self.model.lacking):
            stated = model.estimate(s.select(model.columns), s.covariances.get(model.base.method or ""), s.dt_s)
            found.append(float(nll_per_dim(s.Y - stated.mean, stated.covariance).mean()))
        write_arrays(path, {"nll_per_dim": np.array(found)})

    def load(self, store: Store) -> Array:
        """(n,) of every flight."""
        with np.load(self.path(store), allow_pickle=False) as data:
            return np.asarray(data["nll_per_dim"], dtype=np.float64)


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
