"""Sequences: whole or not at all, the same bytes for a seed, read back by gpvo's own reader."""

import errno
import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from gpvo.cameras.kalibr import read_camchain, read_sensor_pair
from gpvo.cameras.rig import Tolerance
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.sim import sequence, sequence_plan
from gpvo.sim.eye import without_texture
from gpvo.sim.rig import RigError, camera_rig, true_rig
from gpvo.sim.scenario import load_scenario, stated_seed
from gpvo.types import STANDARD_GRAVITY_MPS2


def digest(folder):
    names = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in names}


def test_layout_and_reading(quick, tmp_path):
    info = sequence.simulate(quick(), 3, tmp_path / "seq")
    assert (info.frames, info.redone) == (21, True)
    source = open_source(tmp_path / "seq")
    frames = list(source)
    assert len(frames) == 21
    assert str(source.report) == "21 frames"
    assert source.truth.sigma_translation_m == 0.0
    assert source.imu.noise.gyro_density_radps_sqrthz == 1.7e-4
    assert source.camera.baseline_m == pytest.approx(0.12)
    assert np.allclose(source.mounting.T_body_cam, camera_rig("pinhole").T_body_left)
    # Truth is that of the camera: at rest, ahead of and above the body.
    assert np.allclose(source.truth.T_world_cam[0, :3, 3], [-2.88, 0.0, 1.52], atol=1e-9)
    assert not list(tmp_path.glob("*.part"))


def test_same_bytes_on_any_number_of_threads(quick, tmp_path):
    sequence.simulate(quick(), 3, tmp_path / "one", threads=1)
    sequence.simulate(quick(), 3, tmp_path / "two", threads=2)
    sequence.simulate(quick(), 4, tmp_path / "other")
    assert digest(tmp_path / "one") == digest(tmp_path / "two") != digest(tmp_path / "other")


def test_finished_is_kept_interrupted_is_redone(quick, tmp_path):
    out = tmp_path / "seq"
    (tmp_path / "seq.part" / "mav0").mkdir(parents=True)
    assert sequence.simulate(quick(), 1, out).redone
    again = sequence.simulate(quick(), 1, out)
    assert (again.redone, again.frames) == (False, 21)
    with pytest.raises(GpvoError, match="another sequence"):
        sequence.simulate(quick(), 2, out)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    with pytest.raises(GpvoError, match="not a simulated sequence"):
        sequence.simulate(quick(), 1, tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "precious"


def test_full_disk_leaves_nothing(quick, tmp_path, monkeypatch):
    def full(path, image):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sequence, "_save", full)
    with pytest.raises(GpvoError, match="No space left.*free some space"):
        sequence.simulate(quick(), 1, tmp_path / "seq")
    assert not list(tmp_path.iterdir())


def test_faults_are_written_and_told(quick, tmp_path):
    scenario = quick(rate_hz=20.0, dropped=0.1, frozen=0.1, late=0.1, black=0.1)
    info = sequence.simulate(scenario, 3, tmp_path / "seq")
    plans = sequence_plan.plan_frames(scenario, (), np.random.default_rng(np.random.SeedSequence([3, 78]).spawn(5)[3]))
    fates = [p.fate for p in plans]
    assert {"dropped", "frozen", "late", "black", "shown"} == set(fates)
    assert info.frames == len(fates) - fates.count("dropped")
    pictures = [f.left for f in open_source(tmp_path / "seq")]
    seen = [f for f in fates if f != "dropped"]
    assert [not p.any() for p, f in zip(pictures, seen) if f == "black"] == [True] * fates.count("black")
    for k, fate in enumerate(seen):
        if fate == "frozen":
            assert np.array_equal(pictures[k], pictures[k - 1])


def test_resolved_scenario_flies_the_same_again(quick, tmp_path):
    info = sequence.simulate(quick(calibration={"baseline": 0.01}), 5, tmp_path / "seq")
    text = (tmp_path / "seq" / "scenario.toml").read_text()
    assert "seed = 5" in text
    assert "[drawn.rig_error]" in text
    again = load_scenario(str(tmp_path / "seq" / "scenario.toml"))
    assert stated_seed(str(tmp_path / "seq" / "scenario.toml")) == 5
    second = sequence.simulate(again, 5, tmp_path / "again")
    assert digest(info.path) == digest(second.path)
    with pytest.raises(GpvoError, match=r"holds another sequence \(speed_mps = 0.5, not speed_mps = 0.4\)"):
        sequence.simulate(quick(calibration={"baseline": 0.01}, speed_mps=0.4), 5, tmp_path / "seq")


