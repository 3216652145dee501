"""Every command takes --config, -q and -v; what a file gets wrong is one line; tables fit 80 columns."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer.main
from gpvo.cli import app
from gpvo.cli.common import with_common_options
from gpvo.errors import counted
from gpvo.io.run import write_run
from synthetic_runs import make_run
from typer.testing import CliRunner

from command_line import gpvo

ROOT = Path(__file__).parents[2]
UNSEEN, MODEL = str(ROOT / "data" / "unseen"), str(ROOT / "models" / "tunnel.gpvo")


def test_every_command_is_in_one_group_and_has_the_common_options():
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    for command in commands.values():
        assert command.rich_help_panel in ("Record", "Judge", "Learn", "Fly", "More")
        words = {word for p in command.params for word in p.opts}
        assert {"--config", "--quiet", "--verbose", "-q", "-v"} <= words


@pytest.mark.parametrize("at", ["typer", "gpvo.evaluation.evaluate"])
def test_ctrl_c_is_one_line_while_the_command_line_loads_too(at: str):
    script = """
import sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == NAME:
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupting())
from gpvo.__main__ import main
sys.argv[1:] = ["evaluate", "runs/any"]
main()
""".replace("NAME", repr(at))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (130, "gpvo: interrupted\n")


def test_a_file_gives_options_and_the_line_replaces_them(tmp_path: Path):
    (tmp_path / "o.toml").write_text('\ufeff[evaluate]\nsegments = "5"\njson = false\n[train]\nseed = 3\n')
    config = ("--config", str(tmp_path / "o.toml"))
    given = gpvo("evaluate", UNSEEN, *config)
    assert "  5 m segments" in given.stdout, given.stderr
    replaced = gpvo("evaluate", UNSEEN, *config, "--segments", "7")
    assert "  7 m segments" in replaced.stdout
    assert "  5 m segments" not in replaced.stdout


@pytest.mark.parametrize(
    "text,told",
    [
        ('[evaluate]\nsegmens = "5"', "[evaluate] has no option 'segmens' (did you mean segments?)"),
        ("seed = 3", "'seed' is not the table of any command"),
        ("[fly]\nseed = 3", "'fly' is not the table of any command"),
        ("[evaluate]\ntwins = 2", "[evaluate] twins is 2 (give true or false)"),
        ('[evaluate]\nseed = "x"', "'--seed'"),
        ("[evaluate]\nconfig = 'o.toml'", "has no option 'config'"),
        ("[evaluate", "cannot be read as TOML"),
    ],
)
def test_what_a_file_gets_wrong_is_one_line(tmp_path: Path, text: str, told: str):
    (tmp_path / "o.toml").write_text(text)
    done = gpvo("evaluate", UNSEEN, "--config", str(tmp_path / "o.toml"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert told in done.stderr


def test_a_file_of_options_that_is_missing_is_refused_as_any_other_file(tmp_path: Path):
    done = gpvo("evaluate", UNSEEN, "--config", "o.toml", folder=tmp_path)
    assert done.stderr == "gpvo: o.toml: cannot be read: No such file or directory\n"


@dataclass(frozen=True)
class Wire:
    fast: Annotated[bool, "No waiting."] = False


@dataclass(frozen=True)
class Asked:
    model: Annotated[Path, "--model", "A file."]
    wire: Wire = Wire()
    depth: Annotated[int, "At least 2.", {"min": 2}] = 10
    inner: int = 7  # nobody's option


def test_options_are_declared_by_type_and_help_also_in_settings_of_settings():
    seen: list[object] = []

    def command(runs: Annotated[list[Path], "Folders."], asked: Asked, out: Annotated[Path, "A file."]) -> None:
        seen.append((runs, asked, out))

    alone = typer.Typer()
    alone.command()(with_common_options(command))
    given = ["a", "b", "--model", "m", "-o", "x"]
    assert CliRunner().invoke(alone, [*given, "--fast", "--depth", "3"]).exit_code == 0
    assert seen == [([Path("a"), Path("b")], Asked(Path("m"), Wire(fast=True), 3), Path("x"))]
    for wrong in (["a", "-o", "x"], ["a", "--model", "m"], [*given, "--depth", "1"], [*given, "--no-fast"]):
        assert CliRunner().invoke(alone, wrong).exit_code == 2, wrong


@pytest.mark.parametrize(
    "words", [("evaluate",), ("nonsense",), ("evaluate", "--seed", "x", "r"), ("run", "--nothing")]
)
def test_a_wrong_line_is_one_line(words: tuple[str, ...]):
    done = gpvo(*words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "--help" in done.stderr


def test_verbose_says_what_it_took_and_shows_where_it_failed():
    done = gpvo("info", UNSEEN, "-v")
    assert "gpvo: took" in done.stderr
    failed = gpvo("evaluate", "nowhere", "-v")
    assert failed.returncode == 2
    assert "Traceback" in failed.stderr


def on_a_terminal(*words: str) -> str:
    """All that a command writes to a terminal of 80 columns."""
    pty = pytest.importorskip("pty", reason="this system has no pseudo-terminals")
    ours, theirs = pty.openpty()
    env = {**os.environ, "COLUMNS": "80", "TERM": "xterm"}
    with subprocess.Popen([sys.executable, "-m", "gpvo", *words], stdout=theirs, stderr=theirs, env=env) as process:
        os.close(theirs)
        parts = []
        with suppress(OSError):  # the end of a terminal
            while part := os.read(ours, 4096):
                parts.append(part)
    os.close(ours)
    assert process.returncode == 0
    return re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]", "", b"".join(parts).decode())


def test_training_shows_how_far_it_is_and_how_long_it_will_take(tmp_path: Path):
    runs = [str(tmp_path / f"run-{k}") for k in (1, 2)]
    for k, path in enumerate(runs):
        log, truth = make_run(k, n=120)
        write_run(Path(path), log, truth=truth)
    words = ("train", *runs, "-o", str(tmp_path / "m.gpvo"), "--features", "velocity")
    shown = on_a_terminal(*words)
    steps = [shown.index(f"{done}/3") for done in (0, 1, 2)]
    assert steps == sorted(steps)
    assert re.search(r"2/3 0:00:\d\d", shown)
    assert steps[-1] < shown.index("left out")
    piped = gpvo(*words[:-2], "--features", "velocity", "-q")
    assert "/3" not in piped.stdout + piped.stderr


def test_a_shell_completes_the_commands():
    env = {**os.environ, "_GPVO_COMPLETE": "complete_bash", "COMP_WORDS": "gpvo ev", "COMP_CWORD": "1"}
    script = shutil.which("gpvo", path=str(Path(sys.executable).parent))
    assert script is not None
    done = subprocess.run([script], capture_output=True, text=True, timeout=60, env=env)
    assert done.stdout.split() == ["evaluate"]


def test_a_narrow_terminal_breaks_no_number_and_a_closed_one_no_command():
    show = "from gpvo.cli.output import show; show(('method', *'abcdef'), [['triangulation', *6 * ['0.0719']]])"
    env = {**os.environ, "COLUMNS": "40"}
    done = subprocess.run([sys.executable, "-c", show], capture_output=True, text=True, timeout=120, env=env)
    assert done.stdout.count(" 0.0719") == 6
    closed = 'exec "$0" -m gpvo evaluate "$1" >&-'
    done = subprocess.run(["sh", "-c", closed, sys.executable, UNSEEN], stderr=subprocess.PIPE, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_name_that_the_terminal_cannot_show_stops_no_command(tmp_path: Path):
    """As in a locale of ASCII, or in a pipe on Windows: it ended in a traceback, with the work done."""
    run = shutil.copytree(UNSEEN, tmp_path / "Flüge 飛行")
    env = {**os.environ, "PYTHONIOENCODING": "ascii"}
    words = [sys.executable, "-m", "gpvo", "info", str(run)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=env)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Fl\\xfcge \\u98db\\u884c" in done.stdout
    env = {**os.environ, "PYTHONUTF8": "0", "LC_ALL": "C"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=env)
    assert done.returncode == 0 or "(set PYTHONUTF8=1, or rename the file)" in done.stderr


def test_tables_fit_80_columns():
    done = gpvo("evaluate", UNSEEN, "--model", MODEL, "--truth-sigma", "0.01")
    rows = [
        line for line in done.stdout.splitlines() if line.startswith(("method", "triangulation_", "pointing_", "base"))
    ]
    assert len(rows) >= 6
    assert all(len(line) <= 80 for line in rows)
    assert any("+truth" in line for line in rows)


def test_several_runs_are_predicted_and_judged_together(tmp_path: Path):
    runs = [str(ROOT / "data" / f"tunnel-{k}") for k in (1, 2, 3)]
    done = gpvo("predict", MODEL, *runs, "-o", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"tunnel-{k}.parquet" for k in (1, 2, 3)]
    shutil.copytree(runs[0], tmp_path / "run")
    refused = gpvo("predict", MODEL, str(tmp_path / "run"), "-o", str(tmp_path / "run" / "truth.parquet"))
    assert refused.returncode == 2
    assert "is another file, not an earlier file of predictions" in refused.stderr
    told = gpvo("evaluate", *runs).stdout
    assert "mean of the 3 runs" in told
    assert "with the truth's own noise taken into account" in told
    two = gpvo("evaluate", *runs[:2]).stdout
    assert "mean of the 2 runs: too few for an interval" in two


@pytest.mark.parametrize(
    "words",
    [("evaluate", UNSEEN, "--json"), ("predict", MODEL, UNSEEN, "-o", "out.parquet"), ("check", MODEL, UNSEEN),
     ("publish", UNSEEN, "-o", "out", "--json")],
    ids=lambda words: words[0],
)  # fmt: skip
def test_what_takes_minutes_of_a_long_run_shows_on_a_terminal_that_it_works(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    assert "runs" not in gpvo(*words, folder=tmp_path).stderr
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    done = gpvo(*words, folder=tmp_path)
    assert "runs" in done.stderr
    assert "0/1" not in done.stdout


def test_a_model_that_does_not_fit_is_named_at_once_and_at_the_end(tmp_path: Path):
    from dataclasses import replace

    from gpvo.io.run import read_run, write_run
    from gpvo.types import VoLog

    run = read_run(UNSEEN)
    assert run.log.camera is not None
    wide = replace(run.log.camera, baseline_m=0.6)
    records = [replace(r, disparity_p50_px=9 * r.disparity_p50_px, brightness=0.01, contrast=9.0) for r in run.log]
    write_run(tmp_path / "other", VoLog(records, wide), truth=run.truth, imu=run.imu, mounting=run.mounting)
    for words in (("evaluate",), ("report", "-o", str(tmp_path / "r.html"))):
        done = gpvo(words[0], str(tmp_path / "other"), "--model", MODEL, *words[1:])
        assert done.returncode == 0, done.stderr
        lines = done.stderr.strip().splitlines()
        assert "tunnel.gpvo does not fit other: baseline is 0.6" in done.stderr
        assert "do not fly it there" in lines[-1]
    fused = gpvo("fuse", str(tmp_path / "other"), "--model", MODEL, "--policies", "triangulation,learned")
    assert "the model does not fit: baseline is 0.6" in fused.stderr


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a terminal")
@pytest.mark.parametrize(
    ("bar", "words"),
    [
        ("logs", ["import", f"{UNSEEN}/trajectory.tum", "-o", "run"]),
        ("files", ["info", UNSEEN]),
        ("pages", ["report", UNSEEN, "-o", "report.html"]),
    ],
)
def test_a_long_log_is_not_worked_on_in_silence(tmp_path: Path, bar: str, words: list[str]):
    """A million poses take minutes: on a terminal, a bar shows that something happens."""
    reader, writer = os.openpty()
    line = [sys.executable, "-m", "gpvo", *words]
    with subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=writer, cwd=tmp_path) as process:
        os.close(writer)
        shown = b""
        with suppress(OSError):  # what Linux says at the end
            while part := os.read(reader, 4096):
                shown += part
    os.close(reader)
    assert process.returncode == 0, shown
    assert f"{bar} ".encode() in shown


@pytest.mark.parametrize(
    ("slow", "words"),
    [
        ("gpvo.learning.store", ["train", "a", "-o", "m.gpvo"]),
        ("gpvo.twin.replicate", ["evaluate", "a", "--twins"]),
        ("gpvo.twin.replicate", ["twin", "a", "-o", "twins"]),
        ("gpvo.evaluation.fusion", ["fuse", "a", "--twins"]),
    ],
)
def test_a_terminal_shows_something_before_what_takes_seconds_to_load(slow: str, words: list[str]):
    script = f"""
import io, os, sys
from gpvo.cli import app, output
from rich.console import Console
shown = io.StringIO()
output._terminal = lambda: Console(file=shown, force_terminal=True)
class Watching:
    def find_spec(self, name, *_):
        if name == {slow!r}:
            print(bool(shown.getvalue()), file=sys.__stdout__, flush=True)
            os._exit(0)
sys.meta_path.insert(0, Watching())
app({words!r})
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stdout == "True\n", done.stderr


def test_one_of_anything_is_not_a_plural(tmp_path: Path):
    assert [counted(n, "window") for n in (0, 1, 2)] == ["0 windows", "1 window", "2 windows"]
    (tmp_path / "log.tum").write_text("1.0 0 0 0 0 0 0 1\n")
    done = gpvo("import", str(tmp_path / "log.tum"), "-o", str(tmp_path / "run"))
    assert done.stdout == f"{tmp_path / 'run'}: 1 record, 0 with truth\n"
