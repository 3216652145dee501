"""``gpvo forecast``: from a plan to the covariance of the position along it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.evaluation.forecast import Plan, forecast, resample
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.io.trajectory import Trajectory, write_tum
from gpvo.learning.store import save_model
from gpvo.online import modelfile
from gpvo.online.predictor import Predictor
from small_model import small_model
from synthetic_runs import make_run

from command_line import gpvo


def truth_plan(seed: int, n: int = 200) -> Plan:
    truth = make_run(seed, n=n)[1]
    return Plan((truth.t_ns - truth.t_ns[0]) * 1e-9, truth.T_world_cam)


def final_error_m(seed: int, n: int = 200) -> float:
    log, truth = make_run(seed, n=n)
    return float(np.linalg.norm((log.trajectory()[-1] - truth.T_world_cam[-1])[:3, 3]))


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "m.gpvo"
    save_model(small_model(), path)
    return path


def test_final_sigma_is_that_of_flights_along_the_plan():
    predictor = small_model().predictor()
    predicted = [forecast(predictor, truth_plan(k), draws=3).sigma_m[-1] for k in range(100, 112)]
    actual = [final_error_m(k) for k in range(100, 140)]
    ratio = np.sqrt(np.mean(np.square(predicted)) / np.mean(np.square(actual)))
    assert 0.7 <= ratio <= 1.5


def test_covariances_grow_from_nothing_and_stay_covariances():
    f = forecast(small_model().predictor(), truth_plan(7), draws=2)
    assert not f.covariance[0].any()
    assert np.linalg.eigvalsh(f.covariance[1:]).min() > 0
    assert f.sigma_m[-1] > f.sigma_m[20] > f.sigma_m[1] > 0
    np.testing.assert_allclose(f.sigma_m**2, (f.position_sigma_m**2).sum(axis=1), rtol=1e-9)


def test_same_seed_same_forecast_and_draws_differ():
    predictor, plan = small_model().predictor(), truth_plan(7, n=60)
    a, b, c = (forecast(predictor, plan, draws=2, seed=s).covariance for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0


def test_a_plan_unlike_the_training_is_outside_and_less_certain():
    predictor, plan = small_model().predictor(), truth_plan(7, n=100)
    T = plan.T_world_cam.copy()
    T[:, :3, 3] *= 5.0  # The same turns, five times as fast.
    usual, wild = (forecast(predictor, p, draws=2) for p in (plan, Plan(plan.t_s, T)))
    assert usual.outside_share < 0.1
    assert wild.outside_share > 0.9
    assert wild.outside[0].feature == "v_z_mps"
    assert wild.outside[0].planned[1] > wild.outside[0].trained[1]
    assert wild.sigma_m[-1] > 2 * usual.sigma_m[-1]


def test_any_spacing_of_the_plan():
    predictor, dense = small_model().predictor(), truth_plan(7, n=200)
    t_ns = np.round(dense.t_s * 1e9).astype(np.int64)
    sparse = resample(Trajectory(t_ns[::5], dense.T_world_cam[::5]), dense.t_s)
    assert np.linalg.norm(sparse.T_world_cam[:, :3, 3] - dense.T_world_cam[:, :3, 3], axis=1).max() < 0.02
    a, b = (forecast(predictor, p, draws=4).sigma_m[-1] for p in (dense, sparse))
    assert b == pytest.approx(a, rel=0.15)


def test_motions_over_several_frames_are_planned_as_such():
    """Odometry that keeps its reference over two frames makes half as many errors."""
    predictor, plan = small_model().predictor(), truth_plan(7, n=100)
    one = forecast(predictor, plan, draws=2).sigma_m[-1]
    arrays = {**predictor.arrays, "sample.dt_s": 2 * predictor.arrays["sample.dt_s"]}
    two = forecast(Predictor(arrays, predictor.header), plan, draws=2).sigma_m[-1]
    assert 0.5 < two / one < 0.9


def test_document_table_picture_and_frames(tmp_path, model_file):
    import pyarrow.csv
    import pyarrow.parquet

    plan = truth_plan(7, n=60)
    t_ns = np.round(plan.t_s * 1e9).astype(np.int64)
    write_tum(tmp_path / "cam.tum", t_ns, plan.T_world_cam)
    write_tum(tmp_path / "body.tum", t_ns, plan.T_world_cam @ se3.from_rt(R_FLU_OPTICAL.T, np.zeros(3)))
    found = {}
    for frame in ("cam", "body"):
        code, out, _ = gpvo("forecast", model_file, "--path", tmp_path / f"{frame}.tum", "--frame", frame, "--json")
        assert code == 0
        found[frame] = json.loads(out)
    assert found["cam"]["final_sigma_m"] == pytest.approx(found["body"]["final_sigma_m"], rel=1e-5)
    document = found["cam"]
    assert document["rate_hz"] == pytest.approx(20.0)
    assert document["along"][-1]["sigma_m"] == document["predicted_final_error_m"]
    assert document["along"][0]["sigma_m"] == 0.0
    picture = tmp_path / "plan.png"
    for name in ("all.csv", "all.parquet"):
        args = ("--plot", picture, "-o", tmp_path / name)
        code, out, _ = gpvo("forecast", model_file, "--path", tmp_path / "cam.tum", *args)
        assert code == 0
        assert "% of the plan lies outside the training domain" in out
        assert "axes of the plan's world" in out
        read = pyarrow.csv.read_csv if name.endswith("csv") else pyarrow.parquet.read_table
        table = read(tmp_path / name)
        assert table.num_rows == 61
        assert table["sigma_m"][60].as_py() == pytest.approx(document["predicted_final_error_m"], rel=1e-9)
    assert picture.read_bytes().startswith(b"\x89PNG")
    picture = tmp_path / "pictures" / "plan.pdf"
    assert gpvo("forecast", model_file, "--path", tmp_path / "cam.tum", "--plot", picture)[0] == 0
    assert picture.read_bytes().startswith(b"%PDF")
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(("option", "name"), [("--plot", "p.png"), ("--plot", "p.pdf"), ("--plot", "p.svg"),
                                              ("-o", "p.csv"), ("-o", "p.parquet")])  # fmt: skip
def test_a_forecast_replaces_an_earlier_one_and_nothing_else(tmp_path, model_file, option, name):
    plan, foreign = truth_plan(7, n=60), b"\x89PNG of somebody, or t_s,distance_m by hand"
    write_tum(tmp_path / "cam.tum", np.round(plan.t_s * 1e9).astype(np.int64), plan.T_world_cam)
    given = (model_file, "--path", tmp_path / "cam.tum", option, tmp_path / name)
    (tmp_path / name).write_bytes(foreign)
    code, out, err = gpvo("forecast", *given)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert f"{name}: is another file, not an earlier" in err
    assert (tmp_path / name).read_bytes() == foreign
    (tmp_path / name).unlink()
    assert [gpvo("forecast", *given)[0] for _ in range(2)] == [0, 0]
    assert (tmp_path / name).read_bytes() != foreign


def test_a_plot_never_replaces_the_plan(tmp_path, model_file):
    plan = truth_plan(7, n=60)
    write_tum(tmp_path / "cam.tum", np.round(plan.t_s * 1e9).astype(np.int64), plan.T_world_cam)
    before = (tmp_path / "cam.tum").read_bytes()
    code, _, err = gpvo("forecast", model_file, "--path", tmp_path / "cam.tum", "--plot", tmp_path / "cam.tum")
    assert (code, (tmp_path / "cam.tum").read_bytes()) == (2, before)
    assert "does not have the suffix of an image" in err


def test_what_cannot_be_forecast_is_one_line(tmp_path, model_file):
    write_tum(tmp_path / "short.tum", np.array([0, 60_000_000]), np.stack([np.eye(4)] * 2))
    write_tum(tmp_path / "plan.tum", np.array([0, 10**9]), np.stack([np.eye(4)] * 2))
    cases = [
        (("--path", tmp_path / "none.tum"), "none.tum"),
        (("--path", tmp_path / "short.tum"), "lasts less"),
        (("--path", tmp_path / "plan.tum", "--frame", "imu"), "imu"),
        (("--path", tmp_path / "plan.tum", "-o", tmp_path / "x.txt"), "x.txt"),
        (("--path", tmp_path / "plan.tum", "-o", tmp_path / "plan.tum" / "x.csv"), "plan.tum is no folder"),
        (("--path", tmp_path / "none.tum", "--plot", tmp_path / "x.txt"), "not have the suffix of an image"),
    ]
    for args, says in cases:
        code, out, err = gpvo("forecast", model_file, *args)
        assert (code, out) == (2, "")
        assert len(err.strip().splitlines()) == 1
        assert says in err
    predictor = small_model().predictor()
    bare = {k: v for k, v in predictor.arrays.items() if not k.startswith("sample.")}
    with pytest.raises(ModelError, match="no sample"):
        forecast(Predictor(bare, predictor.header), truth_plan(7, n=60))
    predictor = Predictor(predictor.arrays, predictor.header)
    predictor.target = "window:1s"
    with pytest.raises(ModelError, match="window:1s"):
        forecast(predictor, truth_plan(7, n=60))


def test_a_model_of_windows_is_refused_by_name(tmp_path):
    predictor = small_model().predictor()
    modelfile.save(tmp_path / "windows.gpvo", predictor.arrays, {**predictor.header, "target": "window:1s"})
    code, _, err = gpvo("forecast", tmp_path / "windows.gpvo", "--path", tmp_path / "plan.tum")
    assert code == 2
    assert "windows.gpvo: this model predicts the error over window:1s" in err


@pytest.mark.slow
def test_forecast_along_unseen_simulated_flights(tmp_path):
    """Odometry on simulated tracks: training on ten flights, forecast along the truth of twenty others."""
    from bench.experiment_flights import Campaign, flights
    from gpvo.dataset.build import build_run
    from gpvo.learning.config import TrainConfig
    from gpvo.learning.train import train_sets

    campaign = Campaign("tunnel-clean", tmp_path, 10.0)
    config = TrainConfig(features="velocity,rotation,n_inliers")
    predictor = train_sets(
        [build_run(r) for r in flights(campaign, range(1000, 1010))], config, judge=False
    ).predictor()
    predicted, actual = [], []
    for run in flights(campaign, range(20)):
        truth = run.truth
        plan = resample(Trajectory(truth.t_ns[::10], truth.T_world_cam[::10]), np.arange(200) * predictor.model.dt_s)
        f = forecast(predictor, plan, draws=3)
        assert f.outside_share < 0.2
        T = run.log.trajectory()
        k = int(np.searchsorted(run.log.t_ns, truth.t_ns[0] + round(plan.t_s[-1] * 1e9)))
        ended = truth.T_world_cam[0] @ se3.inverse(T[0]) @ T[k]
        predicted.append(f.sigma_m[-1])
        actual.append(np.linalg.norm(ended[:3, 3] - truth.T_world_cam[k, :3, 3]))
    ratio = np.sqrt(np.mean(np.square(predicted)) / np.mean(np.square(actual)))
    assert 0.7 <= ratio <= 1.5, ratio
