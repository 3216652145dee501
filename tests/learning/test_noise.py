"""Mean and input-dependent noise: against a known truth, with heavy tails, with a base, out of fold, repeatable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.learning.folds import group_folds
from gpvo.learning.noise import HeteroscedasticFit, HeteroscedasticOptions, fit_heteroscedastic
from gpvo.learning.tails import fit_tail, log_fisher, log_scale_score, log_second_moment
from synthetic_errors import Problem, gaussian_nll, make_problem

SMALL = HeteroscedasticOptions(regressor="sparse", inducing=64, noise_inducing=48, max_folds=4)


def gap_and_coverage(fit: HeteroscedasticFit, test: Problem) -> tuple[float, float]:
    """Nats above the true density, and the share of errors within one sigma."""
    mean, var = fit.predict(test.X)
    covered = np.mean(np.abs(test.Y - mean) < np.sqrt(var))
    return gaussian_nll(test.Y, mean, var) - test.true_nll(), float(covered)


def test_nearly_the_true_density_from_3000_rows() -> None:
    train, test = make_problem(3000, 11), make_problem(6000, 12)
    gap, covered = gap_and_coverage(fit_heteroscedastic(train.X, train.Y, train.run), test)
    assert gap < 0.05
    assert 0.66 < covered < 0.70


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_within_a_twentieth_of_a_nat_from_20000_rows(seed: int) -> None:
    train, test = make_problem(20_000, seed), make_problem(20_000, seed + 100)
    gap, covered = gap_and_coverage(fit_heteroscedastic(train.X, train.Y, train.run), test)
    assert gap < 0.05
    assert abs(covered - 0.68) < 0.01


def two_scales(n: int, seed: int, nu: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """X (n, 2), Y (n, 2), true sigma (n, 2), groups: no mean, noise that depends on the first input."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((n, 2))
    sigma = np.exp(np.stack([-2.0 + X[:, 0], 1.0 - 0.5 * X[:, 0]], 1))
    e = rng.standard_normal((n, 2)) if np.isinf(nu) else rng.standard_t(nu, (n, 2))
    return X, sigma * e, sigma, np.arange(n) // 100


def test_heavy_tails_are_found_and_the_second_moment_published() -> None:
    X, Y, sigma, groups = two_scales(4000, 0, nu=5.0)
    fit = fit_heteroscedastic(X, Y, groups, use_mean=np.zeros(2, bool), options=SMALL)
    assert (fit.nu > 4.0).all()
    assert (fit.nu < 6.5).all()
    _, var = fit.predict(X)
    ratio = var / (sigma**2 * 5.0 / 3.0)
    assert abs(np.log(ratio).mean()) < 0.1
    assert np.log(ratio).std() < 0.15


def test_gross_errors_do_not_spread() -> None:
    """One row in 200 is off by a thousand sigmas; a mean square would state 5,000 times the variance everywhere."""
    X, Y, sigma, groups = two_scales(3000, 1)
    Y[::200] *= 1000.0
    fit = fit_heteroscedastic(X, Y, groups, use_mean=np.zeros(2, bool), options=SMALL)
    ratio = fit.predict(X)[1] / sigma**2
    assert 1.0 < np.median(ratio) < 2.5
    assert np.log(ratio).std() < 0.2


def test_gaussian_residuals_are_called_gaussian() -> None:
    X, Y, sigma, groups = two_scales(3000, 2)
    fit = fit_heteroscedastic(X, Y, groups, use_mean=np.zeros(2, bool), options=SMALL)
    assert (fit.nu > 25).all()
    assert abs(np.mean(Y**2 / fit.predict(X)[1]) - 1.0) < 0.05
    np.testing.assert_allclose(np.log(fit.predict(X)[1] / sigma**2).std(), 0.0, atol=0.15)


def test_axes_without_mean_have_none() -> None:
    problem = make_problem(450, 3)
    fit = fit_heteroscedastic(
        problem.X, problem.Y, problem.run, use_mean=np.array([1, 0, 0, 1, 0, 0], bool), options=SMALL
    )
    out = fit.basis.predict(problem.X)
    unused = [1, 2, 4, 5]
    assert (out.mean[:, unused] == 0).all()
    assert (out.epistemic_var[:, unused] == 0).all()
    assert (np.ptp(out.mean[:, [0, 3]], axis=0) > 0.1).all()
    assert (fit.oof_mean[:, unused] == 0).all()


def test_a_base_that_tells_all_leaves_a_constant_ratio() -> None:
    X, Y, sigma, groups = two_scales(3000, 4)
    base = 2 * np.log(sigma) - 1.0
    fit = fit_heteroscedastic(X, Y, groups, base_log_var=base, use_mean=np.zeros(2, bool), options=SMALL)
    ratio = fit.basis.predict(X).log_noise_var
    np.testing.assert_allclose(ratio.mean(0), 1.0, atol=0.12)
    assert (ratio.std(0) < 0.15).all()
    np.testing.assert_allclose(fit.predict(X, base)[1], np.exp(ratio + base))


def test_one_profile_per_output_is_no_worse() -> None:
    train, test = make_problem(800, 5), make_problem(4000, 6)
    common, _ = gap_and_coverage(fit_heteroscedastic(train.X, train.Y, train.run, options=SMALL), test)
    own_options = replace(SMALL, profile="output")
    own_fit = fit_heteroscedastic(train.X, train.Y, train.run, options=own_options)
    own, _ = gap_and_coverage(own_fit, test)
    assert own_fit.basis.mean.projection.ndim == 3
    assert own < common + 0.01


