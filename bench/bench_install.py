"""What an installation weighs on disk, beside NumPy alone, and how soon the command answers. Needs a package index."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench import Rows, row

_ROOT = Path(__file__).parents[1]


def run() -> Rows:
    """Results by name."""
    with tempfile.TemporaryDirectory() as folder:
        _pip(Path(sys.executable), "wheel", "--no-deps", "--wheel-dir", folder, str(_ROOT))
        wheel = next(Path(folder).glob("gpvo-*.whl"))
        packages = {"numpy": "numpy", "gpvo": str(wheel)}
        packages |= {f"gpvo with {extra}": f"{wheel}[{extra}]" for extra in ("vo", "runs")}
        size, answer_s = {}, {}
        for name, what in packages.items():
            python, before = _environment(Path(folder) / name)
            _pip(python, "install", what)
            size[name] = _megabytes(python) - before
            if name != "numpy":
                subprocess.run([python, "-I", "-m", "gpvo", "--help"], check=True, capture_output=True)
                start = time.perf_counter()
                subprocess.run([python, "-I", "-m", "gpvo", "--help"], check=True, capture_output=True)
                answer_s[name] = time.perf_counter() - start
    rows: Rows = {}
    for name, seconds in answer_s.items():
        rows[f"install {name}"] = row(size[name] - size["numpy"], "MB", "numpy alone", size["numpy"])
        rows[f"{name} --help"] = row(seconds, "s")
    return rows


def _environment(folder: Path) -> tuple[Path, float]:
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    return python, _megabytes(python)


def _pip(python: Path, *words: str) -> None:
    subprocess.run([python, "-I", "-m", "pip", "-qq", "--disable-pip-version-check", *words], check=True)


def _megabytes(python: Path) -> float:
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    folder = Path(subprocess.run([python, "-c", where], check=True, capture_output=True, text=True).stdout.strip())
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6
