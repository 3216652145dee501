"""Stretches in which odometry and truth differ as nowhere else: found where they are, and in good data none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gpvo.dataset.build import build
from gpvo.dataset.odd import odd_stretches
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io.run import read_run
from synthetic_runs import make_run


@pytest.mark.parametrize("seed", range(4))
def test_good_data_has_none(seed):
    assert odd_stretches(*make_run(seed)) == []


def test_the_bundled_flights_have_none():
    data = Path(__file__).parents[2] / "data"
    runs = [read_run(p.parent) for p in sorted(data.glob("*/run.json"))]
    assert len(runs) >= 2
    assert all(odd_stretches(r.log, r.truth) == [] for r in runs if r.truth is not None)


def test_the_head_of_a_log_that_shows_half_the_motion():
    log, truth = make_run(1)
    halved = [se3.from_rt(r.T_prev_cur[:3, :3], 0.5 * r.T_prev_cur[:3, 3]) for r in log]
    log = replace(
        log, records=[replace(r, T_prev_cur=T) if 2 <= k <= 7 else r for k, (r, T) in enumerate(zip(log, halved))]
    )
    (found,) = odd_stretches(log, truth)
    assert (found.first, found.last) == (2, 7)
    assert found.what.startswith(("odometry shows 0.4", "odometry shows 0.5"))
    kept, dropped = (build(log, truth, name="a", odd=way) for way in ("keep", "drop"))
    assert kept.counts["odd"] == dropped.counts["odd"] == len(kept) - len(dropped) == 6
    with pytest.raises(GpvoError, match="unknown treatment of odd stretches: 'guess'"):
        build(log, truth, name="a", odd="guess")


def test_a_truth_that_climbs_while_the_vehicle_does_not():
    log, truth = make_run(2, n=800)
    T = truth.T_world_cam.copy()
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    # By 6 % of the way along the camera's own vertical, between two times.
    start, end = truth.t_ns[[len(T) // 4, 3 * len(T) // 8]]
    inside = (truth.t_ns >= start) & (truth.t_ns <= end)
    step = 0.06 * np.where(inside, np.gradient(path_m), 0.0)
    T[:, :3, 3] += np.cumsum(step[:, None] * T[:, :3, 1], axis=0)
    found = odd_stretches(log, replace(truth, T_world_cam=T))
    assert len(found) == 1
    assert "vertically" in found[0].what
    covered = min(found[0].t_ns[1], end) - max(found[0].t_ns[0], start)
    assert covered > 0.8 * (end - start)
