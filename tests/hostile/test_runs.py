"""Run folders: what is stated in them is possible, and a finished one is not lost."""

from __future__ import annotations

import _pyio
import errno
import io
import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gpvo.errors import GpvoError, SourceError
from gpvo.files import read_json, write_csv, write_json
from gpvo.io.run import RunWriter, is_finished, read_run, write_run
from gpvo.online.predictor import Predictor
from gpvo.types import CALIBRATION, VoLog
from synthetic_runs import make_run

from command_line import gpvo

MODEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"
ESC = "\x1b[2J\x1b]0;owned\x07"


@pytest.fixture(scope="module")
def log() -> VoLog:
    log = make_run(50, n=30)[0]
    share = 1e-9 * np.eye(6)
    return replace(log, records=[replace(r, shared={CALIBRATION: share}) if r.usable else r for r in log])


@pytest.fixture
def run(log: VoLog, tmp_path: Path) -> Path:
    write_run(tmp_path / "run", log)
    return tmp_path / "run"


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def _change(path: Path, column: str, value: float) -> None:
    table = pq.read_table(path)
    values = table[column].to_pylist()
    values[10] = value
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, column, pa.array(values, pa.float64())), path)


@pytest.mark.parametrize("name", ["../../escaped", "/tmp/escaped", "..", ".", "a/b", "a\\..\\b", "", "\x1b[2Ja"])
def test_the_name_of_a_run_leads_to_no_other_folder(name: str, run: Path, tmp_path: Path) -> None:
    """Folders of plots, tables and stated covariances hold files of that name."""
    write_json(run / "run.json", read_json(run / "run.json") | {"name": name, "source": f"{ESC}x"})
    found = read_run(run)
    place = tmp_path / "out" / f"{found.name}.txt"
    assert place.resolve().parent == tmp_path / "out"
    assert found.name
    assert (tmp_path / found.name).resolve().parent == tmp_path
    assert found.meta["source"].isprintable()


TWIN = {"of": "a", "seed": 0, "replicate": 0, "tolerance_name": "none", "tolerance": {"focal": 0.0}, "gap": None}


@pytest.mark.parametrize("changed", [
    {"vehicle": [1.0]}, {"vehicle": {"max_turn_radps2": "fast"}}, {"twin": [1]}, {"twin": "x"}, {"twin": {"of": "a"}},
    {"twin": TWIN | {"seed": -1}}, {"twin": TWIN | {"seed": "0"}}, {"twin": TWIN | {"replicate": None}},
    {"twin": TWIN | {"tolerance": 0.1}}, {"twin": TWIN | {"tolerance": {"focal": "0"}}}, {"twin": TWIN | {"gap": 2.0}},
    {"twin": TWIN | {"gap": {"ratio": [1.0], "spread": ["x"]}}}, {"options": ["bits"]}, {"frames": "many"},
], ids=str)  # fmt: skip
def test_what_a_run_says_of_itself_is_held_against_its_kind(changed: dict, run: Path) -> None:
    write_json(run / "run.json", read_json(run / "run.json") | {"twin": TWIN})
    assert read_run(run).meta["twin"] == TWIN
    write_json(run / "run.json", read_json(run / "run.json") | changed)
    with pytest.raises(SourceError, match=r"run\.json: is (damaged|malformed)") as refusal:
        read_run(run)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("column", "value"), [
    ("cov_pointing_matching_01", 1.0), ("cov_pointing_matching_00", np.nan), ("cov_pointing_matching_11", 0.0),
    ("cov_pointing_matching_11", -1.0), ("cov_pointing_matching_12", np.nan), ("cov_pointing_matching_33", np.inf),
    ("shared_calibration_00", -1.0), ("shared_calibration_01", np.nan), ("shared_calibration_22", 1.0),
    ("p_x_m", np.nan), ("p_x_m", -1e200), ("R_00", 2.0), ("R_00", 1e300),
])  # fmt: skip
def test_a_covariance_that_is_none_is_refused(column: str, value: float, run: Path) -> None:
    _change(run / "vo_log.parquet", column, value)
    with pytest.raises(SourceError, match=r"vo_log\.parquet: "):
        read_run(run)


