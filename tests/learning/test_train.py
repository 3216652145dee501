"""Training: honest on flights it has not seen, over one motion and over many metres; repeatable to the byte."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import gpvo
import numpy as np
import pytest
from gpvo.cli import app
from gpvo.cli.learn import _print_table, _train
from gpvo.dataset.build import TrainingSet, build, build_run
from gpvo.dataset.check import check, odometry_problems
from gpvo.dataset.table import read_sets, write_sets
from gpvo.errors import GpvoError, ModelError, OutputError
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.verdict import verdict
from gpvo.geometry import se3
from gpvo.geometry.covariance import are_semidefinite
from gpvo.io import open_source
from gpvo.io.run import Run, read_run, write_run
from gpvo.learning import train as training
from gpvo.learning.basefit import rate_changes
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import Learned, fit_model
from gpvo.learning.methods import METHODS, best_scale, score
from gpvo.learning.parts import fit_parts
from gpvo.learning.rows import Rows, checked
from gpvo.learning.store import (
    card_path,
    config_of,
    folds_path,
    model_card,
    picture_path,
    rows_path,
    save_model,
    train_stored,
    update,
)
from gpvo.learning.train import TrainedModel, _slips, train_sets, unseen_axes
from gpvo.online import modelfile
from gpvo.online.base import COASTED, TWIST_COLUMNS
from gpvo.online.division import divide
from gpvo.online.features import AXES
from gpvo.online.predictor import Predictor
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from gpvo.stats.consistency import nees
from gpvo.types import Mounting, VoLog
from gpvo.vo.config import make_config
from small_model import small_model, training_sets
from synthetic_runs import make_run
from threadpoolctl import threadpool_info, threadpool_limits
from typer.testing import CliRunner

QUICK = TrainConfig(features="velocity,rotation,n_inliers")


@cache
def _of_three() -> TrainedModel:
    """Trained and judged once on three short flights."""
    return train_sets(training_sets(range(3), n=120), QUICK)


@cache
def _of_twelve() -> list[TrainingSet]:
    """Longer flights, whose scale is right."""
    return training_sets(range(12), n=600)


def _said(predictor, s):
    return predictor.predict(s.select(predictor.features), s.covariances.get("pointing_matching"), s.dt_s)


def test_consistent_on_unseen_flights():
    predictor = small_model().predictor()
    per_flight = []
    for s in training_sets(range(100, 112), n=300):
        e = _said(predictor, s)
        per_flight.append(nees(s.Y - e.mean, e.covariance).mean() / 6)
        assert 0.6 < np.mean(np.abs(s.Y - e.mean) < e.sigma) < 0.77
    assert 0.8 <= np.mean(per_flight) <= 1.25


def test_heavy_tails_are_stated_and_carried_to_the_prediction(tmp_path):
    """Each motion's error by a draw of its own wider or narrower: a Student-t of four degrees of freedom."""

    def heavy(seeds):
        rng = np.random.default_rng(seeds[0])
        for s in training_sets(seeds, n=400):
            yield replace(s, Y=s.Y * np.sqrt(2.0 / rng.chisquare(4.0, (len(s), 1))))

    trained = train_sets(list(heavy(range(6))), QUICK, judge=False)
    save_model(trained, tmp_path / "t.gpvo")
    predictor = Predictor.load(tmp_path / "t.gpvo")
    error, stated = zip(*((s.Y, _said(predictor, s)) for s in heavy(range(100, 106))), strict=True)
    nu = stated[0].nu
    assert 3.0 < nu < 6.0
    table = score(
        np.concatenate(error), *(np.concatenate([getattr(e, n) for e in stated]) for n in ("mean", "covariance")), nu
    )
    assert table["nees_dof_median"]["joint"] == pytest.approx(table["nees_dof_median_stated"], rel=0.15)
    assert table["nll_stated_per_dim"] < table["nll_per_dim"] - 0.05
    # Where there are no tails none are stated.
    assert small_model().predictor().model.degrees_of_freedom > 15.0


@pytest.mark.parametrize("right", [True, False])
def test_the_geometry_is_believed_where_it_is_right(right):
    """Of each motion sideways error and yaw go together by 0.8, with a sign that changes at random; the variances are
    those that the geometry states."""
    sets = []
    for i, s in enumerate(training_sets(range(4), n=400)):
        rng = np.random.default_rng(i)
        R = np.tile(np.eye(6), (len(s), 1, 1))
        R[:, 0, 4] = R[:, 4, 0] = 0.8 * rng.choice([-1.0, 1.0], len(s))
        drawn = np.linalg.cholesky(R) @ rng.standard_normal((len(s), 6, 1))
        sigma = np.array([1.0, 1.0, 2.0, 0.4, 0.4, 0.4]) * 1e-3
        scale = s.covariances["pointing_matching"][:, :1, 0] / sigma[0] ** 2
        stated = (R if right else rng.permutation(R)) * np.outer(sigma, sigma) * scale[..., None]
        error = drawn[..., 0] * sigma * np.sqrt(scale)
        sets.append(replace(s, Y=error, covariances=dict.fromkeys(s.covariances, stated)))
    weight = fit_model(sets, QUICK).model.division.geometry_weight[0]
    assert weight >= 0.75 if right else weight <= 0.25


def test_velocities_change_as_in_training():
    """Forty flights whose turn rate is a first-order Gauss-Markov process of 0.3 rad/s, memory 0.95 per motion."""
    found = rate_changes(Rows.stack(training_sets(range(40), n=300)))
    expected = 2 * 0.3**2 * (1 - 0.95 ** np.array(COASTED))
    np.testing.assert_allclose(found[:, 4], expected, rtol=0.15)
    assert (np.diff(found, axis=0) >= 0).all()


