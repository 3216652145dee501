"""gpvo runs on the oldest Python and the oldest packages that it claims to. ``make oldest`` runs all tests on them."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from gpvo.io.run import read_run
from gpvo.types import Status

ROOT = Path(__file__).parents[2]
FOR_ODOMETRY = ("numpy", "rich", "safetensors", "tomli", "typer", "opencv-python-headless", "pyyaml")
FRAMES = 12


def oldest_python() -> str:
    """One that starts: a version manager puts commands on the path of versions that are not chosen."""
    named = re.search(r'requires-python = ">=([\d.]+)"', (ROOT / "pyproject.toml").read_text())[1]
    kept = Path.home().glob(f".pyenv/versions/{named}.*/bin/python")
    for python in (shutil.which(f"python{named}"), *map(str, sorted(kept))):
        if python and subprocess.run([python, "--version"], capture_output=True).returncode == 0:
            return python
    pytest.skip(f"no Python {named} on this machine")


def write_sequence(folder: Path) -> None:
    """Of KITTI's layout: a wall at 8 m, and the camera moves along it by 5 cm a frame."""
    wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (240, 420), dtype=np.uint8), (0, 0), 2.0)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    for side, shift in (("image_0", 0), ("image_1", 20)):
        (folder / side).mkdir(parents=True)
        for k in range(FRAMES):
            cv2.imwrite(str(folder / side / f"{k:06d}.png"), wall[:, shift + 2 * k :][:, :320])
    P = "P{}: 320 0 160 {} 0 320 120 0 0 0 1 0\n"
    (folder / "calib.txt").write_text(P.format(0, 0) + P.format(1, -160))
    (folder / "times.txt").write_text("".join(f"{0.05 * k}\n" for k in range(FRAMES)))


@pytest.mark.slow
def test_images_are_run_on_the_oldest_python_and_packages(tmp_path: Path) -> None:
    python = oldest_python()
    floors = dict(re.findall(r'"([\w.-]+)>=([\d.]+)', (ROOT / "pyproject.toml").read_text()))
    subprocess.run([python, "-m", "venv", tmp_path / "venv"], check=True)
    new = str(tmp_path / "venv" / "bin" / "python")
    packages = [f"{name}=={floors[name]}.*" for name in FOR_ODOMETRY]
    pip = [new, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *packages]
    done = subprocess.run(pip, capture_output=True, text=True)
    if done.returncode and "connection" in done.stderr.lower():
        pytest.skip("no package index is reached")
    assert done.returncode == 0, done.stderr
    write_sequence(tmp_path / "sequence")
    command, alone = [new, "-m", "gpvo", "run", "sequence", "-o", "run"], {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=alone, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [r.status for r in read_run(tmp_path / "run").log] == [Status.START, *[Status.OK] * (FRAMES - 1)]
