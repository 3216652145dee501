"""A run that broke off is resumed from its last chunk: the same bytes as of one that was left in peace."""

from __future__ import annotations

import json
import os
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gpvo import cli, runner
from gpvo.errors import SourceError
from gpvo.io import open_source
from gpvo.io.run import RunWriter, read_run
from gpvo.online.predictor import Predictor
from gpvo.sim.points import simulate_points
from gpvo.vo.odometry import StereoOdometry

MODEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"
LENSES = {"pinhole": ([180.0, 180.0, 149.5, 99.5], "radtan"), "fisheye": ([110.0, 110.0, 149.5, 99.5], "equidistant")}
POSE = "  T_cn_cnm1: [[1.0, 0.0, 0.0, -0.12], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]\n"
TIMES = ("started", "finished", "wall_s", "stage_ms_mean", "digests", "name")


def pictures(folder: Path, kind: str) -> Path:
    """A folder of image pairs, a dark one and a frozen one among them."""
    pytest.importorskip("numba", reason="images need the extra gpvo[sim]")
    from gpvo.cameras.models import KannalaBrandt, PinholeRadtan
    from gpvo.sim.render import StereoRenderer
    from gpvo.sim.worlds import build_world
    from rendered_clip import wander

    numbers, distortion = LENSES[kind]
    lens = (PinholeRadtan if kind == "pinhole" else KannalaBrandt)(*numbers, 300, 200)
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -0.12
    renderer = StereoRenderer(build_world("room", 0), lens, lens, T_right_left)
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
    for k, T in enumerate(wander(15, seed=2)):
        pair = renderer.render(T)[:2] if k != 11 else pair  # noqa: F821 (the one before)
        for side, image in zip(("left", "right"), pair):
            image = np.asarray(image if k != 6 else 0 * image)
            grey = np.clip(255 * image if image.max() <= 1 else image, 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / side / f"{(k + 1) * 50_000_000:019d}.png"), grey)
    block = f"  camera_model: pinhole\n  intrinsics: {numbers}\n  distortion_model: {distortion}\n"
    block += "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [300, 200]\n"
    (folder / "camchain.yaml").write_text(f"cam0:\n{block}cam1:\n{block}{POSE}")
    return folder


def tracks(folder: Path) -> Path:
    return simulate_points("tunnel-bursts", 3, duration_s=2.0, rate_hz=10.0, dark=(0.8, 1.1)).save(folder / "f.npz")


SOURCES: dict[str, Callable[[Path], Path]] = {
    "tracks": tracks,
    "pinhole": partial(pictures, kind="pinhole"),
    "fisheye": partial(pictures, kind="fisheye"),
}


def content(run: Path) -> dict[str, Any]:
    """All that a run holds but for times."""
    table = pq.read_table(run / "vo_log.parquet")
    told = {c: table[c].to_pylist() for c in table.column_names if not c.startswith("stage_")}
    meta = json.loads((run / "run.json").read_text())
    meta["summary"].pop("frames_per_s")
    names = [p.name for p in sorted(run.iterdir()) if p.name not in ("vo_log.parquet", "run.json")]
    files = {name: (run / name).read_bytes() for name in names}
    return {**{c: repr(v) for c, v in told.items()}, **files, "meta": {k: meta[k] for k in meta if k not in TIMES}}


@pytest.mark.parametrize(("kind", "preset"), [("tracks", "fast"), ("fisheye", "fast"), ("pinhole", "thesis")])
def test_the_same_bytes_after_breaking_off_twice(
    kind: str, preset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gpvo.vo.config import make_config

    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=3))
    path = SOURCES[kind](tmp_path / "source") if kind != "tracks" else tracks(tmp_path)
    config, steps, begun = make_config(preset), StereoOdometry.step, []

    def fly(out: str, stop: int = 10**6) -> None:
        begun.clear()
        left = iter(range(stop))

        def on_frame(step: runner.Step, _: object) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt

        predictor = Predictor.load(MODEL)
        runner.run(
            open_source(path),
            tmp_path / out,
            config,
            predictor,
            on_frame,
            keep_tracks=True,
            overwrite=False,
            options={},
        )

    def counted(self: StereoOdometry, frame: Any, imu: Any = None) -> Any:
        begun.append(frame.t_ns)
        return steps(self, frame, imu)

    monkeypatch.setattr(StereoOdometry, "step", counted)
    fly("whole")
    total = len(begun)
    for stop in (7, 11):
        with pytest.raises(KeyboardInterrupt):
            fly("broken", stop)
        assert len(read_run(tmp_path / "broken").log) >= stop // 3 * 3
    fly("broken")
    assert len(begun) == total - 12  # from the fourth chunk on: the 12th record came before it broke off
    assert content(tmp_path / "broken") == content(tmp_path / "whole")


