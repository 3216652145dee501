"""The error of every position of a flight beside the bound that a method states of it.

All positions are in the axes of the first camera, whose pose is made equal to the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import along
from gpvo.dataset.build import observe, predictions_of
from gpvo.dataset.errors import interpolate_truth
from gpvo.evaluation.statements import Statement, corrected, gp_statement, plain_statement, predicted_statement
from gpvo.files import write_arrays
from gpvo.geometry import se3
from gpvo.geometry.covariance import position_in_world, variances, where_stated
from gpvo.io.run import Run, read_run
from gpvo.learning.thesis import ThesisModel, fit_thesis
from gpvo.online.predictor import Predictor
from gpvo.reproduce.experiments import Experiment, Way, printed
from gpvo.reproduce.models import ModelJob, sets_of
from gpvo.reproduce.stages import Store, digest_of
from gpvo.types import Array, MotionError, VoLog
from gpvo.vo.config import pair_method

_FIELDS = ("t_s", "path_m", "error_m", "mean_m", "covariance_m2")


@dataclass(frozen=True)
class Bounds:
    """One flight, N frames with truth. ``t_s``, ``path_m`` (N,): time and length of the true path so far; ``error_m``
    (N, 3) estimate minus truth; ``mean_m`` (N, 3) and ``covariance_m2`` (N, 3, 3): what is stated of that error."""

    name: str
    t_s: Array
    path_m: Array
    error_m: Array
    mean_m: Array
    covariance_m2: Array

    @property
    def sigma_m(self) -> Array:
        """(N, 3) stated standard deviations."""
        return np.sqrt(variances(self.covariance_m2))

    @property
    def predicted_m(self) -> Array:
        """(N,) root of the expected squared error: sqrt(|mean|^2 + trace of the covariance)."""
        return np.sqrt((self.mean_m**2).sum(1) + np.trace(self.covariance_m2, axis1=1, axis2=2))


def bounds_of(run: Run, mean_m: Array, covariance_m2: Array) -> Bounds:
    """The frames with truth, of what is stated (N, 3), (N, 3, 3) of every frame of a run."""
    assert run.truth is not None
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    T_est, first = run.log.trajectory(), int(np.argmax(known))
    T_first_world = T_est[first] @ se3.inverse(T_true[first])
    true_m = (T_first_world @ T_true)[known, :3, 3]
    return Bounds(
        name=run.name,
        t_s=(run.log.t_ns[known] - run.log.t_ns[0]) * 1e-9,
        path_m=se3.path_length_m(true_m),
        error_m=T_est[known, :3, 3] - true_m,
        mean_m=mean_m[known],
        covariance_m2=covariance_m2[known],
    )


def summed_v_t(log: VoLog, method: str) -> Array:
    """(N, 3, 3) the thesis' bound: V_T of every motion, turned into the axes of the first camera and summed."""
    T, parent, v_t = log.trajectory(), log.parent, log.v_t(method)
    out = np.zeros((len(log), 3, 3))
    last = 1e-12 * np.eye(3)
    for k in np.flatnonzero(parent >= 0):
        last = v_t[k] if np.isfinite(v_t[k]).all() else last
        R = T[parent[k], :3, :3]
        out[k] = out[parent[k]] + R @ last @ R.T
    return out


def compounded(log: VoLog, errors: Sequence[MotionError]) -> Array:
    """(N, 3, 3) covariance of every position from the errors stated of every motion."""
    return position_in_world(log.trajectory(), along(log.T_prev_cur, errors, log.parent)[1])


def mean_shift(log: VoLog, mean: Array) -> Array:
    """(N, 3) [m] by how much positions are expected to be off, given the mean error (N, 6) of every motion."""
    return log.trajectory()[:, :3, 3] - corrected(log, mean)[:, :3, 3]


def as_arrays(bounds: Sequence[Bounds]) -> dict[str, NDArray[Any]]:
    """All flights as named arrays."""
    out = {f"{k}.{name}": getattr(b, name) for k, b in enumerate(bounds) for name in _FIELDS}
    return {"names": np.array([b.name for b in bounds]), **out}


