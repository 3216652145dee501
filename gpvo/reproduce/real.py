"""The real column: stereo tracks of drives and logs of another odometry, each sequence judged by models of the others.

``DATA/*/*.npz`` are tracks with truth (see :mod:`gpvo.io.tracks`); ``DATA/*/NAME_est.*`` with ``NAME_gt.*`` are logs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gpvo import __version__, runner
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.io.foreign import read_foreign, to_records
from gpvo.io.run import write_run
from gpvo.io.truth import check_overlap
from gpvo.reproduce.experiments import EXPERIMENTS, WAYS, Experiment, printed
from gpvo.reproduce.flights import is_complete
from gpvo.reproduce.learn import ModelJob, fit
from gpvo.reproduce.run import Workers
from gpvo.reproduce.sayings import SayingJob, model_job, say, saying_of
from gpvo.reproduce.store import Store, digest_of, digest_of_file
from gpvo.types import TruthLog, VoLog
from gpvo.vo.config import make_config

_PAIR_PX = (0.1, 0.5)


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


@dataclass(frozen=True)
class RealRow:
    """One row of the table of real data: an experiment that gives the ways, and the bounds of every sequence by way."""

    experiment: Experiment
    bounds: dict[str, list[Path]]


def make(job: RealRun, store: Store) -> Path:
    """The run folder, made unless it is there."""
    path = job.path(store)
    if is_complete(path):
        return path
    if job.truth is None:
        runner.run(open_source(job.source), path, make_config(job.preset, sigma_pairs_px=_pairs(job.preset)))
        return path
    log = read_foreign(job.source)
    given = read_foreign(job.truth, complete=True).trajectory
    records, notes = to_records(log)
    records = records[: job.frames]
    truth = TruthLog(given.t_ns, given.T_world_body)
    check_overlap(truth, VoLog(records).t_ns, job.truth)
    write_run(path, VoLog(records), truth=truth, meta={"source": job.source.name, "kind": "import", "notes": notes})
    return path


def attempt(job: RealRun, store: Store) -> str:
    """Make the run; one line where the data are not what they look like."""
    try:
        make(job, store)
    except GpvoError as error:
        return str(error)
    return ""


def _pairs(preset: str) -> tuple[tuple[float, float], ...]:
    return (printed(_PAIR_PX) if preset == "thesis" else _PAIR_PX,)


def tracks(data: Path) -> list[Path]:
    """Tracks in the folder of real data."""
    return sorted(data.glob("*/*.npz"))


def logs(data: Path) -> list[tuple[Path, Path]]:
    """Logs with their truth."""
    pairs = ((p, p.with_name(p.name.replace("_est.", "_gt."))) for p in sorted(data.glob("*/*_est.txt")))
    return [(log, truth) for log, truth in pairs if truth.is_file()]


def real_rows(data: Path, frames: int | None, store: Store, workers: Workers) -> tuple[list[RealRow], list[str]]:
    """Every row for which there are at least two sequences, and a line for each that cannot be used.

    ``frames``: of each log at most.
    """
    wanted = [RealRun("tracks", f, None, p, None) for p in ("fast", "thesis") for f in tracks(data)]
    wanted += [RealRun("log", log, truth, "log", frames) for log, truth in logs(data)]
    errors = workers.map("real data", attempt, [(j, store) for j in wanted])
    good = [j for j, error in zip(wanted, errors, strict=True) if not error]
    runs = {p: [j for j in good if j.preset == p] for p in ("fast", "thesis")}
    imported = [j for j in good if j.kind == "log"]
    gp = next(e for e in EXPERIMENTS if e.key == "4.3")
    out = []
    if len(runs["fast"]) > 1:
        title = "stereo tracks of drives, sigma_p 0.1, sigma_m 0.5"
        stated = replace(gp, key="real-tracks", title=title, method="pointing_matching", sigma_px=_PAIR_PX)
        learned = replace(gp, key="real-tracks-gp", title="stereo tracks of drives, GP trained on the other drives")
        for e in (stated, learned):
            out.append(_row(e, "tracks", lambda preset: [j.path(store) for j in runs[preset]], store, workers))
    if len(imported) > 1:
        e = replace(gp, key="real-logs-gp", title="logs of another odometry, GP trained on the other logs")
        out.append(_row(e, "logs", lambda preset: [j.path(store) for j in imported], store, workers))
    return out, [error for error in dict.fromkeys(errors) if error]


def _row(e: Experiment, kind: str, runs_of: Callable[[str], Sequence[Path]], store: Store, workers: Workers) -> RealRow:
    """All ways over all sequences; rows of one ``kind`` share what they have in common."""
    e = replace(e, table="real", published=None, figure="", stands_in="real data", warning=False)
    models: list[ModelJob] = []
    jobs: dict[str, list[SayingJob]] = {}
    for way in WAYS:
        saying = saying_of(e, way)
        runs = tuple(runs_of(saying.preset))
        jobs[way] = []
        for k, run in enumerate(runs):
            others = runs[:k] + runs[k + 1 :]
            model = model_job(f"real-{kind}", saying, others)
            models += [model] if model else []
            own = others if saying.kind == "motion" else ()
            jobs[way].append(SayingJob(f"real-{kind}", saying, (run,), own, model.path(store) if model else None))
    workers.map("models of real data", fit, [(m, store) for m in dict.fromkeys(models)])
    workers.map("bounds", say, [(j, store) for group in jobs.values() for j in group])
    return RealRow(e, {way: [j.path(store) for j in group] for way, group in jobs.items()})