def test_velocities_of_short_flights_are_unrelated_after_longer_times():
    rows = Rows.stack(training_sets(range(4), n=30))
    usual = (rows.select(TWIST_COLUMNS) ** 2).mean(axis=0)
    found = rate_changes(rows)
    np.testing.assert_allclose(found[-1], np.maximum(2 * usual, found[-2]), rtol=1e-9)


def test_consistent_over_many_frames():
    """Sums over 1, 10 and 100 frames against what jitter, white and bias say of them."""
    predictor = small_model().predictor()
    flights = [(s, _said(predictor, s)) for s in training_sets(range(100, 112), n=300)]
    tau = predictor.model.division.bias_tau_s / predictor.model.dt_s
    variance = np.mean([(e.sigma**2).mean(axis=0) for _, e in flights], axis=0)
    model = predictor.model
    parts = model.division
    share = divide(parts.share, parts.growth, np.log(variance)[None] - parts.level, np.zeros((1, 1)))[0]
    for m in (1, 10, 100):
        ratio = []
        for s, e in flights:
            z = np.cumsum(np.vstack([np.zeros(6), (s.Y - e.mean) / e.sigma]), axis=0)
            ratio.append(((z[m:] - z[:-m]) ** 2).mean(axis=0))
        rho = np.exp(-1 / tau)
        i = np.arange(1, m)[:, None]
        stated = share[0] + share[1] * m + share[2] * (m + 2 * ((m - i) * rho**i).sum(axis=0))
        assert 0.7 <= np.mean(np.mean(ratio, axis=0) / stated) <= 1.5, m


@pytest.mark.parametrize("shared", [False, True])
def test_poses_are_calibrated_on_flights_that_nothing_was_learned_from(shared):
    """Eight flights, each with a bias of its own, or all with the same. Fitted to the former, a model would find that
    less adds up than it states; and only the latter show how the axes of a bias go together."""
    rng, flights = np.random.default_rng(8), training_sets(range(8), n=600)
    usual, drawn = np.concatenate([s.Y for s in flights]).std(axis=0), rng.standard_normal((len(flights), 6))
    biases = np.ones((len(flights), 6)) if shared else drawn
    noise = rng.standard_normal((len(flights), *flights[0].Y.shape))
    biased = [replace(s, Y=usual * (0.8 * n + 0.6 * bias)) for s, n, bias in zip(flights, noise, biases)]
    learned = train_sets(biased, TrainConfig(features="velocity"), judge=False)
    together = learned.predictor().model.division.correlation[2][np.triu_indices(6, 1)]
    if shared:
        assert together.min() > 0.8
    else:
        assert np.abs(together).mean() < 0.3
        assert learned.header["calibration"]["added_factor"] >= 1.0


def _no_change(chain: np.ndarray) -> np.ndarray:
    return np.zeros((len(chain), 1))


def test_parts_of_a_known_mixture():
    rng = np.random.default_rng(0)
    out = []
    for _ in range(20):
        n = rng.standard_normal((1001, 3))
        bias = np.zeros((1000, 3))
        for k in range(1, 1000):
            bias[k] = np.exp(-1 / 30) * bias[k - 1] + np.sqrt(1 - np.exp(-2 / 30)) * rng.standard_normal(3)
        out.append(
            np.sqrt(0.3) * (n[1:] - n[:-1]) + np.sqrt(0.3) * rng.standard_normal((1000, 3)) + np.sqrt(0.1) * bias
        )
    parts = fit_parts(*([[f(chain)] for chain in out] for f in (np.array, np.ones_like, _no_change)), 0.1)
    np.testing.assert_allclose(parts.share.mean(axis=1), [0.6, 0.3, 0.1], atol=0.06)
    assert 1.0 < parts.tau_s.mean() < 8.0


def test_a_training_goes_on_from_its_finished_folds_and_the_same_data_give_the_same_bytes(tmp_path, monkeypatch):
    sets, path = training_sets(range(2), n=120), tmp_path / "model.gpvo"
    config = replace(QUICK, keep=str(folds_path(path)))
    whole, fitted = training._fold, []

    def fold(held_out, *rest):
        (alone,) = held_out
        if len(fitted) == 1 and not broken_off:
            broken_off.append(alone.name)
            raise KeyboardInterrupt
        fitted.append(alone.name)
        return whole(held_out, *rest)

    broken_off: list[str] = []
    monkeypatch.setattr(training, "_fold", fold)
    with pytest.raises(KeyboardInterrupt):
        train_sets(sets, config)
    save_model(train_sets(sets, config), path)
    assert fitted == [s.name for s in sets]
    assert not folds_path(path).exists()
    save_model(train_sets(sets, QUICK), tmp_path / "other.gpvo")
    assert path.read_bytes() == (tmp_path / "other.gpvo").read_bytes()


def test_linear_algebra_runs_on_one_thread_so_that_bytes_do_not_depend_on_the_machine(monkeypatch):
    seen = []

    def look(*arguments):
        seen.extend(pool["num_threads"] for pool in threadpool_info())
        return fit_model(*arguments)

    monkeypatch.setattr(training, "fit_model", look)
    with threadpool_limits(limits=2):
        train_sets(training_sets(range(3), n=120), QUICK, judge=False)
    assert seen
    assert set(seen) == {1}


