"""The shim on other people's odometry, each sequence and each system left out, on small simulated logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bench.shim_experiment import run
from gpvo.files import read_json
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.trajectory import write_tum
from synthetic_runs import make_run


def _logs(folder: Path) -> Path:
    """Three flights of one system, the first of another one too."""
    for k in range(3):
        out = folder / f"flight{k}"
        out.mkdir(parents=True)
        log, truth = make_run(k, n=250, geometry=False)
        for name, T in (("a", log.trajectory()), ("truth", truth.T_world_cam)):
            write_tum(out / f"{name}.tum", log.t_ns, T_FLU_OPTICAL @ T @ se3.inverse(T_FLU_OPTICAL))
    (folder / "flight0" / "b.tum").write_bytes((folder / "flight0" / "a.tum").read_bytes())
    return folder


@pytest.mark.slow
def test_each_sequence_and_each_system_left_out(tmp_path: Path) -> None:
    logs = _logs(tmp_path / "logs")
    found = run(logs, tmp_path / "out", ("within", "across"), ["a"])
    assert list(found) == ["within"]  # there is no other system
    found |= run(logs, tmp_path / "out", ("across",))
    assert read_json(tmp_path / "out" / "shim.json").keys() == {"across"}
    for rows, sequences in ((found["within"]["a"], 3), (found["across"]["b"], 1)):
        assert [r["sequence"] for r in rows] == [f"flight{k}" for k in range(sequences)]
        joint = np.array([r["learned"]["nees_dof"]["joint"] for r in rows])
        assert ((joint > 0.3) & (joint < 3.0)).all()
        assert all(r["learned"]["nll_per_dim"] < r["constant"]["nll_per_dim"] + 0.3 for r in rows)
    # The other system's log is a copy: a model of the one has learned from the very run of the other.
    assert "this very run" in " ".join(found["across"]["b"][0]["problems"])
