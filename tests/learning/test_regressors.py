"""Regressors: gradients, repeatability, units, choice by name."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.learning.regressors import Hyperparameters, Regressor, get_regressor, regressor_names
from gpvo.learning.regressors.numerics import Posterior, greedy_points, pack
from gpvo.learning.regressors.sparse import CollapsedBound, SparseRegressor
from scipy.optimize import minimize
from synthetic_errors import gaussian_nll, make_problem

QUICK = {
    "exact": {},
    "sparse": {"inducing": 48},
    "svgp": {"inducing": 32, "steps": 20, "batch": 128},
    "sklearn": {},
}


def rows(n: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    problem = make_problem(n, seed)
    return problem.X, problem.Y[:, :3]


def numerical(f, theta: np.ndarray, h: float = 1e-5) -> np.ndarray:
    out = np.empty_like(theta)
    for i in range(len(theta)):
        step = np.zeros_like(theta)
        step[i] = h
        out[i] = (f(theta + step) - f(theta - step)) / (2 * h)
    return out


@pytest.mark.parametrize("inducing", [15, 60])
def test_gradient_is_the_derivative(inducing: int) -> None:
    X, Y = rows(60)
    objective = CollapsedBound(X, Y, X[:inducing] + 0.1).value_and_gradient
    theta = np.concatenate([np.full(8, 0.6), [-0.3, 0.2, 0.1], [-0.7, -0.5, -1.0]])
    value, gradient = objective(theta)
    expected = numerical(lambda t: objective(t)[0], theta)
    np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6 * abs(value))


@pytest.mark.parametrize("inducing", [20, 60])
def test_no_other_variances_are_likelier(inducing: int) -> None:
    """By an optimiser that knows no better than to try."""
    X, Y = rows(60)
    posterior = Posterior.of(X, Y, greedy_points(X / 2.0, inducing), np.full(8, 2.0))
    signal, noise, bound = posterior.most_likely()

    def of(logs: np.ndarray) -> float:
        return -posterior.bound(Hyperparameters(np.full(8, 2.0), *np.exp(logs.reshape(2, 3))))

    found = minimize(of, np.zeros(6), method="L-BFGS-B")
    assert bound.sum() == pytest.approx(-of(np.log([signal, noise])), rel=1e-6)  # noise at its bound
    assert bound.sum() >= -found.fun - 1e-4


def test_no_other_length_is_likelier() -> None:
    """Of each output alone, against a fine grid of fits."""
    X, Y = rows(80)
    together = SparseRegressor(inducing=80).fit_each(X, Y)
    for j, fit in enumerate(together):
        tried = np.geomspace(0.1, 40.0, 60)[:, None] * X.std(axis=0)
        hyper = [Hyperparameters(length, fit.hyper.signal_var, fit.hyper.noise_var) for length in tried]
        best = max(SparseRegressor(inducing=80, hyper=h).fit(X, Y[:, j]).log_evidence for h in hyper)
        assert fit.log_evidence > best - 0.01
        alone = SparseRegressor(inducing=80, isotropic=True).fit(X, Y[:, j])
        np.testing.assert_allclose(alone.predict(X)[0], fit.predict(X)[0], rtol=1e-6, atol=1e-9)


def test_the_bound_is_the_same_by_either_way() -> None:
    X, Y = rows(60)
    hyper = Hyperparameters(np.full(8, 2.0), np.array([0.5, 0.7, 0.9]), np.array([0.4, 0.3, 0.2]))
    for inducing in (20, 60):
        points = greedy_points(X / 2.0, inducing)
        value, _ = CollapsedBound(X, Y, points * 2.0).value_and_gradient(pack(hyper))
        assert Posterior.of(X, Y, points, hyper.lengthscale).bound(hyper) == pytest.approx(-180 * value, rel=1e-8)


def test_a_rough_function_is_not_called_noise() -> None:
    """Two inputs, many periods: a few points cannot hold it, and their bound would prefer pure noise."""
    rng = np.random.default_rng(0)
    X = rng.uniform(-5, 5, (600, 2))
    Y = (np.sin(3 * X[:, :1]) * np.cos(3 * X[:, 1:])) + 0.02 * rng.standard_normal((600, 1))
    assert get_regressor("sparse", inducing=512).fit(X, Y).hyper.noise_var[0] < 0.05
    assert get_regressor("exact").fit(X, Y).hyper.noise_var[0] < 0.03**2


@pytest.mark.parametrize("name", QUICK)
def test_units_do_not_matter(name: str) -> None:
    X, Y = rows(150)
    x_unit, y_unit = np.array([1e-3, 1, 1e3, 1, 1, 50, 1, 1]), np.array([1e-4, 1.0, 30.0])
    plain = get_regressor(name, **QUICK[name]).fit(X, Y)
    other = get_regressor(name, **QUICK[name]).fit(X * x_unit + 7.0, Y * y_unit + 2.0)
    (m1, v1), (m2, v2) = plain.predict(X[:20]), other.predict(X[:20] * x_unit + 7.0)
    np.testing.assert_allclose((m2 - 2.0) / y_unit, m1, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(v2 / y_unit**2, v1, rtol=1e-2, atol=1e-4)
    assert other.log_evidence == pytest.approx(plain.log_evidence - 150 * np.log(y_unit).sum(), abs=2.0)


@pytest.mark.parametrize("name", QUICK)
def test_the_same_data_and_seed_give_the_same_bits(name: str) -> None:
    X, Y = rows(200)
    a, b = (get_regressor(name, **QUICK[name]).fit(X, Y, seed=3) for _ in range(2))
    for field in ("points", "projection", "weights", "reduction", "signal_var", "offset", "lengthscale", "centre"):
        assert getattr(a.gp, field).tobytes() == getattr(b.gp, field).tobytes(), field


def test_sparse_is_close_to_exact_and_better_than_constants() -> None:
    train, test = make_problem(900, 1), make_problem(1000, 2)
    scores = {}
    for name in ("exact", "sparse"):
        fit = get_regressor(name, threads=1).fit(train.X, train.Y)
        mean, var = fit.predict(test.X)
        scores[name] = gaussian_nll(test.Y, mean, var + fit.hyper.noise_var)
    constant = gaussian_nll(test.Y, train.Y.mean(0), train.Y.var(0))
    assert abs(scores["sparse"] - scores["exact"]) < 0.005
    assert scores["exact"] < constant - 0.05


def test_duplicate_rows_and_constant_columns_do_no_harm() -> None:
    X, Y = rows(100)
    X = np.vstack([X, X])
    X[:, 3] = 5.0
    Y = np.vstack([Y, Y])
    Y[:, 2] = 0.25
    for name in ("exact", "sparse"):
        mean, var = get_regressor(name, **QUICK[name]).fit(X, Y).predict(X)
        assert np.isfinite(mean).all()
        assert (var >= 0).all()
        np.testing.assert_allclose(mean[:, 2], 0.25, atol=1e-6)


def test_greedy_points_are_rows_without_repeats() -> None:
    X, _ = rows(100)
    U = np.vstack([X, X])
    points = greedy_points(U, 150)
    assert len(points) <= 100
    assert greedy_points(X, 100) is X
    assert len(np.unique(points, axis=0)) == len(points)
    assert {p.tobytes() for p in points} <= {u.tobytes() for u in U}


def test_choice_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    assert get_regressor("auto", n_rows=2000).name == "exact"
    assert get_regressor("auto", n_rows=2001).name == "sparse"
    assert {"exact", "sparse", "svgp", "sklearn"} <= set(regressor_names())
    with pytest.raises(GpvoError, match=r"unknown regressor 'magic'.*exact, sparse"):
        get_regressor("magic")
    for name in ("exact", "sklearn"):
        assert get_regressor(name, n_rows=10_000).name == name
        with pytest.raises(GpvoError, match=f"'{name}' learns from at most 10,000 rows, and these are 100,000"):
            get_regressor(name, n_rows=100_000)


def test_regressors_of_other_packages_join(monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        name = "mine"

        @staticmethod
        def load() -> type[Regressor]:
            return SparseRegressor

    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [Entry()])
    assert "mine" in regressor_names()
    assert get_regressor("mine", inducing=7).inducing == 7


@pytest.mark.parametrize("name", QUICK)
def test_bad_shapes_and_values_are_refused(name: str) -> None:
    X, Y = rows(20)
    regressor = get_regressor(name)
    with pytest.raises(ValueError, match=r"\(20, 8\) and \(19, 3\)"):
        regressor.fit(X, Y[:19])
    with pytest.raises(ValueError, match="finite"):
        regressor.fit(np.where(X[0, 0] == X, np.nan, X), Y)
