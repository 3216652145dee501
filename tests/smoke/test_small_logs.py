"""The logs in ``data/`` are what their script makes, and every command reads them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from gpvo.io.run import read_run

DATA = Path(__file__).parents[2] / "data"
NAMES = ("tunnel-1", "tunnel-2", "tunnel-3", "tunnel-4", "unseen")


def _script() -> object:
    spec = importlib.util.spec_from_file_location("remake_data", DATA / "remake.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_they_are_whole(name: str) -> None:
    run = read_run(DATA / name)
    assert len(run.log) == 201
    assert run.truth is not None
    assert run.imu is not None
    assert run.meta["complete"]


def test_the_script_makes_the_same_again(tmp_path: Path) -> None:
    again = read_run(_script().remake("unseen", tmp_path)).log
    kept = read_run(DATA / "unseen").log
    np.testing.assert_array_equal(again.t_ns, kept.t_ns)
    for a, b in zip(again, kept, strict=True):
        assert a.status is b.status
        # Other machines add up in another order.
        np.testing.assert_allclose(a.T_prev_cur, b.T_prev_cur, rtol=0, atol=1e-6)