def test_residuals_are_out_of_fold() -> None:
    """Shifting one fold's targets must not change what is predicted there."""
    problem = make_problem(2000, 7)
    options = HeteroscedasticOptions(regressor="sparse", inducing=40, noise_inducing=32, rounds=1)
    before = fit_heteroscedastic(problem.X, problem.Y, problem.run, options=options)
    rows = before.fold == 0
    assert len(np.unique(problem.run[rows])) == 1
    error_in = np.mean((problem.Y - before.basis.predict(problem.X).mean) ** 2)
    error_out = np.mean((problem.Y - before.oof_mean) ** 2)
    assert error_out > error_in
    spread = np.exp(before.oof_log_noise_var) + before.oof_epistemic_var
    np.testing.assert_allclose(((problem.Y - before.oof_mean) ** 2 / spread).mean(), 1.0, atol=0.05)


def test_the_same_data_and_seed_give_the_same_bits() -> None:
    problem = make_problem(500, 8)
    fits = [fit_heteroscedastic(problem.X, problem.Y, problem.run, options=SMALL) for _ in range(2)]
    first, second = (fit.basis.to_arrays() for fit in fits)
    assert first.keys() == second.keys()
    for name in first:
        assert first[name].tobytes() == second[name].tobytes(), name


def test_far_from_the_data_all_variance_grows() -> None:
    problem = make_problem(1000, 9)
    fit = fit_heteroscedastic(problem.X, problem.Y, problem.run, options=SMALL)
    inside = fit.basis.predict(problem.X)
    outside = fit.basis.predict(problem.X.mean(0) + 300 * problem.X.std(0) * np.eye(8))
    assert (outside.epistemic_var.min(0) >= inside.epistemic_var.max(0) - 1e-12).all()
    assert (outside.log_noise_spread.min(0) >= inside.log_noise_spread.max(0) - 1e-12).all()


def test_folds_keep_groups_whole() -> None:
    groups = np.repeat(["a", "b", "c", "d", "e"], [50, 10, 10, 20, 30])
    fold = group_folds(groups, 3)
    assert set(fold) == {0, 1, 2}
    for g in np.unique(groups):
        assert len(set(fold[groups == g])) == 1
    assert np.bincount(fold).max() == 50
    blocks = group_folds(np.zeros(100), 4)
    assert (np.diff(blocks) >= 0).all()
    assert np.bincount(blocks).tolist() == [25, 25, 25, 25]


@pytest.mark.parametrize("nu", [3.5, 8.0, np.inf])
def test_score_and_information_of_the_log_scale(nu: float) -> None:
    rng = np.random.default_rng(0)
    t = rng.standard_normal(400_000) if np.isinf(nu) else rng.standard_t(nu, 400_000)
    score = log_scale_score(t**2, nu)
    assert abs(score.mean()) < 5e-3
    assert score.var() == pytest.approx(float(log_fisher(nu)), rel=0.02)
    found, log_scale = fit_tail(9.0 * t**2, np.ones(len(t)), heavy=True)
    assert log_scale == pytest.approx(np.log(9.0), abs=0.03)
    assert 1 / found == pytest.approx(1 / nu, abs=0.01)
    assert float(log_second_moment(nu)) == pytest.approx(0.0 if np.isinf(nu) else np.log(nu / (nu - 2)))


def test_shapes_are_checked() -> None:
    problem = make_problem(100, 0)
    with pytest.raises(ValueError, match="99 groups"):
        fit_heteroscedastic(problem.X, problem.Y, problem.run[:99])
    with pytest.raises(ValueError, match=r"base_log_var \(100, 2\)"):
        fit_heteroscedastic(problem.X, problem.Y, problem.run, base_log_var=np.zeros((100, 2)))
    with pytest.raises(ValueError, match="profile"):
        fit_heteroscedastic(problem.X, problem.Y, problem.run, options=HeteroscedasticOptions(profile="none"))


def test_a_mean_sees_the_inputs_it_was_given_alone():
    """Noise of one input, mean of another: the mean is found, and the first changes nothing of it."""
    rng = np.random.default_rng(8)
    X = rng.uniform(-2.0, 2.0, (1500, 2))
    truth = np.sin(2.0 * X[:, 1:])
    Y = np.hstack([truth, -truth]) + np.exp(0.8 * X[:, :1]) * 0.1 * rng.standard_normal((1500, 2))
    options = HeteroscedasticOptions(regressor="sparse", inducing=64)
    fitted = fit_heteroscedastic(X, Y, np.repeat(np.arange(5), 300), mean_inputs=np.array([1]), options=options)
    probe = np.stack([np.full(9, -1.5), np.linspace(-1.8, 1.8, 9)], axis=1)
    other = probe + [3.0, 0.0]
    mean, noise = fitted.basis.predict(probe).mean, fitted.basis.predict(probe).log_noise_var
    np.testing.assert_allclose(fitted.basis.predict(other).mean, mean, rtol=1e-9)
    assert np.abs(mean[:, 0] - np.sin(2.0 * probe[:, 1])).max() < 0.05
    assert np.abs(fitted.basis.predict(other).log_noise_var - noise - 4.8).max() < 1.2
