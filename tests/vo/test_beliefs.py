"""Several Gaussian beliefs at once."""

import numpy as np
from gpvo.vo.beliefs import Gaussians


def test_beliefs_that_differ_in_a_few_places_are_what_one_inverse_of_each_gives():
    rng = np.random.default_rng(5)
    precision = np.repeat(np.stack([np.diag(rng.uniform(1, 9, 7)) for _ in range(2)])[:, None], 3, axis=1)
    for each in precision.reshape(6, 7, 7):
        v = rng.normal(size=3)
        each[np.ix_([1, 2, 6], [1, 2, 6])] += np.outer(v, v)
    mean, rows, weight = rng.normal(size=7), rng.normal(size=(9, 7)), rng.uniform(size=(2, 3))
    beliefs = Gaussians.of(mean, np.linalg.inv(precision))
    after, score = precision + rows.T @ rows, rng.normal(size=7)
    found = beliefs.given(rows.T @ rows, score)
    means = np.linalg.solve(after, (precision @ mean + score)[..., None])[..., 0]
    np.testing.assert_allclose(found.mean, means, rtol=1e-9)
    np.testing.assert_allclose(
        found.covariance(weight), np.einsum("lk,lkij->ij", weight, np.linalg.inv(after)), rtol=1e-9, atol=1e-12
    )
    # Completing the square: what the measurements say of each belief, up to a term that is the same for all.
    gain = np.linalg.slogdet(precision)[1] - np.linalg.slogdet(after)[1]
    expected = 0.5 * (gain + np.einsum("lki,lkij,lkj->lk", means, after, means) - mean @ precision @ mean)
    np.testing.assert_allclose(found.evidence - found.evidence[0, 0], expected - expected[0, 0], atol=1e-9)
