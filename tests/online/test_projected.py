"""The projected GP: the textbook's variance, arrays survive, wrong shapes are refused."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.online.projected import NoisyGP, ProjectedGP
from gpvo.online.stored import check_arrays


def some_gp(rng: np.random.Generator, d: int = 8, D: int = 6, m: int = 40) -> ProjectedGP:
    """A posterior of random data: unit kernel on m points, diagonalised statistics."""
    points = rng.standard_normal((m, d))
    K = np.exp(-0.5 * ((points[:, None] - points[None]) ** 2).sum(2))
    eigenvalues, V = np.linalg.eigh(K)
    ratio = rng.uniform(0.1, 1.0, (D, 1))
    signal = rng.uniform(0.5, 2.0, D)
    gain = 1.0 / (eigenvalues + ratio)
    return ProjectedGP(
        centre=rng.standard_normal(d),
        lengthscale=rng.uniform(0.5, 3.0, d),
        points=points,
        projection=V.T,
        weights=gain * (V.T @ rng.standard_normal((m, D))).T,
        reduction=gain * signal[:, None],
        signal_var=signal,
        offset=rng.standard_normal(D),
    )


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


def test_arrays_round_trip() -> None:
    rng = np.random.default_rng(3)
    noisy = NoisyGP(some_gp(rng), rng.standard_normal(6))
    again = NoisyGP.from_arrays(noisy.to_arrays("thesis.0."), "thesis.0.")
    X = rng.standard_normal((5, 8))
    for a, b in zip(noisy.predict(X), again.predict(X), strict=True):
        np.testing.assert_array_equal(a, b)


def test_missing_or_misshapen_arrays_are_refused() -> None:
    arrays = NoisyGP(some_gp(np.random.default_rng(0)), np.zeros(6)).to_arrays("thesis.0.")
    check_arrays(arrays)
    with pytest.raises(ModelError, match=r"lacks the array 'thesis\.0\.mean\.points'"):
        NoisyGP.from_arrays({k: v for k, v in arrays.items() if k != "thesis.0.mean.points"}, "thesis.0.")
    for name, values in (
        ("mean.projection", np.zeros((3, 4))),
        ("mean.points", np.zeros(3)),
        ("log_noise_offset", np.zeros(2)),
    ):
        with pytest.raises(ModelError, match=r"'thesis\.0\..*' has shape"):
            check_arrays(arrays | {f"thesis.0.{name}": values})
