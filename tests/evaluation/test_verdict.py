"""The verdict says in words what the numbers say: true, overconfident, too cautious, outside the domain."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, make_run
from gpvo.dataset.build import build
from gpvo.dataset.errors import interpolate_truth, interpolation_sigma, turn_without_truth_deg
from gpvo.dataset.misread import FixedRotation, fixed_rotation
from gpvo.errors import GpvoError, SourceError
from gpvo.evaluation.consistency import BY_MODEL
from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, evaluate_run, unjudged_run
from gpvo.evaluation.flights import constants_of, flight_of
from gpvo.evaluation.panels import _LEVELS, reliability
from gpvo.evaluation.report import render
from gpvo.evaluation.verdict import verdict
from gpvo.geometry import se3
from gpvo.io.run_read import Run
from gpvo.types import IMPORTED, Array, Mounting, Status, TruthLog, VoLog, VoRecord
from scipy.spatial.transform import Rotation


def evaluated(factors: dict[str, float | Array]) -> Evaluation:
    """A run whose methods state the true covariance times a factor each, a number or (6, 6)."""
    log, truth = make_run(600)
    records = [
        replace(r, v_t={}, covariances={m: f * r.covariances["triangulation"] for m, f in factors.items()})
        if r.usable
        else r
        for r in log
    ]
    return evaluate_run(Run(Path("hall"), "hall", VoLog(records, log.camera), truth, None, Mounting(), []))


@pytest.mark.parametrize(
    "factor,colour,word", [(1.0, "green", "is honest"), (0.1, "red", "overconfident"), (10.0, "amber", "too cautious")]
)
def test_one_method(factor: float, colour: str, word: str) -> None:
    found = verdict(evaluated({"triangulation": factor}))
    assert found.colour == colour
    assert word in found.headline
    if factor != 1.0:
        assert "by a factor of 3." in found.lines[0]


def test_a_tiny_nees_is_not_called_nothing() -> None:
    (line,) = verdict(evaluated({"triangulation": 1000.0})).lines
    assert re.search(r"NEES/dof 0\.001, 0\.00[1-9] over 1 s", line), line


def test_a_run_too_short_for_any_distance_is_judged_per_motion_alone() -> None:
    log, truth = make_run(600)
    short = VoLog(log.records[:12], log.camera)
    found = verdict(evaluate_run(Run(Path("hall"), "hall", short, truth, None, Mounting(), [])))
    assert "per motion; over a second or a distance, nothing can be judged" in found.headline


def test_only_spans_that_were_judged_are_named() -> None:
    """A hover is honest over a second, and over no distance."""
    evaluation = evaluated({"triangulation": 1.0})
    assert verdict(evaluation).headline.endswith("per motion and over 1 s, 1 m and 10 m.")
    hover = replace(evaluation.consistency["triangulation"], horizons=())
    found = verdict(replace(evaluation, consistency={"triangulation": hover}))
    assert found.headline.endswith("is honest here, per motion and over 1 s.")


@pytest.mark.parametrize("factors", [{"triangulation": 1.0}, {}])
def test_the_summary_of_a_report_judges_nothing_that_its_sections_do_not(factors: dict[str, float | Array]) -> None:
    """Neither by a truth that is too noisy, nor where nothing was stated."""
    evaluation = replace(evaluated(factors), tells_from_m=float("inf"))
    summary = render([evaluation, evaluation]).split("</nav>")[0]
    assert summary.count("cannot be judged") == 2
    assert "honest" not in summary


def test_slips_that_the_model_names_are_no_lost_frames() -> None:
    evaluation = evaluated({"triangulation": 1.0})
    log = evaluation.run.log
    weak = {51: replace(log.records[51], status=Status.DEGRADED, reason="few inliers")}
    called = [weak.get(k, r).with_status(Status.LOST, BY_MODEL) if k in (50, 51) else r for k, r in enumerate(log)]
    told = " ".join(verdict(replace(evaluation, run=replace(evaluation.run, log=VoLog(called)))).lines)
    assert f"The model calls 2 of {len(log)} motions lost, most as slips" in told
    assert "--max-acceleration" in told
    assert "no motion" not in told


def test_translation_does_not_make_up_for_rotation() -> None:
    """Translation stated three times too large, rotation 1.55 times too small: as a whole that seems right."""
    sigma = np.repeat([3.0, 1 / 1.55], 3)
    evaluation = evaluated({"triangulation": np.outer(sigma, sigma)})
    assert 0.5 < evaluation.consistency["triangulation"].nees_dof_truth_noise["joint"] < 2.0
    found = verdict(evaluation)
    assert found.colour == "red"
    assert "too cautious in translation and overconfident in rotation" in found.headline
    assert "too cautious by a factor of 3.0 in sigma in translation" in found.lines[0]
    assert "overconfident by a factor of 1.6 in sigma in rotation" in found.lines[0]


def test_the_method_that_is_true_is_named() -> None:
    found = verdict(evaluated({"triangulation": 0.05, "pointing_matching": 1.0}))
    assert found.colour == "green"
    assert "pointing_matching" in found.headline
    assert any(line.startswith("triangulation: overconfident") for line in found.lines)


def test_where_nothing_is_stated_the_cure_comes_first() -> None:
    log, truth = make_run(600)
    bare = VoLog([replace(r, v_t={}, covariances={}) for r in log], log.camera)
    evaluation = evaluate_run(Run(Path("hall"), "hall", bare, truth, None, Mounting(), []))
    found = verdict(replace(evaluation, in_domain=0.5))
    assert found.headline.startswith("No covariance was stated")
    assert found.lines[0].startswith("gpvo train learns one")


def test_outside_the_domain_is_never_green() -> None:
    found = verdict(replace(evaluated({"triangulation": 1.0}), in_domain=0.1))
    assert found.colour == "red"
    assert "does not know these conditions" in found.headline
    assert any(line.startswith("10 % of the frames") for line in found.lines)


@pytest.mark.parametrize(("every", "colour"), [(3, "green"), (2, "amber")])
def test_a_run_that_is_mostly_lost_is_never_green(every: int, colour: str) -> None:
    evaluation = evaluated({"triangulation": 1.0})
    log = evaluation.run.log
    lost = [r.with_status(Status.LOST, "dark") if k % 6 > every else r for k, r in enumerate(log)]
    lost[1] = lost[1].with_status(Status.LOST, "dark")
    found = verdict(replace(evaluation, run=replace(evaluation.run, log=replace(log, records=lost))))
    assert found.colour == colour
    assert found.headline.endswith("; but most motions are lost.") == (colour == "amber")


def test_a_model_that_does_not_fit_is_never_green() -> None:
    """Judged by its own training run, or made for another odometry: a good score says nothing of the next flight."""
    evaluation = evaluated({"learned": 1.0, "triangulation": 1.0})
    assert verdict(evaluation).colour == "green"
    found = verdict(replace(evaluation, misfits=("it learned from this very run",)))
    assert found.colour == "amber"
    assert "the model does not fit this run" in found.headline
    assert any("it learned from this very run" in line for line in found.lines)


def test_only_what_can_be_published_is_advised() -> None:
    evaluation = evaluated({"learned": 0.05, "base": 1.0, "triangulation": 1.1})
    records = [replace(r, covariances={k: v for k, v in r.covariances.items() if k == "triangulation"})
               for r in evaluation.run.log]  # fmt: skip
    log = VoLog(records, evaluation.run.log.camera)
    lines = verdict(replace(evaluation, run=replace(evaluation.run, log=log))).lines
    assert any(line.startswith("base: honest") for line in lines)
    (advice,) = (line for line in lines if line.startswith("Use "))
    assert advice == "Use triangulation here (gpvo publish --method triangulation): it is honest."


@pytest.mark.parametrize(("angle_deg", "asks"), [(2.0, False), (89.0, False), (120.0, True), (179.5, True)])
def test_a_rotation_that_no_mounting_has_is_asked_about(angle_deg: float, asks: bool) -> None:
    found = verdict(replace(evaluated({"triangulation": 1.0}), turned=FixedRotation(angle_deg, (0.0, 0.0, 0.0), -0.5)))
    [line] = [
        line
        for line in found.lines
        if f"fixed rotation of {angle_deg:.2f} deg (mounting, calibration, or a steady bias" in line
    ]
    assert ("quaternion's order" in line) is asks
    assert ("--frame" in line) is asks
    assert "50 % smaller" in line


def test_nothing_stated_is_said() -> None:
    assert "nothing can be judged" in verdict(evaluated({})).headline


def of_truth(change: Callable[[TruthLog], TruthLog], align: str = "none") -> Evaluation:
    log, truth = make_run(600, v_t=False)
    run = Run(Path("hall"), "hall", log, change(truth), None, Mounting(), [])
    return evaluate_run(run, options=EvaluateOptions(align=align))


def scaled(truth: TruthLog, factor: float) -> TruthLog:
    T = truth.T_world_cam.copy()
    T[:, :3, 3] *= factor
    return replace(truth, T_world_cam=T)


def test_clocks_that_differ_are_named_and_not_taken_for_a_rotation() -> None:
    assert of_truth(lambda truth: truth).late_s is None
    late = of_truth(lambda truth: replace(truth, t_ns=truth.t_ns + 200_000_000))
    assert late.late_s == pytest.approx(0.2, abs=0.01)
    assert late.turned is None
    assert any("with --time-offset auto, errors" in line for line in verdict(late).lines)


@pytest.mark.parametrize("factor,told", [(1.0, False), (1e3, True), (0.5, True), (0.9, False)])
def test_another_unit_is_named(factor: float, told: bool) -> None:
    lines = verdict(of_truth(lambda truth: scaled(truth, factor))).lines
    assert any("times as large as the truth's: are both in metres?" in line for line in lines) == told
    assert any("Are the baseline and the focal length right?" in line for line in lines) == told
    assert any("1.11 times as large as the truth's: a wrong baseline" in line for line in lines) == (factor == 0.9)


def test_a_log_that_starts_again_at_its_origin_is_not_in_another_unit() -> None:
    log, truth = make_run(600)
    poses = log.trajectory()
    again = [replace(r, T_prev_cur=se3.inverse(poses[k - 1])) if k == 300 else r for k, r in enumerate(log)]
    run = Run(Path("hall"), "hall", replace(log, records=again), truth, None, Mounting(), [])
    lines = verdict(evaluate_run(run)).lines
    assert any("In 1 of 600 motions" in line for line in lines)
    assert not any("in metres?" in line for line in lines), lines
    feet = [replace(r, T_prev_cur=longer(r.T_prev_cur, 3.28), is_reference=True) for r in log]
    often_lost = [r.with_status(Status.LOST, "dark") if k % 20 == 10 else r for k, r in enumerate(feet)]
    lines = verdict(evaluate_run(replace(run, log=replace(log, records=often_lost)))).lines
    assert any("path is 3.2" in line for line in lines), lines


def longer(T: np.ndarray, factor: float) -> np.ndarray:
    out = T.copy()
    out[:3, 3] *= factor
    return out


def test_odometry_propagated_between_corrections_is_told_from_a_truth_that_was_made_of_it() -> None:
    log, truth = make_run(600, v_t=False)
    exact = se3.inverse(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    some = [r if k % 10 == 0 else replace(r, T_prev_cur=exact[k - 1]) for k, r in enumerate(log)]
    found = verdict(evaluate_run(Run(Path("imu"), "imu", replace(log, records=some), truth, None, Mounting(), [])))
    assert not found.judged
    assert "or is odometry propagated between corrections" in found.headline


@pytest.mark.parametrize("factor", [0.9, 1.05, 2.5])
@pytest.mark.parametrize("lever_m", [0.0, 0.4])
def test_a_scale_is_not_taken_for_a_lever_arm_nor_hides_one(factor: float, lever_m: float) -> None:
    """A camera alone, or a wrong baseline: a lever arm that stood in for it was named, with what would fit it."""
    X = se3.exp(np.array([lever_m, 0.0, 0.0, 0.2, 0.0, 0.0])) if lever_m else np.eye(4)
    log, truth = make_run(600, v_t=False)
    log = replace(log, records=[replace(r, T_prev_cur=_scaled(r.T_prev_cur, factor)) for r in log])
    found = fixed_rotation(log, replace(truth, T_world_cam=truth.T_world_cam @ X))
    assert found is not None
    assert found.scale == pytest.approx(factor, rel=0.03 if lever_m else 0.01)
    assert found.lever_m == pytest.approx(lever_m, abs=0.05)


@pytest.mark.parametrize(("sigma", "told"), [(1e-17, False), (1e-4, True)])
def test_rounding_is_no_noise_of_a_truth(sigma: float, told: bool) -> None:
    """As on the axes along which an exactly planar one does not move."""
    found = verdict(replace(evaluated({"triangulation": 1.0}), truth_sigma=np.full(6, sigma)))
    assert any("has an estimated noise" in line for line in found.lines) is told


@pytest.mark.parametrize(("align_change", "advised"), [(0.0, False), (-0.2, True)])
def test_align_is_advised_only_where_it_helps(align_change: float, advised: bool) -> None:
    """It fits no size: what fits only beside another size was advised again and again, with a rotation of 0.00 deg."""
    turned = FixedRotation(0.001, (0.0, 0.0, 2e-5), -0.49, lever_m=0.0734, scale=0.974, align_change=align_change)
    [line] = [t for t in verdict(replace(evaluated({}), turned=turned)).lines if "0.974 times" in t]
    assert "fixed rotation" not in line
    assert ("--align transform, but nothing takes off the size" in line) is advised
    assert ("Without it and a lever arm of 0.0734 m, errors over a second are 49 % smaller." in line) is not advised


def test_what_a_scale_alone_explains_is_no_gain_of_align() -> None:
    log, truth = make_run(600, v_t=False)
    log = replace(log, records=[replace(r, T_prev_cur=_scaled(r.T_prev_cur, 0.9)) for r in log])
    turned = {
        lever: fixed_rotation(log, replace(truth, T_world_cam=truth.T_world_cam @ X)) for lever, X in _ARMS.items()
    }
    assert turned[0.0].align_change == 0.0
    assert turned[0.4].error_change < turned[0.4].align_change < -0.1


_ARMS = {0.0: np.eye(4), 0.4: se3.exp(np.array([0.4, 0.0, 0.0, 0.2, 0.0, 0.0]))}


def _scaled(T: Array, factor: float) -> Array:
    return se3.from_rt(T[:3, :3], factor * T[:3, 3])


def _other_flight(truth: TruthLog) -> TruthLog:
    turned = np.arange(len(truth.t_ns))[::-1]
    back = se3.inverse(truth.T_world_cam[turned[0]]) @ truth.T_world_cam[turned]
    return replace(truth, T_world_cam=back @ se3.exp(np.array([0, 0, 0, 0, np.pi, 0])))


def _with_attitudes(change: Callable[[Array], Array]) -> Callable[[TruthLog], TruthLog]:
    """Of quaternions (N, 4), x y z w."""

    def changed(truth: TruthLog) -> TruthLog:
        T = truth.T_world_cam.copy()
        T[:, :3, :3] = Rotation.from_quat(change(Rotation.from_matrix(T[:, :3, :3]).as_quat())).as_matrix()
        return replace(truth, T_world_cam=T)

    return changed


def _mirrored(truth: TruthLog) -> TruthLog:
    T = truth.T_world_cam.copy()
    T[:, 1, 3] *= -1
    return replace(truth, T_world_cam=T)


def _increments(truth: TruthLog) -> TruthLog:
    T = truth.T_world_cam
    return replace(truth, T_world_cam=np.concatenate([np.eye(4)[None], se3.inverse(T[:-1]) @ T[1:]]))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (_with_attitudes(lambda q: q[:, [3, 0, 1, 2]]), "not with the same attitudes"),
        (_with_attitudes(lambda q: q * [-1, -1, -1, 1]), "not with the same attitudes"),
        (_mirrored, "not with the same attitudes"),
        (_other_flight, "do not move alike"),
        (_increments, "do not move alike"),
        (lambda t: replace(t, t_ns=t.t_ns[0] + 2 * (t.t_ns - t.t_ns[0])), "do not move alike"),
        (lambda t: scaled(t, 1e3), ""),
        (lambda t: t, ""),
    ],
)
def test_poses_that_are_not_what_they_are_taken_for_are_named(
    change: Callable[[TruthLog], TruthLog], told: str
) -> None:
    """And neither for a mounting, nor another unit or clock. A truth of another unit is no other flight."""
    found = of_truth(lambda truth: change(replace(truth, T_world_cam=WORLD @ truth.T_world_cam)))
    lines = "\n".join(verdict(found).lines)
    assert (found.unlike is not None) == bool(told)
    assert told in lines
    if told:
        assert not any(other in lines for other in ("fixed rotation", "in metres?", "clocks"))


WORLD = se3.exp(np.array([4.0, -2.0, 1.0, 0.3, -0.5, 1.1]))


def test_a_truth_slower_than_the_frames_does_not_make_a_covariance_overconfident() -> None:
    found = of_truth(lambda truth: replace(truth, t_ns=truth.t_ns[::4], T_world_cam=truth.T_world_cam[::4]))
    c = found.consistency["triangulation"]
    plain, joint = c.nees_dof["joint"], c.nees_dof_truth_noise["joint"]
    assert plain is not None
    assert joint is not None
    assert joint < min(plain.mean, 1.2)
    assert found.run.truth is not None
    missed = interpolation_sigma(found.run.truth, found.run.log.t_ns)
    assert (found.truth_sigma >= missed * (1 - 1e-9)).all()
    assert missed.all()
    told = "The ground truth comes every 0.2 s, the frames every 0.05 s"
    assert any(line.startswith(told) for line in verdict(found).lines)
    assert not of_truth(lambda truth: truth).truth_sigma.any()


@pytest.mark.parametrize(
    "kept,told",
    [
        (slice(0, 2), "has 2 frames; three with truth are needed"),
        (slice(None), "only [0-9]* of 601 frames lie near poses of the ground truth"),
    ],
)
def test_too_little_truth_is_told_from_none(kept: slice, told: str) -> None:
    log, truth = make_run(600, v_t=False)
    every = 20 if kept == slice(None) else 1
    truth = replace(truth, t_ns=truth.t_ns[3::every] + 1, T_world_cam=truth.T_world_cam[3::every])
    if kept != slice(None):
        log, truth = VoLog(log.records[kept], log.camera), make_run(600)[1]
    with pytest.raises(SourceError, match=told):
        evaluate_run(Run(Path("hall"), "hall", log, truth, None, Mounting(), []))


def test_without_truth_nothing_is_judged() -> None:
    run = Run(Path("hall"), "hall", make_run(60, v_t=False)[0], None, None, Mounting(), [])
    assert verdict(unjudged_run(run)).headline == "There is no ground truth, so no covariance can be judged."


@pytest.mark.parametrize("unseen_variance", [1e-9, 1e6])
def test_axes_on_which_odometry_and_truth_never_differ_are_not_judged(unseen_variance: float) -> None:
    """A robot in a plane: its errors have three degrees of freedom, whatever its driver states of the others."""
    sigma, n, rng = np.array([1e-3, 2e-3, 5e-4]), 600, np.random.default_rng(0)
    seen, moved = [0, 2, 4], np.zeros((n, 6))
    moved[:, 2], moved[:, 4] = 0.05, 0.02 * np.cos(0.03 * np.arange(n))
    xi = np.zeros((n, 6))
    xi[:, seen] = rng.normal(0.0, sigma, (n, 3))
    C = np.diag(np.full(6, unseen_variance))
    C[seen, seen] = sigma**2
    t = START_NS + np.arange(n + 1) * 50_000_000
    T = se3.exp(moved)
    poses = [np.eye(4)]
    for step in T:
        poses.append(poses[-1] @ step)
    records = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))] + [
        VoRecord(int(t[k + 1]), int(t[k]), Status.OK, T[k] @ se3.exp(xi[k]), n_inliers=100, covariances={IMPORTED: C})
        for k in range(n)
    ]
    run = Run(Path("hall"), "hall", VoLog(records), TruthLog(t, np.array(poses)), None, Mounting(), [])
    found = evaluate_run(run)
    c = found.consistency[IMPORTED]
    assert c.axes == (0, 2, 4)
    assert c.nees_dof["joint"] is not None
    # 1,800 squared normal values: 0.033 is one standard deviation.
    assert c.nees_dof["joint"].mean == pytest.approx(1.0, abs=0.14)
    assert c.horizons[1].nees_dof == pytest.approx(1.0, abs=0.7)
    assert c.coverage["1"] == pytest.approx(0.683, abs=0.05)
    assert c.energy["rotation_rad"] is not None
    assert c.energy["rotation_rad"] < 5e-4
    told = verdict(found)
    assert told.colour == "green"
    assert any("never differ in y, rx and rz of the camera" in line for line in told.lines)
    # What is drawn agrees with what is said.
    (drawn,) = reliability(found)
    assert drawn["lines"][0]["y"][4] == pytest.approx(float(_LEVELS[4]), abs=0.06)


def test_a_copy_of_the_odometry_is_no_truth() -> None:
    log, _ = make_run(200, v_t=False)
    run = Run(Path("hall"), "hall", log, TruthLog(log.t_ns, log.trajectory()), None, Mounting(), [])
    found = verdict(evaluate_run(run))
    assert (found.colour, found.lines) == ("amber", ())
    assert "was the truth made from odometry?" in found.headline


def test_a_truth_that_cannot_tell_motions_judges_none() -> None:
    """Positions 8 mm off, motions of 5 cm with errors of 2 mm: only over metres do the errors show. Per motion, the
    truth's noise makes the widest statement the likeliest."""
    log, truth = make_run(1600, v_t=False)
    T = truth.T_world_cam.copy()
    T[:, :3, 3] += np.random.default_rng(1).normal(0.0, 0.008, (len(T), 3))
    records = [
        replace(r, covariances={m: f * C for m, f in (("a", 1.0), ("wide", 100.0)) for C in r.covariances.values()})
        for r in log
    ]
    run = Run(Path("hall"), "hall", VoLog(records, log.camera), replace(truth, T_world_cam=T), None, Mounting(), [])
    found = evaluate_run(run)
    assert 0.5 < found.tells_from_m < 10
    told = verdict(found)
    assert told.headline.startswith("The a covariance is honest here, over ")
    assert "per motion" not in " ".join(told.lines)
    assert all(f"over {span}" not in line for line in told.lines for span in ("1 s", "1 m"))


