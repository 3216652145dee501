"""``gpvo evaluate`` from a run folder to the numbers that scripts read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import make_run, stated_covariance
from gpvo.dataset.build import build
from gpvo.dataset.check import check
from gpvo.errors import ModelError
from gpvo.evaluation.document import document
from gpvo.evaluation.evaluate import EvaluateOptions, evaluate_run
from gpvo.evaluation.statements import statements
from gpvo.geometry import se3
from gpvo.io.run import Run, read_run, write_run
from gpvo.io.trajectory import write_tum
from gpvo.learning.methods import METHODS, score
from gpvo.learning.store import save_model
from gpvo.learning.thesis import fit_thesis
from gpvo.online import modelfile
from gpvo.online.predictor import Predictor
from gpvo.types import IMPORTED_POSE, Mounting, Prediction, Status, TruthLog, VoLog
from small_model import small_model
from synthetic_runs import make_run as synthetic_run

from command_line import gpvo
from motion_errors import prediction

RUN_KEYS = {"run", "source", "frames", "lost", "path_length_m", "ate_rmse_m", "rmse_origin_m", "final_error_m"}
METHOD_KEYS = {"nees_dof", "nees_dof_median", "coverage", "nll_per_dim", "crps", "predicted_final_error_m", "horizons"}


def predictions_of(log: VoLog) -> list[Prediction]:
    C = stated_covariance()
    parts = [share * C for share in (0.3, 0.5, 0.2)]
    made = (r for r in log if r.status is not Status.START)
    return [replace(prediction(r.t_ns, *parts, dt_s=r.dt_s, confidence=0.9), status=r.status) for r in made]


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """300 motions, one frame lost, with truth and predictions."""
    log, truth = make_run(300, lost={40})
    path = tmp_path_factory.mktemp("runs") / "hall"
    write_run(path, log, predictions=predictions_of(log), truth=truth, meta={"source": "made"})
    return path


def _assert_refused(*args: object, says: str) -> None:
    code, out, err = gpvo("evaluate", *args)
    assert code == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert says in err


def test_json_has_every_name_of_the_interface(run_folder):
    code, out, _ = gpvo("evaluate", run_folder, "--json")
    assert code == 0
    found = json.loads(out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert found["schema"] == 1
    (run,) = found["runs"]
    assert set(run) >= RUN_KEYS
    assert (run["run"], run["source"], run["frames"], run["lost"]) == ("hall", "made", 301, 1)
    assert set(run["segments"][0]) == {"length_m", "translation_percent", "rotation_deg_per_m", "count"}
    # 15 m of path: longer segments have no figure.
    assert [(s["length_m"], s["translation_percent"]) for s in run["segments"][1:]] == [
        (20.0, None), (50.0, None), (100.0, None),
    ]  # fmt: skip
    assert set(run["methods"]) >= set(METHODS)
    for method in run["methods"].values():
        assert set(method) >= METHOD_KEYS
        assert set(method["nees_dof"]) == set(method["nees_dof_median"]) == {"translation", "rotation", "joint"}
        assert set(method["coverage"]) == {"1", "2", "3"}
        assert set(method["crps"]) == {"translation_m", "rotation_rad"}
    absent, partial = run["methods"]["gp_thesis"], run["methods"]["triangulation_vt"]
    assert absent["nees_dof"] == {"translation": None, "rotation": None, "joint": None}
    assert absent["nll_per_dim"] is None
    assert [(h["length_m"], h["nees_dof"]) for h in absent["horizons"]] == [(1.0, None), (10.0, None), (100.0, None)]
    assert partial["nees_dof"]["translation"] == pytest.approx(1.0, abs=0.15)
    assert partial["nees_dof"]["joint"] is None
    for method in ("triangulation", "learned"):
        assert run["methods"][method]["nees_dof"]["joint"] == pytest.approx(1.0, abs=0.15)
        # 15 m of path: there is no window of 100 m, so its figure is null.
        last = run["methods"][method]["horizons"][-1]
        assert (last["length_m"], last["nees_dof"], last["count"]) == (100.0, None, 0)


def test_the_table_names_the_methods(run_folder):
    code, out, _ = gpvo("evaluate", run_folder, "--segments", "5,10")
    assert code == 0
    for word in (
        "hall: 301 frames, 1 lost",
        "5 m segments",
        "triangulation",
        "learned",
        "1 s: over a second",
        "NLL: ",
    ):
        assert word in out


def test_spans_that_the_path_is_too_short_for_are_not_told(run_folder, tmp_path):
    run = read_run(run_folder)
    write_run(tmp_path / "short", replace(run.log, records=run.log.records[:20]), truth=run.truth)
    _, out, _ = gpvo("evaluate", tmp_path / "short")
    told = next(line for line in out.splitlines() if "relative error" in line)
    assert "over a frame" in told
    assert "10 m" not in told


@pytest.mark.parametrize("name", ["flight[red]", "[dim]"])
def test_a_name_is_printed_as_it_is(run_folder, tmp_path, name):
    run = read_run(run_folder)
    write_run(tmp_path / name, run.log, truth=run.truth)
    code, out, _ = gpvo("evaluate", tmp_path / name)
    assert code == 0
    assert out.startswith(f"{name}: 301 frames")


def test_what_the_model_calls_lost_is_lost_for_every_method(run_folder):
    run = read_run(run_folder)
    plain = evaluate_run(run)
    lost = [replace(p, status=Status.LOST) if k == 100 else p for k, p in enumerate(run.predictions)]
    found = evaluate_run(replace(run, predictions=lost))
    assert document([found])["runs"][0]["lost"] == 2
    for method in ("triangulation", "learned"):
        assert found.consistency[method].count == plain.consistency[method].count - 1


def test_predictions_over_windows_say_nothing_of_single_motions(run_folder):
    run = read_run(run_folder)
    windows = [replace(p, dt_s=1.0) for p in run.predictions]
    assert "learned" not in evaluate_run(replace(run, predictions=windows)).consistency


def test_parts_make_another_final_error_than_independence(run_folder):
    c = evaluate_run(read_run(run_folder)).consistency["learned"]
    # The jitter does not add up, the bias does.
    assert c.predicted_final_error_m != pytest.approx(c.predicted_final_error_independent_m, rel=0.01)


def test_several_runs_and_truth_from_a_file(run_folder, tmp_path):
    run = read_run(run_folder)
    write_run(tmp_path / "bare", run.log)
    write_tum(tmp_path / "truth.tum", run.truth.t_ns, run.truth.T_world_cam)
    code, out, _ = gpvo("evaluate", tmp_path / "bare", run_folder, "--truth", tmp_path / "truth.tum", "--json")
    assert code == 0
    bare, full = json.loads(out)["runs"]
    assert (bare["run"], full["run"]) == ("bare", "hall")
    assert bare["ate_rmse_m"] == pytest.approx(full["ate_rmse_m"], abs=1e-6)


def test_time_offset_is_found(tmp_path):
    log, truth = make_run(1200)
    shifted = TruthLog(truth.t_ns + 320_000_000, truth.T_world_cam)
    write_run(tmp_path / "late", log, truth=shifted)
    run = read_run(tmp_path / "late")
    found = evaluate_run(run, options=EvaluateOptions(time_offset_s=None))
    assert found.time_offset_s == pytest.approx(0.32, abs=0.02)
    given = evaluate_run(run, options=EvaluateOptions(time_offset_s=0.32))
    assert given.consistency["triangulation"].nees_dof["joint"].mean == pytest.approx(1.0, abs=0.1)
    assert given.trajectory.ate_rmse_m < evaluate_run(run).trajectory.ate_rmse_m


def test_truth_sigma_replaces_that_of_the_source(run_folder):
    run = read_run(run_folder)
    found = evaluate_run(run, options=EvaluateOptions(truth_sigma=(0.01, 0.01)))
    c = found.consistency["triangulation"]
    assert c.nees_dof_truth_noise["joint"] < 0.1 < c.nees_dof["joint"].mean
    assert document([found])["runs"][0]["truth_sigma"] == {"translation_m": 0.01, "rotation_rad": 0.01}


def test_first_poses_are_made_equal(run_folder):
    e = evaluate_run(read_run(run_folder))
    np.testing.assert_allclose(e.T_est[0], e.T_true[0], atol=1e-9)
    np.testing.assert_allclose(se3.inverse(e.T_est[:-1]) @ e.T_est[1:], _motions(e.run.log), atol=1e-9)


def _motions(log: VoLog) -> np.ndarray:
    T = log.trajectory()
    return se3.inverse(T[:-1]) @ T[1:]


def test_bad_flags_are_one_line(run_folder):
    for value in ("ten", "", "0", "-5", "nan", "10,,20", "inf"):
        _assert_refused(run_folder, "--segments", value, says="--segments")
    for value in ("x", "-1", "1,2,3,4", "nan"):
        _assert_refused(run_folder, f"--truth-sigma={value}", says="--truth-sigma")
    for value in ("soon", "nan", "1,2"):
        _assert_refused(run_folder, "--time-offset", value, says="--time-offset")
    _assert_refused(run_folder, "--align", "sideways", says="sideways")


@pytest.mark.parametrize("command", ["evaluate", "report", "fuse", "score"])
def test_one_run_given_twice_is_refused(run_folder, command):
    """Three times the same run had a mean with an interval of no width."""
    code, out, err = gpvo(command, run_folder, run_folder.parent / "." / run_folder.name)
    assert (code, out) == (2, "")
    assert "hall: is given twice" in err


def test_a_run_without_truth_is_one_line(run_folder, tmp_path):
    write_run(tmp_path / "blind", read_run(run_folder).log)
    _assert_refused(tmp_path / "blind", says="blind: has no ground truth")


def test_truth_of_another_day_is_one_line(run_folder, tmp_path):
    run = read_run(run_folder)
    write_run(tmp_path / "other", run.log, truth=replace(run.truth, t_ns=run.truth.t_ns + 10**15))
    _assert_refused(tmp_path / "other", says="do not overlap")


def test_what_is_no_run_is_one_line(tmp_path):
    _assert_refused(tmp_path / "nowhere", says="nowhere")
    (tmp_path / "empty").mkdir()
    _assert_refused(tmp_path / "empty", says="empty")


def test_a_run_that_was_lost_throughout_is_evaluated(tmp_path):
    log, truth = make_run(30, lost=range(1, 31))
    write_run(tmp_path / "dark", log, truth=truth)
    code, out, _ = gpvo("evaluate", tmp_path / "dark", "--json", "--plots", tmp_path / "pictures")
    assert code == 0
    (run,) = json.loads(out)["runs"]
    assert run["lost"] == 30
    assert run["methods"]["triangulation"]["nees_dof"]["joint"] is None


def test_pictures_of_two_runs_of_one_name_lie_side_by_side(run_folder, tmp_path):
    run = read_run(run_folder)
    write_run(tmp_path / "b" / "hall", run.log, truth=run.truth)
    code, _, _ = gpvo("evaluate", run_folder, tmp_path / "b" / "hall", "--plots", tmp_path / "pictures")
    assert code == 0
    drawn = {p.name for p in (tmp_path / "pictures").glob("*_trajectory.png")}
    assert drawn == {"hall_trajectory.png", "hall-2_trajectory.png"}


def test_a_gap_in_the_truth_is_no_frame():
    log, truth = make_run(300)
    gap = np.ones(301, dtype=bool)
    gap[100:160] = False
    run = Run(Path("gap"), "gap", log, TruthLog(truth.t_ns[gap], truth.T_world_cam[gap]), None, Mounting(), [])
    whole = evaluate_run(replace(run, truth=truth)).trajectory
    found = evaluate_run(run).trajectory
    assert (whole.rpe_frame.translation_m.count, found.rpe_frame.translation_m.count) == (300, 239)
    assert found.rpe_frame.translation_m.max <= whole.rpe_frame.translation_m.max
    # Starts whose second ends in the gap have no pair.
    assert found.rpe_second.translation_m.count == whole.rpe_second.translation_m.count - 60 - 20
    assert found.rpe_second.translation_m.max <= whole.rpe_second.translation_m.max


def test_truth_from_a_file_takes_the_noise_that_it_is_given(run_folder, tmp_path):
    run = read_run(run_folder)
    write_tum(tmp_path / "truth.tum", run.truth.t_ns, run.truth.T_world_cam)
    args = ("evaluate", run_folder, "--truth", tmp_path / "truth.tum")
    assert "+truth" not in gpvo(*args)[1]
    plain = json.loads(gpvo(*args, "--json")[1])["runs"][0]
    assert "10 mm" in gpvo(*args, "--truth-sigma", "0.01")[1]
    found = json.loads(gpvo(*args, "--truth-sigma", "0,0,0.02", "--json")[1])["runs"][0]
    assert found["truth_jitter_s"] == 0.02
    assert max(found["truth_sigma_axes"]) > 0.0
    assert found["methods"]["triangulation"]["nll_per_dim"] != plain["methods"]["triangulation"]["nll_per_dim"]


def test_the_model_file_gives_constant_and_the_thesis_row(tmp_path):
    """The thesis' row of a model read from its file is that of the fit in memory; other files have none."""
    trained = small_model()
    save_model(trained, tmp_path / "m.gpvo")
    log, truth = synthetic_run(50, n=200)
    write_run(tmp_path / "flight", log, truth=truth)
    code, out, _ = gpvo("evaluate", tmp_path / "flight", "--model", tmp_path / "m.gpvo", "--json")
    assert code == 0
    methods = json.loads(out)["runs"][0]["methods"]
    held_out = build(log, truth, name="flight")
    fitted = fit_thesis(trained.sets)
    expected = score(held_out.Y, *fitted.predict(held_out.select(fitted.columns)))
    assert methods["gp_thesis"]["nll_per_dim"] == pytest.approx(expected["nll_per_dim"], abs=1e-4)
    assert methods["gp_thesis"]["nees_dof"]["joint"] == pytest.approx(expected["nees_dof"]["joint"], rel=1e-3)
    assert methods["gp_thesis"]["predicted_final_error_m"] > 0
    assert methods["constant"]["nees_dof"]["joint"] is not None
    older = {k: v for k, v in trained.arrays.items() if not k.startswith("thesis.")}
    e = evaluate_run(read_run(tmp_path / "flight"), Predictor(older, trained.header))
    assert "gp_thesis" not in e.consistency
    assert "learned" in e.consistency
    damaged = {k: v for k, v in trained.arrays.items() if k != "thesis.centre"}
    with pytest.raises(ModelError, match=r"thesis\.centre"):
        evaluate_run(read_run(tmp_path / "flight"), Predictor(damaged, trained.header))
    with pytest.raises(ModelError, match="newer gpvo"):
        Predictor(trained.arrays, {**trained.header, "model_schema": 2})


