"""Commands killed at random moments: nothing half-written is taken for whole, and a second run gives the same bytes.

``GPVO_KILLS`` is about how many there are in all, by default 24.
"""

from __future__ import annotations

import fcntl
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.files import read_json
from gpvo.io.run import is_finished, read_run
from gpvo.online.predictor import Predictor
from gpvo.sim.points import simulate_points

from command_line import gpvo

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
KILLS = int(os.environ.get("GPVO_KILLS", "24"))
TABLES = ("vo_log.parquet", "trajectory.tum", "rig.json", "truth.parquet", "imu.parquet", "config.toml",
          "predictions.parquet", "tracks.parquet", "calibration_state.json")  # fmt: skip
GPVO = [sys.executable, "-m", "gpvo"]
# A reproduction of one row, without images: smaller than the command line offers, and interrupted as it is.
REPRODUCE = """
import signal, sys
from pathlib import Path
try:
    from gpvo.reproduce.experiments import Plan
    from gpvo.reproduce.run import reproduce
    training = {"images": 0, "points": 2}
    reproduce(Plan(seeds=0, points_seeds=2, training=training, duration_s=5.0, only=("4.3",)), Path(sys.argv[1]))
except KeyboardInterrupt:
    sys.exit(130)
finally:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
"""


def start(*command: object) -> subprocess.Popen[bytes]:
    """In a process group of its own: workers outlive the process that made them, and Ctrl-C reaches all of them, also
    where the tests themselves run in the background of a shell and have to ignore it."""

    def heed() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    return subprocess.Popen([*map(str, command)], stdout=-1, stderr=-1, start_new_session=True, preexec_fn=heed)


def finish(*command: object) -> float:
    """Run to the end; the seconds that it took."""
    began = time.monotonic()
    _, err = (call := start(*command)).communicate(timeout=600)
    assert call.returncode == 0, err.decode()
    return time.monotonic() - began


def kill_after(seconds: float, how: signal.Signals, *command: object) -> None:
    call = start(*command)
    try:
        call.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(call.pid, how)
        call.wait(timeout=60)
        with suppress(ProcessLookupError):  # workers that wait for a process that is no more
            os.killpg(call.pid, signal.SIGKILL)
    _, err = call.communicate(timeout=60)
    assert b"Traceback" not in err, err.decode()


def killed(share: float, command: list[object], look: Callable[[], None], takes_s: float) -> None:
    """Kill a command at so large a share of all kills; after each, ``look`` at what is there. Then let it finish."""
    times, rng = max(2, round(share * KILLS)), random.Random(str(command[-1]))
    for k in range(times):
        kill_after(rng.uniform(0.3, 1.0) * takes_s, SIGNALS[k % 3], *command)
        look()
    finish(*command)


WINDING_DOWN = """
import sys, threading, time
from gpvo.__main__ import main

def other_work():
    threading.main_thread().join()
    print("winding down", flush=True)
    time.sleep(60)

threading.Thread(target=other_work).start()
sys.argv = ["gpvo", "--version"]
main()
"""


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP], ids=lambda how: how.name)
def test_a_signal_after_the_work_is_done_says_nothing(how: signal.Signals) -> None:
    """Python waits for threads, and so for worker processes, after the program's last line."""
    with start(sys.executable, "-c", WINDING_DOWN) as call:
        assert call.stdout is not None
        while b"winding down" not in call.stdout.readline():
            assert call.poll() is None
        call.send_signal(how)
        if how is signal.SIGHUP:  # all is written, and the end comes by itself: no matter that the terminal is gone
            call.terminate()
        _, err = call.communicate(timeout=30)
    assert err == b""


LOADING = """
import os, signal, time
import gpvo.cli
from gpvo.__main__ import main

def load():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(9)
    except KeyboardInterrupt:
        raise ImportError("initialization failed") from None

gpvo.cli.main = load
main()
"""


def test_a_library_that_takes_ctrl_c_for_an_error_is_not_believed() -> None:
    """As those of pybind11 do while they are loaded."""
    with start(sys.executable, "-c", LOADING) as call:
        assert call.communicate(timeout=60)[1] == b"gpvo: interrupted\n"
    assert call.returncode == 130


BLOCKED = """
import signal
from gpvo.parallel import map_jobs
blocked = map_jobs(signal.pthread_sigmask, [(signal.SIG_BLOCK, [])] * 2, jobs=2)
print([signal.SIGINT in of for of in (*blocked, signal.pthread_sigmask(signal.SIG_BLOCK, []))])
"""


def test_ctrl_c_waits_in_workers_from_before_they_load_anything() -> None:
    with start(sys.executable, "-c", BLOCKED) as call:
        assert call.communicate(timeout=120)[0] == b"[True, True, False]\n"


