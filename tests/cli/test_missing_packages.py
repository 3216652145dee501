"""What is not installed costs one line that says what to install, never a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUNS = tuple(str(ROOT / "data" / name) for name in ("tunnel-1", "tunnel-2"))

BLOCK = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
sys.argv = ["gpvo", *{words!r}]
from gpvo.__main__ import main
main()
"""


def call(absent: tuple[str, ...], *words: str) -> tuple[int, str]:
    """Exit code and standard error of a command on a machine without some packages."""
    script = BLOCK.format(absent=set(absent), words=words)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "absent,words,extra",
    [
        (
            ("torch", "gpytorch", "sklearn"),
            ("train", *RUNS, "-o", "unwritten.gpvo"),
            "train",
        ),
        (("cv2", "pyarrow"), ("run", "nowhere", "-o", "unwritten"), "runs"),
        (("cv2",), ("evaluate", "nowhere"), "runs"),
        (("scipy", "numba", "mujoco"), ("simulate", "tunnel-clean", "-o", "unwritten"), "sim"),
    ],
)
def test_a_missing_package_is_one_line(absent: tuple[str, ...], words: tuple[str, ...], extra: str) -> None:
    code, said = call(absent, *words)
    assert code == 2, said
    assert said.count("\n") == 1
    assert f"pip install 'gpvo[{extra}]'" in said


def test_without_the_command_lines_own_packages() -> None:
    code, said = call(("typer",), "--help")
    assert code == 2
    assert said.count("\n") == 1
    assert "pip install typer" in said


def test_what_flies_needs_numpy_and_safetensors_alone() -> None:
    absent = ("cv2", "yaml", "pyarrow", "pandas", "scipy", "torch", "typer", "rich", "rosbags", "matplotlib")
    script = BLOCK.format(absent=set(absent), words=()).split("sys.argv")[0]
    script += "from gpvo.online.predictor import Predictor; import gpvo.filters.eskf; "
    script += f"print(Predictor.load({str(ROOT / 'models' / 'tunnel.gpvo')!r}).target)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.stdout == "frame\n", done.stderr
