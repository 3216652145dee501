"""Calibration: second moments under heavy tails, new sequences, conformal intervals."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.geometry.covariance import correlation
from gpvo.learning.basefit import fit_coefficients
from gpvo.learning.calibrate import (
    Scale,
    conformal_quantiles,
    fit_outside_power,
    fit_scale,
)
from gpvo.online.base import parts
from gpvo.online.guard import growth
from gpvo.stats.student_t import negative_log_likelihood, scatter, second_moment
from scipy.optimize import minimize


def test_second_moment_of_a_gaussian_and_of_a_t():
    rng = np.random.default_rng(0)
    assert second_moment(4.0 * rng.standard_normal((4000, 1)) ** 2) == pytest.approx(4.0, rel=0.1)
    heavy = second_moment(rng.standard_t(5, (4000, 10)) ** 2)
    assert np.mean(heavy) == pytest.approx(5 / 3, rel=0.12)


def test_one_jump_does_not_set_the_scale():
    square = np.random.default_rng(1).standard_normal((2000, 1)) ** 2
    square[7] = 1e6
    assert second_moment(square) < 1.5


@pytest.mark.parametrize("share", [0.49, 0.51, 0.6])
def test_residuals_at_rest_leave_one_jump_as_little_weight(share):
    """Where most are zero, so is the median: the fit must not take the Gaussian's word, a thousand times too large."""
    square = np.random.default_rng(1).standard_t(4, (200, 1)) ** 2
    square[: int(200 * share)] = 0.0
    square[-1] = 1e6
    assert second_moment(square) < 1.0


def test_a_new_sequence_is_covered():
    """Scales drawn per sequence: the mean NEES of new ones stays near one, where pooling would do no worse."""
    rng = np.random.default_rng(2)
    stated = []
    for _ in range(200):
        scale = np.exp(0.5 * rng.standard_normal(6))
        z = np.concatenate([np.sqrt(c) * rng.standard_normal((200, 6)) for c in scale])
        fitted = fit_scale(z, np.repeat(np.arange(6), 200))
        stated.append(np.exp(0.125) / fitted.factor.mean())
    assert 0.85 < np.mean(stated) < 1.15


def test_growth_outside_is_as_seen_and_as_expected_where_nothing_was_seen():
    rng = np.random.default_rng(6)
    distance, group = rng.uniform(0.0, 20.0, 400), np.repeat(np.arange(20), 20)
    for power in (0.25, 1.5, 2.0):
        square = growth(distance, power) * rng.chisquare(6, 400) / 6
        assert fit_outside_power(distance, square, group) == max(power, 1.0)
    assert fit_outside_power(np.zeros(400), np.ones(400), group) == 1.0


def test_conformal_intervals_cover_new_groups():
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(300):
        scale = np.exp(0.4 * rng.standard_normal(11))
        score = [np.abs(s * rng.standard_normal(100)) for s in scale]
        widths, sure = conformal_quantiles(np.concatenate(score[:10]), np.repeat(np.arange(10), 100))
        assert sure == [True, True, True, True, False]
        inside.append([(score[10] <= w).mean() for w in widths])
    assert (np.mean(inside, axis=0)[:4] >= np.array([0.5, 0.6827, 0.8, 0.9]) - 0.02).all()


def test_a_long_flight_counts_as_one_and_few_flights_show_little():
    group = np.concatenate([np.zeros(1000, dtype=int), np.repeat(np.arange(1, 20), 10)])
    score = np.where(group == 0, 10.0, 1.0)
    widths, _ = conformal_quantiles(score, group)
    assert widths == [1.0] * 4 + [10.0]  # one of twenty, and the new one unknown
    # Of two flights that are alike, a third may differ by what is expected of flights: worth two groups beside one.
    np.testing.assert_allclose(Scale.of_new_group(np.ones((2, 6))).spread, 0.3 * np.sqrt(2 / 3))


def test_correlation_of_heavy_tailed_residuals():
    rng = np.random.default_rng(4)
    R = np.array([[1, 0.8], [0.8, 1]])
    z = rng.standard_normal((5000, 2)) @ np.linalg.cholesky(R).T / np.sqrt(rng.chisquare(4, (5000, 1)) / 4)
    np.testing.assert_allclose(correlation(scatter(z)), R, atol=0.05)


def test_base_variance_finds_its_parts():
    rng = np.random.default_rng(5)
    n = 6000
    twist = rng.normal(size=(n, 6)) * [1, 1, 5, 0.1, 0.3, 0.1]
    columns = np.concatenate([twist, rng.normal(size=(n, 6)), 0.5 * rng.normal(size=(n, 1))], axis=1)
    dt = np.full(n, 0.1)
    terms = parts(columns, dt)
    theta = np.array([0.1, 0.0, 2.0, 0.0, 0.5])
    error = np.sqrt(terms @ theta) * rng.standard_normal((n, 6))
    fitted = fit_coefficients(terms, error, np.ones(n))
    ratio = np.log((terms * fitted).sum(axis=-1) / (terms @ theta))
    # The heavy-tailed likelihood finds the shape; its scale is set later, by calibration.
    assert np.abs(ratio - ratio.mean(axis=0)).mean() < 0.1


def test_coefficients_are_as_likely_as_those_of_another_optimiser():
    rng = np.random.default_rng(5)
    n = 600
    columns = np.hstack([rng.standard_normal((n, 6)), np.log(rng.uniform(0.5, 2.0, (n, 7)))])
    terms, weight = parts(columns, np.full(n, 0.1)), rng.uniform(0.5, 1.5, n)
    error = np.sqrt((terms * [0.3, 0.0, 1.0, 0.1, 0.2]).sum(axis=-1)) * rng.standard_t(5, (n, 6))
    found = fit_coefficients(terms, error, weight)

    def loss(theta, j):
        return float(weight @ negative_log_likelihood(error[:, j] ** 2, terms[:, j] @ theta) / weight.sum())

    for j in range(6):
        start = np.maximum(found[j], 1e-4) * rng.uniform(0.5, 2.0, 5)
        other = minimize(loss, start, (j,), method="L-BFGS-B", bounds=[(1e-9, None)] * 5, options={"ftol": 1e-12})
        assert loss(found[j], j) < other.fun + 1e-6
