"""The run folder: bit-exact round trip, interrupted runs, damaged files."""

from __future__ import annotations

import hashlib
import json
import sys
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.run import RunWriter, digest_of_file, read_predictions, read_run, write_predictions, write_run
from gpvo.io.run_read import is_run
from gpvo.types import (
    ImuLog,
    ImuNoise,
    Mounting,
    Prediction,
    Status,
    StereoCamera,
    StoredRecords,
    TruthLog,
    VoLog,
    VoRecord,
)

from motion_errors import prediction

CAMERA = StereoCamera(400.0, 401.0, 319.5, 239.5, 0.1, 640, 480)


def _spd(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.normal(size=(n, n))
    C = A @ A.T
    return 0.5 * (C + C.T)


def make_records(n: int, seed: int = 0) -> list[VoRecord]:
    rng = np.random.default_rng(seed)
    start = 1_520_530_308_199_447_626
    out = [VoRecord(start, start, Status.START, np.eye(4), stage_ms={"detect": 1.5})]
    for k in range(1, n):
        lost = k % 17 == 5
        stated = {} if lost else {"triangulation": _spd(rng, 6), "pointing_matching": _spd(rng, 6)}
        least = min((np.linalg.eigvalsh(C)[0] for C in stated.values()), default=0.0)
        imu = {} if k % 3 else {"imu_gyro_mean_radps": rng.normal(size=3), "imu_acc_std_mps2": rng.normal(size=3)}
        out.append(
            VoRecord(
                start + k * 50_000_001,
                start + (k - 1) * 50_000_001,
                Status.LOST if lost else Status.OK,
                np.eye(4) if lost else se3.exp(0.1 * rng.normal(size=6)),
                reason="too few matches" if lost else "",
                n_inliers=-1 if lost else int(rng.integers(10, 500)),
                n_tracked=500,
                reproj_rms_px=np.nan if lost else float(rng.uniform()),
                covariances=stated,
                v_t={} if lost else {"triangulation": _spd(rng, 3)},
                shared={"calibration": 0.5 * least * np.eye(6)} if k % 7 and not lost else {},
                stage_ms={"detect": float(rng.uniform()), "match": 2.0},
                **imu,
            )
        )
    return out


def make_prediction(record: VoRecord, rng: np.random.Generator, calibration: bool = False) -> Prediction:
    jitter, white, bias = (_spd(rng, 6) for _ in range(3))
    root, tau_s = calibration * rng.normal(size=(6, 6)), 1.0 + calibration * rng.uniform(size=6)
    stated = prediction(record.t_ns, jitter, white, bias, 10.0, root, tau_s, dt_s=record.dt_s)
    return replace(stated, mean=rng.normal(size=6), epistemic=rng.uniform(size=6), in_domain=0.9)


def assert_same(a: object, b: object) -> None:
    for f in fields(a):  # type: ignore[arg-type]
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, dict):
            assert set(x) == set(y), f.name
            for key in x:
                np.testing.assert_array_equal(x[key], y[key], err_msg=f.name)
        elif f.name == "persistent_root":  # the file has its square
            np.testing.assert_allclose(x, y, atol=1e-12, err_msg=f.name)
        elif x is None or isinstance(x, (str, Status)):
            assert x == y, f.name
        else:
            np.testing.assert_array_equal(x, y, err_msg=f.name)