def test_a_model_of_windows_is_refused_by_name(run_folder, tmp_path):
    trained, model = small_model(), tmp_path / "windows.gpvo"
    modelfile.save(model, trained.arrays, {**trained.header, "target": "window:1s"})
    _assert_refused(run_folder, "--model", model, says="windows.gpvo: this model predicts the error over")


def test_constant_is_said_of_one_frame():
    """A motion that bridges two lost frames has three times the covariance; one after it, its own again."""
    log, _ = make_run(60, lost={20, 21})
    (constant,) = [s for s in statements(log, None, small_model().predictor()) if s.method == "constant"]
    one = constant.covariance[5]
    np.testing.assert_allclose(constant.covariance[22], 3 * one)
    np.testing.assert_allclose(constant.covariance[23], one)


def test_a_run_that_states_nothing_of_motions_is_told_with_the_files_for_score(tmp_path: Path) -> None:
    """Its covariances are of poses, as a filter's with a map; the folder would be refused by ``gpvo score``."""
    log, truth = make_run(60, v_t=False)
    log = VoLog([replace(r, covariances={IMPORTED_POSE: stated_covariance()}) for r in log])
    write_run(tmp_path / "slam", log, truth=truth, meta={"source": "made"})
    code, _, err = gpvo("evaluate", tmp_path / "slam", "--stated", tmp_path / "stated")
    assert code == 0
    assert "slam states no covariance of single motions" in err
    assert [p.name for p in (tmp_path / "stated").iterdir()] == ["truth"]


