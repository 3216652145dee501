"""``gpvo publish`` takes predictions of single motions, and those alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_maker import BagMaker
from gpvo.cli import app
from gpvo.cli.files import import_log
from gpvo.dataset.build import predictions_of
from gpvo.errors import GpvoError, ModelError
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.foreign import read_foreign
from gpvo.io.run import read_run, write_run
from gpvo.online import modelfile
from gpvo.online.predictor import Predictor
from gpvo.publish import PublishSettings
from gpvo.publish.export import export_model
from gpvo.publish.job import odometry_of, publish_run
from gpvo.types import IMPORTED, Mounting, Prediction, Status, VoLog
from small_model import small_model
from synthetic_runs import make_run
from typer.testing import CliRunner

GEOMETRY = PublishSettings(method="pointing_matching")


@pytest.fixture(scope="module")
def predicted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the predictions of a model."""
    log, truth = make_run(60, n=40)
    predictions = list(small_model().predictor().replay(log).values())
    path = tmp_path_factory.mktemp("runs") / "flight"
    write_run(path, log, predictions=predictions, truth=truth, meta={"source": "made"})
    return path


def _covariances(path: Path, predictions: list[Prediction]) -> np.ndarray:
    run = replace(read_run(path), predictions=predictions)
    stored = predictions_of(run, None)
    return np.array([o.pose_covariance for o in odometry_of(run, lambda r: stored.get(r.t_ns), GEOMETRY)])


def test_what_is_stored_is_published_unless_it_is_of_windows(predicted: Path) -> None:
    stored = read_run(predicted).predictions
    windows = [replace(p, dt_s=p.dt_s + 1.0) for p in stored]
    plain, of_motions, of_windows = (_covariances(predicted, p) for p in ([], stored, windows))
    assert not np.allclose(of_motions, plain, rtol=0.1)
    np.testing.assert_array_equal(of_windows, plain)


def test_messages_name_the_body_that_they_are_of_and_a_run_without_one_is_told(predicted: Path, tmp_path: Path) -> None:
    run, T_body_cam = read_run(predicted), se3.exp(np.array([0.2, 0.0, 0.1, 0.0, 0.5, 0.0])) @ T_FLU_OPTICAL
    assert "base_link here is the left camera" in str(publish_run(predicted, replace(GEOMETRY, out=tmp_path / "a.bag")))
    path = tmp_path / "placed"
    write_run(path, run.log, predictions=run.predictions, mounting=Mounting(T_body_cam, body="mast"))
    assert "left camera" not in str(publish_run(path, replace(GEOMETRY, out=tmp_path / "b.bag")))
    written = read_foreign(tmp_path / "b.bag")
    assert written.frame_id == "mast"
    record = list(run.log)[5]
    motion = T_body_cam @ record.T_prev_cur @ se3.inverse(T_body_cam)
    T = written.trajectory.T_world_body
    k = written.t_ns.tolist().index(record.t_ns)
    np.testing.assert_allclose(se3.inverse(T[k - 1]) @ T[k], motion, atol=1e-9)


def test_imported_poses_keep_the_name_of_their_frame_where_their_axes_are_its_own(tmp_path: Path) -> None:
    maker = BagMaker(ros1=False)
    for k in range(20):
        T = se3.exp(np.array([0.1 * k, 0.0, 0.0, 0.0, 0.0, 0.01 * k]))
        maker.odometry("/odom", k * 10**8, T, np.eye(6) * 1e-4 * (k + 1), np.eye(6) * 1e-4, child="/imu_link")
    log = read_foreign(maker.write(tmp_path / "log"))
    for frame, name in (("auto", "imu_link"), ("body", "imu_link"), ("frd", "base_link"), ("cam", "base_link")):
        import_log(log, None, tmp_path / frame, frame=frame)
        told = publish_run(tmp_path / frame, PublishSettings(method=IMPORTED, out=tmp_path / f"{frame}.mcap"))
        assert read_foreign(tmp_path / f"{frame}.mcap").frame_id == told.body == name
        assert (f"{name} here is the body whose poses were imported" in str(told)) == (frame != "cam")


def test_a_consumer_that_nothing_would_read_is_refused(predicted: Path, tmp_path: Path) -> None:
    settings = replace(GEOMETRY, to="bag", out=tmp_path / "out", consumer="px4")
    with pytest.raises(GpvoError, match="--consumer .*--check"):
        publish_run(predicted, settings)
    assert publish_run(predicted, replace(settings, check=True)).verdicts


