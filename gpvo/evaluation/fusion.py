"""Run folders through the filters: load, predict, fuse under every policy, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.dataset.build import predictions_of
from gpvo.dataset.errors import interpolate_truth, motion_errors
from gpvo.dataset.rest import without_wandering_truth
from gpvo.errors import GpvoError
from gpvo.evaluation.evaluate import distinct
from gpvo.filters.policies import (
    CONSTANT_BEST,
    CONSTANT_HINDSIGHT,
    LEARNED,
    POLICIES,
    STATED,
    constant_from_errors,
)
from gpvo.filters.run import Flight, FusedRun, FuseOptions, begin
from gpvo.filters.sanity import require_sane
from gpvo.filters.start import StartSigmas, slope_sigma
from gpvo.filters.study import Constants, Study, fit_scalars, make_policies, study
from gpvo.io.run import Run, read_run
from gpvo.learning.check import check
from gpvo.online.predictor import Predictor
from gpvo.twin.gap import simulated_truth
from gpvo.types import IMPORTED, Array, TruthLog


def flight_of(run: Run, predictor: Predictor | None = None, *, use_imu: bool = True) -> Flight:
    """A run as the filters take it, with the model's predictions, else those stored in the run; a twin on a
    path that a vehicle can fly, with an IMU of this path.

    Raises GpvoError where there is an IMU but nobody says how it sits to the camera, or the run is empty.
    """
    if len(run.log) < 2:
        raise GpvoError(f"holds {len(run.log)} records: nothing to fuse", where=run.path)
    imu = run.imu if use_imu else None
    if imu is not None and run.mounting.T_imu_cam is None:
        raise GpvoError("has an IMU but no T_imu_cam in rig.json", where=run.path, cure="add it, or use --no-imu")
    poses = valid = None
    truth_sigma = (0.0, 0.0)
    if run.truth is not None:
        truth_sigma = (run.truth.sigma_translation_m, run.truth.sigma_rotation_rad)
        poses, valid = interpolate_truth(run.truth, run.log.t_ns)
        if not valid.any():
            raise GpvoError("ground truth and frames do not overlap in time", where=run.path)
    flight = Flight(
        name=run.name,
        records=run.log.records,
        imu=imu,
        T_imu_cam=run.mounting.T_imu_cam if imu is not None else None,
        T_world_cam=poses,
        truth_valid=valid,
        predictions=predictions_of(run, predictor),
        truth_sigma=truth_sigma,
    )
    if about := run.meta.get("twin"):
        # Only twins need the simulator.
        from gpvo.evaluation.twin_flight import on_smooth_path

        require_sane(flight)
        return on_smooth_path(flight, (about["seed"], about["replicate"], 31))
    return flight


def start_sigmas(runs: Sequence[Run]) -> StartSigmas:
    """Initial covariance that is no smaller than the noise of the truth it starts from, as poses or as their slope."""
    base = StartSigmas()
    position = max((r.truth.sigma_translation_m for r in runs if r.truth), default=0.0)
    velocity = max((_slope_sigma(r, r.truth) for r in runs if r.truth), default=0.0)
    rotation = max((r.truth.sigma_rotation_rad for r in runs if r.truth), default=0.0)
    return replace(
        base,
        position_m=max(base.position_m, position),
        velocity_mps=max(base.velocity_mps, velocity),
        tilt_rad=max(base.tilt_rad, rotation),
        yaw_rad=max(base.yaw_rad, rotation),
    )


def _slope_sigma(run: Run, truth: TruthLog) -> float:
    return slope_sigma(truth.sigma_translation_m, float(np.median(np.diff(run.log.t_ns))) * 1e-9)


def constants_of(runs: Sequence[Run]) -> Constants:
    """Per-axis mean squares of the motions' errors over training runs, each run with equal weight."""
    squares, dt = [], []
    for run in runs:
        if run.truth is None:
            raise GpvoError("has no ground truth to train a constant on", where=run.path)
        errors = motion_errors(without_wandering_truth(run.log, run.truth), run.truth)
        if not len(errors.index):
            raise GpvoError("has no motion with ground truth at both ends", where=run.path)
        squares.append(constant_from_errors(errors.xi))
        dt.append(float(np.median(errors.dt_s)))
    return Constants(np.mean(squares, axis=0), float(np.median(dt)))


