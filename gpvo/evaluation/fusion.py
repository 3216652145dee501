"""Run folders through the filters: load, predict, fuse under every policy; and what ``gpvo fuse`` writes for machines,
the JSON document and a log of innovations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.check import check, predictor_of
from gpvo.errors import GpvoError
from gpvo.evaluation.evaluate import distinct
from gpvo.evaluation.flights import constants_in, constants_of, flight_of, start_sigmas
from gpvo.files import write_text
from gpvo.filters.measurement import chi2_quantile
from gpvo.filters.metrics import Scores
from gpvo.filters.policies import CONSTANT_BEST, CONSTANT_HINDSIGHT, LEARNED, POLICIES, STATED
from gpvo.filters.run import Flight, FusedRun, FuseOptions, begin
from gpvo.filters.sanity import require_sane
from gpvo.filters.study import Constants, Study, fit_scalars, make_policies, study
from gpvo.io.run import Run, read_run
from gpvo.online.predictor import Predictor
from gpvo.twin.gap import simulated_truth
from gpvo.types import IMPORTED, Array

_AVERAGED = ("ate_rmse_m", "final_error_m", "drift_percent", "nis_dof", "rejected")
_AXES = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")


@dataclass(frozen=True)
class FusionSettings:
    """What ``gpvo fuse`` was asked for. ``policies``: none named stands for all, ``imported`` where a run holds one."""

    policies: tuple[str, ...] = ()
    model: Path | None = None
    training: tuple[Path, ...] = ()
    use_imu: bool = True
    options: FuseOptions = field(default_factory=FuseOptions)


@dataclass(frozen=True)
class Trace:
    """What a plot needs of one run under one policy; errors NaN without truth. ``T_world_first``: its first pose."""

    run: str
    policy: str
    t_s: Array
    T_world_first: Array
    position: Array
    truth: Array | None
    error_m: Array
    sigma_m: Array
    nis_dof: Array


@dataclass(frozen=True)
class FusionReport:
    """The study with its traces, the warnings about the inputs, and which runs are twins, of what."""

    study: Study
    traces: tuple[Trace, ...]
    warnings: tuple[str, ...]
    simulated_truth: Sequence[Mapping[str, Any]] = ()


def fuse_runs(
    paths: Sequence[Path],
    settings: FusionSettings,
    *,
    tell: Callable[[str], None] = lambda _: None,
    on_run: Callable[[FusedRun], None] = lambda _: None,
) -> FusionReport:
    """Fuse run folders under every policy that has what it needs; ``on_run`` sees each filtered run whole.

    Runs of one name are told apart by numbers: ``run``, ``run-2``.
    """
    known = (*POLICIES, IMPORTED)
    unknown = [p for p in settings.policies if p not in known]
    if unknown:
        raise GpvoError(f"unknown policy '{unknown[0]}'", cure=f"choose from {', '.join(known)}")
    predictor = None if settings.model is None else Predictor.load(settings.model).require_motions(settings.model)
    tell("reading")
    runs = [read_run(path) for path in paths]
    if not settings.policies:
        imported = any(IMPORTED in run.log.methods for run in runs)
        settings = replace(settings, policies=known if imported else POLICIES)
    options = replace(settings.options, sigmas=start_sigmas(runs))
    flights, warnings = [], []
    for run, name in zip(runs, distinct([r.name for r in runs]), strict=True):
        tell(f"{name}: predictions and checks")
        flights.append(replace(flight_of(run, predictor, use_imu=settings.use_imu), name=name))
        warnings += _findings(run, flights[-1], options)
        if (stating := predictor or predictor_of(run)) is not None:
            warnings += [f"{name}: the model does not fit: {problem}" for problem in check(stating, run).problems]
    if settings.use_imu and (without := [f.name for f in flights if f.imu is None]):
        which = "any run" if len(without) == len(flights) else ", ".join(without)
        wide = "whose noise errs on the wide side, so NIS is low"
        warnings.append(f"no IMU in {which}: a model of constant velocity stands in for it, {wide}")
    constants = _constants(settings, predictor, flights, options, tell)
    learned = any(f.predictions for f in flights)
    policies = make_policies(constants, names=settings.policies, learned=learned)
    traces: list[Trace] = []

    def keep(flight: Flight, fused: FusedRun) -> None:
        traces.append(trace_of(flight, fused))
        on_run(fused)

    result = study(flights, policies, options, constants=constants, progress=tell, on_run=keep)
    unable = [name for name, row in result.scores.items() if not any(row)]
    failed = [f"{name} is left out: {_why_not(name, constants, predictor)}" for name in unable]
    if len(failed) == len(result.scores):
        raise GpvoError(f"nothing to fuse with: {failed[-1]}")  # one cure is enough
    diverging = _diverging(result) if any(f.imu is not None for f in flights) else []
    origin = simulated_truth([run.meta for run in runs])
    return FusionReport(result, tuple(traces), tuple(warnings + failed + diverging), origin)


def _diverging(result: Study) -> list[str]:
    """A line where most policies diverge in most runs: then the covariances are not to blame."""
    judged = {name: [s.diverged for s in row if s and s.diverged is not None] for name, row in result.scores.items()}
    judged = {name: told for name, told in judged.items() if told}
    n = sum(2 * sum(told) > len(told) for told in judged.values())
    if 2 * n <= len(judged):
        return []
    suspects = "the accelerometer's sign, the IMU's axes, T_imu_cam and timeshift_cam_imu"
    return [f"{n} of {len(judged)} policies diverge: suspect {suspects} (compare with --no-imu)"]


def _findings(run: Run, flight: Flight, options: FuseOptions) -> list[str]:
    """What looks wrong with a run that can be filtered. Raises GpvoError, with its path, where it cannot."""
    try:
        findings = require_sane(flight)
        begin(flight, options)
    except GpvoError as error:
        raise GpvoError(error.what, where=run.path, cure=error.cure) from None
    unjudged = [] if run.truth is not None else ["no ground truth: nothing to score"]
    return [f"{flight.name}: {line}" for line in (*findings, *unjudged)]


def _why_not(policy: str, constants: Constants | None, predictor: Predictor | None) -> str:
    if policy == LEARNED and predictor is not None:
        return "no frame has a prediction: the model predicts only motions that odometry found"
    if policy == LEARNED:
        return "the runs hold no predictions of single motions; give --model"
    if policy == IMPORTED:
        return "the runs hold no covariance stated by their own odometry; gpvo import makes such runs"
    if policy in STATED:
        return f"the runs hold too few of its covariances; gpvo run --methods {policy} states them, a log cannot"
    if policy == CONSTANT_BEST:
        return "it is tuned on training runs; give --train RUN"
    if policy == CONSTANT_HINDSIGHT and constants is not None:
        return "it is tuned on the truth of all these runs, and one has none"
    return "no training errors to take a constant from; give --train RUN, or a --model that carries them"


def _constants(
    settings: FusionSettings,
    predictor: Predictor | None,
    flights: Sequence[Flight],
    options: FuseOptions,
    tell: Callable[[str], None],
) -> Constants | None:
    constants = constants_in(predictor) if predictor else None
    if settings.training:
        runs = [read_run(path) for path in settings.training]
        constants = constants_of(runs)
        if CONSTANT_BEST in settings.policies:
            training = [flight_of(run, use_imu=settings.use_imu) for run in runs]
            best = fit_scalars(training, constants, options, progress=lambda n: tell(f"constant_best on {n}"))
            constants = replace(constants, best=best)
    if constants and CONSTANT_HINDSIGHT in settings.policies and all(f.has_truth for f in flights):
        tuned = fit_scalars(flights, constants, options, progress=lambda n: tell(f"constant_hindsight on {n}"))
        constants = replace(constants, hindsight=tuned)
    return constants


def trace_of(flight: Flight, fused: FusedRun) -> Trace:
    """What a plot needs of a filtered run."""
    position = fused.T_world_cam[:, :3, 3]
    truth = None
    error = np.full(len(position), np.nan)
    if flight.T_world_cam is not None and flight.has_truth:
        index = {r.t_ns: i for i, r in enumerate(flight.records)}
        rows = [index[int(t)] for t in fused.t_ns]
        truth = np.where(flight.known[rows, None], flight.T_world_cam[rows, :3, 3], np.nan)
        error = np.linalg.norm(position - truth, axis=1)
    return Trace(
        run=flight.name,
        policy=fused.policy,
        t_s=(fused.t_ns - fused.t_ns[0]) * 1e-9,
        T_world_first=fused.T_world_cam[0],
        position=position,
        truth=truth,
        error_m=error,
        sigma_m=np.sqrt(np.trace(fused.covariance[:, :3, :3], axis1=1, axis2=2)),
        nis_dof=fused.nis / 6.0,
    )


def write_log(path: Path, fused: FusedRun) -> None:
    """A line per record: what was done with it, NIS, innovation and its standard deviation per axis (camera frame)."""
    header = ["t_ns", "outcome", "nis", *(f"innovation_{a}" for a in _AXES), *(f"sigma_{a}" for a in _AXES)]
    lines = [",".join(header)]
    told = np.column_stack([fused.nis, fused.residual, fused.residual_sigma]).tolist()
    for t_ns, outcome, values in zip(fused.t_ns.tolist(), fused.outcomes, told, strict=True):
        lines.append(",".join([str(t_ns), outcome, *(f"{v:.9g}" if np.isfinite(v) else "" for v in values)]))
    write_text(path, "\n".join(lines) + "\n", "ascii", (rb"\At_ns,outcome,nis,", "log of a filter"))


def document(report: FusionReport) -> dict[str, Any]:
    """The machine-readable result of ``gpvo fuse``; a policy that could not run is null."""
    result = report.study
    others = [n for n in result.scores if n != LEARNED] if LEARNED in result.scores else []
    return {
        "schema": 1,
        "runs": [
            {"run": run, "policies": {name: _score(of_runs[i]) for name, of_runs in result.scores.items()}}
            for i, run in enumerate(result.runs)
        ],
        "mean": {name: _mean(result, name, report.traces) for name in result.scores},
        "comparisons": [_comparison(result, LEARNED, other) for other in others],
        "constants": None if result.constants is None else asdict(result.constants),
        "warnings": list(report.warnings),
        "simulated_truth": list(report.simulated_truth),
    }


def _score(scores: Scores | None) -> dict[str, Any] | None:
    if scores is None:
        return None
    before, after = (*_AVERAGED[:3], "nees_dof", "nis_dof"), ("rejected", "diverged")
    interval = {"nis_dof_interval": [scores.nis_interval.low, scores.nis_interval.high]}
    return {k: getattr(scores, k) for k in before} | interval | {k: getattr(scores, k) for k in after}


def _mean(result: Study, name: str, traces: Sequence[Trace]) -> dict[str, Any] | None:
    if all(s is None for s in result.scores[name]):
        return None
    out: dict[str, Any] = {key: result.mean(name, key) for key in _AVERAGED}
    nees = {part: result.mean(name, f"nees_{part}") for part in ("position", "attitude")}
    out["nis_in_band_percent"] = nis_in_band_percent([t for t in traces if t.policy == name])
    return {**out, "nees_dof": nees, "diverged": result.diverged(name)}


def _comparison(result: Study, policy: str, against: str) -> dict[str, Any] | None:
    compared = result.compare(policy, against)
    if not np.isfinite(compared.gain_percent):
        return None
    d = compared.difference_m
    return {
        "policy": policy,
        "against": against,
        "gain_percent": compared.gain_percent,
        "ate_difference_m": d.mean,
        "interval_m": [d.low, d.high],
    }


def nis_over_runs(traces: Sequence[Trace]) -> tuple[Array, NDArray[np.int64]]:
    """Mean NIS per degree of freedom over runs at each step of the shortest, and how many runs measured there."""
    length = min((len(t.t_s) for t in traces), default=0)
    nis = np.array([t.nis_dof[:length] for t in traces]).reshape(len(traces), length)
    known = np.isfinite(nis).sum(axis=0)
    return np.where(known > 0, np.nansum(nis, axis=0) / np.maximum(known, 1), np.nan), known


def nis_in_band_percent(traces: Sequence[Trace]) -> float:
    """Share of the steps whose mean NIS lies in the 95 % chi-square band of as many runs: 95 where all is right."""
    mean, known = nis_over_runs(traces)
    bands = {int(n): nis_band(int(n)) for n in np.unique(known) if n > 0}
    inside = [bands[int(n)][0] <= m <= bands[int(n)][1] for m, n in zip(mean, known, strict=True) if n > 0]
    return 100.0 * float(np.mean(inside)) if inside else float("nan")


def nis_band(runs: int) -> tuple[float, float]:
    """Where the mean NIS per degree of freedom over so many runs should lie at each time step in 95 % of all cases."""
    dof = 6 * runs
    low, high = (chi2_quantile((1 + sign * 0.95) / 2, dof) / dof for sign in (-1, 1))
    return low, high
