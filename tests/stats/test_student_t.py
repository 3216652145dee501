"""The stated Student-t: its density and its median against SciPy's, its degrees of freedom against known ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from gpvo.stats import student_t
from gpvo.stats.consistency import nees, nees_median, nll_per_dim
from scipy import stats
from scipy.integrate import quad

N = 40_000


def _drawn(nu: float, d: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, d) of a t with ``nu`` degrees of freedom, and their second moment (d, d)."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(d, d))
    C = A @ A.T + 0.1 * np.eye(d)
    z = rng.standard_normal((N, d)) @ np.linalg.cholesky(C).T
    return (z if math.isinf(nu) else z * np.sqrt((nu - 2.0) / rng.chisquare(nu, (N, 1)))), C


@pytest.mark.parametrize("nu", [2.5, 4.0, 30.0])
def test_the_density_is_that_of_scipy(nu: float) -> None:
    e, C = _drawn(nu)
    expected = -stats.multivariate_t(shape=C * (nu - 2.0) / nu, df=nu).logpdf(e[:200]) / 6
    np.testing.assert_allclose(nll_per_dim(e[:200], C, nu), expected, rtol=1e-10)


def test_many_degrees_of_freedom_are_a_gaussian() -> None:
    e, C = _drawn(math.inf)
    np.testing.assert_allclose(nll_per_dim(e, C, 1e7), nll_per_dim(e, C), atol=1e-4)


@pytest.mark.parametrize("nu", [2.5, 4.0, 30.0, math.inf])
def test_fisher_information_is_the_mean_square_of_the_score(nu: float) -> None:
    """Of a residual's log squared scale s: the score is the slope of -log density at s = 0."""
    law = stats.norm() if math.isinf(nu) else stats.t(nu)
    score = lambda x: 0.5 * ((x * x if math.isinf(nu) else (nu + 1.0) * x * x / (nu + x * x)) - 1.0)  # noqa: E731
    expected, _ = quad(lambda x: score(x) ** 2 * law.pdf(x), -np.inf, np.inf)
    assert student_t.log_fisher(nu) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("nu", [3.0, 5.0, 12.0])
def test_degrees_of_freedom_are_found_again(nu: float) -> None:
    # Over 40 seeds the log of nu - 2 had a standard deviation below 0.03 at 40,000 rows.
    for seed in range(3):
        e, C = _drawn(nu, seed=seed)
        found = student_t.fit_dof(nees(e, C), 6, np.ones(N))
        assert abs(math.log((found - 2.0) / (nu - 2.0))) < 0.15


def test_gaussian_errors_have_no_heavy_tails() -> None:
    e, C = _drawn(math.inf)
    found = student_t.fit_dof(nees(e, C), 6, np.ones(N))
    assert found == math.inf


def test_rows_count_as_often_as_they_are_told_to() -> None:
    heavy, C = _drawn(3.0)
    light, _ = _drawn(math.inf)
    squared = nees(np.concatenate([heavy, light]), C)
    count = np.repeat([1.0, 0.0], N)
    assert student_t.fit_dof(squared, 6, count) == pytest.approx(student_t.fit_dof(nees(heavy, C), 6, np.ones(N)))


@pytest.mark.parametrize("nu", [2.5, 4.0, math.inf])
def test_the_median_is_that_of_draws(nu: float) -> None:
    # The share below the median has a standard deviation of 0.0025.
    assert abs((nees(*_drawn(nu)) < nees_median(6, nu)).mean() - 0.5) < 0.01


def test_the_median_is_that_of_scipy() -> None:
    assert nees_median(6) == pytest.approx(stats.chi2.median(6), rel=1e-3)
    assert nees_median(3, 4.0) == pytest.approx(1.5 * stats.f.median(3, 4.0), rel=1e-3)