def test_frames_without_truth_are_counted_and_a_sparse_truth_is_no_missing_statement() -> None:
    def hole(truth: TruthLog) -> TruthLog:
        kept = np.r_[0:200, 300:601]
        return replace(truth, t_ns=truth.t_ns[kept], T_world_cam=truth.T_world_cam[kept])

    def sparse(truth: TruthLog) -> TruthLog:
        return replace(truth, t_ns=truth.t_ns[::40], T_world_cam=truth.T_world_cam[::40])

    assert "100 of 601 frames have no ground truth." in verdict(of_truth(hole)).lines
    told = verdict(of_truth(sparse))
    assert "Fewer than two motions" in told.headline
    assert any("nothing is interpolated over more than 0.5 s" in line for line in told.lines)


def test_a_truth_in_bursts_is_interpolated_between_them() -> None:
    log, truth = make_run(600, v_t=False)
    fine = np.unique((truth.t_ns[:-1:6, None] + np.arange(10) * 10_000_000).ravel())
    T, known = interpolate_truth(truth, fine)
    assert interpolate_truth(TruthLog(fine[known], T[known]), log.t_ns)[1].mean() > 0.95


def test_a_straight_path_has_an_attitude_that_never_changes() -> None:
    """A vehicle on rails, whose odometry drifts by 6 degrees."""
    t = START_NS + np.arange(601) * 50_000_000
    motion, T = se3.exp(np.array([0.0, 0.0, 0.05, 0.0, 1.8e-4, 0.0])), np.tile(np.eye(4), (601, 1, 1))
    T[:, 2, 3] = 0.05 * np.arange(601)
    records = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))]
    records += [VoRecord(int(b), int(a), Status.OK, motion, n_inliers=100) for a, b in pairwise(t)]
    assert turn_without_truth_deg(VoLog(records), TruthLog(t, T)) == 0.0


