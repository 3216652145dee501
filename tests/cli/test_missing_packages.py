"""What is not installed costs one line that says what to install, never a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from gpvo.io.run import read_run

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
        (("cv2", "pyarrow"), ("run", "nowhere", "-o", "unwritten"), "vo"),
        (("cv2",), ("evaluate", "nowhere"), "runs"),
        (("serial",), ("publish", RUNS[0], "--to", "mavlink", "--link", "serial:/dev/null:57600"), "mavlink"),
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


@pytest.mark.parametrize(
    "words", [("evaluate", "--stated", "said"), ("fuse", "--plot", "said.png")], ids=["evaluate", "fuse"]
)
def test_a_model_is_judged_without_what_trains_it(words: tuple[str, str, str], tmp_path: Path) -> None:
    absent = ("torch", "gpytorch", "sklearn", "scipy", "numba", "mujoco", "embreex", "rosbags")
    model = str(ROOT / "models" / "tunnel.gpvo")
    command, option, name = words
    files = ("--model", model, option, str(tmp_path / name))
    code, said = call(absent, command, str(ROOT / "data" / "unseen"), "--json", *files)
    assert code == 0, said


def test_odometry_runs_to_the_end_with_its_extra_alone(tmp_path: Path) -> None:
    rng, n = np.random.default_rng(0), 40
    landmarks = rng.uniform([-4, -3, 3], [4, 3, 25], (300, 3))
    rows = []
    for k in range(n):
        X = landmarks - [0, 0, 0.1 * k]
        u, v, d = 320 + 400 * X[:, 0] / X[:, 2], 240 + 400 * X[:, 1] / X[:, 2], 400 * 0.12 / X[:, 2]
        seen = (X[:, 2] > 1) & (abs(u - 320) < 320) & (abs(v - 240) < 240)
        rows += [(k, i, u[i], v[i], u[i] - d[i], v[i]) for i in np.flatnonzero(seen)]
    table = np.array(rows)
    noisy = (table[:, 2:] + rng.normal(0, 0.1, (len(table), 4))).astype(np.float32)
    known = {"fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0, "baseline_m": 0.12, "width": 640, "height": 480}
    ids = {"frame": table[:, 0].astype(np.int32), "track": table[:, 1].astype(np.int32)}
    np.savez(tmp_path / "t.npz", **ids, uv_left=noisy[:, :2], uv_right=noisy[:, 2:], t_s=0.05 * np.arange(n), **known)
    absent = ("pyarrow", "scipy", "matplotlib", "jinja2", "joblib", "torch", "sklearn", "pandas")
    model = str(ROOT / "models" / "tunnel.gpvo")
    words = ("run", str(tmp_path / "t.npz"), "-o", str(tmp_path / "run"), "--keep-tracks", "--model", model)
    code, said = call(absent, *words)
    assert code == 0, said
    run = read_run(tmp_path / "run")
    assert len(run.log) == n
    assert len(run.predictions) >= n - 1