def test_round_trip_is_bit_exact(tmp_path):
    rng = np.random.default_rng(1)
    records = make_records(250)
    predictions = [make_prediction(r, rng) for r in records[1:]]
    truth = TruthLog(np.arange(5) * 10, se3.exp(rng.normal(size=(5, 6))), 3e-3, 2e-4)
    imu = ImuLog(np.arange(7) * 3, rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), ImuNoise(1e-3, 2e-3, 3e-5, 4e-4))
    mounting = Mounting(T_body_cam=se3.exp(rng.normal(size=6)), T_imu_cam=None)
    config = {"preset": "fast", "n": 3, "nested": {"a": [1.5, 2.0], "on": True, "none": None}}
    with RunWriter(
        tmp_path / "run", camera=CAMERA, mounting=mounting, truth=truth, imu=imu, config=config, chunk=60,
        meta={"source_format": "euroc", "bad": float("nan")},
    ) as writer:  # fmt: skip
        for record, prediction in zip(records, [None, *predictions], strict=True):
            writer.append(record, prediction)
        writer.note(fps=30.0)
    run = read_run(tmp_path / "run")
    assert len(run.log) == 250
    for a, b in zip(records, run.log.records, strict=True):
        assert_same(a, b)
    for p, q in zip(predictions, run.predictions, strict=True):
        assert_same(p, q)
    assert run.truth is not None
    assert run.imu is not None
    assert_same(truth, run.truth)
    assert run.imu.noise == imu.noise
    np.testing.assert_array_equal(run.imu.acc_mps2, imu.acc_mps2)
    assert run.log.camera == CAMERA
    np.testing.assert_array_equal(run.mounting.T_body_cam, mounting.T_body_cam)
    assert run.mounting.T_imu_cam is None
    assert run.meta["complete"] is True
    assert run.meta["fps"] == 30.0
    assert run.meta["bad"] is None
    assert run.meta["frames"] == 250
    tomllib = pytest.importorskip("tomllib")
    assert tomllib.loads((tmp_path / "run" / "config.toml").read_text())["nested"] == {"a": [1.5, 2.0], "on": True}
    assert not (tmp_path / "run" / "chunks").exists()
    lines = (tmp_path / "run" / "trajectory.tum").read_text().splitlines()
    last = np.array([float(v) for v in lines[-1].split()[1:4]])
    np.testing.assert_allclose(last, run.log.trajectory()[-1, :3, 3], atol=1e-8)
    assert len(lines) == 250


def test_a_log_takes_a_kilobyte_a_motion(tmp_path):
    """As objects, each of its arrays and numbers has a header larger than itself: 4 kB."""
    write_run(tmp_path / "run", VoLog(make_records(1200), CAMERA))
    read_run(tmp_path / "run")
    tracemalloc.start()
    run = read_run(tmp_path / "run")
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 1024 * len(run.log)


def test_records_that_come_one_by_one_are_the_same_as_columns():
    records = make_records(1205)  # more than are objects at once
    for one, other in zip(StoredRecords.of(iter(records)), records, strict=True):
        assert_same(one, other)
    assert len(StoredRecords.of([])) == 0


def test_predictions_take_two_kilobytes_each(tmp_path):
    """As objects, of which what is worked out stays, they took 4.3 kB: those of ten hours did not fit into 4 GB."""
    rng, records = np.random.default_rng(0), make_records(1200)
    write_predictions(tmp_path / "p.parquet", [make_prediction(r, rng) for r in records])
    read_predictions(tmp_path / "p.parquet")
    tracemalloc.start()
    found = read_predictions(tmp_path / "p.parquet")
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 2048 * len(found)
    assert [p.t_ns for p in found[5:9]] == [r.t_ns for r in records[5:9]]


def test_predictions_are_written_as_they_come(tmp_path):
    """All at once, 16,000 of them took 60 MB."""
    rng = np.random.default_rng(0)
    few = [make_prediction(r, rng) for r in make_records(40)]
    tracemalloc.start()
    write_predictions(tmp_path / "p.parquet", (p for _ in range(400) for p in few))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16e6
    assert [p.t_ns for p in read_predictions(tmp_path / "p.parquet")[15_990:]] == [p.t_ns for p in few[30:]]


