"""The regressors' posteriors against scikit-learn, gpytorch and one another, at equal hyperparameters."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.learning.regressors import Hyperparameters, Scaling, get_regressor
from gpvo.learning.regressors.sparse import close

HYPER = Hyperparameters(np.array([1.5, 0.8, 4.0]), signal_var=np.array([2.0, 0.5]), noise_var=np.array([0.1, 0.4]))


def some_rows(n: int = 150, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """X (n, 3), Y (n, 2) of mean zero, query rows (40, 3)."""
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((n, 3)) * [1.0, 0.5, 2.0] + [0.0, 3.0, -1.0]
    Y = np.stack([np.sin(X[:, 0]) + 0.3 * X[:, 2], np.cos(2 * X[:, 1])], 1) + 0.3 * rng.standard_normal((n, 2))
    return X, Y - Y.mean(axis=0), X[:40] + 0.3 * rng.standard_normal((40, 3))


def test_exact_equals_scikit_learn() -> None:
    gp = pytest.importorskip("sklearn.gaussian_process")
    kernels = pytest.importorskip("sklearn.gaussian_process.kernels")
    X, Y, Xq = some_rows()
    ours = get_regressor("exact", hyper=HYPER).fit(X, Y)
    mean, var = ours.predict(Xq)
    evidence = 0.0
    for j in range(2):
        kernel = kernels.ConstantKernel(HYPER.signal_var[j]) * kernels.RBF(HYPER.lengthscale)
        theirs = gp.GaussianProcessRegressor(kernel, alpha=HYPER.noise_var[j], optimizer=None).fit(X, Y[:, j])
        m, s = theirs.predict(Xq, return_std=True)
        np.testing.assert_allclose(mean[:, j], m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(var[:, j], s**2, rtol=0, atol=1e-6)
        evidence += theirs.log_marginal_likelihood_value_
    assert ours.log_evidence == pytest.approx(evidence, abs=1e-5)


def test_exact_equals_gpytorch() -> None:
    gpytorch = pytest.importorskip("gpytorch")
    torch = pytest.importorskip("torch")
    X, Y, Xq = some_rows()
    mean, var = get_regressor("exact", hyper=HYPER).fit(X, Y).predict(Xq)

    class Theirs(gpytorch.models.ExactGP):
        def __init__(self, j: int) -> None:
            noise = torch.full((len(X),), HYPER.noise_var[j], dtype=torch.float64)
            likelihood = gpytorch.likelihoods.FixedNoiseGaussianLikelihood(noise=noise)
            super().__init__(torch.tensor(X), torch.tensor(Y[:, j]), likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=3))
            self.covar_module.outputscale = float(HYPER.signal_var[j])
            self.covar_module.base_kernel.lengthscale = torch.tensor(HYPER.lengthscale)[None]

        def forward(self, x: torch.Tensor) -> gpytorch.distributions.MultivariateNormal:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    for j in range(2):
        model = Theirs(j).double().eval()
        with torch.no_grad(), gpytorch.settings.fast_computations(False, False, False):
            latent = model(torch.tensor(Xq))
            np.testing.assert_allclose(mean[:, j], latent.mean.numpy(), rtol=0, atol=1e-6)
            np.testing.assert_allclose(var[:, j], latent.variance.numpy(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["sparse", "svgp", "sklearn"])
def test_all_equal_exact_when_every_row_is_an_inducing_point(name: str) -> None:
    X, Y, Xq = some_rows(n=120, seed=1)
    more = {} if name == "sklearn" else {"inducing": len(X)}
    exact = get_regressor("exact", hyper=HYPER).fit(X, Y)
    other = get_regressor(name, hyper=HYPER, **more).fit(X, Y)
    for a, b in zip(exact.predict(Xq), other.predict(Xq), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)
    assert other.log_evidence == pytest.approx(exact.log_evidence, abs=1e-3)


def test_the_collapsed_posterior_tends_to_the_exact_one() -> None:
    """Sums over the rows, with the rows in another order as points: short length scales, so that rounding is small."""
    X, Y, Xq = some_rows(n=120, seed=1)
    short = Hyperparameters(np.array([0.3, 0.15, 0.6]), HYPER.signal_var, HYPER.noise_var)
    exact = get_regressor("exact", hyper=short).fit(X, Y)
    scaling = Scaling.of(X, Y)
    hyper, Xs = scaling.scaled(short), scaling.inputs(X)
    collapsed = close(Xs, scaling.outputs(Y), scaling, hyper, Xs[::-1] / hyper.lengthscale, relearn=False)
    for a, b in zip(exact.predict(Xq), collapsed.predict(Xq), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)
    assert collapsed.log_evidence == pytest.approx(exact.log_evidence, abs=1e-4)


def test_learnt_hyperparameters_are_as_likely_as_scikit_learns() -> None:
    """One output, so that both maximise the same function."""
    X, Y, _ = some_rows(n=200, seed=2)
    ours = get_regressor("exact").fit(X, Y[:, :1])
    theirs = get_regressor("sklearn", restarts=2).fit(X, Y[:, :1])
    assert ours.log_evidence >= theirs.log_evidence - 0.05


def test_isotropic_learns_one_length() -> None:
    X, Y, _ = some_rows(n=200, seed=3)
    for name in ("exact", "sparse", "sklearn"):
        found = get_regressor(name, isotropic=True).fit(X, Y).hyper.lengthscale / X.std(0)
        np.testing.assert_allclose(found, found[0], rtol=1e-6)
