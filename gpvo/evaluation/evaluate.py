"""One run against its truth: trajectory errors, and the consistency of every method, in one object."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.align import interpolate_truth
from gpvo.dataset.build import align_rotation
from gpvo.dataset.clock import estimate_time_offset
from gpvo.dataset.errors import MotionErrors, motion_errors
from gpvo.dataset.hand_eye import FixedRotation, fixed_rotation
from gpvo.dataset.odd import Stretch, odd_stretches
from gpvo.dataset.rest import without_wandering_truth
from gpvo.dataset.truth_noise import estimate_truth_noise, telling_distance_m, velocity_path
from gpvo.errors import GpvoError, SourceError
from gpvo.evaluation.consistency import BLOCKS, HORIZONS_M, Consistency, Horizon, consistency
from gpvo.evaluation.statements import Statement, statements
from gpvo.evaluation.trajectory import (
    PoseConsistency,
    TrajectoryErrors,
    pose_consistency,
    pose_document,
    trajectory_errors,
)
from gpvo.evaluation.verdict import verdict
from gpvo.io.run import Run
from gpvo.online.predictor import Predictor
from gpvo.stats.bootstrap import sequence_bootstrap
from gpvo.types import IMPORTED, Array, Prediction, Status, TruthLog, VoLog

_UNITS = ("translation_m", "rotation_rad")
METHODS = (
    "constant",
    "triangulation",
    "triangulation_scaled",
    "triangulation_vt",
    "pointing_matching",
    "pointing_matching_scaled",
    "pointing_matching_vt",
    IMPORTED,
    f"{IMPORTED}_scaled",
    "gp_thesis",
    "base",
    "learned",
)


@dataclass(frozen=True)
class EvaluateOptions:
    """``truth_sigma`` (m, rad) per pose, None for what the source states or the run shows, whichever is more;
    ``time_offset_s`` None to estimate it."""

    segments_m: tuple[float, ...] | None = None
    truth_sigma: tuple[float, float] | None = None
    align: str = "none"
    time_offset_s: float | None = 0.0


@dataclass(frozen=True)
class Evaluation:
    """Everything said of one run. ``covered``: frames with truth; ``T_est`` and ``T_true`` (N, 4, 4) with the first
    poses made equal. ``unscored``: motions left out of errors and consistency, as the truth moves while the vehicle
    stands. ``odd``: stretches in which odometry and truth differ as nowhere else. ``truth_sigma`` (6,): noise of the
    truth's poses by axis, as counted in; ``truth_sigma_stated`` (6,): as its source states. ``tells_from_m``: length of
    path from which odometry's errors outweigh it. ``turned``: a fixed rotation between truth and odometry, where it
    matters. ``in_domain``: share of the predicted frames that lie in the model's training domain, None without a model.
    ``poses``: scores of the covariances of poses that a log states.
    """

    run: Run
    errors: MotionErrors
    trajectory: TrajectoryErrors
    statements: tuple[Statement, ...]
    consistency: Mapping[str, Consistency]
    covered: NDArray[np.bool_]
    T_est: Array
    T_true: Array
    truth_sigma: Array
    truth_sigma_stated: Array
    time_offset_s: float
    tells_from_m: float = 0.0
    turned: FixedRotation | None = None
    unscored: int = 0
    odd: Sequence[Stretch] = ()
    in_domain: float | None = None
    poses: PoseConsistency | None = None

    def __str__(self) -> str:
        t = self.trajectory
        return f"{self.run.name}: ATE {t.ate_rmse_m:.3g} m over {t.path_length_m:.1f} m"


def evaluate_run(
    run: Run,
    predictor: Predictor | None = None,
    options: EvaluateOptions | None = None,
    further: Sequence[Statement] = (),
) -> Evaluation:
    """Evaluate a run against its truth; with a predictor, predictions are made as in flight, else those of the run
    are used. A motion that either says is lost counts as lost for every method. ``further``: methods of elsewhere.

    Raises SourceError if the run has no truth, or none at the times of its frames; ModelError if the model predicts
    something else than the error of a motion.
    """
    options = options or EvaluateOptions()
    truth, offset_s = _truth(run, options)
    predictions = predictions_by_stamp(run, predictor)
    run = replace(run, log=judged(run.log, predictions))
    log = run.log
    T_true, known = interpolate_truth(truth, log.t_ns)
    if known.sum() < 3:
        raise SourceError(
            "ground truth and frames do not overlap in time",
            where=run.path,
            cure="use --time-offset auto, or give the truth of this run",
        )
    scored = without_wandering_truth(log, truth)
    errors = motion_errors(scored, truth)
    stated = np.repeat(options.truth_sigma or (truth.sigma_translation_m, truth.sigma_rotation_rad), 3)
    sigma = np.maximum(stated, estimate_truth_noise(errors, scored)) if options.truth_sigma is None else stated
    T_est = log.trajectory()
    made = [*statements(log, predictions, predictor), *further]
    by_velocity = velocity_path(truth, log.t_ns) if options.truth_sigma is None else None
    found = {s.method: consistency(s, errors, scored, T_true, known, sigma, by_velocity) for s in made}
    first = int(np.flatnonzero(known)[0])
    lift = T_true[first] @ np.linalg.inv(T_est[first])
    return Evaluation(
        run=run,
        errors=errors,
        trajectory=trajectory_errors(
            log.t_ns[known], T_est[known], T_true[known], options.segments_m, np.flatnonzero(known)
        ),
        statements=tuple(made),
        consistency={m: c for m, c in found.items() if c is not None},
        covered=known,
        T_est=lift @ T_est,
        T_true=T_true,
        truth_sigma=sigma,
        truth_sigma_stated=stated,
        tells_from_m=telling_distance_m(scored, T_true, known, sigma),
        turned=fixed_rotation(scored, truth) if options.align == "none" else None,
        time_offset_s=offset_s,
        unscored=int(log.usable.sum() - scored.usable.sum()),
        odd=odd_stretches(scored, truth),
        poses=pose_consistency(log, T_est, T_true, known),
        in_domain=float(np.mean([p.in_domain > 0.5 for p in predictions.values()])) if predictions else None,
    )


def predictions_by_stamp(run: Run, predictor: Predictor | None) -> dict[int, Prediction]:
    """Predictions of a model over the run's log, or those stored with the run."""
    if predictor is None:
        return run.predictions_of_motions
    predictor.require_motions()
    return predictor.replay(run.log)