def test_a_truth_without_attitude_is_named() -> None:
    def without(truth: TruthLog) -> TruthLog:
        T = truth.T_world_cam.copy()
        T[:, :3, :3] = np.eye(3)
        return replace(truth, T_world_cam=T)

    found, right = of_truth(without), of_truth(lambda truth: truth)
    assert "holds no attitude" in verdict(found).headline
    assert not verdict(found).lines
    assert found.trajectory.ate_rmse_m == right.trajectory.ate_rmse_m
    assert not found.consistency  # neither is anything else that it cannot tell
    assert np.isnan(found.trajectory.final_error_m)
    assert not found.odd
    assert render([found])
    assert "honest" in verdict(of_truth(lambda truth: truth)).headline
    log, truth = make_run(200)
    with pytest.raises(GpvoError, match=r"never turns, but odometry does, by up to [0-9]+ deg"):
        build(log, without(truth), name="hall")
    assert len(build(log, without(truth), name="hall", target="position")) == 200


@pytest.mark.parametrize(("factor", "told"), [(1e3, "0.001"), (3.28, "0.31"), (1e-3, "1e+03"), (2.0, ""), (0.5, "")])
def test_nothing_is_learned_from_a_truth_in_another_unit(factor: float, told: str) -> None:
    log, truth = make_run(200)
    if told:
        with pytest.raises(GpvoError, match=f"are {re.escape(told)} times as large as the truth's"):
            build(log, scaled(truth, factor), name="hall")
        return
    assert len(build(log, scaled(truth, factor), name="hall")) == 200
    noise = np.random.default_rng(0).standard_normal((len(truth.t_ns), 6)) * [0.5, 0.5, 0.5, 0, 0, 0]
    noisy = replace(truth, T_world_cam=truth.T_world_cam @ se3.exp(noise))  # far larger than the motions themselves
    assert len(build(log, noisy, name="hall")) == 200