def bytes_of(path: Path) -> dict[str, bytes]:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return {str(p.relative_to(path)): p.read_bytes() for p in files}


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
        finish(*GPVO, "run", folder / f"{seed}.npz", "-o", folder / f"run{seed}")
    return folder


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL], ids=lambda how: how.name)
def test_what_ends_a_command_ends_its_workers_too(how: signal.Signals, tmp_path: Path) -> None:
    """As of a service manager, a batch system or the kernel where memory runs out: nothing goes on to write after the
    command has ended."""
    short = ("--points", "--duration", 5, "--seeds", "0..9999")
    call = start(*GPVO, "simulate", "tunnel-clean", *short, "--jobs", 2, "-o", tmp_path)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob("*.npz")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(call.pid, how)
    _, err = call.communicate(timeout=60)
    ends = {signal.SIGTERM: (128 + signal.SIGTERM, b""), signal.SIGKILL: (-signal.SIGKILL, b"")}
    assert (call.returncode, err) == ends[how]
    for _ in range(100):
        try:
            os.killpg(call.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    os.killpg(call.pid, signal.SIGKILL)
    pytest.fail("a worker lives on")


@pytest.mark.parametrize("wrapper", [[], ["nohup"]], ids=["plain", "nohup"])
def test_a_lost_terminal_costs_nothing_that_was_recorded(wrapper: list[str], tmp_path: Path) -> None:
    """As a session on a robot ends with the connection to it; ``nohup`` keeps it going."""
    from bag_maker import BagMaker

    maker, covariance = BagMaker(ros1=True), np.eye(6)
    for k in range(600):
        T = np.eye(4)
        T[0, 3] = 0.05 * k
        maker.odometry("/odom", 10**18 + k * 10**8, T, 1e-4 * (k + 1) * covariance, 1e-4 * covariance)
    bag, model = maker.write(tmp_path / "in.bag"), Path(__file__).parents[2] / "models" / "tunnel.gpvo"
    out, state = tmp_path / "out.bag", tmp_path / "state.json"
    command = [*wrapper, *GPVO, "live", "--replay", bag, "--model", model, "-o", out, "--state", state]
    ours, theirs = os.openpty()

    def take_terminal() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        fcntl.ioctl(theirs, termios.TIOCSCTTY, 0)

    call = subprocess.Popen(
        list(map(str, command)), stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True,
        preexec_fn=take_terminal, cwd=tmp_path, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    os.close(theirs)
    deadline = time.monotonic() + 120
    while not (state.is_file() and read_json(state)["t_ns"] > 10**18) and time.monotonic() < deadline:
        time.sleep(0.05)  # until it is written for the second time
    os.close(ours)
    if not wrapper:
        time.sleep(0.02)
        call.send_signal(signal.SIGHUP)  # the shell that started it says so, too
    if wrapper:
        with pytest.raises(subprocess.TimeoutExpired):
            call.wait(timeout=3)
        call.terminate()
    call.wait(timeout=60)
    assert out.is_file()
    assert not out.with_name("out.bag.parts").exists()


@pytest.mark.slow
def test_runs(flights: Path, tmp_path: Path) -> None:
    """Each goes on from what the last one left, of which every whole chunk can be read."""
    run, model = tmp_path / "run0", Path(__file__).parents[2] / "models" / "tunnel.gpvo"
    command = [*GPVO, "run", flights / "0.npz", "--model", model, "--keep-tracks", "-o", run]
    takes_s = finish(*command)
    wanted = content(run)
    assert wanted["records"] == content(flights / "run0")["records"]
    shutil.rmtree(run)

    def look() -> None:
        try:
            left = read_run(run).log.records
        except GpvoError:  # it did not get so far; no other error is allowed
            left = []
        assert [str(r.T_prev_cur) for r in left] == [r["T_prev_cur"] for r in wanted["records"][: len(left)]]
        if is_finished(run):
            assert content(run) == wanted
            shutil.rmtree(run)

    killed(0.35, command, look, takes_s)
    assert content(run) == wanted


@pytest.mark.slow
def test_replacements(flights: Path, tmp_path: Path) -> None:
    """A finished run that is being replaced is there, whole, whenever the command is killed."""
    command, run = [*GPVO, "run", flights / "0.npz", "--overwrite", "-o", tmp_path / "run0"], tmp_path / "run0"
    takes_s = finish(*command)
    wanted = content(run)

    def look() -> None:
        assert content(run) == wanted

    killed(0.15, command, look, takes_s)
    assert [p.name for p in tmp_path.iterdir()] == ["run0"]


@pytest.mark.slow
def test_trainings(flights: Path, tmp_path: Path) -> None:
    """The old model stays; the new one goes on from the folds that were finished."""
    model = tmp_path / "m.gpvo"
    command = [*GPVO, "train", flights / "run0", flights / "run1", "--features", "n_inliers", "-o", model]
    takes_s = finish(*command)
    wanted = model.read_bytes()

    def look() -> None:
        Predictor.load(model)

    killed(0.1, command, look, takes_s)
    assert model.read_bytes() == wanted
    being_written = {p.name for p in tmp_path.glob(".m.gpvo*")}  # when it was killed
    whole = {model.name, *(f"{model.name}.{suffix}" for suffix in ("md", "svg", "rows.parquet"))}
    assert {p.name for p in tmp_path.iterdir()} <= whole | being_written


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "share"), [("sequence", 0.1), ("campaign of two workers", 0.2)])
def test_simulations(kind: str, share: float, tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="images need the extra gpvo[sim]")
    scene = ["tunnel-clean", "--duration", "4", "--rate", "5", "--set", "speed_mps=0.5"]
    many = ["--seeds", "0..1", "--jobs", "2"] if "campaign" in kind else []
    finish(*GPVO, "simulate", *scene, *many, "-o", tmp_path / "warm")  # the world is built once, into the cache
    takes_s = finish(*GPVO, "simulate", *scene, *many, "-o", tmp_path / "wanted")
    wanted = bytes_of(tmp_path / "wanted")
    out = tmp_path / "out"

    def look() -> None:
        """What stands under its name is whole."""
        folders = [p for p in out.glob("seed_*") if p.suffix not in (".part", ".lock")] if many else [out]
        for folder in folders:
            if (folder / "scenario.toml").is_file():
                place = f"{folder.name}/" if many else ""
                assert bytes_of(folder) == {
                    k.removeprefix(place): v for k, v in wanted.items() if k.startswith(place)
                }, folder
        if bytes_of(out) == wanted:
            shutil.rmtree(out)

    killed(share, [*GPVO, "simulate", *scene, *many, "-o", out], look, takes_s)
    assert {k: v for k, v in bytes_of(out).items() if ".part" not in k and ".lock" not in k} == wanted