def test_many_runs_are_left_out_in_parts(monkeypatch, tmp_path):
    """Every run is judged, in its place, and by a model that has learned from the other parts alone."""
    monkeypatch.setattr(training, "MOST_FOLDS", 2)
    sets, fits = training_sets(range(5), n=120), []
    config = replace(QUICK, keep=str(tmp_path))
    trained = train_sets(sets, config, on_fit=lambda done, total: fits.append((done, total)))
    folds = trained.table["folds"]
    assert [f["held_out"] for f in folds] == [s.name for s in sets]
    assert fits[-1][1] == 3
    for part, others in ((sets[::2], sets[1::2]), (sets[1::2], sets[::2])):
        file = training.fold_model(part, others, config, str(tmp_path))
        assert [s["name"] for s in modelfile.load(file)[1]["sequences"]] == [s.name for s in others]
        stated = Predictor.load(file)
        for s in part:
            C = _said(stated, s).covariance
            of_table = next(f for f in folds if f["held_out"] == s.name)["methods"]["learned"]
            assert of_table["nees_dof"]["joint"] == pytest.approx(nees(s.Y, C).mean() / 6, rel=1e-6)


def test_rows_of_another_target_are_refused():
    rows = [replace(s, target="window:1s") for s in training_sets(range(3), n=120)]
    with pytest.raises(GpvoError, match="target 'window:1s', not 'frame'"):
        train_sets(rows, QUICK)


def test_table_has_every_row_and_every_key(tmp_path):
    trained = _of_three()
    folds = trained.table["folds"]
    assert [f["held_out"] for f in folds] == [s.name for s in trained.sets]
    for fold in folds:
        assert tuple(fold["methods"]) == METHODS
        for method in METHODS:
            assert set(fold["methods"][method]) == {
                "nees_dof", "nees_dof_median", "nees_dof_median_stated", "coverage", "nll_per_dim",
                "nll_stated_per_dim", "crps", "rmse_raw", "rmse_corrected",
            }  # fmt: skip
        assert fold["methods"]["triangulation"]["nll_per_dim"] is None
        assert fold["methods"]["learned"]["nll_per_dim"] < fold["methods"]["pointing_matching"]["nll_per_dim"]
    save_model(trained, tmp_path / "m.gpvo")
    card = card_path(tmp_path / "m.gpvo").read_text()
    assert "pointing_matching_scaled" in card
    assert "training data" in card.lower()
    assert "## Where not to use it" in card
    assert re.search(r"trained on \d{4}-\d\d-\d\d with gpvo", card)
    # The picture: in each of two panels a curve per sequence, near the diagonal on errors as stated.
    assert "(m.gpvo.svg)" in card
    root = ElementTree.fromstring(picture_path(tmp_path / "m.gpvo").read_text())
    assert len([e for e in root.iter() if e.tag.endswith("polyline")]) == 2 * len(trained.sets)
    for fold in folds:
        for pairs in fold["stated_and_actual"].values():
            stated, actual = np.array(pairs).T
            assert 0.7 < np.sqrt((actual**2).mean() / (stated**2).mean()) < 1.4


def test_the_row_base_is_the_model_with_its_gp_at_the_mean_function(tmp_path):
    """Noise that only the inlier count tells: the GP gains over its base, which the file can still state."""
    sets = []
    for s in training_sets(range(4), n=200):
        louder = np.exp(np.tanh(s.select(["n_inliers"]) / 60.0 - 1.5))
        sets.append(replace(s, Y=s.Y * louder))
    trained = train_sets(sets, replace(QUICK, features="n_inliers"))
    assert trained.header["choices"]["inputs"] == "n_inliers"
    assert trained.table["comparison"]["learned_less_base"]["high"] < 0
    assert "the Gaussian process gains" in model_card(trained.header, trained.table, "m")
    of_windows = {**trained.header, "target": "window:1s", "horizon": "window:1s"}
    assert "one motion" not in model_card(of_windows, trained.table, "m")
    save_model(trained, tmp_path / "m.gpvo")
    predictor = Predictor.load(tmp_path / "m.gpvo")
    base = predictor.base()
    learned = fit_model(sets, replace(QUICK, features="n_inliers"))
    for found, wanted in ((predictor, learned.model), (base, learned.base)):
        expected = training.estimate_set(wanted, sets[0]).covariance
        np.testing.assert_allclose(_said(found, sets[0]).covariance, expected, rtol=1e-12)
    assert not base.model.gp.offset.any()
    assert not base.model.gp.weights.any()
    assert base.base().arrays.keys() == base.arrays.keys()


def test_runs_are_taken_as_folders_too(tmp_path):
    runs = [_as_run(*make_run(k, n=120), f"flight{k}") for k in range(2)]
    for r in runs:
        write_run(tmp_path / r.name, r.log, truth=r.truth)
    paths = [tmp_path / r.name for r in runs]
    of_runs, of_paths = (
        gpvo.train(given, QUICK) for given in ([read_run(p) for p in paths], [str(paths[0]), paths[1]])
    )
    assert of_paths.header["training_digest"] == of_runs.header["training_digest"]
    assert of_paths.table == of_runs.table
    assert len(gpvo.train(paths[0], QUICK).sets) == len(gpvo.train(str(paths[0]), QUICK).sets) == 1
    assert str(gpvo.evaluate(paths[0])) == str(gpvo.evaluate(read_run(paths[0])))


