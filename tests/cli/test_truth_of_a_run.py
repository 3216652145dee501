"""A run of gpvo's own is given ground truth afterwards: of another frame and clock, from any file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gpvo.cli import app
from gpvo.dataset.errors import motion_errors
from gpvo.geometry import se3
from gpvo.io.run import digest_of_file, read_run, write_run
from gpvo.io.trajectory import write_tum
from gpvo.types import ImuLog, Mounting, Status, StereoCamera, VoLog, VoRecord
from typer.testing import CliRunner

N, DT_NS = 300, 50_000_000
T_NS = 1_600_000_000_000_000_000 + DT_NS * np.arange(N)
CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)


def _poses(t_s: np.ndarray) -> np.ndarray:
    """A camera on a path that excites every axis."""
    p = np.stack([2 * np.sin(0.7 * t_s), 0.5 * np.sin(1.3 * t_s), t_s + 0.5 * np.cos(0.9 * t_s)], axis=1)
    phi = np.stack([0.3 * np.sin(1.1 * t_s), 0.5 * np.sin(0.8 * t_s + 1), 0.2 * np.sin(1.7 * t_s)], axis=1)
    return se3.from_rt(se3.so3_exp(phi), p)


POSES = _poses(1e-9 * (T_NS - T_NS[0]))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Of a perfect odometry, with covariances, an IMU and its place."""
    records = [
        VoRecord(
            t_ns=int(T_NS[k]),
            t_prev_ns=int(T_NS[max(k - 1, 0)]),
            status=Status.OK if k else Status.START,
            T_prev_cur=se3.inverse(POSES[k - 1]) @ POSES[k] if k else np.eye(4),
            covariances={"triangulation": 1e-6 * np.eye(6)} if k else {},
        )
        for k in range(N)
    ]
    path = tmp_path / "mine"
    imu = ImuLog(t_ns=T_NS, gyro_radps=np.zeros((N, 3)), acc_mps2=np.ones((N, 3)))
    place = Mounting(T_imu_cam=se3.exp(np.array([0.1, 0, 0, 0, 0, 0.2])))
    write_run(path, VoLog(records, CAMERA), imu=imu, mounting=place, meta={"kind": "images"})
    return path


def _worst(path: Path) -> float:
    """The largest error of a motion by the run's truth [m or rad], which it has for nearly all."""
    run = read_run(path)
    assert run.truth is not None
    errors = motion_errors(run.log, run.truth)
    assert len(errors.xi) > N - 10
    return float(np.abs(errors.xi).max())


def _call(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(w) for w in words])
    text = str(result.exception) if result.exception is not None and result.exit_code else ""
    return result.exit_code, result.stdout, result.stderr + text


def _truth(path: Path, late_s: float) -> Path:
    """Of a marker somewhere on the camera, in a world of its own, by a clock that is ``late_s`` ahead, as a CSV."""
    fine = np.arange(0, (N - 1) * DT_NS, 5_000_000)
    X, W = se3.exp(np.array([0.05, -0.1, 0.07, 0.9, -1.2, 0.7])), se3.exp(np.array([5.0, -3, 1, 0.1, -0.2, 2.0]))
    T = W @ _poses(1e-9 * fine) @ X
    q = se3.rotation_to_quaternion_xyzw(T[:, :3, :3])
    stamps = T_NS[0] + fine + round(late_s * 1e9)
    rows = (",".join([str(t), *(f"{v:.9f}" for v in (*p, *o))]) for t, p, o in zip(stamps, T[:, :3, 3], q))
    path.write_text("\n".join(["t_ns,x,y,z,qx,qy,qz,qw", *rows]) + "\n")
    return path


@pytest.mark.parametrize("late_s", [0.083, -1_599_998_765.4])
def test_truth_of_another_frame_and_clock_is_fitted_and_all_else_kept(run: Path, tmp_path: Path, late_s: float) -> None:
    truth, out = _truth(tmp_path / "mocap.csv", late_s), tmp_path / "known"
    words = ("--truth", truth, "--align", "transform", "--time-offset", "auto", "--json")
    code, told, _ = _call("import", run, "-o", out, *words)
    assert code == 0
    assert json.loads(told)["time_offset_s"] == pytest.approx(late_s, abs=2e-3)
    known = read_run(out)
    assert _worst(out) < 1e-3
    same = ["vo_log.parquet", "trajectory.tum", "imu.parquet", "rig.json", "config.toml"]
    assert {f: digest_of_file(out / f) for f in same} == {f: digest_of_file(run / f) for f in same}
    assert known.name == "known"
    assert known.meta["digests"]["truth.parquet"] == digest_of_file(out / "truth.parquet")
    assert known.meta["truth"]["file"] == "mocap.csv"
    assert not [p.name for p in tmp_path.iterdir() if p.name.startswith(".known")]


