"""The log-variance GP against known truths: found within sequences, nothing where there is nothing, out of folds."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.dataset.build import group_folds
from gpvo.learning.logvariance import fit_log_variance, log_ratio


def drawn(n_groups: int, seed: int, *, nu: float = np.inf, level: float = 0.5):
    """Inputs (n, 2), squared ratios (n, 6), groups, and the true log ratio of the first input alone, shared by all."""
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(n_groups), 300)
    X = rng.standard_normal((len(group), 2))
    truth = np.sin(1.5 * X[:, 0])
    of_group = level * rng.standard_normal(n_groups)[group]
    e = rng.standard_normal((len(group), 6)) if np.isinf(nu) else rng.standard_t(nu, (len(group), 6))
    return X, e**2 * np.exp(truth + of_group)[:, None], group, truth


@pytest.mark.parametrize("nu", [np.inf, 4.0])
def test_what_changes_within_sequences_is_found_whatever_their_levels(nu: float) -> None:
    X, ratio, group, truth = drawn(6, 0, nu=nu, level=1.0)
    gp = fit_log_variance(X, ratio, np.ones(len(X)), group)
    found = log_ratio(gp, X)
    assert np.corrcoef(found.mean(axis=1), truth)[0, 1] > 0.95
    assert np.abs((found - found.mean(axis=0)) - (truth - truth.mean())[:, None]).mean() < 0.25


def test_what_differs_between_sequences_alone_teaches_nothing() -> None:
    X, ratio, group, _ = drawn(5, 1)
    mean, _ = fit_log_variance(0.0 * X + group[:, None], ratio, np.ones(len(X)), group).evaluate(
        0.0 * X + group[:, None]
    )
    assert np.abs(mean).max() < 1e-6


def test_noise_without_a_pattern_is_nearly_constant() -> None:
    rng = np.random.default_rng(2)
    X, group = rng.standard_normal((3000, 4)), np.arange(3000) // 500
    mean, _ = fit_log_variance(X, rng.standard_normal((3000, 6)) ** 2, np.ones(3000), group).evaluate(X)
    assert mean.std() < 0.15


def test_far_from_the_rows_it_knows_nothing_and_says_so() -> None:
    X, ratio, group, _ = drawn(4, 3)
    gp = fit_log_variance(X, ratio, np.ones(len(X)), group)
    mean, variance = gp.evaluate(np.full((1, 2), 40.0))
    np.testing.assert_allclose(mean, 0.0, atol=1e-12)
    np.testing.assert_allclose(variance[0], gp.signal_var)
    assert gp.evaluate(X)[1].mean() < 0.6 * gp.signal_var.mean()


def test_the_same_rows_give_the_same_bits_and_a_row_of_weight_two_is_two_rows() -> None:
    X, ratio, group, _ = drawn(3, 4)
    ones = np.ones(len(X))
    a, b = (fit_log_variance(X, ratio, ones, group) for _ in range(2))
    assert all(np.array_equal(getattr(a, n), getattr(b, n)) for n in vars(a))
    twice = fit_log_variance(*(np.repeat(x, 2, axis=0) for x in (X, ratio, ones, group)))
    heavy = fit_log_variance(X, ratio, 2.0 * ones, group)
    np.testing.assert_allclose(log_ratio(heavy, X), log_ratio(twice, X), atol=0.02)


def test_folds_keep_groups_whole() -> None:
    groups = np.repeat(np.arange(11), np.arange(1, 12) * 7)
    fold = group_folds(groups, 4)
    assert set(fold) == {0, 1, 2, 3}
    assert all(len(set(fold[groups == g])) == 1 for g in range(11))
    blocks = group_folds(np.zeros(100), 5)
    assert (np.diff(blocks) >= 0).all()
    assert len(set(blocks)) == 5
