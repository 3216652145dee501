"""Matches of single frames on the report page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from gpvo import cli
from gpvo.sim.points import simulate_points
from sequences import camchain_yaml, grey, write_image


def main(*words: object) -> int:
    """One command as the shell would call it; its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["gpvo", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
    return int(stop.value.code or 0)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flight")
    simulate_points("tunnel-clean", 0, duration_s=4.0, rate_hz=10.0).save(folder / "flight.npz")
    assert main("run", folder / "flight.npz", "-o", folder / "run") == 0
    return folder


def test_the_page_shows_the_frames_asked_for(flight: Path) -> None:
    page = flight / "report.html"
    words = ["report", flight / "run", "-o", page, "--frames", "5,20", "--sequence", flight / "flight.npz"]
    assert main(*words) == 0
    text = page.read_text()
    assert re.findall(r"<figcaption>frame (\d+): ok; \d+ of \d+ matches agree", text) == ["5", "20"]
    assert text.count("data:image/jpeg;base64,") == 2


@pytest.mark.parametrize("frames", ["999", "-1", "x"])
def test_a_frame_that_is_not_there(flight: Path, frames: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["report", flight / "run", "--frames", frames, "--sequence", flight / "flight.npz"]
    assert main(*words) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_the_sequence_of_another_run(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Told by its stamps, as by its camera; and a sequence of which no frame is asked for."""
    simulate_points("tunnel-clean", 0, duration_s=4.0, rate_hz=20.0).save(flight / "faster.npz")
    simulate_points("room-t265", 0, duration_s=4.0, rate_hz=10.0).save(flight / "camera.npz")
    for name, frames, told in (
        ("faster", ["--frames", 5], "its stamps are not those of the run"),
        ("camera", ["--frames", 5], "its camera or calibration is not that of the run"),
        ("flight", [], "--sequence has no effect without --frames"),
    ):
        page = flight / "other.html"
        assert main("report", flight / "run", "-o", page, *frames, "--sequence", flight / f"{name}.npz") == 2
        assert told in capsys.readouterr().err
        assert not page.exists()


def test_the_sequence_is_opened_as_for_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With its calibration, size and rate, also where the run was made from another folder."""
    for side in ("left", "right"):
        for k in range(4):
            write_image(tmp_path / "seq" / side / f"{k}.png", grey(k))
    (tmp_path / "rig.yaml").write_text(camchain_yaml())
    monkeypatch.chdir(tmp_path)
    opened = ["--calibration", "rig.yaml", "--size", "96x80", "--rate-hz", 10]
    assert main("run", "seq", "-o", "run", *opened) == 0
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    words = ["report", "../run", "-o", "page.html", "--frames", 2, "--sequence", "../seq"]
    assert main(*words) == 0, capsys.readouterr().err
    assert "<figcaption>frame 2: " in Path("page.html").read_text()
