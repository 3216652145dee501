"""The live view writes what it would show; without rerun it says how to get it."""

from __future__ import annotations

import builtins
import sys
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from gpvo.accumulation import along
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.io.run import read_run
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from gpvo.types import MotionError, Status, StereoCamera


def test_without_rerun_one_line_names_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    from gpvo.evaluation.pictures import LiveView

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
    from gpvo.evaluation.pictures import LiveView

    flight = simulate_points("tunnel-clean", 0, duration_s=5.0, rate_hz=10.0).save(tmp_path / "flight.npz")
    source = open_source(flight)
    view = LiveView(source.camera, "flight", tmp_path / "flight.rrd")
    run(source, tmp_path / "run", on_frame=view.show)
    assert (tmp_path / "flight.rrd").stat().st_size > 10_000
    assert len(view._path) == 51
    assert np.isfinite(view._path).all()


def test_the_path_goes_on_over_a_break(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where VO begins anew after darkness the pose is a guess, and what is drawn later is of it and of its doubt."""
    from gpvo.evaluation.pictures import LiveView

    viewer = MagicMock()
    monkeypatch.setitem(sys.modules, "rerun", viewer)
    flight = simulate_points("tunnel-clean", 0, duration_s=8.0, rate_hz=10.0, dark=(1.0, 7.0)).save(tmp_path / "f.npz")
    source = open_source(flight)
    view = LiveView(source.camera, "flight", tmp_path / "flight.rrd")
    run(source, tmp_path / "run", on_frame=view.show)
    log = read_run(tmp_path / "run").log
    assert any(r.status is Status.LOST and r.is_reference for r in log)
    assert len(view._path) == 1 + log.usable.sum()
    np.testing.assert_allclose(view._path[-1], log.trajectory()[-1, :3, 3], atol=1e-9)
    errors = [MotionError.independent(C) for C in log.covariance(log.methods[0])]
    sigma = np.sqrt(np.linalg.eigvalsh(along(log.T_prev_cur, errors, log.parent)[1][-1, :3, :3]))
    np.testing.assert_allclose(viewer.Ellipsoids3D.call_args.kwargs["half_sizes"], [3 * sigma], rtol=1e-6)
