"""The projected GP: the textbook's variance."""

from __future__ import annotations

import numpy as np
from gpvo.online.projected import ProjectedGP
from some_gp import some_gp


def test_single_row_equals_batch() -> None:
    rng = np.random.default_rng(0)
    gp = some_gp(rng)
    X = gp.centre + rng.standard_normal((5000, 8)) * 1.5  # more than are worked out at a time
    for k in (0, 1, 4095, 4096, 4999):
        for one, many in zip(gp.evaluate(X[k : k + 1]), gp.evaluate(X), strict=True):
            np.testing.assert_allclose(one[0], many[k], rtol=1e-9, atol=1e-12)


def test_variance_matches_the_textbook() -> None:
    rng = np.random.default_rng(2)
    gp = some_gp(rng, D=1)
    K = gp.kernel(gp.points * gp.lengthscale + gp.centre)
    X = rng.standard_normal((20, 8))
    k = gp.kernel(X)
    eta = 1.0 / (gp.reduction[0, -1] / gp.signal_var[0]) - np.linalg.eigvalsh(K)[-1]
    textbook = gp.signal_var[0] * (1 - (k * np.linalg.solve(K + eta * np.eye(len(K)), k.T).T).sum(1))
    np.testing.assert_allclose(gp.evaluate(X)[1][:, 0], textbook, atol=1e-9)


def test_far_away_the_prior_returns_and_variance_never_falls_on_the_way() -> None:
    gp = some_gp(np.random.default_rng(0))
    steps = np.linspace(5.0, 60.0, 40)
    mean, variance = gp.evaluate(gp.centre + steps[:, None] * np.ones(8) / np.sqrt(8) * gp.lengthscale)
    assert (np.diff(variance, axis=0) >= -1e-12).all()
    np.testing.assert_allclose(variance[-1], gp.signal_var)
    np.testing.assert_allclose(mean[-1], gp.offset)


def test_a_constant_says_the_same_of_every_place() -> None:
    mean, variance = ProjectedGP.constant(np.arange(6.0)).evaluate(np.array([[0.0], [7.0]]))
    np.testing.assert_array_equal(mean, [np.arange(6.0)] * 2)
    assert not variance.any()