def test_a_truth_at_rest_but_for_rounding_is_in_no_other_unit() -> None:
    log, truth = make_run(200)
    rng, shape = np.random.default_rng(1), (len(truth.t_ns), 6)
    still = [replace(r, T_prev_cur=se3.exp(1e-3 * rng.standard_normal(6))) for r in log]
    for _ in range(4):  # by chance, half of them go with the odometry's noise
        rounded = replace(truth, T_world_cam=se3.exp(1e-13 * rng.standard_normal(shape)))
        assert len(build(replace(log, records=still), rounded, name="hover")) > 100


def test_no_filter_starts_from_a_truth_without_attitude_nor_takes_a_constant_from_it() -> None:
    log, truth = make_run(600, v_t=False)
    T = truth.T_world_cam.copy()
    T[:, :3, :3] = np.eye(3)
    run = Run(Path("hall"), "hall", log, replace(truth, T_world_cam=T), None, Mounting(), [])
    for use in (flight_of, lambda run: constants_of([run])):
        with pytest.raises(GpvoError, match="hall: the ground truth holds no attitude"):
            use(run)


def test_few_motions_that_make_up_every_mean_are_named() -> None:
    def moved(truth: TruthLog) -> TruthLog:
        T = truth.T_world_cam.copy()
        here = T[100].copy()  # from where it goes on turned, as some vehicle might turn
        T[100:] = here @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.4, 0.0])) @ se3.inverse(here) @ T[100:]
        return replace(truth, T_world_cam=T)

    lines = verdict(of_truth(moved)).lines
    assert any("In 1 of 600 motions, first at frame 100 (5.00 s)" in line for line in lines), lines
    assert not any("outweigh all others" in line for line in verdict(of_truth(lambda truth: truth)).lines)


