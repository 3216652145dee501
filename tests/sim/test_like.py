"""A scenario taken from a run: what was simulated comes back."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

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


KEPT = {
    "white": {},
    "persistent": {"persistent_px": 0.8},
    "drift": {"drift_px": 0.15, "drift_s": 1.0, "shared_px": ((0.0, 0.0), (0.0, 0.0), (0.1, 0.0))},
}


class Flown(NamedTuple):
    """A run, what its tracks keep, and the scenario found in it."""

    path: Path
    kind: str
    found: dict[str, Any]


@pytest.fixture(scope="module", params=KEPT)
def flown(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("like")
    flight = simulate_points("street", 3, duration_s=20.0, speed_mps=12.0, **MADE, **KEPT[request.param])
    run_vo(open_source(flight.save(folder / "f.npz")), folder / "run", keep_tracks=True)
    return Flown(folder / "run", request.param, like(folder / "run"))


def test_noise_counts_and_camera_come_back(flown: Flown) -> None:
    _, kind, found = flown
    kept = {"persistent_px": 0.0, "drift_px": 0.0, **KEPT[kind]}
    # A twentieth of the tracks are outliers, which no odometry tells from noise to the last one.
    if kind != "drift":
        assert np.median(found["points.sigma_px"]) == pytest.approx(MADE["sigma_px"], rel=0.15)
    assert found["points.persistent_px"] == pytest.approx(kept["persistent_px"], rel=0.3, abs=0.15)
    assert found["points.drift_px"] == pytest.approx(kept["drift_px"], rel=0.3)
    if kind == "drift":
        assert found["points.drift_s"] == pytest.approx(kept["drift_s"], rel=0.5)
    shared = np.array(found["points.shared_px"])[1:, 0]
    assert np.hypot.reduce(shared) == pytest.approx(0.1 if kind == "drift" else 0.0, rel=0.5, abs=0.02)
    assert np.mean(found["points.outliers"]) == pytest.approx(MADE["outliers"], abs=0.03)
    assert np.median(found["points.drop"]) == pytest.approx(MADE["drop"], abs=0.03)
    assert np.median(found["points.tracks"]) == pytest.approx(MADE["tracks"], rel=0.2)
    assert found["rate_hz"] == pytest.approx(10.0)
    assert found["imu_rate_hz"] == pytest.approx(200.0)


def test_each_frame_has_as_many_points_as_that_of_the_run(tmp_path: Path) -> None:
    """At its place on the path: the run has few points, near and noisy, in its second half."""
    half = 60
    made = {
        "tracks": (250,) * half + (60,) * half,
        "sigma_px": (0.1,) * half + (0.4,) * half,
        "reach_m": (60.0,) * half + (25.0,) * half,
    }
    flight = simulate_points("street", 3, duration_s=11.9, speed_mps=12.0, rest_s=0.0, **{**MADE, **made})
    run_vo(open_source(flight.save(tmp_path / "f.npz")), tmp_path / "run", keep_tracks=True)
    found = like(tmp_path / "run")
    again = simulate_points(points_scenario(load_scenario("street", found)), 1)
    counts = np.bincount(again.frame)
    disparity_px = again.uv_left[:, 0] - again.uv_right[:, 0]
    many, few = slice(-110, -65), slice(-55, None)  # from the end, as the flight rests at its start
    assert np.median(counts[many]) == pytest.approx(250, rel=0.1)
    assert np.median(counts[few]) == pytest.approx(60, rel=0.1)
    assert np.median(found["points.sigma_px"][many]) == pytest.approx(0.1, rel=0.25)
    assert np.median(found["points.sigma_px"][few]) == pytest.approx(0.4, rel=0.25)
    last = len(counts) - 1
    assert np.quantile(disparity_px[again.frame > last - 50], 0.05) > 1.8 * np.quantile(
        disparity_px[(again.frame > last - 110) & (again.frame < last - 65)], 0.05
    )


def test_the_flight_is_flown_again(flown: Flown) -> None:
    path, _, found = flown
    scenario = points_scenario(load_scenario("street", found))
    again, run = simulate_points(scenario, 1), read_run(path)
    assert scenario.camera == run.log.camera
    # From the end backwards, as the start is made smooth; in the frame of each flight's last camera.
    T, T_run = again.T_world_cam, run.log.trajectory()
    for back in (20, 60, 100):
        ours, theirs = (np.linalg.inv(X[-5]) @ X[-5 - back] for X in (T, T_run))
        assert np.linalg.norm(ours[:3, 3] - theirs[:3, 3]) < 0.02 * np.linalg.norm(theirs[:3, 3]) + 1.0
    assert len(again.frame) > 50 * len(again.t_s)


def test_a_path_made_smaller_is_told(flown: Flown, recwarn: pytest.WarningsRecorder) -> None:
    """In a hall of 12 m a drive of 150 m was flown at a walk, without a word."""
    with pytest.warns(UserWarning, match=r"flown at 0.11 of its size and speed"):
        simulate_points(points_scenario(load_scenario("room-t265", flown.found)), 1)
    recwarn.clear()
    simulate_points(points_scenario(load_scenario("street", flown.found)), 1)
    assert not recwarn


def test_a_run_without_tracks_is_refused(flown: Flown, tmp_path: Path) -> None:
    path = flown.path
    bare = tmp_path / "bare"
    bare.mkdir()
    for file in path.iterdir():
        if file.name != "tracks.parquet":
            (bare / file.name).write_bytes(file.read_bytes())
    with pytest.raises(SourceError, match="holds no tracks"):
        like(bare)


def test_the_command_line(flown: Flown, tmp_path: Path) -> None:
    path = flown.path
    words = ["simulate", "street", "--like", str(path), "--duration", "6", "-o", str(tmp_path / "sim.npz")]
    CliRunner().invoke(app, [*words, "--points"], catch_exceptions=False)
    assert (tmp_path / "sim.npz").is_file()
    with pytest.raises(GpvoError, match="--points"):
        CliRunner().invoke(app, words, catch_exceptions=False)