def test_a_file_with_another_content_is_another_scenario(quick, tmp_path):
    def path(climb_m):
        t = np.arange(0.0, 8.0, 0.1)
        lines = [f"{a} {0.01 * a} 0 {climb_m * a} 0 0 0 1" for a in t]
        (tmp_path / "path.txt").write_text("\n".join(lines))

    path(0.01)
    scenario = quick(trajectory=str(tmp_path / "path.txt"))
    assert sequence.simulate(scenario, 5, tmp_path / "seq").redone
    assert not sequence.simulate(scenario, 5, tmp_path / "seq").redone
    assert load_scenario(str(tmp_path / "seq" / "scenario.toml")) == scenario
    path(0.02)
    with pytest.raises(GpvoError, match=r"holds another sequence \(trajectory = "):
        sequence.simulate(scenario, 5, tmp_path / "seq")


def test_one_writer_at_a_time(quick, tmp_path):
    with (
        sequence._only_writer(tmp_path / "seq"),
        pytest.raises(GpvoError, match="seq: is being written by another process"),
    ):
        sequence.simulate(quick(), 1, tmp_path / "seq")
    assert sequence.simulate(quick(), 1, tmp_path / "seq").redone
    assert sorted(p.name for p in tmp_path.iterdir()) == ["seq"]


def test_truth_holds_every_frame(quick, tmp_path):
    sequence.simulate(quick(rate_hz=30.0), 1, tmp_path / "seq")
    truth = np.loadtxt(
        tmp_path / "seq" / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=",", dtype=str, skiprows=1
    )
    frames = np.loadtxt(tmp_path / "seq" / "mav0" / "cam0" / "data.csv", delimiter=",", dtype=str, skiprows=1)
    assert set(frames[:, 0]) <= set(truth[:, 0])
    assert (np.diff(truth[:, 0].astype(np.int64)) > 0).all()


def test_perfect_imu_in_the_file_integrates_to_the_truth(quick, tmp_path):
    """What a reader of the files finds, not what the simulator holds: 10 s by the trapezoid at 1 kHz."""
    values = {"duration_s": 14.0, "path": "wander", "imu": "perfect", "imu_rate_hz": 1000.0, "rate_hz": 1.0}
    sequence.simulate(quick(**values), 1, tmp_path / "seq")
    mav = tmp_path / "seq" / "mav0"
    readings = np.loadtxt(mav / "imu0" / "data.csv", delimiter=",")[3500:13501]
    truth = np.loadtxt(mav / "state_groundtruth_estimate0" / "data.csv", delimiter=",")[3500:13501]
    q_xyzw = np.roll(truth[:, 4:8], -1, axis=1)
    R, v, p = se3.from_quaternion(truth[:, 1:4], q_xyzw)[0, :3, :3], truth[0, 8:11], truth[0, 1:4]
    down, h = np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2]), 1e-3
    for now, then in pairwise(readings):
        R_then = R @ se3.so3_exp(0.5 * h * (now[1:4] + then[1:4]))
        a = 0.5 * (R @ now[4:] + R_then @ then[4:]) + down
        p, v, R = p + h * v + 0.5 * h * h * a, v + h * a, R_then
    end = se3.from_quaternion(truth[-1:, 1:4], q_xyzw[-1:])[0]
    assert np.linalg.norm(p - end[:3, 3]) < 1e-3
    assert np.rad2deg(np.linalg.norm(se3.so3_log(R.T @ end[:3, :3]))) < 1e-3


def test_bare_pictures_keep_their_brightness():
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.2, 0.6, (120, 160)).astype(np.float32)
    linear[:, :20] = 0.0
    bare = without_texture(linear, 0.97)
    assert not bare[:, :20].any(), "what is behind the rim stays black"
    assert bare[:, 20:].mean() == pytest.approx(linear[:, 20:].mean(), rel=0.02)
    assert bare[20:-20, 60:-20].std() < 0.06 * linear[20:-20, 60:-20].std()


@pytest.mark.parametrize("speed, message", [(9.0, "leaves the world"), (1.88, "crashes at t")])
def test_no_flight_through_walls(quick, tmp_path, speed, message):
    # The slower one stops 10 cm from the wall.
    with pytest.raises(GpvoError, match=message):
        sequence.simulate(quick(duration_s=5.2, rest_s=0.0, speed_mps=speed), 1, tmp_path / "seq")
    assert not list(tmp_path.iterdir())


def test_a_recorded_path_must_be_given(quick, tmp_path):
    with pytest.raises(GpvoError, match="--trajectory"):
        sequence.simulate(quick(needs_trajectory=True), 1, tmp_path / "seq")