@pytest.mark.parametrize("way", ["in place", "another file"])
def test_new_content_of_the_same_size_and_time_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """As when a calibration or recording is mended by a tool that sets times back: half is of the old."""
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=5))
    path, went, before = tracks(tmp_path), [], time.time_ns()
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *a: (went.append(True), step(*a))[1])

    def fly() -> None:
        went.clear()

        def on_frame(*_: object) -> None:
            if len(went) == 13:
                raise KeyboardInterrupt

        runner.run(open_source(path), tmp_path / "run", on_frame=on_frame, options={})

    with pytest.raises(KeyboardInterrupt):
        fly()
    while time.time_ns() - before < 5e7:  # a clock of files may tick a hundred times a second
        time.sleep(0.01)
    was, blob = path.stat(), bytearray(path.read_bytes())
    blob[10] ^= 1  # the time of its first member, which nobody reads
    if way == "another file":
        path.unlink()
    path.write_bytes(blob)
    os.utime(path, ns=(was.st_atime_ns, was.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (was.st_size, was.st_mtime_ns)
    with pytest.raises(KeyboardInterrupt):
        fly()
    assert len(went) == 13


def test_another_source_setting_or_code_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=5))
    path, seen = tracks(tmp_path), []

    def broken(**known: Any) -> int:
        """How many frames odometry goes through until the run breaks off at the 13th."""
        seen.clear()

        def on_frame(step: runner.Step, _: object) -> None:
            seen.append(step.frame.t_ns)
            if len(seen) == 13:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            runner.run(open_source(path), tmp_path / "run", on_frame=on_frame, **known)
        return went.count(True)

    went: list[bool] = []
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *a: (went.append(True), step(*a))[1])
    made: list[int] = []
    for known in (
        {"options": {}},
        {"options": {}},
        {"options": {"bits": 12}},
        {"options": {"bits": 12}, "keep_tracks": True},
        {"options": {"bits": 12}, "config": runner.VoConfig(sigma_px=2.0)},
        {},
    ):
        went.clear()
        made.append(broken(**known))
    assert made == [13, 3, 13, 13, 13, 13]


def test_an_edited_calibration_that_lies_elsewhere_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lens' distortion shows in no rectified camera, only in the images: half a run would be of either lens."""
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=3))
    picture = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    for side in ("left", "right"):
        (tmp_path / "source" / side).mkdir(parents=True)
        for k in range(9):
            cv2.imwrite(str(tmp_path / "source" / side / f"{10**18 + k * 10**8}.png"), picture)
    calibration, went = tmp_path / "camchain.yaml", []
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *given: (went.append(True), step(*given))[1])

    def broken(k1: float) -> tuple[Any, int]:
        """The rectified camera, and how many frames odometry goes through until the run breaks off at the 7th."""
        block = "  camera_model: pinhole\n  intrinsics: [60.0, 60.0, 31.5, 23.5]\n  distortion_model: radtan\n"
        block += f"  distortion_coeffs: [{k1}, 0.0, 0.0, 0.0]\n  resolution: [64, 48]\n"
        calibration.write_text(f"cam0:\n{block}cam1:\n{block}{POSE}")
        source, left = open_source(tmp_path / "source", calibration=calibration, hfov_deg=30.0), iter(range(6))

        def stop(*_: object) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt

        went.clear()
        with pytest.raises(KeyboardInterrupt):
            runner.run(source, tmp_path / "run", on_frame=stop, options={})
        return source.camera, len(went)

    (camera, begun), (_, resumed), (other, anew) = broken(0.001), broken(0.001), broken(0.05)
    assert (camera, begun, resumed) == (other, 7, 1)
    assert anew == 7


