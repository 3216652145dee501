"""Two studies of the learned model: a learning curve over training flights, and an ablation of its inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpvo.reproduce.flights import Flights
from gpvo.reproduce.models import Lacking, LikelihoodJob, ModelJob
from gpvo.reproduce.plan import Mode, Plan
from gpvo.reproduce.stages import Store, Workers
from gpvo.stats.bootstrap import sequence_bootstrap
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


def document(studies: Studies | None) -> dict[str, Any] | None:
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