def test_the_camera_of_a_kitti_folder(tmp_path):
    left, right = "700 0 600 0 0 700 180 0 0 0 1 0", "700 0 600 -350 0 700 180 0 0 0 1 0"
    (tmp_path / "calib.txt").write_text(f"P0: {left}\nP1: {right}\n")
    rig = camera_rig(str(tmp_path / "calib.txt"))
    assert rig.baseline_m == pytest.approx(0.5)
    assert (rig.left.width, rig.left.height) == (1201, 361)  # twice the principal point: the file states no size
    (tmp_path / "calib.txt").write_text("fx 700")
    with pytest.raises(GpvoError, match=r"calib\.txt"):
        camera_rig(str(tmp_path / "calib.txt"))


@pytest.mark.parametrize("more", [(0.0,), (-0.25,), (0.0, 0.0, 0.02, 0.001)])
def test_the_written_calibration_is_that_of_the_rig(more, tmp_path):
    rig = camera_rig("euroc")
    left, right = (replace(lens, distortion=(-0.3, 0.12, 1e-3, -5e-4, *more)) for lens in (rig.left, rig.right))
    sequence._write_calibration(tmp_path, replace(rig, left=left, right=right), 20.0, 0.0)
    pair = read_sensor_pair(*(tmp_path / "mav0" / f"cam{k}" / "sensor.yaml" for k in (0, 1)))
    chain = read_camchain(tmp_path / "dso" / "camchain.yaml")
    for read in (pair, chain):
        assert tuple(read.left.distortion) == tuple(left.distortion)
        assert tuple(read.right.distortion) == tuple(right.distortion)


@pytest.mark.parametrize("camera", ["pinhole", "euroc", "t265"])
def test_drawn_rig(camera):
    written = camera_rig(camera)
    same = true_rig(written, RigError.draw(Tolerance(), np.random.default_rng(0)))
    assert np.allclose(same.T_right_left, written.T_right_left, atol=1e-15)
    assert same.left == written.left
    errors = [RigError.draw(Tolerance(0.01, 0.003, 5e-4, 1e-3), np.random.default_rng(s)) for s in range(200)]
    drawn = [true_rig(written, e) for e in errors]
    ratio = np.array([d.baseline_m / written.baseline_m for d in drawn])
    assert ratio.std() == pytest.approx(0.01, rel=0.2)
    assert all(d.left.fx_px != written.left.fx_px for d in drawn)
    fixed = true_rig(written, RigError.draw(Tolerance(), np.random.default_rng(0), Tolerance(baseline=0.01)))
    assert fixed.baseline_m / written.baseline_m == pytest.approx(1.01, abs=1e-12)


def test_episodes_reach_the_frames():
    scenario = load_scenario("tunnel-bursts", {"duration_s": 60.0})
    episodes = sequence_plan.plan_episodes(scenario, np.random.default_rng(2))
    plans = sequence_plan.plan_frames(scenario, episodes, np.random.default_rng(3))
    bad = [p for p in plans if p.light < 1 or p.dust or p.noise_sigma or p.exposure_s or p.bare]
    assert 0.15 < len(bad) / len(plans) < 0.25


def test_in_the_dark_nothing_else_is_seen():
    scenario = load_scenario("tunnel", {"dark": (20.0, 40.0), "episodes_share": 0.4})
    episodes = sequence_plan.plan_episodes(scenario, np.random.default_rng(1))
    plans = sequence_plan.plan_frames(scenario, episodes, np.random.default_rng(2))
    light = np.array([p.light for p in plans])
    assert (light[400:800] == 0.0).all()
    assert (np.delete(light, slice(400, 800)) > 0.0).all()


@pytest.mark.slow
def test_a_write_that_fails_is_one_line_and_leaves_nothing(tmp_path, tmp_path_factory):
    """The kernel refuses files above 100 kB: the first long table or image cannot be written whole."""
    pytest.importorskip("numba")
    resource = pytest.importorskip("resource")
    done = subprocess.run(
        [sys.executable, "-m", "gpvo", "simulate", "tunnel-clean", "-o", str(tmp_path / "seq"), "--duration", "4"],
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)),
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path_factory.mktemp("cache"))},
    )
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert "cannot be written" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_rendered_sequence_and_odometry(tmp_path):
    pytest.importorskip("mujoco")
    pytest.importorskip("numba")
    from gpvo import runner
    from gpvo.vo.config import make_config

    scenario = load_scenario("tunnel-clean", {"duration_s": 10.0})
    sequence.simulate(scenario, 0, tmp_path / "seq")
    source = open_source(tmp_path / "seq")
    summary = runner.run(source, tmp_path / "run", make_config())
    assert summary.frames == 201
    assert summary.status.get("lost", 0) == 0
    assert summary.path_length_m == pytest.approx(sequence.simulate(scenario, 0, tmp_path / "seq").distance_m, rel=0.02)