@pytest.mark.parametrize("body", [None, "", 7, {}, "x" * 300])
def test_a_body_that_is_no_name_is_refused(body: object, run: Path) -> None:
    write_json(run / "rig.json", {**read_json(run / "rig.json"), "body": body})
    with pytest.raises(SourceError, match=r"rig\.json: .*body is not the name of a frame"):
        read_run(run)


def test_a_mounting_beyond_all_measure_is_refused_without_a_warning(run: Path) -> None:
    rig = read_json(run / "rig.json")
    write_json(run / "rig.json", {**rig, "T_body_cam": np.diag([1e300, 1.0, 1.0, 1.0])})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(SourceError, match=r"rig\.json: row 0 holds no rigid motion"):
            read_run(run)


@pytest.mark.parametrize(("column", "value"), [("cov_white_00", -1.0), ("mean_x_m", np.inf), ("cov_jitter_01", 1.0),
                                               ("cov_bias_00", 1e308), ("cov_bias_44", 4.6e18),
                                               ("mean_ry_rad", -1e30)])  # fmt: skip
def test_a_prediction_that_is_none_is_refused(column: str, value: float, log: VoLog, tmp_path: Path) -> None:
    predictions = list(Predictor.load(MODEL).replay(log).values())
    write_run(tmp_path / "run", log, predictions=predictions)
    assert len(read_run(tmp_path / "run").predictions) == len(predictions)
    path = tmp_path / "run" / "predictions.parquet"
    if column in pq.read_schema(path).names:
        _change(path, column, value)
        with pytest.raises(SourceError, match=r"predictions\.parquet: "):
            read_run(tmp_path / "run")


def test_the_writer_leaves_out_what_is_no_covariance(log: VoLog, tmp_path: Path) -> None:
    records = list(log.records)
    bad = np.ones((6, 6)) + np.eye(6) * -0.5
    records[5] = replace(records[5], covariances={**records[5].covariances, "pointing_matching": bad})
    write_run(tmp_path / "run", VoLog(records, log.camera))
    assert "pointing_matching" not in read_run(tmp_path / "run").log.records[5].covariances


