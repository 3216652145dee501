"""Images with a known cause of error give that error: a small version of the simulator's experiment."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("numba", reason="images need the extra gpvo[sim]")
pytest.importorskip("mujoco", reason="flights need the extra gpvo[sim]")
from bench import simulator_experiment as experiment


@pytest.mark.slow
def test_clean_flights_are_exact_and_a_wrong_baseline_shows_as_scale(tmp_path: Path) -> None:
    clean = experiment.clean(tmp_path, 1)
    assert max(clean["mean_error_percent"]["values"]) < 0.4  # one flight of 9 s; over ten seeds the mean is below 0.2
    assert max(clean["drift_percent"]["values"]) < 1.0
    off = experiment.fly(seed=0, folder=tmp_path, **experiment.CLEAN, calibration_offset__baseline=0.01)
    # A longer true baseline makes disparities larger, so everything looks nearer and motions shorter.
    change = experiment.scale_percent(off.errors) - clean["scale_percent"]["values"][0]
    assert change == pytest.approx(-1.0, abs=0.2)