def constants_in(predictor: Predictor) -> Constants | None:
    """The constants that a model file carries, None where it has none."""
    covariance = predictor.arrays.get("method.constant")
    if covariance is None or covariance.shape != (6, 6):
        return None
    best = predictor.header.get("constant_best")
    scalars = None if best is None else (float(best[0]), float(best[1]))
    return Constants(np.diagonal(covariance).copy(), predictor.model.dt_s, scalars)


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
    """What a plot needs of one run under one policy; errors NaN without truth."""

    run: str
    policy: str
    t_s: Array
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
    tell: Callable[[str], None] | None = None,
    on_run: Callable[[FusedRun], None] | None = None,
) -> FusionReport:
    """Fuse run folders under every policy that has what it needs; ``on_run`` sees each filtered run whole.

    Runs of one name are told apart by numbers: ``run``, ``run-2``.
    """
    tell = tell or (lambda _: None)
    known = (*POLICIES, IMPORTED)
    unknown = [p for p in settings.policies if p not in known]
    if unknown:
        raise GpvoError(f"unknown policy '{unknown[0]}'", cure=f"choose from {', '.join(known)}")
    predictor = None if settings.model is None else Predictor.load(settings.model).require_motions(settings.model)
    runs = [read_run(path) for path in paths]
    if not settings.policies:
        imported = any(IMPORTED in run.log.methods for run in runs)
        settings = replace(settings, policies=known if imported else POLICIES)
    options = replace(settings.options, sigmas=start_sigmas(runs))
    flights, warnings = [], []
    for run, name in zip(runs, distinct([r.name for r in runs]), strict=True):
        flights.append(replace(flight_of(run, predictor, use_imu=settings.use_imu), name=name))
        warnings += _findings(run, flights[-1], options)
        if predictor is not None:
            warnings += [f"{name}: the model does not fit: {problem}" for problem in check(predictor, run).problems]
    constants = _constants(settings, predictor, flights, options, tell)
    learned = any(f.predictions for f in flights)
    policies = make_policies(constants, names=settings.policies, learned=learned)
    traces: list[Trace] = []

    def keep(flight: Flight, fused: FusedRun) -> None:
        traces.append(trace_of(flight, fused))
        if on_run:
            on_run(fused)

    result = study(flights, policies, options, constants=constants, progress=tell, on_run=keep)
    failed = [f"{name} is left out: {_why_not(name, constants)}" for name, row in result.scores.items() if not any(row)]
    if len(failed) == len(result.scores):
        raise GpvoError(f"nothing to fuse with: {'; '.join(failed)}")
    origin = simulated_truth([run.meta for run in runs])
    return FusionReport(result, tuple(traces), tuple(warnings + failed), origin)


def _findings(run: Run, flight: Flight, options: FuseOptions) -> list[str]:
    """What looks wrong with a run that can be filtered. Raises GpvoError, with its path, where it cannot."""
    try:
        findings = require_sane(flight)
        begin(flight, options)
    except GpvoError as error:
        raise GpvoError(error.what, where=run.path, cure=error.cure) from None
    unjudged = [] if run.truth is not None else ["no ground truth: nothing to score"]
    return [f"{flight.name}: {line}" for line in (*findings, *unjudged)]


def _why_not(policy: str, constants: Constants | None) -> str:
    """Why a policy could not run at all, and the cure."""
    if policy == LEARNED:
        return "the runs hold no predictions of single motions; give --model"
    if policy == IMPORTED:
        return "the runs hold no covariance that their odometry states itself; gpvo import makes such runs"
    if policy in STATED:
        return f"the runs hold too few usable covariances; run VO with --methods {policy}"
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
        position=position,
        truth=truth,
        error_m=error,
        sigma_m=np.sqrt(np.trace(fused.covariance[:, :3, :3], axis1=1, axis2=2)),
        nis_dof=fused.nis / 6.0,
    )
