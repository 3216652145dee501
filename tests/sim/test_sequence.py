"""Sequences: whole or not at all, the same bytes for a seed, read back by gpvo's own reader."""

import errno
import hashlib
from types import SimpleNamespace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.sim import sequence, sequence_plan
from gpvo.sim.rig import RigError, RigTolerance, camera_rig, true_rig
from gpvo.sim.scenario import load_scenario

SHORT = {"duration_s": 4.0, "rate_hz": 5.0, "rest_s": 2.0, "speed_mps": 0.5}


@pytest.fixture
def quick(monkeypatch):
    """A hall of air in which pictures are noise of the seed: all but rendering stays as it is."""
    world = SimpleNamespace(
        bounds=np.array([[-5.0, -5.0, 0.0], [5.0, 5.0, 4.0]]),
        clearance=lambda p: np.minimum(5.0 - np.abs(p[:, 0]), 5.0 - np.abs(p[:, 1])),
        start_pose=se3.from_rt(np.eye(3), np.array([-3.0, 0.0, 1.5])),
        centreline=np.stack([np.linspace(-4, 4, 40), np.zeros(40), np.full(40, 1.5)], 1),
        heights=(),
    )
    monkeypatch.setattr(sequence, "build_world", lambda kind, seed, **params: world)

    class Eye:
        depth_m = None

        def __init__(self, scenario, seed, world, rig, motion, threads):
            self.seed = seed

        def see(self, index, plan):
            rng = np.random.default_rng([self.seed, index])
            pair = rng.integers(1, 256, (2, 480, 640), dtype=np.uint8)
            return (pair[0], pair[1]) if plan.fate != "black" else (pair[0] * 0, pair[1] * 0)

    monkeypatch.setattr(sequence, "Eye", Eye)
    return lambda **values: load_scenario("tunnel", {**SHORT, "vehicle": "path", "path": "straight", **values})


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
    with pytest.raises(GpvoError, match="no simulated sequence"):
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


@pytest.mark.parametrize("speed, message", [(9.0, "leaves the world"), (1.88, "crashes at t")])
def test_no_flight_through_walls(quick, tmp_path, speed, message):
    # The slower one stops 10 cm from the wall.
    with pytest.raises(GpvoError, match=message):
        sequence.simulate(quick(duration_s=5.2, rest_s=0.0, speed_mps=speed), 1, tmp_path / "seq")
    assert not list(tmp_path.iterdir())


def test_a_recorded_path_must_be_given(quick, tmp_path):
    with pytest.raises(GpvoError, match="--trajectory"):
        sequence.simulate(quick(needs_trajectory=True), 1, tmp_path / "seq")


@pytest.mark.parametrize("camera", ["pinhole", "euroc", "t265"])
def test_drawn_rig(camera):
    written = camera_rig(camera)
    same = true_rig(written, RigError.draw(RigTolerance(), np.random.default_rng(0)))
    assert np.allclose(same.T_right_left, written.T_right_left, atol=1e-15)
    assert same.left == written.left
    errors = [RigError.draw(RigTolerance(0.01, 0.003, 5e-4, 1e-3), np.random.default_rng(s)) for s in range(200)]
    drawn = [true_rig(written, e) for e in errors]
    ratio = np.array([d.baseline_m / written.baseline_m for d in drawn])
    assert ratio.std() == pytest.approx(0.01, rel=0.2)
    assert all(d.left.fx_px != written.left.fx_px for d in drawn)
    fixed = true_rig(written, RigError.draw(RigTolerance(), np.random.default_rng(0), RigTolerance(baseline=0.01)))
    assert fixed.baseline_m / written.baseline_m == pytest.approx(1.01, abs=1e-12)


def test_episodes_reach_the_frames():
    scenario = load_scenario("tunnel-bursts", {"duration_s": 60.0})
    episodes = sequence_plan.plan_episodes(scenario, np.random.default_rng(2))
    plans = sequence_plan.plan_frames(scenario, episodes, np.random.default_rng(3))
    bad = [p for p in plans if p.light < 1 or p.dust or p.noise_sigma or p.exposure_s or p.bare]
    assert 0.15 < len(bad) / len(plans) < 0.25


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