def test_a_run_that_was_lost_for_a_whole_chunk_is_read_with_its_predictions(tmp_path):
    """A lost motion has no degrees of freedom, and a chunk of nothing else no column of them."""
    rng, records = np.random.default_rng(1), make_records(12)
    predictions = [make_prediction(r, rng) for r in records]
    predictions = [replace(p, nu=np.inf if 4 <= k < 9 else 5.0) for k, p in enumerate(predictions)]
    with RunWriter(tmp_path / "run", camera=CAMERA, chunk=4) as writer:
        for record, prediction in zip(records, predictions, strict=True):
            writer.append(record, prediction)
    assert [p.nu for p in read_run(tmp_path / "run").predictions] == [p.nu for p in predictions]


def test_digests_are_of_files_that_do_not_fit_into_memory(tmp_path):
    """The tracks of a run of hours."""
    (tmp_path / "tracks.parquet").write_bytes(bytes(20_000_000))
    tracemalloc.start()
    found = digest_of_file(tmp_path / "tracks.parquet")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found == hashlib.sha256(bytes(20_000_000)).hexdigest()
    assert peak < 5_000_000


def test_parts_that_know_different_methods_make_one_log(tmp_path):
    bare = [replace(r, covariances={}, v_t={}, shared={}, stage_ms={}, n_tracked=-1) for r in make_records(90)[:30]]
    records = [*bare, *make_records(90)[30:60], *(replace(r, v_t={}) for r in make_records(90)[60:])]
    with RunWriter(tmp_path / "run", camera=CAMERA, chunk=30) as writer:
        for record in records:
            writer.append(record)
        chunked = writer.path / "chunks"
        run = read_run(tmp_path / "run")
        assert len(list(chunked.glob("log_*"))) == 3
    for log in (run.log, read_run(tmp_path / "run").log):
        for a, b in zip(records, log, strict=True):
            assert_same(a, b)
        assert log.methods == VoLog(records).methods
        np.testing.assert_array_equal(log.covariance("triangulation"), VoLog(records).covariance("triangulation"))
        assert log.v_t_methods == VoLog(records).v_t_methods
        np.testing.assert_array_equal(log.v_t("triangulation"), VoLog(records).v_t("triangulation"))
        some = np.arange(90) % 4 == 1
        assert log.rows(some & (log.t_ns < log.t_ns[30])).methods == ()
        for a, b in zip(log.rows(some), VoLog(records).rows(some), strict=True):
            assert_same(a, b)
        assert_same(log.records[-1], records[-1])
        assert [r.t_ns for r in log.records[3:50:7]] == [r.t_ns for r in records[3:50:7]]
        with pytest.raises(IndexError):
            log.records[90]


def test_a_log_judged_anew_differs_in_status_and_reason_alone(tmp_path):
    records = make_records(40)
    write_run(tmp_path / "run", VoLog(records, CAMERA))
    log, judged = read_run(tmp_path / "run").log, [r.with_status(Status.LOST, "slip") for r in records]
    for of in (log, VoLog(records, CAMERA)):
        for a, b in zip(judged, of.judged_as(r.with_status(Status.LOST, "slip") for r in of), strict=True):
            assert_same(a, b)
    assert log.statuses == [r.status for r in records]
    assert not of.judged_as(judged).usable.any()


def test_killed_run_reads_up_to_the_last_chunk(tmp_path):
    writer = RunWriter(tmp_path / "run", camera=CAMERA, chunk=40)
    records = make_records(130)
    for record in records:
        writer.append(record)
    # No close: as after a kill.
    assert is_run(tmp_path / "run")
    run = read_run(tmp_path / "run")
    assert len(run.log) == 120
    assert run.meta["complete"] is False
    assert_same(run.log.records[-1], records[119])
    # A new run in the same place starts afresh; with the process went its hold on the folder.
    del writer
    write_run(tmp_path / "run", VoLog(records[:10], CAMERA))
    assert len(read_run(tmp_path / "run").log) == 10


