"""A small reproduction without images, end to end: what it writes, what it keeps, how it goes on when killed."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from gpvo.cli import app
from gpvo.errors import GpvoError, OutputError
from gpvo.files import FolderLock, make_folder
from gpvo.reproduce import tables
from gpvo.reproduce.experiments import Plan
from gpvo.reproduce.flights import flights_of, fly
from gpvo.reproduce.run import reproduce
from gpvo.reproduce.stages import Store, only_user
from typer.testing import CliRunner

SMALL = {"seeds": 0, "points_seeds": 2, "training": {"images": 0, "points": 2}, "duration_s": 5.0, "only": ("4.3",)}
SCRIPT = f"""
import sys
from pathlib import Path
from gpvo.reproduce.experiments import Plan
from gpvo.reproduce.run import reproduce
reproduce(Plan(**{SMALL!r}), Path(sys.argv[1]))
"""


def stages(folder: Path) -> dict[str, int]:
    """Every finished run, model and bound, with when it was written."""
    runs = [p for p in folder.glob("stages/runs/*/run.json") if json.loads(p.read_text())["complete"]]
    others = [*folder.glob("stages/models/*.gpvo"), *folder.glob("stages/bounds/*.npz")]
    return {str(p.relative_to(folder)): p.stat().st_mtime_ns for p in (*runs, *others)}


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, int]]:
    """A reproduction that is killed when the third run is there, and what it had finished."""
    folder = tmp_path_factory.mktemp("killed")
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(folder)])
    deadline = time.monotonic() + 120
    while len(stages(folder)) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    return folder, stages(folder)


@pytest.fixture(scope="module")
def done(killed: tuple[Path, dict[str, int]]) -> tuple[Path, dict]:
    folder, _ = killed
    return folder, reproduce(Plan(**SMALL), folder)


def test_a_killed_reproduction_goes_on(killed, done):
    _, before = killed
    folder, _ = done
    after = stages(folder)
    assert 3 <= len(before) < len(after)
    assert {name: after[name] for name in before} == before
    assert not [*folder.rglob("*.tmp"), *folder.glob("stages/flights/*")]


def test_what_is_there_is_not_done_again(done):
    folder, result = done
    before = stages(folder)
    texts = {p: p.read_bytes() for p in folder.glob("*.*")}
    again = reproduce(Plan(**SMALL), folder)
    assert stages(folder) == before
    assert json.dumps(again["rows"]) == json.dumps(result["rows"])
    assert {p: p.read_bytes() for p in folder.glob("*.*")} == texts


def test_the_row_is_told_three_ways_beside_the_thesis(done):
    folder, _ = done
    document = json.loads((folder / "results.json").read_text())
    assert document["schema"] == 1
    (row,) = document["rows"]
    assert row["thesis"]["ratio"] == pytest.approx(2.11 / 1.03)
    assert list(row["ways"]) == ["recipe", "corrected", "full"]
    assert row["seeds"] == 2
    for way in row["ways"].values():
        assert way["ratio"] == pytest.approx(way["predicted_final_error_m"] / way["final_error_m"])
        assert way["ratio_interval"] is None  # Two seeds tell nothing of an interval.
    assert {t["met"] for t in document["targets"] if "interval" in t["target"]} == {None}
    assert any("NO RECORDED PATHS" in note for note in document["notes"])


def test_tables_and_page_show_the_numbers_of_the_document(done):
    folder, _ = done
    document = json.loads((folder / "results.json").read_text())
    (row,) = document["rows"]
    lines = list(csv.DictReader((folder / "tables.csv").read_text().splitlines()))
    assert [float(line["ratio"]) for line in lines] == [w["ratio"] for w in row["ways"].values()]
    page = (folder / "report.html").read_text()
    cells = [re.sub("<[^>]+>", "", c) for c in re.findall(r"<td>(.*?)</td>", page)]
    markdown = (folder / "tables.md").read_text()
    for line in tables.cells(row):
        start = next(k for k in range(len(cells)) if tuple(cells[k : k + len(line)]) == line)
        assert start >= 0
        assert "| " + " | ".join(line) + " |" in markdown
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert page.count("data:image/png;base64,") == len(document["figures"]) == 1


def test_what_decides_a_flight_decides_its_key(tmp_path):
    store = Store(tmp_path)
    base = flights_of(Plan(**SMALL), "tunnel", "points", store)
    same = flights_of(Plan(**SMALL), "tunnel", "points", store)
    other = flights_of(Plan(**{**SMALL, "duration_s": 6.0}), "tunnel", "points", store)
    assert [f.key for f in base] == [f.key for f in same]
    assert len({f.key for f in (*base, *other)}) == 4


def test_recorded_paths_of_training_and_test_differ(tmp_path):
    folder = tmp_path / "flown_paths"
    folder.mkdir()
    for name in "abc":
        text = "\n".join(f"{0.05 * k:.3f} {0.01 * k:.4f} 0 1 0 0 0 1" for k in range(400))
        (folder / f"{name}.txt").write_text(text + "\n")
    plan = Plan(**{**SMALL, "only": (), "data": tmp_path})
    store = Store(tmp_path / "out")
    flown = {n: {Path(f.scenario.trajectory).stem[0] for f in flights_of(plan, n, "points", store)}
             for n in ("t265", "t265-training")}  # fmt: skip
    assert flown["t265"] == {"b"}
    assert flown["t265-training"] == {"a", "c"}
    drawn = flights_of(plan, "t265", "points", store)[0].scenario
    assert drawn.calibration
    assert not flights_of(plan, "t265-perfect", "points", store)[0].scenario.calibration


def test_wrong_wishes_are_one_line():
    with pytest.raises(GpvoError, match="no flight was asked for"):
        Plan(seeds=0, points_seeds=0)
    with pytest.raises(GpvoError, match="unknown experiment '9.9'"):
        Plan(only=("9.9",))
    with pytest.raises(GpvoError, match="--data"):
        Plan(data=Path("/no/such"))


def test_two_reproductions_do_not_share_a_folder(tmp_path):
    with only_user(tmp_path), pytest.raises(GpvoError, match="another reproduction"):
        reproduce(Plan(**SMALL), tmp_path)


def test_a_run_that_cannot_be_written_is_no_flight_that_cannot_be_flown(tmp_path):
    """Else the tables would be of fewer flights, as while a worker of a killed reproduction still writes its run."""
    store = Store(tmp_path)
    flight = flights_of(Plan(**SMALL), "tunnel-training", "points", store)[0]
    (run,) = fly(flight, store).runs.values()
    (run / "run.json").unlink()
    lock = FolderLock(make_folder(run))
    with pytest.raises(OutputError, match="being written by another process"):
        fly(flight, store)
    lock.release()


def test_a_flight_that_cannot_be_flown_is_told_and_does_not_stop_the_others(tmp_path):
    store = Store(tmp_path)
    good, bad = flights_of(Plan(**SMALL), "tunnel", "points", store)
    bad = replace(bad, scenario=bad.scenario.model_copy(update={"trajectory": "/no/such.txt"}))
    flown = [fly(f, store) for f in (good, bad)]
    assert set(flown[0].runs) == {"fast", "thesis"}
    assert "/no/such.txt" in flown[1].error
    assert len(flown[1].error.splitlines()) == 1


def test_help_names_the_options():
    text = CliRunner().invoke(app, ["reproduce", "--help"]).output
    for option in ("--quick", "--seeds", "--jobs", "--backend", "--data", "--json"):
        assert option in text


@pytest.mark.slow
def test_everything_without_pictures(tmp_path):
    plan = Plan.quick(seeds=0, points_seeds=3, training={"images": 0, "points": 3}, duration_s=8.0, curve=(1, 2))
    result = reproduce(plan, tmp_path)
    assert not result["failed"]
    assert len(result["rows"]) == 9
    assert ["NO RECORDED PATHS" in row["title"] for row in result["rows"]] == [False] * 6 + [True] * 3
    assert len(result["sensitivity"]) == 6
    assert len(result["claims"]) == 9
    assert all(c["evidence"] for c in result["claims"])
    assert len(result["figures"]) == 10
    tight, _, wide = (r["ways"]["corrected"] for r in result["sensitivity"][:3])
    assert tight["predicted_final_error_m"] < wide["predicted_final_error_m"]
