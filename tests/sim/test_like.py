"""A scenario taken from a run: what was simulated comes back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gpvo.cli import app
from gpvo.errors import GpvoError, SourceError
from gpvo.io import open_source
from gpvo.io.run import read_run
from gpvo.runner import run as run_vo
from gpvo.sim.like import like
from gpvo.sim.points import simulate_points
from gpvo.sim.scenario import load_scenario, points_scenario
from typer.testing import CliRunner

MADE = {"tracks": 300, "sigma_px": 0.2, "blur_px": 0.0, "spread": 0.0, "outliers": 0.05, "drop": 0.05}


@pytest.fixture(scope="module", params=[0.0, 0.8], ids=["white", "persistent"])
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    folder = tmp_path_factory.mktemp("like")
    flight = simulate_points("street", 3, duration_s=20.0, speed_mps=12.0, persistent_px=request.param, **MADE)
    run_vo(open_source(flight.save(folder / "f.npz")), folder / "run", keep_tracks=True)
    return folder / "run", request.param


def test_noise_counts_and_camera_come_back(flown: tuple[Path, float]) -> None:
    path, persistent_px = flown
    found = like(path)
    # A twentieth of the tracks are outliers, which no odometry tells from noise to the last one.
    assert found["points.sigma_px"] == pytest.approx(MADE["sigma_px"], rel=0.15)
    assert found["points.persistent_px"] == pytest.approx(persistent_px, rel=0.3, abs=0.15)
    assert found["points.outliers"] == pytest.approx(MADE["outliers"], abs=0.03)
    assert found["points.drop"] == pytest.approx(MADE["drop"], abs=0.03)
    assert found["points.tracks"] == pytest.approx(MADE["tracks"], rel=0.2)
    assert found["rate_hz"] == pytest.approx(10.0)
    assert found["imu_rate_hz"] == pytest.approx(200.0)


def test_the_flight_is_flown_again(flown: tuple[Path, float]) -> None:
    path, _ = flown
    scenario = points_scenario(load_scenario("street", like(path)))
    again, run = simulate_points(scenario, 1), read_run(path)
    assert scenario.camera == run.log.camera
    # From the end backwards, as the start is made smooth; in the frame of each flight's last camera.
    T, T_run = again.T_world_cam, run.log.trajectory()
    for back in (20, 60, 100):
        ours, theirs = (np.linalg.inv(X[-5]) @ X[-5 - back] for X in (T, T_run))
        assert np.linalg.norm(ours[:3, 3] - theirs[:3, 3]) < 0.02 * np.linalg.norm(theirs[:3, 3]) + 1.0
    assert len(again.frame) > 50 * len(again.t_s)


def test_a_path_made_smaller_is_told(flown: tuple[Path, float], recwarn: pytest.WarningsRecorder) -> None:
    """In a hall of 12 m a drive of 150 m was flown at a walk, without a word."""
    path, _ = flown
    with pytest.warns(UserWarning, match=r"flown at 0.11 of its size and speed"):
        simulate_points(points_scenario(load_scenario("room-t265", like(path))), 1)
    recwarn.clear()
    simulate_points(points_scenario(load_scenario("street", like(path))), 1)
    assert not recwarn


def test_a_run_without_tracks_is_refused(flown: tuple[Path, float], tmp_path: Path) -> None:
    path, _ = flown
    bare = tmp_path / "bare"
    bare.mkdir()
    for file in path.iterdir():
        if file.name != "tracks.parquet":
            (bare / file.name).write_bytes(file.read_bytes())
    with pytest.raises(SourceError, match="holds no tracks"):
        like(bare)


def test_the_command_line(flown: tuple[Path, float], tmp_path: Path) -> None:
    path, _ = flown
    words = ["simulate", "street", "--like", str(path), "--duration", "6", "-o", str(tmp_path / "sim.npz")]
    CliRunner().invoke(app, [*words, "--points"], catch_exceptions=False)
    assert (tmp_path / "sim.npz").is_file()
    with pytest.raises(GpvoError, match="--points"):
        CliRunner().invoke(app, words, catch_exceptions=False)
