"""A package of one's own adds a source, features and a regressor: really installed, found by its entry points."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PYPROJECT = """
[build-system]
requires = ["setuptools"]
build-backend = "setuptools.build_meta"
[project]
name = "mine"
version = "1"
[project.entry-points."gpvo.sources"]
listed = "mine:ListedSource"
[project.entry-points."gpvo.features"]
hurry = "mine:HURRY"
[project.entry-points."gpvo.regressors"]
copied = "mine:Copied"
[tool.setuptools]
py-modules = ["mine"]
"""

MODULE = '''
from pathlib import Path
from gpvo.io.tracks import TracksSource
from gpvo.learning.regressors.sparse import SparseRegressor
from gpvo.online.features import Feature, FeatureGroup, twist

class ListedSource(TracksSource):
    """A text file that names a file of tracks."""
    format = "listed"

    @staticmethod
    def recognises(path):
        return Path(path).suffix == ".listed"

    def __init__(self, path, **options):
        super().__init__(Path(Path(path).read_text().strip()), **options)

def start(camera):
    return lambda record: (float(twist(record)[4]),)

HURRY = FeatureGroup("hurry", (Feature("hurry_radps", "rad/s"),), start)

class Copied(SparseRegressor):
    name = "copied"
'''

SCRIPT = """
import sys
from dataclasses import replace
import numpy as np
from gpvo.dataset.build import build
from gpvo.io import open_source
from gpvo.learning.config import TrainConfig
from gpvo.learning.regressors import get_regressor, regressor_names
from gpvo.learning.train import train_sets
from synthetic_runs import make_run
import mine

source = open_source(sys.argv[1])
assert isinstance(source, mine.ListedSource) and len(list(source)) == 21, source
assert "copied" in regressor_names()
fitted = get_regressor("copied").fit(np.linspace(0, 1, 30)[:, None], np.linspace(0, 1, 30)[:, None] ** 2)
assert abs(fitted.predict(np.array([[0.5]]))[0][0, 0] - 0.25) < 0.01
sets = [build(*make_run(k, n=150), name=str(k)) for k in range(3)]
# Left turns are worse than right ones, which nothing built in but the turn rate's sign can tell.
sets = [replace(s, Y=s.Y * np.exp(3 * s.select(["hurry_radps"]))) for s in sets]
config = TrainConfig(features="hurry", regressor="copied")
model = train_sets(sets, config, judge=False)
assert "hurry_radps" in model.header["features"], model.header["features"]
said = [model.predictor().step(r) for r in make_run(9, n=5)[0]]
assert np.isfinite(said[-1].covariance).all()
print("found all three")
"""


@pytest.fixture
def installed(tmp_path) -> Path:
    """The folder into which pip put the package, without a network."""
    source = tmp_path / "mine"
    source.mkdir()
    (source / "pyproject.toml").write_text(PYPROJECT)
    (source / "mine.py").write_text(MODULE)
    target = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    made = subprocess.run([*pip, "--target", target, source], capture_output=True, text=True, timeout=120, check=False)
    assert made.returncode == 0, made.stderr
    assert (target / "mine-1.dist-info" / "entry_points.txt").is_file()
    return target


def test_source_features_and_regressor_of_an_installed_package(installed, tmp_path):
    from gpvo.sim.points import simulate_points

    tracks = simulate_points("tunnel-clean", 0, duration_s=1.0).save(tmp_path / "flight.npz")
    (tmp_path / "flight.listed").write_text(str(tracks))
    helpers = Path(__file__).parent.parent / "learning"
    path = os.pathsep.join(map(str, (installed, helpers)))
    child = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path / "flight.listed"],
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == "found all three"
