"""Every gpvo command of the README runs as written, on flights simulated here."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from gpvo.geometry import se3
from gpvo.io.trajectory import tum_line
from gpvo.sim.points import simulate_points

from command_line import gpvo

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"


def commands() -> list[str]:
    """The indented lines that call gpvo, without their remarks. ``gpvo live`` runs until it is stopped: tests/live."""
    lines = re.findall(r"^ {4}(gpvo .*)$", README.read_text(), flags=re.MULTILINE)
    return [line.split("#")[0].strip() for line in lines if not line.startswith("gpvo live")]


def call(line: str, folder: Path) -> None:
    done = gpvo(*line.split()[1:], folder=folder)
    assert done.returncode in ((0, 1) if " check " in line else (0,)), f"{line}\n{done.stdout}\n{done.stderr}"


def prepare(folder: Path) -> dict[str, str]:
    """What the README's placeholders stand for."""
    for name in ("data", "models"):
        (folder / name).symlink_to(ROOT / name)
    for name, seed in (("a", 0), ("b", 1), ("c", 2), ("today", 3)):
        simulate_points("tunnel-bursts", seed, duration_s=20.0, rate_hz=10.0).save(folder / f"{name}.npz")
        call(f"gpvo run {name}.npz -o runs/{name}", folder)
    flight = simulate_points("tunnel-bursts", 4, duration_s=20.0, rate_hz=10.0)
    flight.save(folder / "flight.npz")
    stamps = [round(t * 1e9) for t in flight.t_s]
    lines = [tum_line(t, T) for t, T in zip(stamps, flight.T_world_cam, strict=True)]
    (folder / "truth.tum").write_text("\n".join(lines) + "\n")
    # Somebody else's odometry: the same path, a little too long.
    scaled = [se3.from_rt(T[:3, :3], 1.01 * T[:3, 3]) for T in flight.T_world_cam]
    log = [tum_line(t, T) for t, T in zip(stamps, scaled, strict=True)]
    (folder / "log.tum").write_text("\n".join(log) + "\n")
    return {"PATH": "flight.npz", "NAME": "kitti", "LOG": "log.tum", "GT": "truth.tum", "PLAN.tum": "truth.tum"}


def test_the_readme_names_commands() -> None:
    assert len(commands()) >= 10
    assert any(line.startswith("gpvo train") for line in commands())


def test_it_is_read_in_a_minute() -> None:
    """At most 700 words of prose and one table of at most six rows; every figure of the table stands in the results."""
    text = README.read_text()
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert 2 < len(rows) <= 2 + 6
    prose = re.sub(r"```[^`]*```|^ {4}.*$|^\|.*$|^!\[.*$", "", text, flags=re.MULTILINE)
    assert len(re.sub(r"\]\([^)]*\)", "]", prose).split()) <= 700
    pages = "\n".join((ROOT / "docs" / name).read_text() for name in ("results.rst", "concepts/twins.rst"))
    stated = {f.rstrip("0") for f in re.findall(r"-?\d+\.\d+", pages)}
    for figure in re.findall(r"-?\d+\.\d+", "\n".join(rows)):
        assert figure.rstrip("0") in stated, figure


@pytest.mark.slow
def test_every_command_runs(tmp_path: Path) -> None:
    stand_in = prepare(tmp_path)
    for line in commands():
        words = [stand_in.get(word, word) for word in line.split()]
        call(" ".join(words), tmp_path)
    assert (tmp_path / "report.html").stat().st_size > 10_000
