"""``gpvo fuse`` and ``gpvo publish`` from run folders to tables, JSON, figures and bags."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from gpvo.cli import app
from gpvo.errors import GpvoError
from gpvo.evaluation.fusion import FusionSettings, fuse_runs
from gpvo.filters.policies import POLICIES
from gpvo.filters.run import FuseOptions
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.io.run import read_run, write_run
from gpvo.online import modelfile
from gpvo.types import ImuLog, Mounting, Status, TruthLog, VoLog, VoRecord
from small_model import small_model
from synthetic_flights import FORWARD_CAMERA, ErrorLaw, synthetic_flight, with_geometric
from typer.testing import CliRunner

MOUNTING = Mounting(se3.from_rt(R_FLU_OPTICAL, np.array([0.3, 0.0, 0.1])), FORWARD_CAMERA)


def _write(path: Path, seed: int, imu_scale: float = 1.0, method: str = "pointing_matching") -> Path:
    flight = synthetic_flight(seed, duration_s=8, law=ErrorLaw(burst_factor=10.0))
    flight = with_geometric(flight, np.diag([4e-4] * 3 + [4e-6] * 3), method)
    assert flight.imu is not None
    assert flight.T_world_cam is not None
    t_ns = np.array([r.t_ns for r in flight.records])
    write_run(
        path,
        VoLog(flight.records),
        predictions=list(flight.predictions.values()),
        mounting=MOUNTING,
        truth=TruthLog(t_ns, flight.T_world_cam),
        imu=replace(flight.imu, acc_mps2=flight.imu.acc_mps2 * imu_scale),
    )
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("runs")
    return [_write(folder / f"flight{seed}", seed) for seed in range(3)]


def _run(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_json_holds_every_policy(runs: list[Path], tmp_path: Path) -> None:
    picture = tmp_path / "pictures" / "fuse.png"
    out = json.loads(_run("fuse", *runs[:2], "--train", runs[2], "--plot", picture, "--log", tmp_path, "--json"))
    lines = (tmp_path / "flight0_learned.csv").read_text().splitlines()
    assert len(lines) == 162
    assert lines[0].startswith("t_ns,outcome,nis,innovation_x_m")
    assert out["mean"]["learned"]["nis_in_band_percent"] > 80
    assert out["schema"] == 1
    assert picture.stat().st_size > 10_000
    assert [r["run"] for r in out["runs"]] == ["flight0", "flight1"]
    for row in out["runs"]:
        assert set(row["policies"]) == set(POLICIES)
        assert row["policies"]["triangulation"] is None
        for name in ("constant", "constant_best", "constant_hindsight", "pointing_matching", "learned"):
            scores = row["policies"][name]
            assert scores["ate_rmse_m"] > 0
            assert scores["drift_percent"] > 0
            assert set(scores["nees_dof"]) == {"position", "attitude"}
            assert scores["diverged"] is False
    assert out["mean"]["triangulation"] is None
    assert out["mean"]["learned"]["ate_rmse_m"] < out["mean"]["constant"]["ate_rmse_m"]


def test_a_covariance_that_another_odometry_states_is_compared_where_there_is_one(tmp_path: Path) -> None:
    run = _write(tmp_path / "theirs", 0, method="imported")
    scores = json.loads(_run("fuse", run, "--json"))["runs"][0]["policies"]
    assert set(scores) == {*POLICIES, "imported"}
    assert scores["imported"]["ate_rmse_m"] > 0
    with pytest.raises(GpvoError, match="gpvo import makes such runs"):
        fuse_runs([_write(tmp_path / "ours", 0)], FusionSettings(policies=("imported",)))


def test_two_runs_of_one_name_are_told_apart(runs: list[Path], tmp_path: Path) -> None:
    flight = _write(tmp_path / "flight0", 1)
    report = fuse_runs([runs[0], flight], FusionSettings(policies=("learned",)))
    assert [t.run for t in report.traces] == ["flight0", "flight0-2"]
    out = json.loads(_run("fuse", runs[0], flight, "--policies", "learned", "--log", tmp_path / "log", "--json"))
    assert [r["run"] for r in out["runs"]] == ["flight0", "flight0-2"]
    logs = {p.name: p.read_text() for p in (tmp_path / "log").iterdir()}
    assert set(logs) == {"flight0_learned.csv", "flight0-2_learned.csv"}
    assert len(set(logs.values())) == 2


def test_table_without_model_or_training(runs: list[Path]) -> None:
    out = _run("fuse", runs[0], "--policies", "pointing_matching,learned")
    assert "pointing_matching" in out
    assert "learned less pointing_matching" in out


def test_a_model_that_no_frame_has_a_prediction_of(runs: list[Path], tmp_path: Path) -> None:
    """All frames are lost: a model was given, and giving one is no cure."""
    run, trained = read_run(runs[0]), small_model()
    modelfile.save(tmp_path / "m.gpvo", trained.arrays, trained.header)
    records = [r.with_status(Status.LOST, "dark") if k else r for k, r in enumerate(run.log)]
    write_run(tmp_path / "lost", VoLog(records), mounting=MOUNTING, truth=run.truth, imu=run.imu)
    with pytest.raises(GpvoError, match="learned is left out: no frame has a prediction"):
        fuse_runs([tmp_path / "lost"], FusionSettings(policies=("learned",), model=tmp_path / "m.gpvo"))


def test_without_imu(runs: list[Path]) -> None:
    out = json.loads(_run("fuse", runs[0], "--policies", "learned", "--no-imu", "--json"))
    assert out["runs"][0]["policies"]["learned"]["ate_rmse_m"] < 2.0


def test_an_imu_in_g_is_refused_in_one_line(tmp_path: Path) -> None:
    wrong = _write(tmp_path / "in_g", 5, 1 / 9.80665)
    with pytest.raises(GpvoError, match="it is in g") as error:
        _run("fuse", wrong)
    assert "multiply it by 9.80665" in str(error.value)


def test_most_policies_diverging_names_the_suspects(runs: list[Path], tmp_path: Path) -> None:
    """A flight too short for the sign of the accelerometer to be told for sure: it is filtered, with a warning."""
    settings = FusionSettings()
    assert not any("diverge" in line for line in fuse_runs(runs[:1], settings).warnings)
    wrong = fuse_runs([_write(tmp_path / "wrong", 0, imu_scale=-1.0)], settings).warnings
    assert [line for line in wrong if "policies diverge: suspect the accelerometer's sign" in line]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--init", "magic"), "truth or static"),
        (("--init", "static"), "not at rest"),
        (("--gate", "magic"), "discard or inflate"),
        (("--policies", "best"), "unknown policy"),
        (("--model", "nowhere.gpvo"), "nowhere.gpvo"),
        (("--plot", "fuse.xyz"), "fuse.xyz: does not have the suffix of an image.*png"),
        (("--plot", "fuse"), "fuse: does not have the suffix of an image.*png"),
    ],
)
def test_bad_options_are_one_line(runs: list[Path], arguments: tuple[str, str], words: str) -> None:
    with pytest.raises(GpvoError, match=words):
        _run("fuse", runs[0], *arguments)


def test_a_plot_replaces_an_earlier_one_and_nothing_else(runs: list[Path], tmp_path: Path) -> None:
    path, asked = tmp_path / "fuse.png", ("--plot", tmp_path / "fuse.png", "--policies", "pointing_matching")
    path.write_bytes(b"\x89PNG of somebody")
    with pytest.raises(GpvoError, match="fuse.png: is another file, not an earlier plot"):
        _run("fuse", runs[0], *asked)
    assert path.read_bytes() == b"\x89PNG of somebody"
    path.unlink()
    _run("fuse", runs[0], *asked)
    _run("fuse", runs[0], *asked)


def _write_at_rest(path: Path) -> Path:
    """A run without truth whose camera and IMU stand still."""
    rng, C = np.random.default_rng(0), np.diag([1e-6] * 6)
    t_ns = np.arange(61, dtype=np.int64) * 50_000_000
    motions = se3.exp(1e-3 * rng.standard_normal((60, 6)))
    records = [
        VoRecord(int(t), int(t) - 50_000_000, Status.OK, T, covariances={"triangulation": C})
        for t, T in zip(t_ns[1:], motions, strict=True)
    ]
    stamps = np.arange(601, dtype=np.int64) * 5_000_000
    gyro, acc = 1e-3 * rng.standard_normal((2, 601, 3))
    imu = ImuLog(stamps, gyro, acc + [0.0, 0.0, 9.80665])
    write_run(path, VoLog([VoRecord(0, 0, Status.START, np.eye(4)), *records]), mounting=MOUNTING, imu=imu)
    return path


def test_a_run_without_truth_shows_what_it_can(tmp_path: Path) -> None:
    still = _write_at_rest(tmp_path / "still")
    command = ("fuse", still, "--init", "static", "--policies", "triangulation,constant_best")
    out = json.loads(_run(*command, "--json"))
    assert out["warnings"] == [
        "still: no ground truth: nothing to score",
        "constant_best is left out: it is tuned on training runs; give --train RUN",
    ]
    scores = out["runs"][0]["policies"]["triangulation"]
    assert scores["nis_dof"] == out["mean"]["triangulation"]["nis_dof"] == pytest.approx(1.0, abs=0.3)
    assert scores["rejected"] < 3
    assert scores["ate_rmse_m"] is scores["diverged"] is out["mean"]["triangulation"]["diverged"] is None
    told = _run(*command)
    row = next(line for line in told.splitlines() if line.startswith("triangulation"))
    assert row.split()[-1] == "-"
    assert "nan" not in told


def test_one_run_has_no_interval(runs: list[Path]) -> None:
    out = _run("fuse", runs[0], "--policies", "pointing_matching,learned")
    assert "With fewer than three runs there is no interval." in out
    assert "inf" not in out


@pytest.mark.parametrize(
    "policy, words", [("constant", "--train RUN"), ("triangulation", "gpvo run --methods triangulation")]
)
def test_nothing_to_fuse_with_is_an_error(runs: list[Path], policy: str, words: str) -> None:
    with pytest.raises(GpvoError, match=f"nothing to fuse with: {policy} is left out: .*{words}"):
        _run("fuse", runs[0], "--policies", policy)


def test_of_many_policies_that_cannot_run_one_cure_is_told(runs: list[Path]) -> None:
    with pytest.raises(GpvoError, match="^nothing to fuse with: constant_best is left out: [^:]*; give --train RUN$"):
        _run("fuse", runs[0], "--policies", "constant,constant_best")


def test_errors_name_the_path_of_a_run(runs: list[Path], tmp_path: Path) -> None:
    (tmp_path / "elsewhere").symlink_to(runs[0])
    with pytest.raises(GpvoError, match="elsewhere: the vehicle is not at rest"):
        _run("fuse", tmp_path / "elsewhere", "--init", "static")


@pytest.mark.parametrize("to, name", [("bag", "x.bag"), ("bag", "x"), ("mcap", "y"), ("mavlink", "z.tlog")])
def test_publish_writes(runs: list[Path], tmp_path: Path, to: str, name: str) -> None:
    if to == "mavlink":
        pytest.importorskip("pymavlink")
    out = json.loads(_run("publish", runs[0], "--to", to, "-o", tmp_path / name, "--json"))
    assert out["messages"] == 161 - (to != "mavlink")
    assert (tmp_path / name).exists()
    if to != "mavlink":
        parameters = yaml.safe_load((tmp_path / f"{Path(name).stem}_robot_localization.yaml").read_text())
        if not name.endswith(".bag"):  # ROS 2 nests parameters under the node, ROS 1 does not
            parameters = parameters["ekf_filter_node"]["ros__parameters"]
        assert parameters["odom0"] == "/gpvo/odometry"
        assert np.flatnonzero(parameters["odom0_config"]).tolist() == [6, 7, 8, 9, 10, 11]


@pytest.mark.parametrize(
    "name, kind, ending",
    [("x.bag", "bag", ".bag"), ("x.mcap", "mcap", ".mcap"), ("x.tlog", "mavlink", ".tlog"), ("x", "bag", ".db3")],
)
def test_the_name_tells_what_to_publish(runs: list[Path], tmp_path: Path, name: str, kind: str, ending: str) -> None:
    if kind == "mavlink":
        pytest.importorskip("pymavlink")
    out = json.loads(_run("publish", runs[0], "-o", tmp_path / name, "--json"))
    assert out["to"] == kind
    assert any(p.is_file() and p.suffix == ending for p in tmp_path.rglob("x*"))


@pytest.mark.parametrize("to, name", [("mcap", "x.tlog"), ("bag", "x.mcap"), ("mavlink", "x.bag")])
def test_a_name_for_something_else_is_refused(runs: list[Path], tmp_path: Path, to: str, name: str) -> None:
    with pytest.raises(GpvoError, match=f"{name}: is not a file name for --to {to}"):
        _run("publish", runs[0], "--to", to, "-o", tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_publish_check_alone_writes_nothing(runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = _run("publish", runs[0].resolve(), "--consumer", "px4", "--check")
    assert "EKF2_EVV_NOISE" in out
    assert list(tmp_path.iterdir()) == []


def test_a_run_whose_imu_log_is_elsewhere_in_time(tmp_path: Path) -> None:
    flight = synthetic_flight(1, duration_s=4)
    assert flight.imu is not None
    imu = ImuLog(flight.imu.t_ns + 10**13, flight.imu.gyro_radps, flight.imu.acc_mps2)
    assert flight.T_world_cam is not None
    truth = TruthLog(np.array([r.t_ns for r in flight.records]), flight.T_world_cam)
    write_run(tmp_path / "late", VoLog(flight.records), mounting=MOUNTING, truth=truth, imu=imu)
    with pytest.raises(GpvoError, match="do not overlap"):
        _run("fuse", tmp_path / "late")


def test_a_filter_without_an_imu_says_so(runs: list[Path], tmp_path: Path) -> None:
    run = read_run(runs[0])
    write_run(tmp_path / "bare", run.log, mounting=run.mounting, truth=run.truth)
    settings = FusionSettings(policies=("pointing_matching",))
    for flown, names in (((runs[0],), ""), ((runs[0], tmp_path / "bare"), "bare"), ((tmp_path / "bare",), "any run")):
        told = [line for line in fuse_runs(flown, settings).warnings if "no IMU" in line]
        stands_in = "a model of constant velocity stands in for it, whose noise errs on the wide side, so NIS is low"
        assert told == [f"no IMU in {names}: {stands_in}"] * bool(names)
    asked = replace(settings, use_imu=False)
    assert not any("no IMU" in line for line in fuse_runs([runs[0]], asked).warnings)


def test_truth_where_there_is_no_imu_is_no_truth(tmp_path: Path) -> None:
    """At rest, with an IMU in the first half and truth in the second: a start from rest at the origin, and no score."""
    flight = with_geometric(synthetic_flight(1, duration_s=4), np.diag([4e-4] * 3 + [4e-6] * 3), "pointing_matching")
    assert flight.imu is not None
    records = [replace(r, T_prev_cur=np.eye(4)) for r in flight.records]
    imu = ImuLog(flight.imu.t_ns[:400], np.zeros((400, 3)), np.tile([0.0, 0.0, 9.81], (400, 1)), flight.imu.noise)
    away = se3.from_rt(np.eye(3), np.array([50.0, 0.0, 0.0]))
    truth = TruthLog(np.array([r.t_ns for r in records[45:]]), np.tile(away, (36, 1, 1)))
    write_run(tmp_path / "apart", VoLog(records), mounting=MOUNTING, truth=truth, imu=imu)
    with pytest.raises(GpvoError, match="needs ground truth.*--init static"):
        _run("fuse", tmp_path / "apart")
    settings = FusionSettings(policies=("pointing_matching",), options=FuseOptions(init="static"))
    report = fuse_runs([tmp_path / "apart"], settings)
    (trace,) = report.traces
    (scores,) = report.study.scores["pointing_matching"]
    assert scores is not None
    assert np.isnan(scores.ate_rmse_m)
    assert scores.frames == 0
    assert trace.truth is None
    assert np.linalg.norm(trace.position, axis=1).max() < 1.0
    assert "no frame covered by the IMU has ground truth" in "".join(report.warnings)
    assert "pointing_matching" not in "".join(report.warnings)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("quiet", [False, True])
def test_a_terminal_is_told_what_is_done_and_left_as_it_was(
    quiet: bool, runs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["fuse", str(runs[0]), "--policies", "pointing_matching", "--json"]
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", told := _Terminal())
    with pytest.raises(SystemExit) as ended:
        app([*arguments, *(["-q"] if quiet else [])])
    assert not ended.value.code
    if quiet:
        assert told.getvalue() == ""
    else:
        assert "flight0" in told.getvalue()
        assert told.getvalue().endswith("\x1b[2K")  # the line is empty again