def test_frames_that_their_quality_forbids_are_counted(predicted: Path, tmp_path: Path) -> None:
    run = read_run(predicted)
    records = [r.with_status(Status.LOST, "dark") if k == 9 else r for k, r in enumerate(run.log)]
    stored = [replace(p, in_domain=0.001 if k in (5, 6, 9) else 1.0) for k, p in enumerate(run.predictions)]
    write_run(tmp_path / "far", VoLog(records), predictions=stored, meta={"source": "made"})
    told = publish_run(tmp_path / "far", PublishSettings(check=True, consumer="ardupilot"))
    assert (told.document()["lost"], told.document()["outside"]) == (1, 2)
    assert "1 lost frame, 2 far outside the model's domain" in str(told)
    assert "outside" not in str(publish_run(predicted, PublishSettings(check=True)))


def test_the_source_of_the_covariance_is_told(predicted: Path, tmp_path: Path) -> None:
    settings = replace(GEOMETRY, to="bag", out=tmp_path / "out")
    assert publish_run(predicted, settings).source == "the model"
    run = read_run(predicted)
    windows = [replace(p, dt_s=p.dt_s + 1.0) for p in run.predictions]
    other = tmp_path / "windows"
    write_run(other, run.log, predictions=windows, truth=run.truth, meta={"source": "made"})
    assert publish_run(other, replace(settings, out=tmp_path / "other")).source == "pointing_matching"


@pytest.mark.parametrize(("rate_hz", "told_hz"), [(20.0, 30.0), (50.0, 50.0)])
def test_a_filter_beside_the_bag_runs_no_slower_than_the_odometry(
    tmp_path: Path, rate_hz: float, told_hz: float
) -> None:
    log, truth = make_run(61, n=20, rate_hz=rate_hz)
    write_run(tmp_path / "run", log, truth=truth, meta={"source": "made"})
    publish_run(tmp_path / "run", replace(GEOMETRY, out=tmp_path / "out.mcap"))
    text = (tmp_path / "out_robot_localization.yaml").read_text()
    assert f"frequency: {told_hz:.1f}" in text


@pytest.mark.parametrize(
    "to, name, words",
    [
        ("bag", "file", "file: is a file, and a ROS 2 bag is a folder"),
        ("mcap", "file", "file: is a file"),
        ("bag", "folder.bag", "folder.bag: exists"),
        ("mavlink", "folder", "folder: is a folder"),
    ],
)
def test_what_lies_where_it_should_be_written_is_left_alone(
    predicted: Path, tmp_path: Path, to: str, name: str, words: str
) -> None:
    if to == "mavlink":
        pytest.importorskip("pymavlink")
    (tmp_path / "file").write_bytes(b"mine")
    for folder in ("folder", "folder.bag"):
        (tmp_path / folder).mkdir()
    with pytest.raises(GpvoError, match=words):
        publish_run(predicted, replace(GEOMETRY, to=to, out=tmp_path / name))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder", "folder.bag"]
    assert (tmp_path / "file").read_bytes() == b"mine"


