"""The models in ``models/`` are what their script makes, carry their scores, and speak about the logs in ``data/``."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from gpvo.io.run import read_run
from gpvo.learning.store import card_path
from gpvo.online.predictor import Predictor
from gpvo.types import Array, Prediction

ROOT = Path(__file__).parents[2]
MODELS = sorted((ROOT / "models").glob("*.gpvo"))


def _script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("remake_models", ROOT / "models" / "remake.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _predictions(model: Path) -> list[Prediction]:
    return list(Predictor.load(model).replay(read_run(ROOT / "data" / "unseen").log).values())


def _ln_sigma(predictions: list[Prediction]) -> Array:
    return np.array([0.5 * np.log(np.diag(p.covariance)) for p in predictions])


def test_each_has_a_line_in_the_script() -> None:

    assert {path.stem for path in MODELS} == set(_script().MODELS)


@pytest.mark.parametrize("path", MODELS, ids=lambda p: p.stem)
def test_it_speaks_and_its_card_has_the_scores(path: Path) -> None:
    for prediction in _predictions(path):
        assert np.linalg.eigvalsh(prediction.covariance).min() > 0
    assert "\n| learned | " in card_path(path).read_text()
    assert path.stat().st_size < 1_000_000


@pytest.mark.slow
def test_the_script_makes_the_same_again(tmp_path: Path) -> None:
    again = _predictions(_script().remake("tunnel", tmp_path))
    kept = _predictions(ROOT / "models" / "tunnel.gpvo")
    # Other machines add up in another order, and a fit that stops a step earlier is as good: 5 % of sigma.
    np.testing.assert_allclose(_ln_sigma(again), _ln_sigma(kept), atol=0.05)
