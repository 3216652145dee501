"""The rows of the tables: each method of each experiment, over simulated flights and over real sequences.

Real data: ``DATA/*/*.npz`` are tracks with truth (see :mod:`gpvo.io.tracks`); ``DATA/*/NAME_est.*`` with ``NAME_gt.*``
are logs of another odometry. Each sequence is judged by models of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from gpvo import __version__, runner
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.io.foreign import read_foreign
from gpvo.io.run import is_finished, write_run
from gpvo.io.stated import to_records
from gpvo.io.trajectory import check_overlap
from gpvo.reproduce.bounds import Bounds, BoundsJob, job_of, load_bounds, method_of
from gpvo.reproduce.experiments import EXPERIMENTS, WAYS, Experiment, Mode, Plan, Way, printed
from gpvo.reproduce.flights import Flights
from gpvo.reproduce.stages import Store, Workers, digest_of, digest_of_file
from gpvo.types import TruthLog, VoLog
from gpvo.vo.config import make_config

_PAIR_PX = (0.1, 0.5)


@dataclass(frozen=True)
class Cell:
    """One way of one experiment in one mode, and the jobs that state its bounds: one, or one per real sequence."""

    experiment: Experiment
    way: Way
    mode: Mode | Literal["real"]
    jobs: tuple[BoundsJob, ...]

    def load(self, store: Store) -> list[Bounds]:
        """The bounds of every flight."""
        return [b for job in self.jobs for b in load_bounds(job.path(store))]


def compute(cells: Sequence[Cell], store: Store, workers: Workers) -> None:
    """Every model that a cell needs, then every cell's bounds."""
    jobs = [job for cell in cells for job in cell.jobs]
    workers.keep("models", [job.model for job in jobs if job.model is not None], store)
    # Jobs of several tables may come to the same file.
    workers.keep("bounds", {job.path(store): job for job in jobs}.values(), store)


def simulated_cells(plan: Plan, flights: Flights) -> list[Cell]:
    """Every cell of the tables for which there are flights."""
    out = []
    for mode in plan.modes:
        for e in plan.experiments:
            for way in WAYS:
                if e.table == "sensitivity" and way == "full":
                    continue
                preset = method_of(e, way).preset
                runs, training = (flights.runs(name, mode, preset) for name in (e.flights, e.training))
                job = job_of(f"{e.flights}-{mode}", e, way, runs, training, f"{e.training}-{mode}")
                out += [] if job is None else [Cell(e, way, mode, (job,))]
    return out


@dataclass(frozen=True)
class RealRun:
    """A run to make of real data: tracks through the odometry of a preset, or a log as it is. ``frames``: at most."""

    kind: str
    source: Path
    truth: Path | None
    preset: str
    frames: int | None

    def path(self, store: Store) -> Path:
        """Where the run lies."""
        files = [digest_of_file(f) for f in (self.source, self.truth) if f is not None]
        key = digest_of(files, self.preset, self.frames, __version__)
        return store.folder("runs") / f"{self.kind}-{self.source.stem}-{self.preset}-{key}"

    def make(self, path: Path, store: Store) -> None:
        """Write the run folder."""
        if self.truth is None:
            pair = printed(_PAIR_PX) if self.preset == "thesis" else _PAIR_PX
            runner.run(open_source(self.source), path, make_config(self.preset, sigma_pairs_px=(pair,)))
            return
        log = read_foreign(self.source)
        given = read_foreign(self.truth, complete=True).trajectory
        records, notes = to_records(log)
        records = records[: self.frames]
        truth = TruthLog(given.t_ns, given.T_world_body)
        check_overlap(truth, VoLog(records).t_ns, self.truth)
        meta = {"source": self.source.name, "kind": "import", "notes": notes}
        write_run(path, VoLog(records), truth=truth, meta=meta)


def attempt(run: RealRun, store: Store) -> str:
    """Make the run, unless it is there; one line where the data are not what they look like."""
    path = run.path(store)
    try:
        if not is_finished(path):
            run.make(path, store)
    except GpvoError as error:
        return str(error)
    return ""


def real_cells(data: Path, frames: int | None, store: Store, workers: Workers) -> tuple[list[Cell], list[str]]:
    """Every row for which there are at least two sequences, and a line for each sequence that cannot be used.

    ``frames``: of each log at most.
    """
    wanted = [RealRun("tracks", f, None, p, None) for p in ("fast", "thesis") for f in sorted(data.glob("*/*.npz"))]
    pairs = ((p, p.with_name(p.name.replace("_est.", "_gt."))) for p in sorted(data.glob("*/*_est.txt")))
    wanted += [RealRun("log", log, truth, "log", frames) for log, truth in pairs if truth.is_file()]
    errors = workers.map("real data", attempt, wanted, store)
    good = [run for run, error in zip(wanted, errors, strict=True) if not error]

    def runs_of(preset: str) -> tuple[Path, ...]:
        return tuple(run.path(store) for run in good if run.preset == preset)

    gp = replace(
        next(e for e in EXPERIMENTS if e.key == "4.3"), table="real", published=None, figure="", stands_in="real data"
    )
    out: list[Cell] = []
    if len(runs_of("fast")) > 1:
        title = "stereo tracks of drives, sigma_p 0.1, sigma_m 0.5"
        stated = replace(gp, key="real-tracks", title=title, method="pointing_matching", sigma_px=_PAIR_PX)
        learned = replace(gp, key="real-tracks-gp", title="stereo tracks of drives, GP trained on the other drives")
        for e in (stated, learned):
            out += _each_by_the_others(e, "real-tracks", runs_of)
    if len(runs_of("log")) > 1:
        e = replace(gp, key="real-logs-gp", title="logs of another odometry, GP trained on the other logs")
        out += _each_by_the_others(e, "real-logs", lambda preset: runs_of("log"))
    return out, [error for error in dict.fromkeys(errors) if error]


def _each_by_the_others(e: Experiment, name: str, runs_of: Callable[[str], tuple[Path, ...]]) -> Iterator[Cell]:
    """All ways over all sequences; rows of one ``name`` share what they have in common."""
    for way in WAYS:
        runs = runs_of(method_of(e, way).preset)
        jobs = [job_of(name, e, way, (run,), runs[:k] + runs[k + 1 :], name) for k, run in enumerate(runs)]
        yield Cell(e, way, "real", tuple(job for job in jobs if job is not None))
