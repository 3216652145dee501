"""The projected GP: batch and single row agree, arrays survive, wrong shapes are refused."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.errors import ModelError
from gpvo.online.basis import ProjectedGP, SharedBasis


def some_gp(rng: np.random.Generator, d: int = 8, D: int = 6, m: int = 40, *, per_output: bool = False) -> ProjectedGP:
    """A posterior of random data: unit kernel on m points, diagonalised statistics."""
    points = rng.standard_normal((m, d))
    K = np.exp(-0.5 * ((points[:, None] - points[None]) ** 2).sum(2))
    eigenvalues, V = np.linalg.eigh(K)
    ratio = rng.uniform(0.1, 1.0, (D, 1))
    projection = V.T
    signal = rng.uniform(0.5, 2.0, D)
    gain = 1.0 / (eigenvalues + ratio)
    return ProjectedGP(
        centre=rng.standard_normal(d),
        lengthscale=rng.uniform(0.5, 3.0, d),
        points=points,
        projection=np.stack([projection] * D) if per_output else projection,
        weights=gain * (V.T @ rng.standard_normal((m, D))).T,
        reduction=gain * signal[:, None],
        signal_var=signal,
        offset=rng.standard_normal(D),
    )


def cases() -> dict[str, SharedBasis]:
    rng = np.random.default_rng(0)
    mean, noise = some_gp(rng), some_gp(rng, m=25)
    shared = ProjectedGP(
        mean.centre,
        mean.lengthscale,
        mean.points,
        mean.projection,
        noise_weights(rng),
        mean.reduction,
        np.ones(6),
        np.ones(6),
    )
    split, constant = some_gp(rng, per_output=True), rng.standard_normal(6)
    return {
        "own noise kernel": SharedBasis(mean, noise, constant),
        "shared kernel": SharedBasis(mean, shared, constant),
        "constant noise": SharedBasis(mean, None, constant),
        "projection per output": SharedBasis(split, noise, constant),
    }


def noise_weights(rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal((6, 40))


@pytest.mark.parametrize("case", cases())
def test_single_row_equals_batch(case: str) -> None:
    basis = cases()[case]
    rng = np.random.default_rng(1)
    X = basis.mean.centre + rng.standard_normal((200, 8)) * 1.5
    many = basis.predict(X)
    one = [basis.predict_one(x) for x in X]
    for name in many._fields:
        got, wanted = np.array([getattr(p, name) for p in one]), getattr(many, name)
        scale = {"mean": np.abs(wanted).max(), "epistemic_var": basis.mean.signal_var.max()}.get(name, 1.0)
        assert np.abs(got - wanted).max() <= 5e-6 * max(scale, np.abs(wanted).max()), name


def test_results_of_single_rows_are_not_overwritten() -> None:
    basis = cases()["own noise kernel"]
    first = basis.predict_one(np.zeros(8))
    kept = [values.copy() for values in first]
    basis.predict_one(np.ones(8))
    for values, before in zip(first, kept, strict=True):
        np.testing.assert_array_equal(values, before)


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
    basis = cases()["own noise kernel"]
    direction = np.ones(8) / np.sqrt(8)
    steps = np.linspace(5.0, 60.0, 40)
    out = basis.predict(basis.mean.centre + steps[:, None] * direction * basis.mean.lengthscale)
    assert (np.diff(out.epistemic_var, axis=0) >= -1e-12).all()
    np.testing.assert_allclose(out.epistemic_var[-1], basis.mean.signal_var)
    np.testing.assert_allclose(out.mean[-1], basis.mean.offset)
    assert basis.noise is not None
    np.testing.assert_allclose(out.log_noise_spread[-1], basis.noise.signal_var)


@pytest.mark.parametrize("case", cases())
def test_arrays_round_trip(case: str) -> None:
    basis = cases()[case]
    arrays = basis.to_arrays("gp.")
    again = SharedBasis.from_arrays(arrays, "gp.")
    assert again.shares_kernel == basis.shares_kernel
    X = np.random.default_rng(3).standard_normal((5, 8))
    for a, b in zip(basis.predict(X), again.predict(X), strict=True):
        np.testing.assert_array_equal(a, b)


def test_missing_or_misshapen_arrays_are_refused() -> None:
    arrays = cases()["own noise kernel"].to_arrays()
    with pytest.raises(ModelError, match=r"lacks the array 'mean\.points'"):
        SharedBasis.from_arrays({k: v for k, v in arrays.items() if k != "mean.points"})
    with pytest.raises(ModelError, match="projection"):
        SharedBasis.from_arrays(arrays | {"mean.projection": np.zeros((3, 4))})
    with pytest.raises(ModelError):
        SharedBasis.from_arrays(arrays | {"mean.points": np.zeros(3)})
    with pytest.raises(ModelError, match="log_noise_offset"):
        SharedBasis.from_arrays(arrays | {"log_noise_offset": np.zeros(2)})


def test_wrong_number_of_features_is_refused() -> None:
    with pytest.raises(ValueError, match="8 features"):
        cases()["constant noise"].predict(np.zeros((3, 7)))
