"""Pooling over seeds, the two residuals, the intervals."""

import numpy as np
import pytest
from gpvo.reproduce.bounds import Bounds
from gpvo.reproduce.rows import expected_length, pooled, score


def flights(seeds, said=1.0, mean=0.0, n=40):
    """Errors that are one draw per flight, growing with time: what a wrong calibration makes."""
    out = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        grown = np.linspace(1e-3, 1.0, n)[:, None]
        error = grown * (mean + rng.standard_normal(3))
        covariance = said**2 * grown[:, :, None] ** 2 * np.eye(3)
        out.append(Bounds(f"f{seed}", np.arange(n) * 0.1, np.arange(n), error, mean * grown * np.ones(3), covariance))
    return out


def test_an_honest_statement_has_a_ratio_of_one_and_half_a_residual():
    s = score(flights(200))
    assert s["ratio_interval"][0] < 1.0 < s["ratio_interval"][1]
    assert s["ratio"] == pytest.approx(1.0, abs=0.15)
    assert s["vector_over_rmse"] == pytest.approx(1.0)
    # |x| of a normal vector in space: standard deviation over root mean square.
    assert s["magnitude_over_rmse"] == pytest.approx(np.sqrt(1 - 8 / (3 * np.pi)), abs=0.05)
    assert s["coverage_3_sigma"] == pytest.approx(0.997, abs=0.006)


def test_twice_the_sigma_is_twice_the_ratio():
    assert score(flights(50, said=2.0))["ratio"] == pytest.approx(2 * score(flights(50))["ratio"])


def test_a_known_mean_leaves_a_smaller_vector():
    s = score(flights(50, said=1.0, mean=5.0))
    assert s["vector_over_rmse_interval"][1] < 0.3
    assert 0.8 < s["ratio"] < 1.2


def test_two_seeds_say_nothing_of_an_interval():
    assert score(flights(2))["ratio_interval"] is None
    assert pooled(np.ones(3), np.ones(3))[1][0] == pytest.approx(1.0)


def test_the_interval_over_five_seeds_knows_how_few_they_are():
    """500 sets of right statements, whose true ratio is 1: a plain bootstrap holds it in 79 %, this one in 87 %."""
    rng, inside = np.random.default_rng(1), 0
    for _ in range(500):
        variance = rng.lognormal(0.0, 0.3, 5)
        low, high = pooled(3 * variance, variance * (rng.standard_normal((5, 3)) ** 2).sum(axis=1))[1]
        inside += low <= 1.0 <= high
    assert 0.83 <= inside / 500 <= 0.99


def test_expected_length_against_draws():
    rng = np.random.default_rng(3)
    mean = np.array([[0.0, 0, 0], [1, 2, 3], [0, 0, 0], [4, 0, 0]])
    spread = np.array([[1.0, 1, 1], [0.1, 2, 0.5], [1, 0, 0], [1e-6, 1e-6, 1e-6]])
    found = expected_length(mean, spread[:, :, None] ** 2 * np.eye(3))
    drawn = np.linalg.norm(mean[:, None] + spread[:, None] * rng.standard_normal((4, 40000, 3)), axis=2).mean(1)
    np.testing.assert_allclose(found, drawn, rtol=0.01)
