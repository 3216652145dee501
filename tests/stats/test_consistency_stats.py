"""NEES, coverage, NLL and CRPS of statements that are known to be right, or wrong by a known factor."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from gpvo.stats.consistency import (
    by_difficulty,
    correlation_gain,
    coverage,
    crps_gaussian,
    energy_score,
    nees,
    nees_by_block,
    nll_per_dim,
    seen_axes,
    whiten,
)
from scipy import stats
from scipy.integrate import quad

N = 20_000


def _drawn(d: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Errors (N, d) drawn from as many different covariances (N, d, d)."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(N, d, d))
    C = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(d)
    return (np.linalg.cholesky(C) @ rng.standard_normal((N, d, 1)))[..., 0], C


@pytest.mark.parametrize("d", [1, 3, 6])
def test_nees_of_right_statements_has_mean_d_and_is_chi_squared(d):
    values = nees(*_drawn(d))
    # Standard deviation of the mean: sqrt(2 d / N); four of it.
    assert abs(values.mean() - d) < 4 * np.sqrt(2 * d / N)
    assert stats.kstest(values, stats.chi2(d).cdf).pvalue > 1e-3


def test_nees_of_a_variance_too_small_by_four_is_four_times_larger():
    e, C = _drawn(3)
    np.testing.assert_allclose(nees(e, C / 4), 4 * nees(e, C))


def test_nees_is_told_of_the_blocks_that_the_errors_hold():
    """Of translations alone there is no joint NEES; of the axes that count, only theirs."""
    (e, C), count = _drawn(6), lambda *given: {name: values.mean() for name, values in nees_by_block(*given).items()}
    whole = {"translation": pytest.approx(1.0, abs=0.03), "rotation": pytest.approx(1.0, abs=0.03)}
    assert count(e, C) == {**whole, "joint": pytest.approx(1.0, abs=0.03)}
    assert count(e[:, :3], C[:, :3, :3]) == {"translation": whole["translation"]}
    np.testing.assert_allclose(nees_by_block(e, C, [1, 2])["joint"], nees(e[:, 1:3], C[:, 1:3, 1:3]) / 2)
    assert nees_by_block(e, C, [1, 2]).keys() == {"translation", "joint"}


@pytest.mark.parametrize(
    ("d", "shares"), [(1, (0.683, 0.954, 0.997)), (3, (0.20, 0.74, 0.97)), (6, (0.014, 0.32, 0.83))]
)
def test_joint_ellipsoid_coverage(d, shares):
    values = nees(*_drawn(d))
    for sigma, share in zip((1, 2, 3), shares, strict=True):
        assert abs((values <= sigma**2).mean() - share) < 0.012


def test_coverage_per_axis():
    e, C = _drawn(6)
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    shares = np.array([0.6827, 0.9545, 0.9973])
    np.testing.assert_allclose(coverage(e, sigma), shares, atol=0.005)
    # Within five standard deviations of the share of errors that are drawn apart.
    assert (np.abs(coverage(e, sigma) - shares) < 5 * np.sqrt(shares * (1 - shares) / N)).all()
    np.testing.assert_allclose(coverage(e, 10 * sigma, (1.0,)), [1.0], atol=1e-9)


def test_whitened_errors_are_standard_normal():
    z = whiten(*_drawn(4))
    np.testing.assert_allclose(np.cov(z.T), np.eye(4), atol=0.04)


def test_nll_is_scipys():
    e, C = _drawn(6)
    theirs = [-stats.multivariate_normal(np.zeros(6), C[k]).logpdf(e[k]) / 6 for k in range(50)]
    np.testing.assert_allclose(nll_per_dim(e[:50], C[:50]), theirs, rtol=1e-9)


@pytest.mark.parametrize(("error", "sigma"), [(0.0, 1.0), (0.7, 0.5), (-2.0, 0.3), (1e-3, 2e-3)])
def test_crps_is_its_integral(error, sigma):
    cdf = stats.norm(0, sigma).cdf
    low = quad(lambda x: cdf(x) ** 2, min(error, 0) - 12 * sigma, error, points=[0.0] if error > 0 else None)[0]
    high = quad(lambda x: (1 - cdf(x)) ** 2, error, max(error, 0) + 12 * sigma, points=[0.0] if error < 0 else None)[0]
    assert crps_gaussian(np.array([error]), np.array([sigma]))[0] == pytest.approx(low + high, rel=1e-6)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="last axes"):
        nees(np.zeros((5, 6)), np.zeros((5, 3, 3)))


def test_the_energy_score_of_one_axis_is_its_crps():
    e, C = _drawn(1, seed=3)
    found = energy_score(e[:500], C[:500], draws=20_000)
    np.testing.assert_allclose(found, crps_gaussian(e[:500], np.sqrt(C[:500, 0]))[:, 0], rtol=0.02, atol=2e-3)


def test_the_energy_score_is_proper_and_of_no_width_the_length():
    e, C = _drawn(3, seed=4)
    right, bold, timid = (energy_score(e[:5000], f * C[:5000]).mean() for f in (1.0, 0.25, 4.0))
    assert right < min(bold, timid)
    sure = energy_score(e[:100], 1e-18 * C[:100])
    np.testing.assert_allclose(sure, np.linalg.norm(e[:100], axis=1), rtol=1e-6)


def test_the_energy_scores_of_many_errors_fill_no_memory():
    e, C = _drawn(3, seed=4)
    tracemalloc.start()
    many = energy_score(e, C)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e3 * N  # bytes; all draws of one error take 6,144
    np.testing.assert_array_equal(many[7000:7010], energy_score(e[7000:7010], C[7000:7010]))
    assert energy_score(e[0], C[0]) == many[0]


def test_right_correlations_gain_and_wrong_ones_lose():
    rng = np.random.default_rng(5)
    R = np.full((4, 4), 0.8) + 0.2 * np.eye(4)
    e = rng.standard_normal((N, 4)) @ np.linalg.cholesky(R).T
    S = np.diag([1.0, -1.0, 1.0, -1.0])
    # Of a Gaussian the gain is minus half the log determinant of the correlation, per dimension.
    expected = -0.5 * np.linalg.slogdet(R)[1] / 4
    assert correlation_gain(e, np.broadcast_to(R, (N, 4, 4))).mean() == pytest.approx(expected, abs=0.02)
    assert correlation_gain(e, np.broadcast_to(S @ R @ S, (N, 4, 4))).mean() < -0.5
    np.testing.assert_allclose(correlation_gain(e, np.broadcast_to(np.eye(4), (N, 4, 4))), 0.0, atol=1e-12)


def test_a_constant_in_changing_conditions_fails_by_difficulty():
    rng = np.random.default_rng(6)
    sigma = np.exp(rng.normal(0, 0.7, N))
    e = sigma[:, None] * rng.standard_normal((N, 2))
    told = (sigma**2)[:, None, None] * np.eye(2)
    nees_dof, covered = by_difficulty(e, told)
    np.testing.assert_allclose(nees_dof, 1.0, atol=0.06)
    np.testing.assert_allclose(covered, 0.6827, atol=0.02)
    blunted = (sigma**1.0)[:, None, None] * np.eye(2)  # half of what is to be known of each motion's difficulty
    nees_dof, _ = by_difficulty(e, blunted)
    assert nees_dof[0] < 0.7 < 1.6 < nees_dof[3]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 80.0])
def test_the_axes_that_count_do_not_depend_on_the_size_of_the_rig(scale):
    """An endoscope errs by less than a micrometre in a motion; height, roll and pitch in a plane are rounding."""
    e = 4e-4 * scale * np.random.default_rng(0).standard_normal((500, 6)) * [1.0, 0.2, 2.0, 0.3, 1.0, 0.2]
    e[:, 3:] /= scale
    assert seen_axes(e).tolist() == [0, 1, 2, 3, 4, 5]
    plane = [1, 3, 5]
    e[:, plane] = 4e-7 * min(scale, 1.0) * np.random.default_rng(1).standard_normal((500, 3))
    assert seen_axes(e).tolist() == [0, 2, 4]


def test_an_odometry_that_is_its_own_truth_shows_no_axis():
    rounding = 4e-7 * np.random.default_rng(0).standard_normal((500, 6))
    for e in (rounding, 0.0 * rounding, rounding[:0]):
        assert len(seen_axes(e)) == 0
