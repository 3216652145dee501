"""Autocorrelation and Allan deviation of series whose law is known; intervals that cover the true mean about as often
as they say.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from gpvo.stats import series, student_t
from gpvo.stats.series import Interval, allan_deviation, autocorrelation, block_bootstrap, sequence_bootstrap
from hypothesis import given
from hypothesis import strategies as st

N = 40_000
TRIALS = 300


def _slope(tau: np.ndarray, deviation: np.ndarray, low: float, high: float) -> float:
    inside = (tau >= low) & (tau <= high)
    return float(np.polyfit(np.log(tau[inside]), np.log(deviation[inside]), 1)[0])


def test_autocorrelation_of_white_ar1_and_differenced_noise():
    white = np.random.default_rng(0).standard_normal(N)
    np.testing.assert_allclose(autocorrelation(white, 5), [1, 0, 0, 0, 0, 0], atol=4 / np.sqrt(N))
    np.testing.assert_allclose(autocorrelation(np.diff(white), 3), [1, -0.5, 0, 0], atol=0.03)
    ar1 = np.zeros(N)
    for k in range(1, N):
        ar1[k] = 0.7 * ar1[k - 1] + white[k]
    np.testing.assert_allclose(autocorrelation(ar1, 4), 0.7 ** np.arange(5), atol=0.04)


def test_autocorrelation_of_a_constant_and_of_more_lags_than_values():
    np.testing.assert_array_equal(autocorrelation(np.full(9, 2.5), 3), [1, 0, 0, 0])
    assert autocorrelation(np.array([1.0, -1.0]), 4).shape == (5,)


def test_allan_deviation_of_white_noise_falls_with_the_root_of_time():
    tau, deviation = allan_deviation(0.3 * np.random.default_rng(1).standard_normal(N), 0.05)
    assert tau[0] == pytest.approx(0.05)
    assert deviation[0] == pytest.approx(0.3, rel=0.02)
    assert _slope(tau, deviation, 0.05, 20.0) == pytest.approx(-0.5, abs=0.05)


def test_allan_deviation_of_a_random_walk_rises_with_the_root_of_time():
    walk = np.cumsum(np.random.default_rng(2).standard_normal(N))
    tau, deviation = allan_deviation(walk, 0.05)
    assert _slope(tau, deviation, 0.5, 30.0) == pytest.approx(0.5, abs=0.1)


def test_allan_deviation_of_differenced_noise_falls_with_time():
    tau, deviation = allan_deviation(np.diff(np.random.default_rng(3).standard_normal(N)), 0.05)
    assert _slope(tau, deviation, 0.05, 10.0) == pytest.approx(-1.0, abs=0.05)


def test_allan_deviation_of_a_ramp_and_of_too_little():
    tau, deviation = allan_deviation(np.arange(300) * 0.1, 1.0)
    np.testing.assert_allclose(deviation, 0.1 * tau / np.sqrt(2), rtol=1e-9)
    assert allan_deviation(np.ones(3), 0.1)[0].size == 0


def _ar1(rho: float, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x = np.empty(n)
    x[0] = rng.standard_normal()
    for k in range(1, n):
        x[k] = rho * x[k - 1] + np.sqrt(1 - rho**2) * rng.standard_normal()
    return x


def _share(intervals: list[Interval], value: float) -> float:
    return float(np.mean([i.low <= value <= i.high for i in intervals]))


@pytest.mark.parametrize(
    ("rho", "n", "least"),
    [(0.0, 500, 0.92), (0.5, 500, 0.90), (0.8, 500, 0.88), (0.98, 5000, 0.88), (0.98, 1000, 0.83), (0.0, 8, 0.92)],
)
def test_block_bootstrap_covers_an_autocorrelated_mean(rho, n, least):
    """Nominal 95 %: a series that is not many times as long as its memory loses some of it."""
    series = [3.0 + _ar1(rho, n, seed) for seed in range(TRIALS)]
    share = _share([block_bootstrap(x, draws=400) for x in series], 3.0)
    assert least < share < 0.995


@pytest.mark.parametrize("nu", [2, 3, 4, 7, 30])
def test_quantiles_of_students_t_are_scipys(nu):
    from scipy.stats import t as students

    for level in (0.9, 0.95):
        assert student_t.quantile(level, nu) == pytest.approx(students.ppf((1 + level) / 2, nu), rel=2e-6)


def test_single_frames_as_blocks_are_overconfident():
    series = [_ar1(0.8, 500, seed) for seed in range(TRIALS)]
    assert _share([block_bootstrap(x, block=1, draws=400) for x in series], 0.0) < 0.65


@pytest.mark.parametrize(("n", "least"), [(3, 0.92), (4, 0.92), (5, 0.93), (6, 0.93), (12, 0.92), (24, 0.92)])
def test_sequence_bootstrap_covers_the_mean_over_sequences(n, least):
    """Nominal 95 %. From the least to the largest of three or four is 75 and 88 %; percentiles of five have 91 %."""
    rng = np.random.default_rng(0)
    intervals = [sequence_bootstrap(1.0 + rng.standard_normal(n), draws=2000) for _ in range(TRIALS)]
    assert least < _share(intervals, 1.0) < 0.98


@pytest.mark.parametrize("n", [3, 4, 5, 6])
def test_the_interval_of_few_sequences_is_students_t(n):
    from scipy.stats import sem
    from scipy.stats import t as students

    x = np.random.default_rng(n).lognormal(size=n)
    found = sequence_bootstrap(x)
    expected = students.interval(0.95, n - 1, x.mean(), sem(x))
    np.testing.assert_allclose((found.low, found.high), expected, atol=0.05 * (expected[1] - expected[0]))


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


@pytest.mark.parametrize("n", [300, 3000, 3001])
def test_memory_of_a_series_is_that_of_its_lags_one_by_one(n):
    """Also where it changes its level, and remembers itself over thousands of rows: found without all pairs of rows."""
    x = np.random.default_rng(4).chisquare(6, n) * np.where(np.arange(n) < n // 2, 1.0, 8.0)
    rho, memory = autocorrelation(x, n // 2 - 1), 1.0
    for lag in range(1, n // 2):
        memory += 2.0 * rho[lag]
        if lag >= 5.0 * memory:
            break
    np.testing.assert_allclose(series._memory(x), memory, rtol=1e-12)


def test_interval_of_a_long_series_that_changes_its_level_costs_few_products():
    class Counted(np.ndarray):
        products = 0

        def __matmul__(self, other):
            Counted.products += 1
            return np.asarray(self) @ np.asarray(other)

    series._memory(np.repeat([1.0, 8.0], 10_000).view(Counted))
    assert 0 < Counted.products < 2000


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=9).map(np.array))
def test_the_median_is_numpys_to_the_last_bit(values):
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        np.testing.assert_array_equal(series.median(values), np.median(values))