def judged(log: VoLog, predictions: Mapping[int, Prediction]) -> VoLog:
    """The log as a flight with the model would write it: each status the worse of odometry's and the model's."""
    records = []
    for r in log:
        p = predictions.get(r.t_ns)
        records.append(r if p is None or r.status is Status.START else r.with_status(p.status, "prediction"))
    return replace(log, records=records)


def _truth(run: Run, options: EvaluateOptions) -> tuple[TruthLog, float]:
    if run.truth is None:
        raise SourceError("has no ground truth", where=run.path, cure="--truth FILE (TUM lines), or --twins")
    truth, offset_s = run.truth, options.time_offset_s
    if offset_s is None:
        offset_s = estimate_time_offset(run.log, truth)
    if offset_s:
        truth = replace(truth, t_ns=truth.t_ns - round(offset_s * 1e9))
    if options.align == "rotation":
        truth = align_rotation(run.log, truth)
    elif options.align != "none":
        raise GpvoError(f"unknown alignment '{options.align}'", cure="none or rotation")
    return truth, float(offset_s)


def distinct(names: Sequence[str]) -> list[str]:
    """Names of runs, later ones of a kind numbered: ``a``, ``a-2``."""
    out: list[str] = []
    for name in names:
        k, candidate = 2, name
        while candidate in out:
            candidate, k = f"{name}-{k}", k + 1
        out.append(candidate)
    return out