def test_a_report_replaces_an_earlier_one_and_nothing_else(run_folder, tmp_path):
    page = tmp_path / "report.html"
    page.write_text("<!doctype html><title>gpvo, as I see it</title>")
    before = page.read_bytes()
    code, out, err = gpvo("report", run_folder, "-o", page)
    assert (code, out, page.read_bytes()) == (2, "", before)
    assert "report.html: is another file, not an earlier report" in err.splitlines()[0]
    page.unlink()
    assert [gpvo("report", run_folder, "-o", page)[0] for _ in range(2)] == [0, 0]


@pytest.mark.skipif(
    np.lib.NumpyVersion(np.__version__) < "2.0.0", reason="the last bits differ from array to array in this NumPy"
)
def test_the_offset_that_evaluate_advises_is_an_option_of_train(tmp_path):
    """Of a truth on another clock, with it, a model is that of the truth on the log's, to the bit."""
    late_s, models = 0.25, {}
    for k, by_s in enumerate((0.0, late_s)):
        log, truth = synthetic_run(4, n=300)
        truth = replace(truth, t_ns=truth.t_ns + round(by_s * 1e9))
        write_run(tmp_path / str(k) / "run", log, truth=truth)
    advice = gpvo("evaluate", tmp_path / "1" / "run")[1]
    assert "with --time-offset auto" in advice
    for name, run, offset in (("own", "0", "0"), ("late", "1", str(late_s)), ("auto", "1", "auto")):
        given = (tmp_path / run / "run", "--time-offset", offset, "-o", tmp_path / f"{name}.gpvo")
        code, _, err = gpvo("train", *given)
        assert (code, "contradict" in err) == (0, False)
        models[name], header = modelfile.load(tmp_path / f"{name}.gpvo")
        assert header["config"].get("time_offset_s", 0.0) == {"own": 0.0, "late": late_s, "auto": None}[name]
    assert models["own"].keys() == models["late"].keys()
    for name, array in models["own"].items():
        np.testing.assert_array_equal(array, models["late"][name])
    np.testing.assert_allclose(
        models["auto"]["method.constant"], models["own"]["method.constant"], rtol=0.05, atol=1e-7
    )