def test_images_behind_a_link_that_changed_begin_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera's folder may be a link to another disk, or lead back to where it stands."""
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=3))
    rng, went = np.random.default_rng(0), []
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *given: (went.append(True), step(*given))[1])
    block = "  camera_model: pinhole\n  intrinsics: [60.0, 60.0, 31.5, 23.5]\n  distortion_model: radtan\n"
    block += "  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [64, 48]\n"
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "camchain.yaml").write_text(f"cam0:\n{block}cam1:\n{block}{POSE}")
    (tmp_path / "source" / "again").symlink_to(tmp_path / "source")
    for side in ("left", "right"):
        (tmp_path / "disk" / side).mkdir(parents=True)
        (tmp_path / "source" / side).symlink_to(tmp_path / "disk" / side)

    def broken(seed: int | None) -> int:
        """How many frames odometry goes through until the run breaks off at the 7th; with a seed, of new images."""
        if seed is not None:
            picture = rng.integers(0, 255, (48, 64 + seed), dtype=np.uint8)[:, seed:]
            for side in ("left", "right"):
                for k in range(9):
                    cv2.imwrite(str(tmp_path / "disk" / side / f"{10**18 + k * 10**8}.png"), picture)
        left = iter(range(6))

        def stop(*_: object) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt

        went.clear()
        with pytest.raises(KeyboardInterrupt):
            runner.run(open_source(tmp_path / "source"), tmp_path / "run", on_frame=stop, options={})
        return len(went)

    assert [broken(0), broken(None), broken(1), broken(None)] == [7, 1, 7, 1]


def test_the_command_resumes_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=5))
    monkeypatch.setattr("sys.argv", ["gpvo", "run", str(tracks(tmp_path)), "-o", str(tmp_path / "run")])
    went: list[bool] = []
    step = StereoOdometry.step

    def stopping(*given: Any) -> Any:
        went.append(True)
        if len(went) == 13:
            raise KeyboardInterrupt
        return step(*given)

    monkeypatch.setattr(StereoOdometry, "step", stopping)
    for stop in (KeyboardInterrupt, SystemExit):
        with pytest.raises(stop) as end:
            cli.main()
    assert end.value.code == 0
    assert len(went) == 13 + len(read_run(tmp_path / "run").log) - 10


def test_a_source_that_changed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = open_source(tracks(tmp_path))
    done = [r.record for _, r in zip(range(3), runner.steps(source, runner.VoConfig()))]
    shifted = [type(r)(r.t_ns + 1, r.t_prev_ns + 1, r.status, r.T_prev_cur) for r in done]
    with pytest.raises(SourceError, match="not the source of the interrupted run"):
        list(runner.steps(source, runner.VoConfig(), done=shifted))


def broken_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, keep_tracks: bool = False) -> Path:
    """The source of a run that broke off after two chunks."""
    monkeypatch.setattr(runner, "RunWriter", partial(RunWriter, chunk=5))
    path, left = tracks(tmp_path), iter(range(13))

    def stop(*_: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(open_source(path), tmp_path / "run", on_frame=stop, options={}, keep_tracks=keep_tracks)
    return path


@pytest.mark.parametrize(("column", "value"), [("p_x_m", float("nan")), ("R_00", 1e90)])
def test_chunks_with_motions_that_cannot_be_are_not_gone_on_with(
    column: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = broken_off(tmp_path, monkeypatch)
    chunk = tmp_path / "run" / "chunks" / "log_000000.parquet"
    table = pq.read_table(chunk)
    values = [*table[column].to_pylist()[:-1], value]
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, column, pa.array(values, pa.float64())), chunk)
    went: list[int] = []
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *a: (went.append(1), step(*a))[1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        runner.run(open_source(path), tmp_path / "run", options={})
    assert len(went) == len(read_run(tmp_path / "run").log)


@pytest.mark.parametrize("noticed", ["in a motion", "when it is written"])
def test_a_state_that_cannot_be_is_refused_in_one_line(
    noticed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, state = broken_off(tmp_path, monkeypatch, keep_tracks=True), tmp_path / "run" / "chunks" / "state.npz"
    with np.load(state) as file:
        tree, data = json.loads(file["tree"].tobytes()), file["data"]
    _, made_by = tree["state"]["tuple"]
    odometry, recorder = (of["fields"] for of in made_by["tuple"])
    if noticed == "in a motion":
        odometry["_state"]["fields"]["t_last_ns"] = "x"
    else:
        recorder["_begun"] = 2**40  # tracks are numbered with 32 bits
    np.savez(state, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8), data=data)
    with pytest.raises(SourceError, match=r"run: cannot be resumed: [A-Z]") as refusal:
        runner.run(open_source(path), tmp_path / "run", options={}, keep_tracks=True)
    assert "\n" not in str(refusal.value)
