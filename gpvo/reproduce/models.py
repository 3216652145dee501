"""Models of training flights, and how likely they find the errors of other flights: a learning curve over training
flights, and an ablation of the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gpvo.dataset.build import TrainingSet, build_run
from gpvo.files import write_arrays
from gpvo.io.run import read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.online import modelfile
from gpvo.online.features import resolve
from gpvo.online.predictor import Predictor
from gpvo.reproduce.experiments import Mode, Plan
from gpvo.reproduce.flights import Flights
from gpvo.reproduce.stages import Store, Workers, digest_of
from gpvo.stats.consistency import nll_per_dim
from gpvo.stats.series import sequence_bootstrap
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
            trained = train_sets(sets, config, judge=False)
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
            found.append(float(nll_per_dim(s.Y, stated.covariance).mean()))
        write_arrays(path, {"nll_per_dim": np.array(found)})

    def load(self, store: Store) -> Array:
        """(n,) of every flight."""
        with np.load(self.path(store), allow_pickle=False) as data:
            return np.asarray(data["nll_per_dim"], dtype=np.float64)


def sets_of(runs: Sequence[Path], lacking: Lacking = "") -> list[TrainingSet]:
    """Training sets of runs, as of a vehicle without IMU, or of an odometry without geometric covariance."""
    out = []
    for s in (build_run(read_run(p)) for p in runs):
        if lacking:
            imu, X = resolve("imu"), s.X.copy()
            geometry = lacking == "geometry"
            gone = [c.startswith(("ln_var_", "ln_det_")) if geometry else c in imu for c in s.columns]
            X[:, gone] = np.nan
            s = replace(s, X=X, covariances={} if geometry else s.covariances)
        out.append(s)
    return out


SAME, OTHER = "same world and path", "other worlds"
ABLATION: dict[str, tuple[str, Lacking]] = {
    "all inputs": ("full", ""),
    "without IMU": ("full", "imu"),
    "without geometric covariance": ("full", "geometry"),
    "velocity and feature count": ("thesis", ""),
}


@dataclass(frozen=True)
class Studies:
    """Negative log-likelihood per axis of every test flight: ``curve`` by kind of training and number of flights,
    ``ablation`` by inputs. ``mode``: of the flights."""

    mode: Mode
    curve: Mapping[str, Mapping[int, Array]]
    ablation: Mapping[str, Array]


def run_studies(plan: Plan, flights: Flights, store: Store, workers: Workers) -> Studies | None:
    """Fit and judge every model of both studies, on points where there are any: many flights tell more."""
    mode: Mode = "points" if "points" in plan.modes else "images"
    same = flights.runs("same-path-training", mode, "fast")
    mixed = flights.runs("tunnel-training", mode, "fast")
    # Every other training flight is noisy: the curve compares worlds, not noise.
    other = mixed[0::2]
    test = flights.runs("same-path", mode, "fast")
    held_out = (*flights.runs("tunnel", mode, "fast"), *flights.runs("tunnel-noisy", mode, "fast"))
    if not (same and other and test and held_out):
        return None
    counts = [n for n in plan.curve if n <= min(len(same), len(other))]
    curve = {
        kind: {n: LikelihoodJob(ModelJob(f"curve-{mode}-{n}", "learned", runs[:n]), test) for n in counts}
        for kind, runs in ((SAME, same), (OTHER, other))
    }
    ablation = {
        name: LikelihoodJob(ModelJob(f"ablation-{mode}", "learned", mixed, features, lacking), held_out)
        for name, (features, lacking) in ABLATION.items()
    }
    jobs = [*(job for by_count in curve.values() for job in by_count.values()), *ablation.values()]
    workers.keep("models of the studies", [job.model for job in jobs], store)
    workers.keep("likelihoods", jobs, store)
    return Studies(
        mode,
        {kind: {n: job.load(store) for n, job in by_count.items()} for kind, by_count in curve.items()},
        {name: job.load(store) for name, job in ablation.items()},
    )


def studies_document(studies: Studies | None) -> dict[str, Any] | None:
    """The studies as scripts read them."""
    if studies is None:
        return None
    curve = {
        kind: [{"flights": n, **_mean(v)} for n, v in by_count.items()] for kind, by_count in studies.curve.items()
    }
    return {"mode": studies.mode, "curve": curve, "ablation": {n: _mean(v) for n, v in studies.ablation.items()}}


def _mean(nll_per_dim: Array) -> dict[str, Any]:
    found = sequence_bootstrap(nll_per_dim)
    interval = None if not np.isfinite(found.low) else [found.low, found.high]
    return {"nll_per_dim": float(nll_per_dim.mean()), "interval": interval}