def test_a_suffix_that_tells_nothing_is_refused(predicted: Path, tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match=r"z\.csv: its suffix does not tell .* \.bag, \.mcap, \.tlog"):
        publish_run(predicted, PublishSettings(out=tmp_path / "z.csv"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("system", [0, 256, -1])
def test_the_system_is_a_byte(predicted: Path, tmp_path: Path, system: int) -> None:
    with pytest.raises(GpvoError, match=f"--system is {system}.*1 to 255"):
        publish_run(predicted, replace(GEOMETRY, out=tmp_path / "out", system=system))


@pytest.mark.parametrize("topic", ["", "/", "vo\nodom1: /imu", "/a//b", "/3d", "/odom: x", "/odomé"])
def test_a_topic_that_is_no_name_of_ros_is_refused(tmp_path: Path, topic: str) -> None:
    """It goes into a parameter file."""
    with pytest.raises(GpvoError, match="not a valid ROS name"):
        publish_run(tmp_path, PublishSettings(topic=topic))


def test_a_run_without_a_motion_makes_no_bag(predicted: Path, tmp_path: Path) -> None:
    run = read_run(predicted)
    write_run(tmp_path / "one", VoLog(run.log.records[:1], run.log.camera), meta={"source": "made"})
    with pytest.raises(GpvoError, match="one: no frame has a motion"):
        publish_run(tmp_path / "one", replace(GEOMETRY, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_model_of_windows_is_refused_by_name(predicted: Path, tmp_path: Path) -> None:
    trained = small_model()
    model = tmp_path / "windows.gpvo"
    modelfile.save(model, trained.arrays, {**trained.header, "target": "window:1s"})
    assert Predictor.load(model).target == "window:1s"
    for name, to in (("x.h", "c"), ("x.onnx", "onnx")):
        export_model(model, tmp_path / name, to)
        assert b"window:1s" in (tmp_path / name).read_bytes()
    words = ["predict", str(model), str(predicted), "-o", str(tmp_path / "p.parquet")]
    assert " mrad over window:1s\n" in CliRunner().invoke(app, words, catch_exceptions=False).output
    with pytest.raises(ModelError, match=r"windows\.gpvo.*window:1s.*--target frame"):
        publish_run(predicted, replace(GEOMETRY, model=model))
    with pytest.raises(ModelError, match=r"windows\.gpvo.*window:1s.*--target frame"):
        Predictor.load(model).require_motions(model)


def test_a_model_that_does_not_fit_is_named(predicted: Path, tmp_path: Path) -> None:
    """What is written goes to a filter: it is told as evaluate tells it."""
    model = tmp_path / "other.gpvo"
    modelfile.save(model, small_model().arrays, {**small_model().header, "camera": None, "rate_hz": 99.0})
    log, truth = make_run(61, n=40, rate_hz=7.0)
    write_run(tmp_path / "slow", log, truth=truth, meta={"source": "made"})
    with pytest.warns(match=r"other\.gpvo does not fit slow: the rate is 7 Hz"):
        publish_run(tmp_path / "slow", replace(GEOMETRY, model=model, check=True))
    words = ["predict", str(model), str(tmp_path / "slow"), "-o", str(tmp_path / "p.parquet")]
    with pytest.warns(match=r"other\.gpvo does not fit slow: the rate is 7 Hz"):
        CliRunner().invoke(app, words, catch_exceptions=False)


def test_a_run_of_poses_alone_needs_a_model(predicted: Path, tmp_path: Path) -> None:
    bare = [replace(r, covariances={}) for r in read_run(predicted).log]
    write_run(tmp_path / "bare", VoLog(bare), meta={"source": "made"})
    with pytest.raises(GpvoError, match=r"bare: holds neither predictions nor covariances \(give --model\)"):
        publish_run(tmp_path / "bare", GEOMETRY)


@pytest.mark.parametrize("to, seconds, words", [
    ("bag", 2**31, "after January 2038"), ("mcap", 2**31, "after January 2038"), ("bag", -100, "before 1970"),
    ("mcap", -100, "before 1970"), ("mavlink", -100, "before 1970"), ("mavlink", 2**31, ""),
    ("bag", 2**31 - 100, ""),
])  # fmt: skip
def test_stamps_that_no_message_holds_are_refused(
    to: str, seconds: int, words: str, predicted: Path, tmp_path: Path
) -> None:
    run = read_run(predicted)
    shift = seconds * 10**9 - run.log.records[0].t_ns
    moved = [replace(r, t_ns=r.t_ns + shift, t_prev_ns=r.t_prev_ns + shift) for r in run.log]
    write_run(tmp_path / "run", VoLog(moved, run.log.camera), meta={"source": "made"})
    for out in ("out", "out.bag") if to == "bag" else ("out",):
        settings = replace(GEOMETRY, to=to, out=tmp_path / out)
        if words:
            with pytest.raises(GpvoError, match=f"run: has stamps {words}"):
                publish_run(tmp_path / "run", settings)
            assert not (tmp_path / out).exists()
        else:
            publish_run(tmp_path / "run", settings)


@pytest.mark.parametrize(("to", "name"), [("c", "main.c"), ("c", "errors.gpvo"), ("c", "main.h"), ("onnx", "net.onnx")])
def test_an_export_replaces_an_earlier_one_and_nothing_else(tmp_path: Path, to: str, name: str) -> None:
    if to == "onnx":
        pytest.importorskip("onnx")
    model = tmp_path / "errors.gpvo"
    trained = small_model()
    modelfile.save(model, trained.arrays, trained.header)
    if not (tmp_path / name).exists():
        (tmp_path / name).write_text("int main(void) { return 0; }")
    before = (tmp_path / name).read_bytes()
    with pytest.raises(GpvoError, match=rf"{name}: is another file, not an earlier export \(choose another name"):
        export_model(model, tmp_path / name, to)
    assert (tmp_path / name).read_bytes() == before
    out = tmp_path / {"c": "new.h", "onnx": "new.onnx"}[to]
    export_model(model, out, to)
    written = out.read_bytes()
    export_model(model, out, to)
    assert out.read_bytes() == written
