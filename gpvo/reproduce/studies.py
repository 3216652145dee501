"""Two studies of the learned model: a learning curve over training flights, and an ablation of its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.reproduce import likelihood
from gpvo.reproduce.learn import Lacking, ModelJob, fit
from gpvo.reproduce.likelihood import LikelihoodJob, judge
from gpvo.reproduce.plan import Mode, Plan
from gpvo.reproduce.run import Flights, Workers
from gpvo.reproduce.store import Store
from gpvo.stats.bootstrap import Interval, sequence_bootstrap
from gpvo.types import Array

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
    # Every other training flight is noisy: the curve compares worlds, not noise.
    other = flights.runs("tunnel-training", mode, "fast")[0::2]
    test = flights.runs("same-path", mode, "fast")
    mixed = flights.runs("tunnel-training", mode, "fast")
    held_out = (*flights.runs("tunnel", mode, "fast"), *flights.runs("tunnel-noisy", mode, "fast"))
    if not (same and other and test and held_out):
        return None
    counts = [n for n in plan.curve if n <= min(len(same), len(other))]
    curve = {
        kind: {n: (ModelJob(f"curve-{mode}-{n}", "learned", runs[:n]), test) for n in counts}
        for kind, runs in ((SAME, same), (OTHER, other))
    }
    ablation = {
        name: (ModelJob(f"ablation-{mode}", "learned", mixed, features, lacking), held_out)
        for name, (features, lacking) in ABLATION.items()
    }
    pairs = [*(pair for by_count in curve.values() for pair in by_count.values()), *ablation.values()]
    workers.map("models of the studies", fit, [(m, store) for m in dict.fromkeys(m for m, _ in pairs)])
    jobs = [_judgement(m, runs, store) for m, runs in pairs]
    workers.map("likelihoods", judge, [(j, store) for j in jobs])

    def found(pair: tuple[ModelJob, tuple[Path, ...]]) -> Array:
        return likelihood.load(_judgement(*pair, store), store)

    return Studies(
        mode,
        {kind: {n: found(pair) for n, pair in by_count.items()} for kind, by_count in curve.items()},
        {name: found(pair) for name, pair in ablation.items()},
    )


def _judgement(model: ModelJob, runs: tuple[Path, ...], store: Store) -> LikelihoodJob:
    return LikelihoodJob(model.path(store), runs, model.lacking)


def gain(better: Array, worse: Array) -> Interval:
    """By how many nats per axis the first is better, over flights, with a bootstrap interval in pairs."""
    return sequence_bootstrap(worse - better)


def document(studies: Studies | None) -> dict[str, Any] | None:
    """The studies as scripts read them."""
    if studies is None:
        return None
    return {
        "mode": studies.mode,
        "curve": {
            kind: [{"flights": n, "nll_per_dim": float(v.mean()), "interval": _mean(v)} for n, v in by_count.items()]
            for kind, by_count in studies.curve.items()
        },
        "ablation": {
            name: {"nll_per_dim": float(v.mean()), "interval": _mean(v)} for name, v in studies.ablation.items()
        },
    }


def _mean(values: Sequence[float] | Array) -> list[float] | None:
    found = sequence_bootstrap(np.asarray(values))
    return None if not np.isfinite(found.low) else [found.low, found.high]