def test_an_offset_that_nothing_tells_names_the_run(tmp_path):
    log, truth = synthetic_run(4, n=40)
    write_run(tmp_path / "short", log, truth=truth)
    for command in (["evaluate"], ["train", "-o", tmp_path / "m.gpvo"]):
        code, out, err = gpvo(*command, tmp_path / "short", "--time-offset", "auto")
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert "short: the log lasts 2.00 s" in err


def test_motions_that_are_lost_lie_in_no_domain_and_outside_none():
    """The share is that of gpvo check, however often odometry is lost."""
    log, truth = synthetic_run(9, n=300)
    blind = [replace(r, status=Status.LOST, T_prev_cur=np.eye(4)) if k % 10 < 4 else r for k, r in enumerate(log)]
    run = Run(Path("hall"), "hall", replace(log, records=blind), truth, None, Mounting(), [])
    predictor = small_model().predictor()
    found = check(predictor, run)
    assert found.in_domain > 0.8
    assert evaluate_run(run, predictor).in_domain == pytest.approx(found.in_domain, abs=1e-9)


@pytest.mark.parametrize("late_s,cure", [(0, "every 1.1 s: give one whose poses are at most 0.5 s"), (99, "one clock")])
def test_a_truth_too_slow_to_learn_from_is_told_from_one_of_another_clock(tmp_path, late_s, cure):
    log, truth = make_run(200)
    slow = replace(truth, t_ns=truth.t_ns[::22] + 10**7 + late_s * 10**9, T_world_cam=truth.T_world_cam[::22])
    write_run(tmp_path / "run", log, truth=slow)
    code, out, err = gpvo("train", tmp_path / "run", "-o", tmp_path / "m.gpvo")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "only 0 of 200 motions have ground truth" in err
    assert cure in err


@pytest.mark.parametrize("lost", [False, True], ids=["short", "lost throughout"])
def test_what_no_run_so_short_or_lost_can_tell_is_said_of_it(tmp_path, lost):
    log, truth = make_run(200 if lost else 12, lost=set(range(1, 201)) if lost else set())
    write_run(tmp_path / "run", log, truth=truth)
    code, out, err = gpvo("train", tmp_path / "run", "-o", tmp_path / "m.gpvo")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    of = "0 of 200" if lost else "12 of 12"
    assert f"run: only {of} motions were measured, 30 are needed (give a longer sequence" in err
    save_model(small_model(), tmp_path / "m.gpvo")
    code, out, _ = gpvo("predict", tmp_path / "m.gpvo", tmp_path / "run", "-o", tmp_path / "p.parquet")
    assert (code, "nan" in out, "no motion was measured" in out) == (0, False, lost)
    code, out, err = gpvo("calibration", tmp_path / "run")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "run: holds no calibration state (gpvo run estimates one" in err
    code, out, err = gpvo("score", tmp_path / "none")
    assert (code, out, err) == (2, "", f"gpvo: {tmp_path / 'none'}: no such file or folder\n")
