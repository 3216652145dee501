"""Commands killed at random moments: nothing half-written is taken for whole, and a second run gives the same bytes."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from gpvo.errors import GpvoError
from gpvo.io.run import is_finished, read_run
from gpvo.online.predictor import Predictor
from gpvo.sim.points import simulate_points

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
TABLES = ("vo_log.parquet", "trajectory.tum", "rig.json", "truth.parquet", "imu.parquet", "config.toml")


def start(*words: object) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "gpvo.cli", *map(str, words)], stdout=-1, stderr=-1)


def finish(*words: object) -> float:
    """Run to the end; the seconds that it took."""
    began = time.monotonic()
    call = start(*words)
    _, err = call.communicate(timeout=300)
    assert call.returncode == 0, err.decode()
    return time.monotonic() - began


def kill_after(seconds: float, how: signal.Signals, *words: object) -> None:
    call = start(*words)
    try:
        call.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        call.send_signal(how)
    _, err = call.communicate(timeout=60)
    assert b"Traceback" not in err, err.decode()


def content(run: Path) -> dict[str, Any]:
    """What a run holds but for the times that it took."""
    log = read_run(run).log
    records = [{k: str(v) for k, v in vars(r).items() if k != "stage_ms"} for r in log]
    return {"records": records, **{n: (run / n).read_bytes() for n in TABLES[1:] if (run / n).is_file()}}


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flights")
    for seed in range(2):
        simulate_points("tunnel-bursts", seed, duration_s=30.0, rate_hz=10.0).save(folder / f"{seed}.npz")
        finish("run", folder / f"{seed}.npz", "-o", folder / f"run{seed}")
    return folder


def frames_left(run: Path) -> int:
    """How many records a killed run left, 0 where it did not get so far; no other error is allowed."""
    try:
        return len(read_run(run).log)
    except GpvoError:
        return 0


def killed_runs(flights: Path, folder: Path, times: int) -> None:
    """A run killed over and over, each time begun anew over what the last one left."""
    words = ("run", flights / "0.npz", "-o", folder / "run0")
    takes_s = finish(*words)
    wanted = content(folder / "run0")
    assert wanted == content(flights / "run0")
    shutil.rmtree(folder / "run0")
    rng = random.Random(0)
    for k in range(times):
        kill_after(rng.uniform(0.3, 1.0) * takes_s, SIGNALS[k % 3], *words)
        assert frames_left(folder / "run0") <= len(wanted["records"])
        if is_finished(folder / "run0"):
            assert content(folder / "run0") == wanted
            shutil.rmtree(folder / "run0")
    if not is_finished(folder / "run0"):
        finish(*words)
    assert content(folder / "run0") == wanted


def killed_replacements(flights: Path, folder: Path, times: int) -> None:
    """A finished run that is being replaced is there, whole, whenever the command is killed."""
    words = ("run", flights / "0.npz", "-o", folder / "run0", "--overwrite")
    takes_s = finish(*words)
    wanted = content(folder / "run0")
    rng = random.Random(1)
    for k in range(times):
        kill_after(rng.uniform(0.3, 1.0) * takes_s, SIGNALS[k % 3], *words)
        assert content(folder / "run0") == wanted
    finish(*words)
    assert [p.name for p in folder.iterdir()] == ["run0"]


@pytest.mark.slow
def test_runs_killed_many_times(flights: Path, tmp_path: Path) -> None:
    killed_runs(flights, tmp_path, 24)


@pytest.mark.slow
def test_replacements_killed_many_times(flights: Path, tmp_path: Path) -> None:
    killed_replacements(flights, tmp_path, 12)


@pytest.mark.slow
def test_a_training_that_is_killed_leaves_the_old_model(flights: Path, tmp_path: Path) -> None:
    words = ("train", flights / "run0", flights / "run1", "-o", tmp_path / "m.gpvo", "--seed", "0")
    takes_s = finish(*words)
    wanted = (tmp_path / "m.gpvo").read_bytes()
    rng = random.Random(2)
    for k in range(3):
        kill_after(rng.uniform(0.3, 1.0) * takes_s, SIGNALS[k % 3], *words)
        Predictor.load(tmp_path / "m.gpvo")
    finish(*words)
    assert (tmp_path / "m.gpvo").read_bytes() == wanted
