"""The fourth stage: what each way says of each test flight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gpvo.dataset.build import TrainingSet, build_run, observe
from gpvo.evaluation.evaluate import predictions_by_stamp
from gpvo.evaluation.statements import statements
from gpvo.io.run import Run, read_run
from gpvo.learning.methods import Statement, thesis_gp
from gpvo.online.features import THESIS
from gpvo.online.position import PositionPredictor
from gpvo.online.predictor import Predictor
from gpvo.reproduce.bounds import Bounds, as_arrays, bounds_of, compounded, mean_shift, summed_v_t
from gpvo.reproduce.experiments import Experiment, Way, printed
from gpvo.reproduce.learn import ModelJob, sets_of
from gpvo.reproduce.store import Store, digest_of, write_arrays
from gpvo.types import Array, MotionError, Status, VoLog
from gpvo.vo.config import pair_method

Kind = Literal["v_t", "joint", "position", "motion", "learned"]


@dataclass(frozen=True)
class Saying:
    """How the error of a position is stated: ``v_t`` summed (thesis), ``joint`` compounded, GP of the ``position``
    (thesis) or of each ``motion``, or the ``learned`` model."""

    kind: Kind
    method: str = ""

    @property
    def preset(self) -> str:
        """Of the odometry."""
        return "thesis" if self.kind in ("v_t", "position") else "fast"


def saying_of(e: Experiment, way: Way) -> Saying:
    """What a way of an experiment comes to."""
    if way == "full":
        return Saying("learned")
    if e.method == "gp":
        return Saying("position" if way == "recipe" else "motion")
    if e.method == "triangulation":
        return Saying("v_t" if way == "recipe" else "joint", e.method)
    if way == "recipe":
        return Saying("v_t", pair_method(*printed(e.sigma_px)))
    return Saying("joint", pair_method(*e.sigma_px))


@dataclass(frozen=True)
class SayingJob:
    """One way over the flights of one set. ``training``: runs that the thesis' GP of motions learns from."""

    name: str
    saying: Saying
    runs: tuple[Path, ...]
    training: tuple[Path, ...] = ()
    model: Path | None = None

    def path(self, store: Store) -> Path:
        """Where the bounds lie; names of runs and models hold the digests of what they were made from."""
        made_from = [p.name for p in (*self.runs, *self.training)], self.model.name if self.model else ""
        key = digest_of(self.saying.kind, self.saying.method, made_from)
        return store.folder("bounds") / f"{self.name}-{self.saying.kind}-{key}.npz"


def model_job(name: str, saying: Saying, training: tuple[Path, ...]) -> ModelJob | None:
    """The model that a saying needs, if any."""
    if saying.kind == "learned":
        return ModelJob(name, "learned", training)
    return ModelJob(f"{name}-position", "position", training) if saying.kind == "position" else None


def say(job: SayingJob, store: Store) -> Path:
    """State the bounds of every flight and save them, unless they are there."""
    path = job.path(store)
    if not path.is_file():
        write_arrays(path, as_arrays(bounds(job)))
    return path


def bounds(job: SayingJob) -> list[Bounds]:
    """The bounds of every flight of a job."""
    runs = [read_run(p) for p in job.runs]
    kind, method = job.saying.kind, job.saying.method
    if kind == "v_t":
        return [bounds_of(r, np.zeros((len(r.log), 3)), summed_v_t(r.log, method)) for r in runs]
    if kind == "joint":
        return [_joint(r, method) for r in runs]
    if kind == "motion":
        state = thesis_gp(sets_of(job.training))
        return [_motion(r, state) for r in runs]
    assert job.model is not None
    if kind == "position":
        predictor = PositionPredictor.load(job.model)
        return [_position(r, predictor) for r in runs]
    return [_learned(r, Predictor.load(job.model)) for r in runs]


def _joint(run: Run, method: str) -> Bounds:
    # Of all that the records state, this method alone is wanted.
    log = VoLog(
        [replace(r, covariances={method: r.covariances[method]} if r.covariances else {}, v_t={}) for r in run.log]
    )
    errors = next(s.errors for s in statements(log) if s.method == method)
    assert errors is not None
    return bounds_of(run, np.zeros((len(run.log), 3)), compounded(run.log, errors))


def _position(run: Run, predictor: PositionPredictor) -> Bounds:
    _, X = observe(run.log, predictor.features, "position")
    mean, sigma = predictor.predict(X)
    return bounds_of(run, mean, sigma[:, :, None] ** 2 * np.eye(3))


def _motion(run: Run, state: Statement) -> Bounds:
    """A GP speaks of measured motions; a lost one is taken to be like the one before."""
    s: TrainingSet = build_run(run, columns=THESIS)
    said = state(s)
    assert said is not None
    at = {int(t): k for k, t in enumerate(s.t_ns)}
    mean, errors, last = np.zeros((len(run.log), 6)), [], 1e-12 * np.eye(6)
    for k, record in enumerate(run.log):
        row = at.get(record.t_ns)
        if row is not None:
            mean[k], last = said[0][row], said[1][row]
        errors.append(MotionError.independent(last))
    return bounds_of(run, mean_shift(run.log, mean), compounded(run.log, errors))


def _learned(run: Run, predictor: Predictor) -> Bounds:
    predictions = predictions_by_stamp(run, predictor)
    bare = VoLog([replace(r, covariances={}, v_t={}) for r in run.log])
    said = next(s for s in statements(bare, predictions) if s.method == "learned")
    assert said.errors is not None
    mean: Array = np.where([[r.status is Status.LOST] for r in run.log], 0.0, said.mean)
    return bounds_of(run, mean_shift(run.log, mean), compounded(run.log, said.errors))