def document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """The result as scripts read it; what could not be computed is None. SI units; the names are part of the interface.

    ``pooled``: of each method ``nll_per_dim`` and ``nees_dof`` (with the truth's noise) {``mean``, ``low``, ``high``}
    over the runs. Of each run, beside its name, counts, path length, ATE and segments:

    * ``degraded``: frames of that status, by the odometry or a model. ``lost`` are counted apart.
    * ``truth_moves_at_rest``: motions that are not scored, as the vehicle stands and the truth moves; they count in
      ATE, final error and RPE alone.
    * ``odd_stretches``: motions, in words, in which odometry and truth differ as nowhere else; they are scored.
    * ``in_domain``: share of the frames in the model's training domain.
    * ``poses`` {``count``, ``position``, ``orientation``, ``joint``}: NEES of the pose covariances that a filter's log
      states (see :class:`gpvo.evaluation.trajectory.PoseConsistency`); None where it states none.
    * ``verdict`` {``colour``, ``headline``, ``lines``}: what the numbers come to, in words.
    * ``time_offset_s``: what was taken off the truth's clock, given or estimated.
    * ``truth_sigma`` {``translation_m``, ``rotation_rad``}: noise of the truth per pose, root mean square over axes,
      as counted in: what ``--truth-sigma`` says, else what the source states (``truth_sigma_stated``) or the run shows
      (:mod:`gpvo.dataset.truth_noise`), whichever is more. ``truth_sigma_axes``: by axis, x y z [m], then [rad].
      ``truth_tells_from_m``: length of path from which odometry's errors outweigh it; 0: every motion; None: nowhere.
    * ``fixed_rotation`` {``angle_deg``, ``rotvec_rad``, ``error_change``}: between truth and odometry, None where it
      does not matter; ``error_change``: relative change of the errors over a second without it.
    * ``rpe`` {``frame``, ``1s``, ``10m``}: relative pose error over one frame, a second and ten metres of path, each
      {``translation_m``, ``rotation_rad``} with rmse, mean, median, std, min, max and the count of pairs. Pairs of a
      frame or a second do not reach across a gap in the truth.

    Of each method, beside NEES, coverage, NLL and CRPS:

    * ``nees_dof_interval``: by block, 95 % interval [low, high] of ``nees_dof`` by a bootstrap over blocks of time.
    * ``nees_dof_truth_noise``: by block, ``nees_dof`` with the truth's own noise added to what the method states.
    * ``energy`` {``translation_m``, ``rotation_rad``}: energy score, the CRPS of vectors; it rewards sharp and honest
      statements alike. ``correlation_gain_nats``: by how much the stated correlations make the errors likelier.
      ``by_difficulty`` {``nees_dof``, ``coverage`` at one sigma}: in quartiles of rising stated uncertainty.
    * ``nll_per_dim`` takes every statement as Gaussian; ``nll_stated_per_dim`` is of the stated density, a Student-t
      for models that learnt their tails, and ``nees_dof_median_stated`` the median NEES/dof that it expects.
    * ``one_second`` {``nees_dof``, ``nees_dof_truth_noise``, ``z2_truth_noise``, ``truth_drift_m``, ``count``}: of the
      motion over windows of a second, joint and (6,) by axis, and the truth's drift (3,) that is counted in as its own
      velocities contradict its positions; ``horizons`` are the same over lengths of path.
    * ``predicted_final_error_m``: root of the trace of the accumulated position covariance, by the method's parts;
      ``predicted_final_error_independent_m``: the same if all motions were independent.

    ``constant`` is said of the motion of one frame: a motion that bridges lost frames has as many times its covariance.
    ``gp_thesis`` needs a model file that holds it, as all written by this version do.
    """
    runs = [_run_document(e) for e in evaluations]
    return {"schema": 1, "runs": runs, "pooled": _pooled([r["methods"] for r in runs])}


