"""Intervals cover the true mean about as often as they say."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.stats.bootstrap import Interval, block_bootstrap, sequence_bootstrap

TRIALS = 300


def _ar1(rho: float, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = np.empty(n)
    x[0] = rng.standard_normal()
    for k in range(1, n):
        x[k] = rho * x[k - 1] + np.sqrt(1 - rho**2) * rng.standard_normal()
    return x


def _share(intervals: list[Interval], value: float) -> float:
    return float(np.mean([i.contains(value) for i in intervals]))


@pytest.mark.parametrize(("rho", "least"), [(0.0, 0.90), (0.5, 0.88), (0.8, 0.80)])
def test_block_bootstrap_covers_an_autocorrelated_mean(rho, least):
    """Nominal 95 %: short blocks lose some of it, the more the longer the memory."""
    series = [3.0 + _ar1(rho, 500, seed) for seed in range(TRIALS)]
    share = _share([block_bootstrap(x, draws=400) for x in series], 3.0)
    assert least < share < 0.985


def test_single_frames_as_blocks_are_overconfident():
    series = [_ar1(0.8, 500, seed) for seed in range(TRIALS)]
    assert _share([block_bootstrap(x, block=1, draws=400) for x in series], 0.0) < 0.65


def test_sequence_bootstrap_covers_the_mean_over_sequences():
    rng = np.random.default_rng(0)
    intervals = [sequence_bootstrap(1.0 + rng.standard_normal(12), draws=1000) for _ in range(TRIALS)]
    assert 0.85 < _share(intervals, 1.0) < 0.98


def test_too_little_says_nothing():
    for found in (block_bootstrap(np.ones(7)), sequence_bootstrap(np.ones(1))):
        assert (found.mean, found.low, found.high) == (1.0, -np.inf, np.inf)
    for found in (block_bootstrap(np.empty(0)), sequence_bootstrap(np.empty(0))):
        assert np.isnan(found.mean)


def test_a_constant_has_no_width_and_the_seed_decides():
    found = block_bootstrap(np.full(50, 2.0))
    assert found.low == pytest.approx(2.0)
    assert found.high == pytest.approx(2.0)
    x = _ar1(0.5, 100, 1)
    assert block_bootstrap(x, seed=3) == block_bootstrap(x, seed=3)
    assert block_bootstrap(x, seed=3) != block_bootstrap(x, seed=4)
    assert str(Interval(1.0, 0.5, 1.5)) == "1 [0.5, 1.5]"