def test_a_run_killed_after_its_last_record_keeps_its_trajectory(tmp_path):
    records = make_records(80)
    writer = RunWriter(tmp_path / "run", chunk=40, resume="key")
    for record in records:
        writer.append(record)
    del writer
    write_run(tmp_path / "whole", VoLog(records))
    with RunWriter(tmp_path / "run", chunk=40, resume="key") as writer:
        assert writer.kept is not None
        for record in records:
            writer.append(record)
    trajectory, whole = ((tmp_path / name / "trajectory.tum").read_text() for name in ("run", "whole"))
    assert trajectory == whole


def _interrupted_run(path) -> None:
    with RunWriter(path, chunk=40) as writer:
        for record in make_records(130):
            writer.append(record)
        raise RuntimeError


def test_an_exception_leaves_every_record(tmp_path):
    with pytest.raises(RuntimeError):
        _interrupted_run(tmp_path / "run")
    run = read_run(tmp_path / "run")
    assert len(run.log) == 130
    assert run.meta["complete"] is False
    assert run.truth is None
    assert run.log.camera is None


@pytest.mark.parametrize("at", ["os.replace", "gpvo.io.run.write_json", "gpvo.io.run.write_toml"])
def test_a_run_that_was_killed_while_it_began_is_begun_anew(tmp_path, monkeypatch, at):
    def killed(*_):
        raise SystemExit

    monkeypatch.setattr(at, killed)
    with pytest.raises(SystemExit):
        RunWriter(tmp_path / "run")
    monkeypatch.undo()
    write_run(tmp_path / "run", VoLog(make_records(10), CAMERA))
    assert len(read_run(tmp_path / "run").log) == 10


def test_a_finished_run_is_replaced_by_whatever_path_it_is_named(tmp_path, monkeypatch):
    log = VoLog(make_records(20), CAMERA)
    run = tmp_path / "run"
    write_run(run, log)
    (tmp_path / "latest").symlink_to(run, target_is_directory=True)
    for path in (".", "../run", tmp_path / "latest", run / ".." / "run"):
        monkeypatch.chdir(run)
        write_run(path, VoLog(log.records[:10]))
        assert len(read_run(run).log) == 10
        write_run(run, log)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["latest", "run"]


def test_a_finished_run_is_replaced_in_one_step(tmp_path, monkeypatch):
    """At whatever moment the writer is killed, there is the old run or the new one."""
    log = VoLog(make_records(20), CAMERA)
    write_run(tmp_path / "run", log)

    def watched(call):
        def then(*words, **named):
            out = call(*words, **named)
            assert len(read_run(tmp_path / "run").log) in (20, 10)
            return out

        return then

    for name in ("os.replace", "os.rename", "shutil.rmtree"):
        module, _, attribute = name.partition(".")
        monkeypatch.setattr(name, watched(getattr(sys.modules[module], attribute)))
    if sys.platform != "linux":
        pytest.skip("no such step on this system")
    write_run(tmp_path / "run", VoLog(log.records[:10], CAMERA))
    monkeypatch.undo()
    assert len(read_run(tmp_path / "run").log) == 10
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_where_no_step_exchanges_folders_two_do(tmp_path, monkeypatch):
    log = VoLog(make_records(20), CAMERA)
    write_run(tmp_path / "run", log)
    monkeypatch.setattr("gpvo.io.run_folder._exchanged", lambda *_: False)
    write_run(tmp_path / "run", VoLog(log.records[:10], CAMERA))
    assert len(read_run(tmp_path / "run").log) == 10
    assert [p.name for p in tmp_path.iterdir()] == ["run"]


def test_stored_paths_lead_where_they_led(tmp_path):
    """Persian names hold joiners, those of screenshots narrow spaces: neither is printable to Python."""
    names = {
        "options": {"calibration": "/data/\u06a9\u062a\u0627\u0628\u200c\u0647\u0627 9\u202fAM.yaml"},
        "model": "/m\u200d.gpvo",
    }
    write_run(tmp_path / "run", VoLog(make_records(5)), meta={**names, "source": "a\u202eb"})
    meta = read_run(tmp_path / "run").meta
    assert {key: meta[key] for key in names} == names
    assert meta["source"] == "a?b"


