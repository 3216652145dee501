"""The live view writes what it would show; without rerun it says how to get it."""

from __future__ import annotations

import builtins
from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from gpvo.types import StereoCamera


def test_without_rerun_one_line_names_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    from gpvo.evaluation.live_view import LiveView

    real = builtins.__import__

    def refuse(name: str, *rest: object, **more: object) -> object:
        if name == "rerun":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(GpvoError, match="gpvo\\[viz\\]"):
        LiveView(StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480), "run")


def test_a_run_lands_in_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs the extra gpvo[viz]")
    from gpvo.evaluation.live_view import LiveView

    flight = simulate_points("tunnel-clean", 0, duration_s=5.0, rate_hz=10.0).save(tmp_path / "flight.npz")
    source = open_source(flight)
    view = LiveView(source.camera, "flight", tmp_path / "flight.rrd")
    run(source, tmp_path / "run", on_frame=view.show)
    assert (tmp_path / "flight.rrd").stat().st_size > 10_000
    assert len(view._path) == 51
    assert np.isfinite(view._path).all()