@pytest.mark.slow
def test_reproductions(tmp_path: Path) -> None:
    """One goes on where the last one was killed; its tables are those of one that was left in peace."""
    command = [sys.executable, "-c", REPRODUCE]
    takes_s = finish(*command, tmp_path / "wanted")
    killed(0.1, [*command, tmp_path / "out"], lambda: None, takes_s)
    one, other = ({p.name: p.read_bytes() for p in (tmp_path / n).glob("tables.*")} for n in ("wanted", "out"))
    assert one
    assert one == other
    for kind in ("models", "bounds"):
        whole, again = ({p.name: p.read_bytes() for p in (tmp_path / n / "stages" / kind).glob("[!.]*")}
                        for n in ("wanted", "out"))  # fmt: skip
        assert whole == again


# -- a disk that is full, as a limit on the size of a file; folders that may not be written --

WRITERS = {
    "run": ("run", "0.npz", "--overwrite", "-o"),
    "import": ("import", "run0/trajectory.tum", "--overwrite", "-o"),
    "points": ("simulate", "tunnel-bursts", "--points", "--duration", "5", "-o"),
    "report.html": ("report", "run0", "-o"),
    "log.bag": ("publish", "run0", "-o"),
    "log.tlog": ("publish", "run0", "-o"),
    "model.h": ("export", "tunnel.gpvo", "-o"),
    "model.onnx": ("export", "tunnel.gpvo", "-o"),
    "said.parquet": ("predict", "tunnel.gpvo", "run0", "-o"),
    "forecast.csv": ("forecast", "tunnel.gpvo", "--path", "run0/trajectory.tum", "-o"),
    "fused.png": ("fuse", "run0", "--model", "tunnel.gpvo", "--policies", "learned", "--plot"),
}


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of ten seconds, its run and a model."""
    folder = tmp_path_factory.mktemp("short")
    simulate_points("tunnel-bursts", 0, duration_s=10.0, rate_hz=10.0).save(folder / "0.npz")
    finish(*GPVO, "run", folder / "0.npz", "-o", folder / "run0")
    shutil.copy(Path(__file__).parents[2] / "models" / "tunnel.gpvo", folder)
    return folder


@contextmanager
def files_of_at_most(size_bytes: int) -> Iterator[None]:
    """The kernel refuses this process any byte beyond. Of bytecode, Python would keep what fits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_costs_one_line_and_leaves_what_was_there(name: str, short: Path, tmp_path: Path) -> None:
    out = tmp_path / ("points.npz" if name == "points" else name)
    if name in ("run", "import"):
        shutil.copytree(short / "run0", out)
    before = bytes_of(tmp_path)
    for limit_bytes in (0, 1_000, 10_000):
        with files_of_at_most(limit_bytes):
            call = gpvo(*WRITERS[name], out, folder=short)
        if call.returncode == 0:
            assert limit_bytes > 0
            break
        assert call.returncode == 2, call.stderr
        assert len(call.stderr.strip().splitlines()) == 1, call.stderr
        assert str(out.parent) in call.stderr
        assert "File too large" in call.stderr
        assert bytes_of(tmp_path) == before
