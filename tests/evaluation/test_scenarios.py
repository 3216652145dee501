"""Is the learned covariance true in simulated scenarios, per motion and over a distance? Few flights, wide bounds.

The full experiment is ``python -m bench.scenario_experiment``: more flights, whose means must lie within
[0.8, 1.25] per motion and [0.7, 1.5] over 1, 10 and 100 m. The eight test flights here, of few windows of 10 m each,
leave those means uncertain by about a fifth, so the bounds are twice as far from one on the log scale.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from bench.scenario_experiment import MethodScores, fly, judge, main, markdown
from gpvo.errors import GpvoError


def _scores(nees: list[list[float]]) -> MethodScores:
    return MethodScores(np.array(nees), np.ones(len(nees)), np.zeros(len(nees)), np.ones((len(nees), 2)))


def test_a_horizon_that_no_flight_reaches_is_left_blank():
    table = markdown({"short": {"learned": _scores([[1.0, 1.1, 0.9, math.nan], [1.2, 0.9, math.nan, math.nan]])}})
    cells = [c.strip() for c in table.splitlines()[-1].strip("|").split("|")]
    assert cells[:3] == ["short", "learned", "2"]
    assert cells[3].startswith("1.10 [")
    assert cells[5].startswith("0.90")
    assert cells[6] == "-"


def test_a_test_flight_that_taught_is_refused(tmp_path):
    with pytest.raises(GpvoError, match="among the training flights"):
        main(["tunnel-noise", "--train", "2", "--test-seed", "1001", "-o", str(tmp_path)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tunnel-bursts", "lunar-straight"])
def test_the_learned_covariance_is_true_on_flights_not_seen(name, tmp_path):
    scores = judge(fly(name, tmp_path, train=4, test=8, test_seed=7000, duration_s=40.0))
    frame, one, ten = scores["learned"].nees[:, :3].mean(axis=0)
    assert 0.8**2 < frame < 1.25**2
    assert 0.7**2 < one < 1.5**2
    assert scores["learned"].nll.mean() < scores["constant"].nll.mean()
    assert 0.7**2 < ten < 1.5**2
