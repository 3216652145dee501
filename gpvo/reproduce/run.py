"""The whole reproduction: simulate -> odometry -> models -> bounds -> tables, each stage kept in the folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gpvo.learning.parallel import map_jobs
from gpvo.reproduce.experiments import WAYS, Experiment, Way
from gpvo.reproduce.flights import Flown, fly
from gpvo.reproduce.learn import ModelJob, fit
from gpvo.reproduce.plan import Flight, Mode, Plan, flights_of
from gpvo.reproduce.sayings import Saying, SayingJob, model_job, say, saying_of
from gpvo.reproduce.store import Store

Progress = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True)
class Workers:
    """Where jobs run, and who is told of progress."""

    jobs: int = 1
    backend: str = "local"
    scheduler: str | None = None
    progress: Progress = lambda what, total: nullcontext(lambda: None)

    def map(self, what: str, function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> list[Any]:
        """The function over all arguments, in order."""
        listed = list(arguments)
        with self.progress(what, len(listed)) as done:
            return map_jobs(
                function, listed, jobs=self.jobs, backend=self.backend, scheduler=self.scheduler, on_done=done
            )


@dataclass(frozen=True)
class Flights:
    """All flights that were made. ``failed``: one line per flight that could not be flown."""

    flown: dict[tuple[str, Mode], list[Flown]] = field(default_factory=dict)

    def runs(self, name: str, mode: Mode, preset: str) -> tuple[Path, ...]:
        """Run folders of a set, in the order of its seeds."""
        return tuple(f.runs[preset] for f in self.flown.get((name, mode), []) if preset in f.runs)

    @property
    def failed(self) -> list[str]:
        """What could not be flown, and why."""
        return [f"{f.flight.name}: {f.error}" for group in self.flown.values() for f in group if f.error]


def fly_all(plan: Plan, store: Store, workers: Workers) -> Flights:
    """Stages one and two, for every set of flights in every mode."""
    wanted: dict[tuple[str, Mode], list[Flight]] = {
        (name, mode): flights_of(plan, name, mode, store) for mode in plan.modes for name in plan.flight_sets
    }
    listed = [f for group in wanted.values() for f in group]
    # The long ones first, so that no core waits for a last long one.
    listed.sort(key=lambda f: (f.mode != "images", -f.scenario.duration_s))
    flown = workers.map("flights", fly, [(f, store) for f in listed])
    by_key = {f.flight.name: f for f in flown}
    return Flights({where: [by_key[f.name] for f in group] for where, group in wanted.items()})


@dataclass(frozen=True)
class Cell:
    """One way of one experiment in one mode, and the job that says it."""

    experiment: Experiment
    way: Way
    mode: Mode
    job: SayingJob
    model: ModelJob | None


def cells(plan: Plan, flights: Flights, store: Store) -> list[Cell]:
    """Every cell of the tables for which there are flights."""
    out = []
    for mode in plan.modes:
        for e in plan.experiments:
            for way in WAYS:
                if e.table == "sensitivity" and way == "full":
                    continue
                cell = _cell(e, way, mode, flights, store)
                if cell is not None:
                    out.append(cell)
    return out


def _cell(e: Experiment, way: Way, mode: Mode, flights: Flights, store: Store) -> Cell | None:
    saying = saying_of(e, way)
    runs = flights.runs(e.flights, mode, saying.preset)
    training = flights.runs(e.training, mode, saying.preset)
    needs_training = saying.kind in ("position", "motion", "learned")
    if not runs or (needs_training and not training):
        return None
    model = model_job(f"{e.training}-{mode}", saying, training)
    path = None if model is None else model.path(store)
    own = training if saying.kind == "motion" else ()
    return Cell(e, way, mode, _job(e, mode, saying, runs, own, path), model)


def _job(
    e: Experiment, mode: Mode, saying: Saying, runs: tuple[Path, ...], training: tuple[Path, ...], model: Path | None
) -> SayingJob:
    return SayingJob(f"{e.flights}-{mode}", saying, runs, training, model)


def compute(table: Sequence[Cell], store: Store, workers: Workers) -> None:
    """Stages three and four: every model that a cell needs, then every cell's bounds."""
    models = dict.fromkeys(c.model for c in table if c.model is not None)
    workers.map("models", fit, [(m, store) for m in models])
    jobs = {c.job.path(store): c.job for c in table}
    workers.map("bounds", say, [(j, store) for j in jobs.values()])