def test_update_adds_flights(tmp_path):
    path = tmp_path / "m.gpvo"
    save_model(_of_three(), path)
    run = _as_run(*make_run(9, n=120), "flight9")
    more = update(path, [run], QUICK, judge=False)
    assert [s.name for s in more.sets] == ["flight0", "flight1", "flight2", "flight9"]
    told = []
    again = update(path, [_as_run(*make_run(8, n=120), "flight1")], QUICK, judge=False, tell=told.append)
    assert [s.name for s in again.sets] == ["flight0", "flight2", "flight1"]
    assert "flight1" in told[0]
    rows_path(path).unlink()
    with pytest.raises(ModelError, match="not beside"):
        update(path, [run], QUICK)


def test_rows_of_windows_and_slips_are_found_again_beside_the_model(tmp_path):
    from gpvo.dataset.build import build

    log, truth = make_run(1, n=200)
    records = list(log)
    jump = se3.exp(np.array([0, 0, 5.0, 0, 0, 0]))
    records[90] = replace(records[90], T_prev_cur=records[90].T_prev_cur @ jump)
    for target in ("frame", "window:0.5s"):
        made = build(VoLog(records, log.camera), truth, name="one", target=target)
        assert made.counts["lost"] == len(made.lost_xi) == 1
        write_sets(tmp_path / "rows", [made])
        (found,) = read_sets(tmp_path / "rows")
        assert found.digest() == made.digest()
        np.testing.assert_array_equal(found.lost_xi, made.lost_xi)
        np.testing.assert_array_equal(found.lost_jump, made.lost_jump)


def test_an_update_keeps_the_settings_of_the_model_and_reads_each_run_once(tmp_path, monkeypatch):
    path = tmp_path / "m.gpvo"
    config = replace(QUICK, features="velocity", seed=5)
    save_model(train_sets(training_sets(range(3), n=120), config, judge=False), path)
    log, truth = make_run(9, n=120)
    off = np.random.default_rng(0).normal(0.0, 0.05, (len(truth.t_ns), 6)) * [1, 1, 1, 0, 0, 0]
    write_run(tmp_path / "flight9", log, truth=replace(truth, T_world_cam=truth.T_world_cam @ se3.exp(off)))
    out = tmp_path / "more.gpvo"
    command = ["train", str(tmp_path / "flight9"), "--update", str(path), "--seed", "6", "-o", str(out)]
    read: list[Path] = []
    monkeypatch.setattr("gpvo.cli.learn.read_run", lambda p: read.append(p) or read_run(p))
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert read == [tmp_path / "flight9"]
    assert "ground truth of flight9 is noisy" in " ".join(result.output.split())
    assert config_of(out) == replace(config, seed=6)


