"""Autocorrelation and Allan deviation of series whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.stats.series import allan_deviation, autocorrelation

N = 40_000


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