def test_a_finished_run_stays_until_the_new_one_is_whole(
    log: VoLog, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = bytes_of(run)
    with pytest.raises(SourceError, match="holds a finished run"):
        RunWriter(run, overwrite=False)
    assert bytes_of(run) == before

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("gpvo.io.parquet._footer", full)
        with pytest.raises(SourceError, match="No space left"):
            write_run(run, VoLog(log.records[:20], log.camera))
    assert bytes_of(run) == before
    assert [p.name for p in run.parent.iterdir()] == ["run"]
    write_run(run, VoLog(log.records[:20], log.camera))
    assert len(read_run(run).log) == 20
    assert [p.name for p in run.parent.iterdir()] == ["run"]


def test_what_a_broken_run_left_is_replaced_without_asking(log: VoLog, tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run", camera=log.camera, overwrite=False)
    writer.append(log.records[0])
    writer.close(complete=False)
    assert not is_finished(tmp_path / "run")
    write_run(tmp_path / "run", log, overwrite=False)
    assert is_finished(tmp_path / "run")


def test_a_full_disk_names_the_file_and_leaves_nothing_half_written(
    log: VoLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError("Error writing bytes to file")

    monkeypatch.setattr("gpvo.io.parquet._footer", full)
    with pytest.raises(SourceError, match=r"log_000000\.parquet: cannot be written"):
        write_run(tmp_path / "run", log)
    assert not list(tmp_path.rglob("*.part"))


def test_a_file_system_without_locks_is_written_all_the_same(
    log: VoLog, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Lustre without ``-o flock``, or a share mounted from a cloud: nobody else was writing there."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr(fcntl, "flock", refuse)
    write_run(tmp_path / "run", log)
    assert is_finished(tmp_path / "run")


def test_lines_end_alike_on_every_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On Windows, text files turn each line end into two characters unless told not to."""
    monkeypatch.setattr(io, "open", _pyio.open)
    monkeypatch.setattr(os, "linesep", "\r\n")
    write_csv(tmp_path / "t.csv", {"a": [1, 2]})
    assert (tmp_path / "t.csv").read_bytes() == b"a\n1\n2\n"


def test_two_writers_do_not_mix(log: VoLog, tmp_path: Path) -> None:
    first = RunWriter(tmp_path / "run", camera=log.camera)
    first.append(log.records[0])
    with pytest.raises(SourceError, match="being written by another process"):
        RunWriter(tmp_path / "run", camera=log.camera)
    for record in log.records[1:]:
        first.append(record)
    first.close()
    assert len(read_run(tmp_path / "run").log) == len(log)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_is_named(log: VoLog, tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir(mode=0o555)
    with pytest.raises(SourceError, match="cannot be written"):
        write_run(tmp_path / "runs" / "run", log)


def test_the_command_replaces_a_finished_run_only_when_told(tmp_path: Path) -> None:
    log = tmp_path / "est.txt"
    log.write_text("".join(f"{k * 0.1:.1f} {k * 0.01} 0 0 0 0 0 1\n" for k in range(20)))
    assert gpvo("import", log, "-o", tmp_path / "run").returncode == 0
    again = gpvo("import", log, "-o", tmp_path / "run")
    assert again.returncode == 2
    assert "holds a finished run" in again.stderr
    assert len(again.stderr.strip().splitlines()) == 1
    assert gpvo("import", log, "-o", tmp_path / "run", "--overwrite").returncode == 0


def test_nothing_of_a_file_reaches_the_terminal_as_a_command(log: VoLog, tmp_path: Path) -> None:
    name = f"a{ESC}b"
    (tmp_path / "est.csv").write_text(f"t_s,p_x,p_y,p_z,q_x,q_y,q_z,q_w,{ESC}\n0,0,0,0,0,0,0,1,0\n1,0,0,0,0,0,0,1,0\n")
    write_run(tmp_path / "run", log, meta={"name": name, "source": name})
    assert read_run(tmp_path / "run").name.isprintable()
    for words in (("info", "run"), ("info", "est.csv"), ("evaluate", "run"), ("info", f"no{ESC}such")):
        done = gpvo(*words, folder=tmp_path)
        assert "\x1b" not in done.stdout + done.stderr, words
    assert "\x1b" not in str(GpvoError(f"no such '{ESC}'", where=name))


def test_names_inside_a_bag_reach_neither_terminal_nor_run_raw(tmp_path: Path) -> None:
    from bag_maker import BagMaker, stereo_bag

    maker: BagMaker = stereo_bag(ros1=True)
    for k in range(12):
        T = np.eye(4)
        T[0, 3] = k
        maker.odometry(f"/odom{ESC}", 10**18 + k * 10**8, T, np.eye(6), np.eye(6))
        maker.messages[-1][2].header.frame_id = f"base{ESC}"
        maker.messages[-1][2].child_frame_id = f"base{ESC}"
    maker.write(tmp_path / "evil.bag")
    for words in (("info", "evil.bag"), ("doctor", "evil.bag"), ("run", "evil.bag", "-o", "run")):
        done = gpvo(*words, folder=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "odom" in done.stdout + done.stderr
        assert "\x1b" not in done.stdout + done.stderr, words


def test_a_warning_reaches_the_terminal_as_text() -> None:
    code = (
        "import contextlib, sys, warnings\nfrom gpvo.cli import main\nsys.argv = ['gpvo', 'info', 'none']\n"
        "with contextlib.suppress(SystemExit):\n    main()\nwarnings.warn('odd\\x1b[2J')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert "gpvo: odd?[2J" in done.stderr


def test_a_file_named_to_fool_the_terminal_is_refused(tmp_path: Path) -> None:
    done = gpvo("run", f"a{ESC}.npz", "-o", "x", folder=tmp_path)
    assert done.returncode == 2
    assert "a control character in an argument" in done.stderr
    assert "\x1b" not in done.stderr