def load_bounds(path: Path) -> list[Bounds]:
    """The flights of one file of :func:`as_arrays`."""
    with np.load(path, allow_pickle=False) as data:
        names = [str(n) for n in data["names"]]
        return [Bounds(n, **{name: data[f"{k}.{name}"] for name in _FIELDS}) for k, n in enumerate(names)]


@dataclass(frozen=True)
class BoundMethod:
    """How the error of a position is stated: ``v_t`` summed (thesis), ``joint`` compounded, GP of the ``position``
    (thesis) or of each ``motion``, or the ``learned`` model. ``name``: of the covariance in the log, for the
    first two."""

    kind: Literal["v_t", "joint", "position", "motion", "learned"]
    name: str = ""

    @property
    def preset(self) -> str:
        """Of the odometry."""
        return "thesis" if self.kind in ("v_t", "position") else "fast"


def method_of(e: Experiment, way: Way) -> BoundMethod:
    """The method that a way of an experiment comes to."""
    if way == "full":
        return BoundMethod("learned")
    if e.method == "gp":
        return BoundMethod("position" if way == "recipe" else "motion")
    if e.method == "triangulation":
        return BoundMethod("v_t" if way == "recipe" else "joint", e.method)
    if way == "recipe":
        return BoundMethod("v_t", pair_method(*printed(e.sigma_px)))
    return BoundMethod("joint", pair_method(*e.sigma_px))


@dataclass(frozen=True)
class BoundsJob:
    """The bounds of a set of flights by one method. ``training``: runs that the thesis' GP of motions learns from."""

    name: str
    method: BoundMethod
    runs: tuple[Path, ...]
    training: tuple[Path, ...] = ()
    model: ModelJob | None = None

    def path(self, store: Store) -> Path:
        """Where the bounds lie."""
        made_from = [p.name for p in (*self.runs, *self.training)], self.model.path(store).name if self.model else ""
        key = digest_of(self.method.kind, self.method.name, made_from)
        return store.folder("bounds") / f"{self.name}-{self.method.kind}-{key}.npz"

    def make(self, path: Path, store: Store) -> None:
        """State the bounds of every flight and save them."""
        stated = self._statement(store)
        write_arrays(path, as_arrays([bounds_of(run, *stated(run)) for run in map(read_run, self.runs)]))

    def _statement(self, store: Store) -> Callable[[Run], tuple[Array, Array]]:
        """What gives mean (N, 3) and covariance (N, 3, 3) of the position's error at every frame of a run."""
        kind, name = self.method.kind, self.method.name
        if kind == "v_t":
            return lambda run: (np.zeros((len(run.log), 3)), summed_v_t(run.log, name))
        if kind == "joint":
            return lambda run: _of_motions(
                run.log, plain_statement(run.log, name, where_stated(run.log.covariance(name)))
            )
        if kind == "motion":
            gps = fit_thesis(sets_of(self.training))
            return lambda run: _of_motions(run.log, gp_statement(run.log, gps))
        assert self.model is not None
        model = self.model.path(store)
        if kind == "position":
            positions = ThesisModel.of_positions(model)
            return lambda run: positions.predict(observe(run.log, positions.columns, "position")[1])
        predictor = Predictor.load(model)
        return lambda run: _of_motions(run.log, predicted_statement("learned", run.log, predictions_of(run, predictor)))


def job_of(
    name: str, e: Experiment, way: Way, runs: tuple[Path, ...], training: tuple[Path, ...], trained_on: str
) -> BoundsJob | None:
    """A way of an experiment over ``runs``, learnt from ``training`` runs; None where it needs some and has none."""
    method = method_of(e, way)
    if not runs or (method.kind in ("position", "motion", "learned") and not training):
        return None
    model = None
    if method.kind == "learned":
        model = ModelJob(trained_on, "learned", training)
    elif method.kind == "position":
        model = ModelJob(f"{trained_on}-position", "position", training)
    return BoundsJob(name, method, runs, training if method.kind == "motion" else (), model)


def _of_motions(log: VoLog, said: Statement) -> tuple[Array, Array]:
    """Mean (N, 3) and covariance (N, 3, 3) of positions from what is said of motions."""
    assert said.errors is not None
    return mean_shift(log, said.mean), compounded(log, said.errors)