@pytest.mark.parametrize(
    "twin", [None, {"of": "f", "tolerance_name": "none", "seed": 0, "replicate": 0, "tolerance": {}}]
)
def test_a_truth_that_contradicts_odometry_is_named_before_a_model_learns_from_it(tmp_path, twin):
    path, runs = tmp_path / "m.gpvo", [tmp_path / "flight8", tmp_path / "flight9"]
    save_model(_of_three(), path)
    for run_path, is_conjugate in zip(runs, (False, True), strict=True):
        log, truth = make_run(9)
        T = np.array(truth.T_world_cam)
        if is_conjugate:
            T[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
        write_run(run_path, log, truth=replace(truth, T_world_cam=T), meta={"twin": twin})
    command = ["train", *map(str, runs), "--update", str(path), "-o", str(tmp_path / "more.gpvo")]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    said = result.output.replace("\n", " ")
    # The truth of a twin is simulated: in its frames, on its clock.
    assert said.count("contradict each other") == (not twin)
    assert twin or f"truth of {runs[1]} contradict each other" in said


def test_a_model_of_positions_is_not_updated(tmp_path):
    path = tmp_path / "m.gpvo"
    save_model(_of_three(), path)
    with pytest.raises(GpvoError, match="train again"):
        _train([tmp_path], replace(QUICK, target="position"), path, print)


def _as_run(log, truth, name):
    return Run(Path("runs", name), name, log, truth, None, Mounting(), [])


def test_few_sequences_are_calibrated_by_blocks_and_marked():
    trained = train_sets(training_sets([0], n=200), QUICK)
    assert trained.header["calibration"]["by"] == "time blocks"
    assert not np.any(trained.header["calibration"]["interval_guaranteed"])
    assert trained.header["by_few_sequences"]
    assert trained.table["folds_are"] == "time blocks"
    assert [f["held_out"][-6:] for f in trained.table["folds"]] == ["part 1", "part 2", "part 3"]
    assert trained.table["comparison"]["learned_less_base"]["low"] is None
    card = model_card(trained.header, trained.table, "m")
    assert "say nothing about another flight" in card
    assert "too few for an interval" in card


def test_two_sequences_give_scores_and_no_interval():
    trained = train_sets(training_sets(range(2), n=120), QUICK)
    assert len(trained.table["folds"]) == 2
    found = trained.table["comparison"]["nll_per_dim_difference"]
    assert found["mean"] is not None
    assert (found["low"], found["high"]) == (None, None)


def test_a_short_sequence_alone_has_no_scores():
    trained = train_sets(training_sets([0], n=100), QUICK)
    assert trained.table["folds"] == []


def test_logs_of_poses_alone_train_on_what_they_have():
    def bare(seed):
        log, truth = make_run(seed, n=120, geometry=False)
        records = [replace(r, n_inliers=-1, n_tracked=-1, n_detected=-1, n_stereo=-1) for r in log]
        return type(log)(records, None), truth

    from gpvo.dataset.build import build

    trained = train_sets([build(*bare(k), name=str(k)) for k in range(3)], TrainConfig())
    assert trained.header["base_method"] is None
    assert not any(f.startswith(("n_", "ln_", "inlier")) for f in trained.header["features"])
    assert trained.table["mean"]["pointing_matching"]["nll_per_dim"] is None
    assert trained.table["mean"]["gp_thesis"]["nll_per_dim"] is not None


def test_window_target():
    from gpvo.dataset.build import build

    sets = [build(*make_run(k, n=160), name=str(k), target="window:0.5s") for k in range(3)]
    trained = train_sets(sets, replace(QUICK, target="window:0.5s"), judge=False)
    predictor = trained.predictor()
    said = [predictor.step(r) for r in make_run(50, n=40)[0]]
    assert said[5] is None
    assert said[20].dt_s == pytest.approx(0.5)


def test_positions_of_runs_of_one_name_are_judged_by_the_other_parts(monkeypatch):
    monkeypatch.setattr(training, "MOST_FOLDS", 2)
    config = TrainConfig(target="position")
    sets = [build(*make_run(k, n=60), name="run", target="position") for k in range(3)]
    folds = train_sets(sets, config).table["folds"]
    for k, (fold, s) in enumerate(zip(folds, sets, strict=True)):
        model = training._fit_position([other for i, other in enumerate(sets) if i % 2 != k % 2], config)
        found = score(s.Y, *model.predict(s.select(model.columns)))
        size_m = fold["methods"]["gp_thesis"]["rmse_corrected"]["translation_m"]
        assert size_m == pytest.approx(found["rmse_corrected"]["translation_m"], rel=1e-9)


def test_rows_that_are_streamed_leave_nothing_behind_and_names_are_judged_before_they_are_made(tmp_path):
    config = TrainConfig(target="position", max_rows=1000, keep=str(tmp_path / "kept"))
    for k in range(2):
        log, truth = make_run(k, n=600)
        write_run(tmp_path / str(k), log, truth=truth)
    trained = _train([tmp_path / "0", tmp_path / "1"], config, None, lambda done, total: None)
    assert trained.header["rows"]["in_memory"] <= 1000 < trained.header["rows"]["given"]
    assert {p.suffix for p in (tmp_path / "kept").iterdir()} == {".json"}
    for wrong in ({"features": "magic"}, {"regressor": "magic"}):
        with pytest.raises(GpvoError, match=f"unknown {next(iter(wrong)).rstrip('s')} 'magic'"):
            _train([tmp_path / "none"], replace(config, **wrong), None, lambda done, total: None)


def test_positions_are_trained_from_stored_rows_and_go_on_from_finished_folds_too(tmp_path, monkeypatch):
    sets = [build(*make_run(k, n=60), name=str(k), target="position") for k in range(3)]
    config = TrainConfig(target="position")
    whole = train_sets(sets, config)
    write_sets(tmp_path / "rows.parquet", sets)
    with pytest.raises(GpvoError, match="--target position"):
        train_stored(tmp_path / "rows.parquet", QUICK)
    config, fits = replace(config, keep=str(tmp_path / "kept")), []
    stored = train_stored(tmp_path / "rows.parquet", config, on_fit=lambda done, total: fits.append((done, total)))
    assert fits == [(k, 4) for k in range(4)]
    assert stored.table == whole.table
    assert all((stored.arrays[name] == values).all() for name, values in whole.arrays.items())
    monkeypatch.setattr(training, "_position_fold", None)
    assert train_stored(tmp_path / "rows.parquet", config).table == whole.table


def test_position_target_has_its_own_type(tmp_path):
    from gpvo.dataset.build import build
    from gpvo.learning.thesis import ThesisModel

    sets = [build(*make_run(k, n=100), name=str(k), target="position") for k in range(3)]
    trained = train_sets(sets, TrainConfig(target="position"))
    assert trained.table["mean"]["gp_thesis"]["rmse_raw"]["translation_m"] > 0
    save_model(trained, tmp_path / "p.gpvo")
    with pytest.raises(ModelError, match="residual of a position.*--target frame"):
        Predictor.load(tmp_path / "p.gpvo")
    model = ThesisModel.of_positions(tmp_path / "p.gpvo")
    mean, covariance = model.predict(sets[0].select(model.columns))
    assert mean.shape == (100, 3)
    assert covariance.shape == (100, 3, 3)


def test_best_scale_is_best():
    sets = training_sets(range(2), n=200)
    scale = best_scale(sets, "pointing_matching")

    def loss(c):
        return np.mean(
            [
                score(s.Y, 0 * s.Y, s.covariances["pointing_matching"] * np.sqrt(np.outer(c, c)))["nll_per_dim"]
                for s in sets
            ]
        )

    for j in range(6):
        for factor in (0.9, 1.1):
            assert loss(scale * np.where(np.arange(6) == j, factor, 1.0)) > loss(scale)


def test_a_run_that_cannot_be_learnt_from_is_named_by_its_path():
    log, truth = make_run(0, n=10)
    for given, words in ((None, "has no ground truth"), (truth, "only .* motions")):
        with pytest.raises(GpvoError, match=f"^runs/there: {words}"):
            build_run(_as_run(log, given, "there"))


def test_runs_of_different_rate_are_refused():
    sets = [*training_sets([0], n=100), *training_sets([1], n=100, rate_hz=60.0)]
    with pytest.raises(GpvoError, match="rate"):
        train_sets(sets, QUICK)


def test_the_table_prints_names_as_they_are(capsys):
    document = {"folds": [{"held_out": "[/red]", "rows": 3, "methods": {}}], "mean": {}, "comparison": None}
    _print_table(document)
    assert "1: [/red] (3 rows)" in capsys.readouterr().out


def test_an_error_that_was_expected_is_no_missed_slip():
    """Two errors alike, a hundred times the usual one; of the first the model says that it may be as large."""
    trained = small_model()
    s = training_sets(range(100, 101), n=120)[0]
    Y = s.Y.copy()
    Y[[30, 60], :3] = 100.0 * np.median(np.linalg.norm(Y[:, :3], axis=1)) / np.sqrt(3.0)
    estimate = _said(trained.predictor(), s)
    estimate.covariance[30, :3, :3] += np.outer(Y[30, :3], Y[30, :3])
    learned = Learned(trained.predictor().model, {}, {}, np.arange(0))
    assert _slips(replace(s, Y=Y), estimate, learned, np.eye(6))["missed"] == 1


def test_the_table_says_what_slips_would_cost(capsys):
    fold = {"held_out": "a", "rows": 3, "methods": {}}
    counts = [(1, 2, 0, 1.5, 80.0), (3, 0, 1, 0.5, 40.0)]
    folds = [
        {
            **fold,
            "slips": {
                "caught": caught,
                "missed": missed,
                "falsely_flagged": false,
                "nees_dof_with_slips": {"learned": learned, "constant": constant},
            },
        }
        for caught, missed, false, learned, constant in counts
    ]
    _print_table({"folds": folds, "mean": {}, "comparison": None})
    said = " ".join(capsys.readouterr().out.split())
    assert "slips: 4 caught, 2 missed, 1 falsely flagged" in said
    assert "flagged ones: learned 1, constant 60" in said


@pytest.mark.slow
def test_folds_on_a_dask_cluster_of_two_processes():
    distributed = pytest.importorskip("distributed")
    sets, here = _of_three().sets, _of_three().table["folds"]
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        config = replace(QUICK, backend="dask", scheduler=cluster.scheduler_address)
        there = train_sets(sets, config).table["folds"]
    assert [f["methods"]["learned"]["nll_per_dim"] for f in there] == pytest.approx(
        [f["methods"]["learned"]["nll_per_dim"] for f in here], abs=1e-9
    )


def _theirs(seed: int, state=lambda C: {"imported": C}):
    """A run of another odometry; ``state`` is given a covariance that knows of the noise and is a tenth of it."""
    log, truth = make_run(seed, n=200)
    own = [r.covariances.get("pointing_matching") for r in log]
    stated = [{} if C is None else state(C) for C in own]
    return build(VoLog([replace(r, covariances=c, n_inliers=-1, n_tracked=-1) for r, c in zip(log, stated)], None),
                 truth, name=f"theirs{seed}")  # fmt: skip


def test_what_another_odometry_states_is_compared_and_learnt_from():
    config = TrainConfig()
    trained = train_sets([_theirs(k) for k in range(3)], config)
    said = trained.table["mean"]
    assert said["imported"]["nees_dof"]["joint"] > 5
    assert 0.5 < said["imported_scaled"]["nees_dof"]["joint"] < 2
    assert said["imported_scaled"]["nll_per_dim"] < said["constant"]["nll_per_dim"]
    assert trained.header["base_method"] == "imported"
    without = train_sets([_theirs(k, lambda C: {}) for k in range(3)], config).table["mean"]
    assert without["imported"]["nees_dof"]["joint"] is None
    assert said["learned"]["nll_per_dim"] < without["learned"]["nll_per_dim"] - 0.05


def test_a_covariance_that_is_always_the_same_is_compared_but_says_nothing():
    sets = [_theirs(k, lambda C: {"imported": 1e-6 * np.eye(6)}) for k in range(3)]
    trained = train_sets(sets, TrainConfig())
    assert trained.header["base_method"] is None
    assert not any("imported" in f for f in trained.header["features"])
    assert trained.table["mean"]["imported"]["nees_dof"]["joint"] is not None


def test_a_wrong_scale_is_a_part_of_its_own(tmp_path):
    """Forward motions are too long, or too short, all flight, by more than all else is wrong by; they turn around."""
    rng = np.random.default_rng(0)
    sets, plain = [], _of_twelve()
    for s in plain:
        v = np.where(np.arange(len(s)) // 80 % 2 == 0, 1.0, -1.0) * rng.uniform(0.5, 1.0)
        X, Y = s.X.copy(), s.Y.copy()
        X[:, s.columns.index(TWIST_COLUMNS[2])] = v
        Y[:, 2] += rng.choice([-1.5, 1.5]) * s.Y[:, 2].std() * v
        sets.append(replace(s, X=X, Y=Y))
    save_model(train_sets(sets, QUICK, judge=False), tmp_path / "model.gpvo")
    model = Predictor.load(tmp_path / "model.gpvo").model
    forward = np.sqrt((model.division.calibration_patterns[:, 2, 2] ** 2).sum())
    assert forward == pytest.approx(1.5 * np.mean([s.Y[:, 2].std() for s in plain]), rel=0.3)
    rows = Rows.stack(sets).select(model.columns)
    said = model.estimate(rows[[0, 100]])
    ahead, back = said.persistent_root[:, 2, 6:]
    assert ahead @ back < -0.9 * np.linalg.norm(ahead) * np.linalg.norm(back)
    assert np.linalg.matrix_rank(said.persistent_root[..., :6]).min() == 6
    assert "camera's calibration differs between these sequences" in card_path(tmp_path / "model.gpvo").read_text()


def test_without_a_wrong_scale_there_is_no_such_part():
    trained = train_sets(_of_twelve(), QUICK, judge=False)
    assert trained.header["calibration"]["calibration_part"] is False
    assert not trained.arrays["calibration_patterns"].any()


def test_a_run_given_twice_is_refused(tmp_path):
    """Left out in turn, its copy would still be learnt from."""
    run = tmp_path / "run"
    with pytest.raises(GpvoError, match="run.* is given twice"):
        _train([run, tmp_path / "other", tmp_path / "other" / ".." / "run"], QUICK, None, print)


def test_a_model_knows_the_odometry_that_it_was_trained_on(tmp_path: Path) -> None:
    for name, preset in (("a", "fast"), ("b", "fast"), ("c", "thesis")):
        source = simulate_points("tunnel-bursts", ord(name), duration_s=8.0, rate_hz=10.0).save(
            tmp_path / f"{name}.npz"
        )
        run(open_source(source), tmp_path / name, make_config(preset))
    runs = [read_run(tmp_path / name) for name in "abc"]
    sets = [build_run(r) for r in runs]
    path = tmp_path / "m.gpvo"
    save_model(train_sets(sets[:2], QUICK, judge=False), path)
    predictor = Predictor.load(path)
    assert not any("settings" in problem for problem in check(predictor, runs[0]).problems)
    (told,) = (problem for problem in check(predictor, runs[2]).problems if "settings" in problem)
    assert "keyframe_parallax_px is 0.0, not 1.0" in told
    assert "self_calibration is False, not True" in told
    # The noise of a covariance matters only to a model that reads it.
    reads = {}
    for method, setting in (("triangulation", "sigma_px"), ("pointing_matching", "sigma_p_px")):
        reads[method] = any(method in name for name in predictor.features)
        assert bool(odometry_problems(predictor, {**runs[0].settings, setting: 0.3})) == reads[method], method
    assert sorted(reads.values()) == [False, True]
    # Scores on what it learned from say nothing about others: a copy under another name is known by its rows.
    (tmp_path / "a").rename(tmp_path / "copy")
    assert any("learned from this very run" in p for p in check(predictor, read_run(tmp_path / "copy")).problems)
    assert not any("this very run" in problem for problem in check(predictor, runs[2]).problems)
    # Kept with the rows for --update; of settings that differ among the runs, nothing is said.
    assert [s.odometry for s in read_sets(rows_path(path))] == [s.odometry for s in sets[:2]]
    mixed = train_sets(sets, QUICK, judge=False).predictor()
    assert not any("settings" in problem for problem in check(mixed, runs[2]).problems)
    # Predictions that are stored with a run are of a model, too, as long as its file is there to be asked.
    for given, told in ((predictor, True), (Predictor(predictor.arrays, predictor.header, "another's"), False)):
        stored = runs[0].path.with_name(f"stored-{told}")
        source = open_source(tmp_path / "a.npz")
        run(source, stored, make_config("fast"), given, meta={"model": str(path)})
        assert any("learned from this very run" in p for p in evaluate_run(stored).misfits) == told
        assert verdict(evaluate_run(stored)).colour != "green" or not told
    # Another's odometry has no settings of ours, and a model of its poses no camera.
    assert not odometry_problems(predictor, {"import": {"frame": "body"}})
    poses_alone = Predictor(predictor.arrays, {**predictor.header, "camera": None, "odometry": {}})
    assert any("another odometry's poses" in p for p in check(poses_alone, runs[0]).problems)
    # What the check finds, besides the domain, stands in the evaluation.
    assert any("learned from this very run" in p for p in evaluate_run(runs[0], predictor).misfits)
    assert not any("inside" in p for p in evaluate_run(runs[2], predictor).misfits)


def test_the_folder_of_a_model_is_made_and_one_that_cannot_be_is_named(tmp_path: Path) -> None:
    save_model(_of_three(), tmp_path / "new" / "m.gpvo")
    assert (tmp_path / "new" / "m.gpvo").is_file()
    (tmp_path / "file").write_text("")
    for path, told in ((tmp_path / "file" / "m.gpvo", "cannot be written"), (tmp_path / "new", "new: is a folder")):
        with pytest.raises(OutputError, match=told):
            save_model(_of_three(), path)


def test_windows_of_path_take_as_long_as_the_vehicle_is_slow() -> None:
    """Their durations are no rate of frames, which a flight could match or miss."""
    runs = [make_run(seed, n=150, speed=speed) for seed, speed in enumerate((1.0, 1.0, 2.5))]
    sets = [build(*run, name=str(k), target="length:1m") for k, run in enumerate(runs)]
    trained = train_sets(sets, replace(QUICK, target="length:1m"), judge=False)
    card = model_card(trained.header, trained.table, "m.gpvo")
    assert "* target: length:1m\n" in card
    assert "frames/s" not in card


@pytest.mark.parametrize("axes", [[5], [2, 3, 4], [0, 1, 2, 3, 4, 5]])
def test_axes_on_which_log_and_truth_never_differ_are_filled_in(axes: list[int]) -> None:
    """A robot in a plane: its height, roll and pitch are zero in both."""
    sets = [replace(s, Y=np.where(np.isin(np.arange(6), axes), 0.0, s.Y)) for s in training_sets(range(3), n=120)]
    trained = train_sets(sets, QUICK)
    assert unseen_axes(trained.sets) == [AXES[k] for k in axes]
    assert 0.7 < trained.table["mean"]["learned"]["nees_dof"]["joint"] < 1.4
    C = training.estimate_set(trained.predictor().model, sets[0]).covariance
    assert (np.diagonal(C, axis1=1, axis2=2)[:, axes] < 1e-10).all()
    assert train_sets(sets, QUICK, judge=False).arrays["share"].tobytes() == trained.arrays["share"].tobytes()


def test_errors_of_a_tiny_rig_are_not_taken_for_an_axis_without_any() -> None:
    """A baseline of a millimetre errs by 50 nm in a motion: noise of a micrometre would outweigh it."""
    tiny = np.array([5e-8 / np.sqrt((training_sets([0], n=120)[0].Y[:, :3] ** 2).mean())] * 3 + [1.0] * 3)
    sets = [replace(s, Y=s.Y * tiny) for s in training_sets(range(3), n=120)]
    for before, after in zip(sets, checked(sets, "frame"), strict=True):
        np.testing.assert_array_equal(after.Y, before.Y)
    assert unseen_axes(sets) == []


def test_a_flight_that_begins_at_rest_is_learned_from() -> None:
    """Its first blocks have no errors at all; they do not show how large errors can be."""
    (s,) = training_sets([0], n=240)
    resting = replace(s, Y=np.where(np.arange(240)[:, None] < 80, 0.0, s.Y))
    stated = train_sets([resting], QUICK, judge=False).predictor()
    plain = train_sets([s], QUICK, judge=False).predictor()
    sigma, usual = (
        np.sqrt(np.diagonal(training.estimate_set(p.model, s).covariance, axis1=1, axis2=2)) for p in (stated, plain)
    )
    assert np.isfinite(sigma).all()
    assert (np.median(sigma[80:], axis=0) < 3.0 * np.median(usual[80:], axis=0)).all()


@pytest.mark.parametrize("rest", [slice(0, 80), slice(120, 240)])
def test_a_flight_that_rests_is_learned_from_and_judged(rest: slice) -> None:
    """At rest, neither odometry nor truth moves at all."""
    (s,) = training_sets([1], n=240)
    X, Y = s.X.copy(), s.Y.copy()
    X[rest, [[s.columns.index(name)] for name in TWIST_COLUMNS]] = 0.0
    Y[rest] = 0.0
    trained = train_sets([replace(s, X=X, Y=Y)], QUICK)
    assert len(trained.table["folds"]) == training.JUDGED_BLOCKS
    assert trained.predictor().model.factor.max() < 10.0


def test_a_robot_in_a_plane_and_one_that_is_not_have_a_model_each() -> None:
    first, *others = training_sets(range(4), n=120)
    flat = [replace(s, Y=np.where(np.isin(np.arange(6), [1, 3, 5]), 0.0, s.Y)) for s in others]
    with pytest.raises(GpvoError, match="never differ in y, rx, rz .* but those of 'flight0' do"):
        train_sets([first, *flat], QUICK)


def test_covariances_that_call_some_error_impossible_are_not_held_against_errors() -> None:
    """Axes that a lever arm ties together: a run folder may hold such, as they are semidefinite."""
    sets = training_sets(range(3), n=120)
    for s in sets:
        C = s.covariances["pointing_matching"]
        sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
        C[:60] = sigma[:60, :, None] * sigma[:60, None, :]
    assert are_semidefinite(sets[0].covariances["pointing_matching"]).all()
    mean = train_sets(sets, QUICK).table["mean"]
    assert 0.5 < mean["pointing_matching_scaled"]["nees_dof"]["joint"] < 2.0


def _stated_smaller(s: TrainingSet, factor: float) -> TrainingSet:
    columns = [k for k, name in enumerate(s.columns) if name.startswith("ln_var_pointing_matching")]
    X = s.X.copy()
    X[:, columns] += np.log(factor)
    return replace(s, X=X, covariances={m: C * factor for m, C in s.covariances.items()})


def test_however_little_odometry_states_the_model_can_be_loaded(tmp_path: Path) -> None:
    sets = training_sets(range(3), n=120)
    trained = train_sets([_stated_smaller(s, 1e-20) for s in sets], QUICK, judge=False)
    save_model(trained, tmp_path / "m.gpvo")
    plain = train_sets(sets, QUICK, judge=False)
    assert trained.header["choices"]["base"] == "pointing_matching"
    of_small = training.estimate_set(Predictor.load(tmp_path / "m.gpvo").model, _stated_smaller(sets[0], 1e-20))
    np.testing.assert_allclose(of_small.sigma, training.estimate_set(plain.predictor().model, sets[0]).sigma, rtol=1e-6)


def test_a_model_that_could_not_be_loaded_is_not_made() -> None:
    sets = training_sets(range(4), n=120)
    with pytest.raises(GpvoError, match="differ so much from run to run.*factor'"):
        train_sets([replace(s, Y=s.Y * scale) for s, scale in zip(sets, (1.0, 1.0, 1e6, 1e6))], QUICK, judge=False)


def test_a_vehicle_that_never_leads_on_teaches_nothing_of_how_errors_add_up():
    """At rest, all motions begin at one keyframe."""
    resting = [replace(s, dt_s=0.05 + 1e-9 * (s.t_ns - s.t_ns[0])) for s in training_sets(range(3), n=120)]
    with pytest.raises(GpvoError, match="a vehicle that hardly moves"):
        train_sets(resting, QUICK, judge=False)