def test_into_its_own_folder_and_with_its_own_truth(run: Path, tmp_path: Path) -> None:
    """What was given without a fit is fitted later."""
    truth = _truth(tmp_path / "mocap.csv", 0.0)
    assert _call("import", run, "-o", run, "--truth", truth)[0] != 0  # it is there
    assert _call("import", run, "-o", run, "--truth", truth, "--overwrite")[0] == 0
    assert _worst(run) > 0.01
    assert _call("import", run, "-o", run, "--align", "transform", "--overwrite")[0] == 0
    assert _worst(run) < 1e-3


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "give it with --truth"),
        (["--truth", "{truth}", "--frame", "body"], "--frame has no effect on a run"),
        (["--truth", "{truth}", "--map", "a=t_s"], "--map has no effect on a run"),
        (["--truth", "{truth}", "--covariance-axes", "body"], "--covariance-axes has no effect on a run"),
        (["--truth", "{truth}", "--covariance-of", "motion"], "--covariance-of has no effect on a run"),
        (["--truth", "{truth}", "--vehicle", "car"], "--vehicle has no effect on a run"),
        (["--truth", "{truth}", "--max-turn", "3"], "--max-turn has no effect on a run"),
        (["--align", "transform", "--truth-topic", "/gt"], "--truth-topic has no effect without ground truth"),
        (["--truth", "{late}"], "--time-offset auto"),
    ],
)
def test_refusals_leave_nothing(run: Path, tmp_path: Path, words: list[str], reason: str) -> None:
    files = {"truth": _truth(tmp_path / "a.csv", 0.0), "late": _truth(tmp_path / "b.csv", 1e4)}
    code, _, err = _call("import", run, "-o", tmp_path / "out", *(w.format(**files) for w in words))
    assert code != 0
    assert reason in err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["--align", "rotation"], ["--truth-sigma", "0.01,0.01"], ["--truth-map", "a=t_s"]])
def test_what_is_asked_of_a_truth_needs_one(tmp_path: Path, words: list[str]) -> None:
    """Of a log, as of a run: it was ignored, and no truth was fitted."""
    code, _, err = _call("import", _truth(tmp_path / "log.csv", 0.0), "-o", tmp_path / "out", *words)
    assert code != 0
    assert f"{words[0]} has no effect without ground truth (give it with --truth)" in err
    assert not (tmp_path / "out").exists()


def test_other_files_in_the_folder_of_a_run_stay(run: Path, tmp_path: Path) -> None:
    """A note, a figure, a folder: what gpvo did not write it does not remove, whichever command replaces the run."""
    (run / "notes.txt").write_text("battery changed")
    (run / "figures").mkdir()
    (run / "figures" / "a.txt").write_text("a")
    truth = _truth(tmp_path / "mocap.csv", 0.0)
    for words in (["import", run, "--truth", truth], ["import", truth, "--frame", "cam"]):
        code, _, err = _call(*words, "-o", run, "--overwrite")
        assert code == 0, err
        assert (run / "notes.txt").read_text() == "battery changed"
        assert (run / "figures" / "a.txt").read_text() == "a"
    assert read_run(run).truth is None  # of the second one, of which nothing else was kept
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "mocap.csv"]


def test_a_run_that_broke_off_is_ended_first(run: Path, tmp_path: Path) -> None:
    meta = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps({**meta, "complete": False}))
    code, _, err = _call("import", run, "-o", tmp_path / "out", "--truth", _truth(tmp_path / "a.csv", 0.0))
    assert code != 0
    assert "broke off" in err


def test_what_evaluate_does_not_read_import_does(run: Path, tmp_path: Path) -> None:
    code, _, err = _call("evaluate", run, "--truth", _truth(tmp_path / "a.csv", 0.0))
    assert code != 0
    assert "'gpvo import', of a log or as --truth of a run, takes CSV" in err


def test_a_folder_that_is_no_run_is_left_alone(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("mine")
    write_tum(tmp_path / "gt.tum", T_NS, POSES)
    code, _, err = _call("import", run, "-o", out, "--truth", tmp_path / "gt.tum")
    assert code != 0
    assert "not a run" in err
    assert [p.name for p in out.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("words", [("import", "-o", "new"), ("evaluate",)], ids=lambda words: words[0])
def test_a_table_of_a_run_points_to_its_folder(run: Path, words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, [words[0], str(run / "vo_log.parquet"), *words[1:]])
    assert done.exit_code != 0
    assert f"give its folder, {run}" in str(done.exception)