def test_a_jump_that_no_vehicle_makes_is_not_scored_and_a_stalled_truth_is_named() -> None:
    def faulty(truth: TruthLog) -> TruthLog:
        T = truth.T_world_cam.copy()
        T[100:] = se3.exp(np.array([3.0, 2.0, 0.0, 0.0, 0.0, 0.5])) @ T[100:]
        T[400:420] = T[400]
        return replace(truth, T_world_cam=T)

    found, right = of_truth(faulty), of_truth(lambda truth: truth)
    assert found.unscored == 1
    assert any("motions 100 to 100: truth jumps" in str(s) for s in found.odd)
    nees = [e.consistency["triangulation"].nees_dof["joint"].mean for e in (found, right)]
    assert nees[0] == pytest.approx(nees[1], rel=0.02)
    assert any(
        "19 of 601 poses of the ground truth only repeat the one before" in line for line in verdict(found).lines
    )


def test_a_lever_arm_of_the_truth_is_named_and_taken_off() -> None:
    """Markers elsewhere on the vehicle, turned relative to the camera."""

    def of_markers(truth: TruthLog) -> TruthLog:
        X = se3.exp(np.array([0.3, -0.1, 0.2, 0.4, -0.2, 0.1]))
        return replace(truth, T_world_cam=truth.T_world_cam @ X)

    told = [line for line in verdict(of_truth(of_markers)).lines if "fixed rotation" in line]
    assert len(told) == 1
    assert "lever arm of 0.3" in told[0]
    assert told[0].endswith("(--align transform).")
    found, right = of_truth(of_markers, align="transform"), of_truth(lambda truth: truth)
    assert found.turned is right.turned is None
    nees = [e.consistency["triangulation"].nees_dof["joint"].mean for e in (found, right)]
    assert nees[0] == pytest.approx(nees[1], rel=0.02)
