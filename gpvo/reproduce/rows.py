"""The rows of the tables: each method of each experiment, over simulated flights and over real sequences; and their
scores, flights pooled over seeds, beside what the thesis prints and what is asked of the full model.

Real data: ``DATA/*/*.npz`` are tracks with truth (see :mod:`gpvo.io.tracks`); ``DATA/*/NAME_est.*`` with ``NAME_gt.*``
are logs of another odometry. Each sequence is judged by models of the others. What could not be computed is None.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo import __version__, runner
from gpvo.dataset.build import leave_out
from gpvo.errors import GpvoError, OutputError
from gpvo.files import digest_of_file
from gpvo.io import open_source
from gpvo.io.foreign import read_foreign
from gpvo.io.run import is_finished, write_run
from gpvo.io.stated import to_records
from gpvo.io.trajectory import check_overlap
from gpvo.reproduce.bounds import Bounds, BoundsJob, job_of, load_bounds, method_of
from gpvo.reproduce.experiments import EXPERIMENTS, WAYS, Experiment, Mode, Plan, Way, printed
from gpvo.reproduce.flights import Flights
from gpvo.reproduce.stages import Store, Workers, digest_of
from gpvo.stats.series import bootstrap_over
from gpvo.types import Array, TruthLog, VoLog
from gpvo.vo.config import make_config

_PAIR_PX = (0.1, 0.5)
RATIO = (0.7, 1.5)
MAGNITUDE_BELOW, VECTOR_UP_TO = 0.7, 1.0
_RESIDUAL_TABLES = ("4.3", "4.6")

Interval = tuple[float, float]


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
        used = VoLog(records[: self.frames])
        truth = TruthLog(given.t_ns, given.T_world_body)
        check_overlap(truth, used.t_ns, self.truth)
        meta = {"source": self.source.name, "kind": "import", "notes": notes}
        write_run(path, used, truth=truth, meta=meta)


def attempt(run: RealRun, store: Store) -> str:
    """Make the run, unless it is there; one line where the data are not what they look like."""
    path = run.path(store)
    try:
        if not is_finished(path):
            run.make(path, store)
    except OutputError:
        raise
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
        next(e for e in EXPERIMENTS if e.key == "4.3"), table="real", thesis=None, figure="", stands_in="real data"
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
        jobs = [job_of(name, e, way, (run,), tuple(others), name) for (run,), others in leave_out(runs)]
        yield Cell(e, way, "real", tuple(job for job in jobs if job is not None))


def score(flights: Sequence[Bounds]) -> dict[str, Any]:
    """One way of one row [m], as in ``results.json``; each flight counts alike.

    Roots of mean squares over the flights, ``*_interval``: 95 % of a bootstrap by flight, None with fewer than three.
    ``ratio``: predicted over actual final error. ``vector``: position error after the predicted mean is taken off;
    ``magnitude``: |error| minus its predicted expectation, the thesis' residual. ``coverage_3_sigma``: share of
    position errors inside, per axis.
    """
    squared_error = np.array([(b.error_m**2).sum(1).mean() for b in flights])
    final, predicted = squared_ends(flights)
    vector = np.array([((b.error_m - b.mean_m) ** 2).sum(1).mean() for b in flights])
    expected = [expected_length(b.mean_m, b.covariance_m2) for b in flights]
    magnitude = np.array([((np.linalg.norm(b.error_m, axis=1) - m) ** 2).mean() for b, m in zip(flights, expected)])
    inside = [(np.abs(b.error_m - b.mean_m) <= 3 * b.sigma_m + 1e-9).mean() for b in flights]
    one = np.ones(len(flights))
    out: dict[str, Any] = {"seeds": len(flights)}
    out["rmse_m"], out["rmse_interval_m"] = pooled(squared_error, one)
    out["final_error_m"], out["final_error_interval_m"] = pooled(final, one)
    out["predicted_final_error_m"] = pooled(predicted, one)[0]
    out["ratio"], out["ratio_interval"] = pooled(predicted, final)
    for name, residual in (("vector", vector), ("magnitude", magnitude)):
        out[f"{name}_residual_m"] = pooled(residual, one)[0]
        out[f"{name}_over_rmse"], out[f"{name}_over_rmse_interval"] = pooled(residual, squared_error)
    return out | {"coverage_3_sigma": float(np.mean(inside))}


def squared_ends(flights: Sequence[Bounds]) -> tuple[Array, Array]:
    """(n,) squared error of the last position of every flight, and what is expected of it [m^2]."""
    final = np.array([(b.error_m[-1] ** 2).sum() for b in flights])
    return final, np.array([b.predicted_m[-1] ** 2 for b in flights])


def expected_length(mean: Array, covariance: Array) -> Array:
    """E|x| of x ~ N(mean (N, 3), covariance (N, 3, 3)).

    ``E sqrt(q) = (4 pi)^-1/2 int_0^inf t^-3/2 (1 - E exp(-t q)) dt`` for q >= 0, with the Laplace transform of a
    quadratic form of normal variables (A. Mathai, S. Provost, "Quadratic forms in random variables", 1992, theorem
    3.2a.2), by the trapezium rule in ln t.
    """
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, 0.0)
    along = (np.swapaxes(vectors, 1, 2) @ mean[:, :, None])[:, :, 0] ** 2
    scale = np.maximum(values.sum(1) + along.sum(1), 1e-300)
    values, along = values / scale[:, None], along / scale[:, None]
    u = np.linspace(-32.0, 32.0, 401)
    t = np.exp(u)
    spread = 1.0 + 2.0 * values[:, None, :] * t[:, None]
    log_laplace = -(0.5 * np.log(spread) + along[:, None, :] * t[:, None] / spread).sum(2)
    return np.sqrt(scale) * (-np.expm1(log_laplace) / np.sqrt(t)).sum(1) * (u[1] - u[0]) / np.sqrt(4 * np.pi)


def pooled(above: Array, below: Array) -> tuple[float, Interval | None]:
    """``sqrt(mean(above) / mean(below))`` of squares (n,), with an interval over seeds, drawn in pairs."""

    def root_ratio(above: Array, below: Array) -> Array:
        return np.sqrt(np.asarray(above) / np.maximum(below, 1e-300))

    value = float(root_ratio(above.mean(), below.mean()))
    return value, over_seeds(len(above), lambda pick: root_ratio(above[pick].mean(1), below[pick].mean(1)))


def over_seeds(seeds: int, statistic: Callable[[NDArray[np.int64]], Array]) -> Interval | None:
    """95 % of a statistic (draws,) of drawn seeds (draws, seeds), by a bootstrap; None with fewer than three."""
    found = bootstrap_over(seeds, statistic)
    return (found.low, found.high) if seeds > 2 else None


def scored(cells: Sequence[Cell], store: Store) -> list[dict[str, Any]]:
    """One entry per experiment and mode, in the order of the cells, as scripts read it."""
    made: dict[tuple[BoundsJob, ...], dict[str, Any]] = {}
    out: dict[tuple[str, str], dict[str, Any]] = {}
    for cell in cells:
        # Cells of several tables share their bounds, and the work.
        found = made.get(cell.jobs) or made.setdefault(cell.jobs, score(cell.load(store)))
        e = cell.experiment
        row = out.setdefault((e.key, cell.mode), {
            **{name: getattr(e, name) for name in ("key", "table", "title", "method")},
            "sigma_px": list(e.sigma_px) if e.method == "pointing_matching" else None,
            "warning": e.warning,
            "stands_in": e.stands_in,
            "thesis": e.thesis,
            "mode": cell.mode,
            "seeds": found["seeds"],
            "ways": {},
        })  # fmt: skip
        row["ways"][cell.way] = found
    return list(out.values())


def targets(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What is asked of the full model, row by row, and whether it is met; None where too few seeds tell."""
    out = []
    for row in rows:
        found = row["ways"].get("full")
        if found is None or row["warning"]:
            continue
        low_high = found["ratio_interval"]
        inside = RATIO[0] <= found["ratio"] <= RATIO[1]
        contains = None if low_high is None else low_high[0] <= 1.0 <= low_high[1]
        out.append(_target(row, f"predicted over actual in [{RATIO[0]}, {RATIO[1]}]", found["ratio"], inside))
        out.append(_target(row, "its interval contains 1", found["ratio"], contains))
        if row["table"] in _RESIDUAL_TABLES:
            m, v = found["magnitude_over_rmse"], found["vector_over_rmse"]
            out.append(_target(row, f"magnitude residual below {MAGNITUDE_BELOW} of RMSE", m, m < MAGNITUDE_BELOW))
            # A model without a mean leaves the error as it is: rounding must not fail it.
            out.append(_target(row, "vector residual not above RMSE", v, v <= VECTOR_UP_TO + 1e-9))
    return out


def _target(row: Mapping[str, Any], what: str, value: float, met: bool | None) -> dict[str, Any]:
    return {"key": row["key"], "mode": row["mode"], "target": what, "value": value, "met": met}
