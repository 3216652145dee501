"""Matches of single frames on the report page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from gpvo.sim.points import simulate_points
from sequences import camchain_yaml, grey, write_image

from command_line import gpvo


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    simulate_points("tunnel-clean", 0, duration_s=4.0, rate_hz=10.0).save(folder / "flight.npz")
    assert gpvo("run", folder / "flight.npz", "-o", folder / "run").returncode == 0
    return folder


def test_the_page_shows_the_frames_asked_for(flight: Path) -> None:
    page = flight / "report.html"
    words = ["report", flight / "run", "-o", page, "--frames", "5,20", "--sequence", flight / "flight.npz"]
    assert gpvo(*words).returncode == 0
    text = page.read_text()
    assert re.findall(r"<figcaption>frame (\d+): ok; \d+ of \d+ matches agree", text) == ["5", "20"]
    assert text.count("data:image/jpeg;base64,") == 2


@pytest.mark.parametrize("frames", ["999", "-1", "x"])
def test_a_frame_that_is_not_there(flight: Path, frames: str) -> None:
    done = gpvo("report", flight / "run", "--frames", frames, "--sequence", flight / "flight.npz")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_the_sequence_of_another_run(flight: Path) -> None:
    """Told by its stamps, as by its camera; and a sequence of which no frame is asked for."""
    simulate_points("tunnel-clean", 0, duration_s=4.0, rate_hz=20.0).save(flight / "faster.npz")
    simulate_points("room-t265", 0, duration_s=4.0, rate_hz=10.0).save(flight / "camera.npz")
    for name, frames, told in (
        ("faster", ["--frames", 5], "its stamps are not those of the run"),
        ("camera", ["--frames", 5], "its camera or calibration is not that of the run"),
        ("flight", [], "--sequence has no effect without --frames"),
    ):
        page = flight / "other.html"
        done = gpvo("report", flight / "run", "-o", page, *frames, "--sequence", flight / f"{name}.npz")
        assert done.returncode == 2
        assert told in done.stderr
        assert not page.exists()


def test_the_sequence_is_opened_as_for_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its calibration, size and rate, also where the run was made from another folder."""
    for side in ("left", "right"):
        for k in range(4):
            write_image(tmp_path / "seq" / side / f"{k}.png", grey(k))
    (tmp_path / "rig.yaml").write_text(camchain_yaml())
    monkeypatch.chdir(tmp_path)
    opened = ["--calibration", "rig.yaml", "--size", "96x80", "--rate-hz", 10]
    assert gpvo("run", "seq", "-o", "run", *opened).returncode == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    done = gpvo("report", "../run", "-o", "page.html", "--frames", 2, "--sequence", "../seq")
    assert done.returncode == 0, done.stderr
    assert "<figcaption>frame 2: " in Path("page.html").read_text()
