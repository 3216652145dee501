"""A campaign of mutated inputs: 2,000 here, and on to ``GPVO_HOSTILE_CASES`` (by default 30,000) with longer tests."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_maker import stereo_bag
from campaign import CAMERA, READERS, bytes_of, read_broken_run
from gpvo import runner
from gpvo.cli import app
from gpvo.files import write_json
from gpvo.io import open_source
from gpvo.io.run import RunWriter, write_run
from gpvo.io.stated import write_stated
from gpvo.io.trajectory import write_tum
from gpvo.online.predictor import Predictor
from gpvo.sim.points import simulate_points
from gpvo.types import TruthLog, VoLog
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.rig_error import RigState
from gpvo.vo.rig_findings import document
from synthetic_runs import make_run
from typer.testing import CliRunner

CAMPAIGN = Path(__file__).parent / "campaign.py"
MODEL = Path(__file__).parents[2] / "models" / "tunnel.gpvo"
USUAL, ALL = 2_000, int(os.environ.get("GPVO_HOSTILE_CASES", "30000"))
LENS = "  camera_model: pinhole\n  intrinsics: [60.0, 60.0, 32.0, 24.0]\n  distortion_model: radtan\n" \
    "  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]\n  resolution: [64, 48]\n"  # fmt: skip
POSE = "  T_cn_cnm1: [[1.0, 0.0, 0.0, -0.1], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]\n"


@pytest.fixture(scope="module")
def seeds() -> Iterator[Path]:
    """One of each kind, as gpvo writes and reads them; on a disk of memory if there is one, as cases write much."""
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        yield _all_kinds(Path(folder) / "seeds")


def _all_kinds(root: Path) -> Path:
    for kind in READERS:
        (root / kind).mkdir(parents=True)
    shutil.copy(MODEL, root / "model" / "model.gpvo")
    simulate_points("tunnel-bursts", 0, duration_s=2.0, rate_hz=10.0).save(root / "tracks" / "tracks.npz")
    log, truth = make_run(50, n=12)
    predictions = list(Predictor.load(MODEL).replay(log).values())
    run = root / "run" / "folder"
    write_run(run, log, predictions=predictions, truth=truth, config={"a": 1})
    for suffix in ("bag", "mcap"):
        done = CliRunner().invoke(app, ["publish", str(run), "--to", suffix, "-o", str(root / "bag" / f"bag.{suffix}")])
        assert done.exit_code == 0, done.output
    next((root / "bag").glob("*.yaml")).unlink()
    ros2 = stereo_bag(ros1=False, n=3).write(root / "recording" / "ros2")
    shutil.copytree(ros2, root / "bag" / "ros2")
    stereo_bag(ros1=True, n=3).write(root / "recording" / "ros1.bag")
    (root / "calibration" / "camchain.yaml").write_text(f"cam0:\n{LENS}cam1:\n{LENS}{POSE}")
    shutil.copy(run / "trajectory.tum", root / "log" / "log.tum")
    shutil.copy(run / "trajectory.tum", root / "plan" / "plan.txt")
    (root / "log" / "log.csv").write_text(
        "t_s,p_x,p_y,p_z,q_x,q_y,q_z,q_w,cov_00\n" + "0.1,1,2,3,0,0,0,1,0.1\n0.2,1,2,3,0,0,0,1,0.1\n"
    )
    (root / "log" / "kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n")
    shutil.copy(run / "config.toml", root / "settings" / "config.toml")
    picture = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
    for suffix in ("png", "jpg", "bmp", "tif", "pgm", "webp"):
        cv2.imwrite(str(root / "image" / f"image.{suffix}"), picture)
    _newer(root, log, truth)
    _euroc(root / "sequence" / "euroc", picture)
    _kitti(root / "sequence" / "kitti", picture)
    return root


def _newer(root: Path, log: VoLog, truth: TruthLog) -> None:
    """What odometry saw, states of a calibration and of a live session, options, and files of the scoreboard."""
    seen = root / "seen" / "folder"
    short = simulate_points("tunnel-bursts", 0, duration_s=0.6, rate_hz=10.0).save(root.parent / "short.npz")
    runner.run(open_source(short), seen, keep_tracks=True)
    write_json(root / "calibration state" / "state.json", document(RigState.prior(CAMERA), CAMERA))
    (root / "gap" / "gap.json").write_text(json.dumps({"pooled": {"1 s": {"ratio": [2.0] * 6, "spread": [1.5] * 6}}}))
    (root / "gap" / "mine.toml").write_text("rotation_rad = 0.001\nfocal = 0.002\nbaseline = 0.003\n")
    (root / "options" / "options.toml").write_text(
        '[run]\npreset = "thesis"\nsigma = 0.5\nmin_inliers = 10\nkeep_tracks = true\nset = ["max_features=500"]\n'
        '[live]\ndepth = 20\nstate = "s.json"\n[evaluate]\nsegments = "10,20"\n'
    )
    stated = root / "stated" / "folder"
    stated.mkdir()
    covariance = np.array([r.covariances.get("pointing_matching", np.full((6, 6), np.nan)) for r in log])
    write_stated(stated / "stated.txt", log, log.trajectory(), covariance)
    write_tum(stated / "truth.txt", truth.t_ns, truth.T_world_cam)
    state = {"schema": 1, "T_odom_body": np.eye(4), "pose_covariance": np.eye(6), "scale": np.ones(6)}
    write_json(root / "live state" / "state.json", state)
    _broken(root / "broken run" / "folder")


def _broken(path: Path) -> None:
    """A run that broke off when its third chunk was whole."""
    path.mkdir()
    source = simulate_points("tunnel-bursts", 1, duration_s=0.6, rate_hz=10.0).save(path / "source.npz")
    left = iter(range(5))

    def stop(*_: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "RunWriter", partial(RunWriter, chunk=2))
        patch.setattr(runner, "_content", bytes_of)
        with pytest.raises(KeyboardInterrupt):
            runner.run(open_source(source), path / "run", on_frame=stop, keep_tracks=True, options={})
    assert (path / "run" / "chunks" / "state.npz").is_file()


def _euroc(path: Path, picture: np.ndarray) -> None:
    stamps = [1400000000000000000 + k * 50_000_000 for k in range(3)]
    for k in range(2):
        data = path / "mav0" / f"cam{k}" / "data"
        data.mkdir(parents=True)
        for t in stamps:
            cv2.imwrite(str(data / f"{t}.png"), picture)
        (data.parent / "data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in stamps))
        pose = [1, 0, 0, 0.1 * k, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        (data.parent / "sensor.yaml").write_text(
            f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {pose}\nresolution: [64, 48]\n"
            "camera_model: pinhole\nintrinsics: [60.0, 60.0, 32.0, 24.0]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )


def _kitti(path: Path, picture: np.ndarray) -> None:
    for k in range(2):
        (path / f"image_{k}").mkdir(parents=True)
        for i in range(3):
            cv2.imwrite(str(path / f"image_{k}" / f"{i:06d}.png"), picture)
    (path / "calib.txt").write_text(
        "".join(f"P{k}: 60 0 32 {-6.0 * (k % 2)} 0 60 24 0 0 0 1 0\n" for k in range(4))
        + "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    )
    (path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (path / "poses.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {0.1 * i}\n" for i in range(3)))


def fly(seeds: Path, first: int, end: int, workers: int = 2) -> None:
    each = (end - first) // workers
    begins = [first + k * each for k in range(workers)]
    calls = [
        subprocess.Popen([sys.executable, CAMPAIGN, seeds, str(k), str(each)], stdout=-1, stderr=-1, text=True)
        for k in begins
    ]
    for k, call in zip(begins, calls, strict=True):
        out, err = call.communicate(timeout=36_000)
        last = (seeds.parent / f"work-{k}.case").read_text()
        assert call.returncode == 0, f"died at case {last}: {err[-2000:]}"
        assert not out, out[:4000]


def test_every_seed_is_read_as_it_is(seeds: Path, tmp_path: Path) -> None:
    copied = shutil.copytree(seeds, tmp_path / "seeds")
    for kind, (read, _) in READERS.items():
        for path in (copied / kind).iterdir():
            read(path)


def test_a_broken_run_that_was_copied_is_gone_on_with(seeds: Path, tmp_path: Path, monkeypatch) -> None:
    """Else its state would never be read, whatever has become of it."""
    frames = []
    step = StereoOdometry.step
    monkeypatch.setattr(StereoOdometry, "step", lambda *a: frames.append(a) or step(*a))
    read_broken_run(shutil.copytree(seeds / "broken run" / "folder", tmp_path / "folder"))
    assert len(frames) == 1  # of seven: three chunks of two were kept


def test_no_mutated_input_breaks_anything(seeds: Path) -> None:
    fly(seeds, 0, USUAL, workers=1)


@pytest.mark.slow
def test_no_mutated_input_of_many_breaks_anything(seeds: Path) -> None:
    fly(seeds, USUAL, ALL)
