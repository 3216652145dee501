"""How likely the errors of each motion are under a model: for learning curves and ablations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.online.predictor import Predictor
from gpvo.reproduce.learn import Lacking, sets_of
from gpvo.reproduce.store import Store, digest_of, write_arrays
from gpvo.stats.consistency import nll_per_dim
from gpvo.types import Array


@dataclass(frozen=True)
class LikelihoodJob:
    """A learned model over test runs whose logs lack a group of inputs, as those of its training do."""

    model: Path
    runs: tuple[Path, ...]
    lacking: Lacking = ""

    def path(self, store: Store) -> Path:
        """Where the result lies."""
        key = digest_of(self.model.name, [p.name for p in self.runs], self.lacking)
        return store.folder("likelihoods") / f"{self.model.stem}-{key}.npz"


def judge(job: LikelihoodJob, store: Store) -> Path:
    """Mean negative log-likelihood per axis [nats] of every flight, saved, unless it is there."""
    path = job.path(store)
    if not path.is_file():
        write_arrays(path, {"nll_per_dim": _nll(job)})
    return path


def load(job: LikelihoodJob, store: Store) -> Array:
    """(n,) of every flight."""
    with np.load(job.path(store), allow_pickle=False) as data:
        return np.asarray(data["nll_per_dim"], dtype=np.float64)


def _nll(job: LikelihoodJob) -> Array:
    model = Predictor.load(job.model).model
    out = []
    for s in sets_of(job.runs, job.lacking):
        said = model.estimate(s.select(model.columns), s.covariances.get(model.base.method or ""), s.dt_s)
        out.append(float(nll_per_dim(s.Y - said.mean, said.covariance).mean()))
    return np.array(out)
