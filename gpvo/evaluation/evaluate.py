"""One run against its truth: trajectory errors, and the consistency of every method, in one object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import along
from gpvo.dataset.build import aligned, predictions_of
from gpvo.dataset.check import check, predictor_of
from gpvo.dataset.clock import on_clock_of_log
from gpvo.dataset.doubtful import Stretch, in_waits, jumps, odd_stretches, without_wandering_truth
from gpvo.dataset.errors import (
    MAX_GAP_S,
    MotionErrors,
    interpolate_truth,
    interpolation_sigma,
    motion_errors,
    turn_without_truth_deg,
)
from gpvo.dataset.misread import FixedRotation, InversePoses, Misread, Resemblance, late_by
from gpvo.dataset.truth_noise import (
    TruthNoise,
    estimate_truth_noise,
    of_errors,
    rates_of,
    telling_distance_m,
    velocity_path,
)
from gpvo.errors import NO_TRUTH, SourceError
from gpvo.evaluation.consistency import BY_MODEL, Consistency, consistency
from gpvo.evaluation.statements import Statement, statements
from gpvo.evaluation.trajectory import (
    PoseConsistency,
    TrajectoryErrors,
    pose_consistency,
    trajectory_errors,
)
from gpvo.geometry import se3
from gpvo.io.run import Run, read_run
from gpvo.online.predictor import Predictor
from gpvo.types import Array, Prediction, Status, TruthLog, VoLog


@dataclass(frozen=True)
class EvaluateOptions:
    """``truth_sigma`` (m, rad) per pose, or (m, rad, s) with jitter of stamps; None for what the source states or the
    run shows, whichever is more. ``time_offset_s`` None to estimate it."""

    segments_m: tuple[float, ...] | None = None
    truth_sigma: tuple[float, ...] | None = None
    align: str = "none"
    time_offset_s: float | None = 0.0


@dataclass(frozen=True)
class Evaluation:
    """Everything said of one run; what scripts read of it is explained there, by
    :func:`gpvo.evaluation.document.document`.

    ``covered``: frames with truth; ``T_est`` and ``T_true`` (N, 4, 4) with the first poses made equal. ``truth_sigma``,
    ``truth_sigma_stated`` (6,): by axis; ``truth_noise`` (M, 6, 6): what the truth's noise and the jitter of its stamps
    add to the errors, None for nothing. ``late_s``: offset between the clocks, where it matters and none was given;
    ``turned``: a fixed rotation between truth and odometry, likewise. ``unscored``: motions left out of errors and
    consistency. ``misfits``: why else the model does not fit the run, or cannot be judged by it.
    """

    run: Run
    errors: MotionErrors
    trajectory: TrajectoryErrors
    statements: Sequence[Statement]
    consistency: Mapping[str, Consistency]
    covered: NDArray[np.bool_]
    T_est: Array
    T_true: Array
    truth_sigma: Array = field(default_factory=lambda: np.zeros(6))
    truth_sigma_stated: Array = field(default_factory=lambda: np.zeros(6))
    truth_jitter_s: float = 0.0
    truth_noise: Array | None = None
    time_offset_s: float = 0.0
    tells_from_m: float = 0.0
    turned: FixedRotation | None = None
    inverse: InversePoses | None = None
    unlike: Resemblance | None = None
    late_s: float | None = None
    unscored: int = 0
    odd: Sequence[Stretch] = ()
    in_domain: float | None = None
    misfits: tuple[str, ...] = ()
    poses: PoseConsistency | None = None

    @cached_property
    def shown(self) -> Statement | None:
        """The statement to draw bounds of: ``learned`` if there is one, else ``triangulation``, else any full one."""
        full, rank = (s for s in self.statements if s.errors is not None), {"learned": 0, "triangulation": 1}
        return min(full, key=lambda s: rank.get(s.method, 2), default=None)

    @property
    def shown_method(self) -> str:
        """Its name for a caption."""
        return "no method" if self.shown is None else self.shown.method

    @cached_property
    def shown_bounds(self) -> Array | None:
        """(N, 6, 6) covariance of every pose by that statement; None without one."""
        if self.shown is None or self.shown.errors is None:
            return None
        return along(self.run.log.T_prev_cur, self.shown.errors, self.run.log.parent)[1]

    @property
    def T_world_first(self) -> Array:
        """(4, 4) of the first frame with truth; where there is none, of the first frame."""
        return self.T_true[self.covered][0] if self.covered.any() else self.T_est[0]

    @property
    def t_s(self) -> Array:
        """(N,) seconds since the first frame."""
        return (self.run.log.t_ns - self.run.log.t_ns[0]) * 1e-9

    def __str__(self) -> str:
        t = self.trajectory
        return f"{self.run.name}: ATE {t.ate_rmse_m:.3g} m over {t.path_length_m:.1f} m"


def evaluate_run(
    run: Run | str | Path,
    predictor: Predictor | None = None,
    options: EvaluateOptions | None = None,
    further: Sequence[Statement] = (),
    misfits: tuple[str, ...] | None = None,
) -> Evaluation:
    """Evaluate a run, or its folder, against its truth; with a predictor, predictions are made as in flight, else those
    of the run are used. A motion that either says is lost counts as lost for every method. ``further``: methods of
    elsewhere. ``misfits``: those of :func:`gpvo.dataset.check.check`, where they are known.

    Raises SourceError if the run has no truth, or none at the times of its frames; ModelError if the model predicts
    something else than the error of a motion.
    """
    run, options = read_run(run), options or EvaluateOptions()
    fitted, offset_s = aligned(run, options.align, options.time_offset_s)
    if (truth := fitted.truth) is None:
        raise SourceError("has no ground truth", where=run.path, cure=NO_TRUTH)
    predictions, misfits = predictions_of(run, predictor), _misfits(run, predictor, misfits)
    run = replace(run, log=judged(run.log, predictions))
    log = run.log
    T_true, known = interpolate_truth(truth, log.t_ns)
    _refuse_too_little(run, truth, int(known.sum()))
    blind = turn_without_truth_deg(log, truth) > 0.0
    leaps = [] if blind else jumps(log, truth)
    unseen = (r.with_status(Status.LOST, "truth has no attitude") for r in log)  # positions alone judge no motion
    scored = log.judged_as(unseen) if blind else without_wandering_truth(log, truth, leaps)
    errors = motion_errors(scored, truth)
    given = options.truth_sigma or (truth.sigma_translation_m, truth.sigma_rotation_rad)
    stated = np.repeat(given[:2], 3)
    noise, rates = TruthNoise(stated, sum(given[2:])), rates_of(T_true, log.t_ns, known)
    if options.truth_sigma is None:
        shown = estimate_truth_noise(errors, scored)
        least = np.maximum(stated, interpolation_sigma(truth, log.t_ns))
        noise = replace(shown, sigma=np.maximum(shown.sigma, least))
    sigma, added = noise.usual(rates[known]), None
    if sigma.any():
        added = (noise.of_poses(rates), of_errors(errors, scored, noise.of_poses(rates)))
    late_s = late_by(scored, truth) if options.time_offset_s == 0.0 else None
    on_its_clock = on_clock_of_log(truth, late_s) if late_s else truth
    misread = Misread.of(scored, on_its_clock)
    T_est = log.trajectory()
    made = statements(log, predictions, predictor, further)
    by_velocity = velocity_path(truth, log.t_ns) if options.truth_sigma is None else None

    def judge(statement: Statement) -> Consistency | None:
        return consistency(statement, errors, scored, T_true, known, added, by_velocity)

    found = list(map(judge, made))  # each statement is let go before the next
    first = int(np.flatnonzero(known)[0])
    number = np.arange(len(log)) + np.cumsum(in_waits(log, [s.t_ns for s in leaps]))  # no window over a jump is whole
    trajectory = trajectory_errors(log.t_ns[known], T_est[known], T_true[known], options.segments_m, number[known])
    if blind:
        trajectory = TrajectoryErrors.of_positions(trajectory.path_length_m, trajectory.ate_rmse_m)
    lift = T_true[first] @ np.linalg.inv(T_est[first])
    return Evaluation(
        run=run,
        errors=errors,
        trajectory=trajectory,
        statements=made,
        consistency={c.method: c for c in found if c is not None},
        covered=known,
        T_est=lift @ T_est,
        T_true=T_true,
        truth_sigma=sigma,
        truth_sigma_stated=stated,
        truth_jitter_s=noise.jitter_s,
        truth_noise=added and added[1],
        tells_from_m=telling_distance_m(scored, T_true, known, sigma),
        turned=misread.turned if options.align == "none" else None,
        inverse=misread.inverse,
        unlike=misread.unlike,
        time_offset_s=offset_s,
        late_s=late_s,
        unscored=0 if blind else int(log.usable.sum() - scored.usable.sum()),
        odd=[] if blind else [*leaps, *odd_stretches(scored, truth)],
        poses=pose_consistency(log, T_est, T_true, known),
        in_domain=_in_domain(predictions),
        misfits=misfits,
    )


def _refuse_too_little(run: Run, truth: TruthLog, known: int) -> None:
    if known >= 3:
        return
    t = run.log.t_ns
    inside = int(((t >= truth.t_ns[0]) & (t <= truth.t_ns[-1])).sum()) if len(truth.t_ns) else 0
    if inside < min(3, len(t)):
        what = "ground truth and frames do not overlap in time"
        cure = "use --time-offset auto, or give the truth of this run"
    elif inside < 3:
        what, cure = f"has {len(t)} frames; three with truth are needed", "give a longer sequence"
    else:
        what = f"only {known} of {len(t)} frames lie near poses of the ground truth"
        cure = f"give a truth with evenly spaced poses, at most {MAX_GAP_S:g} s apart"
    raise SourceError(what, where=run.path, cure=cure)


def unjudged_run(run: Run, predictor: Predictor | None = None, misfits: tuple[str, ...] | None = None) -> Evaluation:
    """An evaluation without errors: no frame is covered by truth, and no method has a score.

    Raises ModelError if the model predicts something else than the error of a motion.
    """
    predictions, misfits = predictions_of(run, predictor), _misfits(run, predictor, misfits)
    run = replace(run, log=judged(run.log, predictions))
    T_est, none = run.log.trajectory(), np.zeros((0, 4, 4))
    length = float(se3.path_length_m(T_est[:, :3, 3])[-1])
    return Evaluation(
        run=run,
        errors=MotionErrors(np.zeros(0, np.int64), np.zeros((0, 6)), none, none, np.zeros(0)),
        trajectory=TrajectoryErrors.of_positions(length),
        statements=statements(run.log, predictions, predictor),
        consistency={},
        covered=np.zeros(len(run.log), bool),
        T_est=T_est,
        T_true=np.full_like(T_est, np.nan),
        in_domain=_in_domain(predictions),
        misfits=misfits,
    )


def _misfits(run: Run, predictor: Predictor | None, known: tuple[str, ...] | None) -> tuple[str, ...]:
    predictor = predictor or predictor_of(run) if known is None else None
    return known or () if predictor is None else check(predictor, run).misfits


def _in_domain(predictions: Mapping[int, Prediction]) -> float | None:
    """A motion that is lost, as one after a jump, was not measured: it tells nothing about the conditions."""
    measured = [bool(p.in_domain > 0.5) for p in predictions.values() if p.measured]
    return float(np.mean(measured)) if measured else None


def judged(log: VoLog, predictions: Mapping[int, Prediction]) -> VoLog:
    """The log as a flight with the model would write it: each status the worse of odometry's and the model's."""
    told = ((r, predictions.get(r.t_ns)) for r in log)
    return log.judged_as(
        r if p is None or r.status is Status.START else r.with_status(p.status, BY_MODEL) for r, p in told
    )


def distinct(names: Sequence[str]) -> list[str]:
    """Names of runs, later ones of a kind numbered: ``a``, ``a-2``."""
    out: list[str] = []
    for name in names:
        k, candidate = 2, name
        while candidate in out:
            candidate, k = f"{name}-{k}", k + 1
        out.append(candidate)
    return out
