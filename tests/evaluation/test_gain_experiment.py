"""What the Gaussian process adds, on a few small simulated flights."""

from __future__ import annotations

from pathlib import Path

import pytest
from bench.gain_experiment import SETS, Place, judge, markdown


@pytest.mark.slow
def test_poses_alone_show_how_good_they_are_by_their_jerk(tmp_path: Path) -> None:
    """Nothing but poses is known of flights with bursts of noise: the base variance, which sees how fast the vehicle
    is, cannot tell a burst; the process tells it by the jerk."""
    row = judge("bursts-poses", Place(tmp_path, tmp_path, 5, 20.0))
    assert (row["sequences"], row["inputs"]) == (5, "agility")
    assert row["high"] < -0.2
    assert row["set"] in markdown([row])


def test_at_least_ten_sets_are_named_beforehand() -> None:
    assert len({title for title, _ in SETS.values()}) >= 10