def _pooled(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over the runs, with 95 % intervals by whole runs, of the methods that speak of the motions of every run."""
    out: dict[str, Any] = {}
    for method in runs[0] if runs else ():
        scores = {
            "nll_per_dim": [r[method]["nll_per_dim"] for r in runs if method in r],
            "nees_dof": [r[method]["nees_dof_truth_noise"]["joint"] for r in runs if method in r],
        }
        if all(len(values) == len(runs) and None not in values for values in scores.values()):
            out[method] = {n: sequence_bootstrap(np.array(v, np.float64)).document() for n, v in scores.items()}
    return out


def _run_document(e: Evaluation) -> dict[str, Any]:
    t = e.trajectory
    counts = {s.value: sum(r.status is s for r in e.run.log) for s in Status}
    return {
        "run": e.run.name,
        "source": e.run.meta.get("source"),
        "frames": len(e.run.log),
        "lost": counts["lost"],
        "degraded": counts["degraded"],
        "truth_moves_at_rest": e.unscored,
        "odd_stretches": [str(s) for s in e.odd],
        "in_domain": e.in_domain,
        "path_length_m": t.path_length_m,
        "ate_rmse_m": t.ate_rmse_m,
        "rmse_origin_m": t.rmse_origin_m,
        "final_error_m": t.final_error_m,
        "time_offset_s": e.time_offset_s,
        "truth_sigma": _by_kind(e.truth_sigma),
        "truth_sigma_axes": e.truth_sigma.tolist(),
        "truth_sigma_stated": _by_kind(e.truth_sigma_stated),
        "truth_tells_from_m": e.tells_from_m,
        "fixed_rotation": None if e.turned is None else asdict(e.turned),
        "rpe": {"frame": asdict(t.rpe_frame), "1s": asdict(t.rpe_second), "10m": asdict(t.rpe_10m)},
        "segments": [asdict(s) for s in t.segments],
        "poses": pose_document(e.poses),
        "verdict": asdict(verdict(e)),
        "methods": {m: _method_document(e.consistency.get(m)) for m in _methods_of(e)},
    }


def _by_kind(sigma: Array) -> dict[str, float]:
    translation, rotation = np.sqrt((sigma.reshape(2, 3) ** 2).mean(axis=1))
    return {"translation_m": float(translation), "rotation_rad": float(rotation)}


def _methods_of(e: Evaluation) -> list[str]:
    return [*METHODS, *(m for m in e.consistency if m not in METHODS)]


def _horizon(h: Horizon | None) -> dict[str, Any]:
    keys = ("nees_dof", "nees_dof_truth_noise", "z2_truth_noise", "truth_drift_m")
    return {k: getattr(h, k, None) for k in keys} | {"count": 0 if h is None else h.count}


def _method_document(c: Consistency | None) -> dict[str, Any]:
    """Scores of one method; of one that says nothing the same entries, all None."""

    def of(name: str) -> Any:
        return getattr(c, name, None)

    def by_block(name: str) -> dict[str, Any]:
        return of(name) or dict.fromkeys(BLOCKS)

    return {
        "nees_dof": {b: i and i.mean for b, i in by_block("nees_dof").items()},
        "nees_dof_interval": {b: i and [i.low, i.high] for b, i in by_block("nees_dof").items()},
        "nees_dof_median": by_block("nees_dof_median"),
        "nees_dof_truth_noise": by_block("nees_dof_truth_noise"),
        "coverage": dict(zip("123", of("coverage") or [None] * 3, strict=True)),
        "nll_per_dim": of("nll_per_dim"),
        "nll_stated_per_dim": of("nll_stated_per_dim"),
        "nees_dof_median_stated": of("nees_dof_median_stated"),
        "crps": {unit: of(f"crps_{unit}") for unit in _UNITS},
        "energy": {unit: of(f"energy_{unit}") for unit in _UNITS},
        "correlation_gain_nats": of("correlation_gain_nats"),
        "by_difficulty": {name: of(f"{name}_by_difficulty") for name in ("nees_dof", "coverage")},
        "predicted_final_error_m": of("predicted_final_error_m"),
        "predicted_final_error_independent_m": of("predicted_final_error_independent_m"),
        "one_second": _horizon(of("one_second")),
        "horizons": [
            {"length_m": m, **_horizon(h)} for m, h in itertools.zip_longest(HORIZONS_M, of("horizons") or ())
        ],
    }