def test_foreign_folder_is_not_overwritten(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(SourceError, match="not a run"):
        RunWriter(tmp_path)
    assert (tmp_path / "precious.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["vo_log.parquet", "truth.parquet", "rig.json", "run.json", "predictions.parquet"])
@pytest.mark.parametrize("how", ["cut", "flip", "empty", "garbage"])
def test_damaged_files_are_refused_in_one_line(tmp_path, name, how):
    rng = np.random.default_rng(0)
    records = make_records(50)
    truth = TruthLog(np.arange(50) * 10, se3.exp(rng.normal(size=(50, 6))))
    predictions = [make_prediction(r, rng) for r in records[1:]]
    write_run(tmp_path / "run", VoLog(records, CAMERA), truth=truth, predictions=predictions)
    file = tmp_path / "run" / name
    raw = bytearray(file.read_bytes())
    if how == "flip":
        # Inside the first data page for tables, so that only a checksum can tell.
        position = 40 if name.endswith("parquet") else 2
        raw[position] ^= 0xFF
    new = {"cut": raw[: len(raw) // 2], "flip": raw, "empty": b"", "garbage": b"\x00\xff" * 300}[how]
    file.write_bytes(bytes(new))
    with pytest.raises(SourceError) as caught:
        read_run(tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_missing_column_and_newer_schema(tmp_path):
    pd = pytest.importorskip("pandas")
    write_run(tmp_path / "run", VoLog(make_records(20), CAMERA))
    table = pd.read_parquet(tmp_path / "run" / "vo_log.parquet")
    assert {"v_x_mps", "cov_triangulation_00", "vt_triangulation_22", "stage_match_ms"} <= set(table.columns)
    table.assign(extra=1.0).to_parquet(tmp_path / "run" / "vo_log.parquet")
    assert len(read_run(tmp_path / "run").log) == 20
    table.drop(columns=["p_x_m"]).to_parquet(tmp_path / "run" / "vo_log.parquet")
    with pytest.raises(SourceError, match="p_x_m"):
        read_run(tmp_path / "run")
    meta = json.loads((tmp_path / "run" / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**meta, "schema": 99}))
    with pytest.raises(SourceError, match="schema 99"):
        read_run(tmp_path / "run")


def test_not_a_run(tmp_path):
    with pytest.raises(SourceError, match="no such run folder"):
        read_run(tmp_path / "nothing")
    (tmp_path / "flight.npz").write_bytes(b"x")
    with pytest.raises(SourceError, match="is a file, not a run folder"):
        read_run(tmp_path / "flight.npz")
    with pytest.raises(SourceError, match=r"lacks run\.json"):
        read_run(tmp_path)


def test_writer_refuses_records_that_do_not_chain(tmp_path):
    a, b, c = make_records(3)
    late = VoRecord(c.t_ns, a.t_ns, Status.OK, np.eye(4))
    with pytest.raises(ValueError, match="does not follow"):
        write_run(tmp_path / "r1", VoLog([a, late, b]))
    with pytest.raises(ValueError, match="not in the run"):
        write_run(tmp_path / "r2", VoLog([a, c]))


def test_a_reference_lasts_as_long_as_rest(tmp_path):
    with RunWriter(tmp_path / "run", chunk=5_000) as writer:
        writer.append(VoRecord(0, 0, Status.START, np.eye(4)))
        for t_ns in range(1, 20_003):
            writer.append(VoRecord(t_ns, 0, Status.LOST, np.eye(4)))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["frames"] == 20_003


@pytest.mark.parametrize("calibration", [False, True])
def test_predictions_file(tmp_path, calibration):
    rng = np.random.default_rng(3)
    predictions = [make_prediction(r, rng, calibration) for r in make_records(5)[1:]]
    write_predictions(tmp_path / "p.parquet", predictions)
    for p, q in zip(predictions, read_predictions(tmp_path / "p.parquet"), strict=True):
        assert_same(p, q)
