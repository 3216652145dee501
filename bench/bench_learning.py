"""Speed and size of learning and prediction beside scikit-learn and gpytorch, every party on one thread."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from bench import Rows, median_s, row

_ROOT = Path(__file__).resolve().parents[1]
_TESTS = _ROOT / "tests" / "learning"
sys.path.insert(0, str(_TESTS))

from gpvo.learning.logvariance import fit_log_variance  # noqa: E402
from gpvo.learning.regressors import get_regressor  # noqa: E402
from gpvo.online import modelfile  # noqa: E402
from gpvo.online.projected import ProjectedGP  # noqa: E402
from synthetic_errors import Problem, gaussian_nll, make_problem  # noqa: E402

entry = partial(row, smaller_wins=True)

N = 2000


@dataclass(frozen=True)
class Fit:
    """GPs of the mean and of the log noise variance of six outputs."""

    mean: ProjectedGP
    log_noise: ProjectedGP

    def predict(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and total variance, (n, 6) each."""
        (mean, epistemic_var), (log_noise, spread) = (gp.evaluate(X) for gp in (self.mean, self.log_noise))
        return mean, np.exp(log_noise + 0.5 * spread) + epistemic_var


def fit_mean_and_noise(problem: Problem) -> Fit:
    """The mean by the sparse regressor, the noise by the GP of the log variance of what it leaves."""
    mean = get_regressor("sparse").fit(problem.X, problem.Y)
    centre, scale = problem.X.mean(axis=0), problem.X.std(axis=0)
    U, ones = (problem.X - centre) / scale, np.ones(len(problem.X))
    left = (problem.Y - mean.predict(problem.X)[0]) ** 2
    noise = fit_log_variance(U, left / left.mean(axis=0), ones, problem.run)
    stated, spread = noise.evaluate(U)
    level = np.log((left * np.exp(-stated - 0.5 * spread)).mean(axis=0))
    return Fit(mean.gp, replace(noise, centre=centre, lengthscale=noise.lengthscale * scale, offset=level))


def prediction(fit: Fit, rows: np.ndarray) -> Rows:
    """One row: mean, aleatoric and epistemic variance of six outputs; mean and standard deviation by the peers."""
    few = make_problem(N, 1)

    def microseconds(call: Callable[[np.ndarray], Any], repeats: int, warm_up: int) -> float:
        return 1e6 * median_s(lambda k: call(rows[k % len(rows)]), repeats, warm_up=warm_up)

    ours = microseconds(lambda x: fit.predict(x[None]), 5000, 500)
    from_sklearn = microseconds(sklearn_predictor(few), 100, 5)
    from_gpytorch = microseconds(gpytorch_predictor(few), 100, 20)
    return {
        "predict_one_us": entry(ours, "us", "scikit-learn GaussianProcessRegressor, n=2000", from_sklearn),
        "predict_one_us_vs_gpytorch": entry(ours, "us", "gpytorch ExactGP, n=2000, fast_pred_var", from_gpytorch),
    }


def sklearn_predictor(few: Problem) -> Callable[[np.ndarray], Any]:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel(0.5) * RBF(np.full(8, 2.5)) + WhiteKernel(0.7)
    model = GaussianProcessRegressor(kernel, optimizer=None, normalize_y=True).fit(few.X, few.Y)
    return lambda x: model.predict(x[None], return_std=True)


def gpytorch_predictor(few: Problem) -> Callable[[np.ndarray], Any]:
    import gpytorch

    class Model(gpytorch.models.ExactGP):
        """Six outputs as a batch that shares nothing but the inputs: what gpytorch's tutorial suggests."""

        def __init__(self, X: torch.Tensor, Y: torch.Tensor, likelihood: Any) -> None:
            super().__init__(X, Y, likelihood)
            batch = torch.Size([6])
            self.mean_module = gpytorch.means.ConstantMean(batch_shape=batch)
            base = gpytorch.kernels.RBFKernel(ard_num_dims=8, batch_shape=batch)
            self.covar_module = gpytorch.kernels.ScaleKernel(base, batch_shape=batch)

        def forward(self, x: torch.Tensor) -> Any:
            normal = gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))
            return gpytorch.distributions.MultitaskMultivariateNormal.from_batch_mvn(normal)

    likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=6)
    model = Model(torch.tensor(few.X).float(), torch.tensor(few.Y).float(), likelihood).eval()

    def predict(x: np.ndarray) -> Any:
        with torch.no_grad(), gpytorch.settings.fast_pred_var():
            out = likelihood.eval()(model(torch.as_tensor(x, dtype=torch.float32)[None]))
            return out.mean.numpy(), out.variance.numpy()

    return predict


def loading(fit: Fit) -> Rows:
    """Import of everything that flies, the model file, and one prediction, in a fresh interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.gpvo"
        modelfile.save(path, fit.mean.to_arrays(), {"features": []})
        code = f"""
import json, time
def megabytes():
    return int(next(l for l in open("/proc/self/status") if l.startswith("VmRSS")).split()[1]) / 1024
before, begin = megabytes(), time.perf_counter()
import numpy as np
import gpvo.online.predictor
from gpvo.online import modelfile
from gpvo.online.projected import ProjectedGP
ProjectedGP.from_arrays(modelfile.load({str(path)!r})[0]).evaluate(np.zeros((1, 8)))
print(json.dumps([time.perf_counter() - begin, megabytes() - before]))
"""
        found = np.array([child(code) for _ in range(7)])
    seconds, megabytes = np.median(found, axis=0)
    return {"import_load_s": entry(float(seconds), "s"), "import_load_mb": entry(float(megabytes), "MB")}


def training(test: Problem) -> Rows:
    """2,000 rows to hyperparameters and posterior; held-out NLL beside the time."""
    few = make_problem(N, 1)
    out: Rows = {}
    begin = time.perf_counter()
    theirs, peer_nll = sklearn_fit(few, test)
    peer_s = time.perf_counter() - begin - theirs
    for name in ("sparse", "exact"):
        begin = time.perf_counter()
        fit = get_regressor(name).fit(few.X, few.Y)
        seconds = time.perf_counter() - begin
        mean, var = fit.predict(test.X)
        nll = gaussian_nll(test.Y, mean, var + fit.hyper.noise_var)
        out[f"train_2000_{name}_s"] = entry(seconds, "s", "scikit-learn GaussianProcessRegressor", peer_s)
        out[f"train_2000_{name}_nll"] = entry(nll, "nats", "scikit-learn GaussianProcessRegressor", peer_nll)
    return out


def sklearn_fit(few: Problem, test: Problem) -> tuple[float, float]:
    """Seconds spent on predicting the test rows (not to be counted), and their NLL."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    centre, scale = few.X.mean(0), few.X.std(0)
    kernel = ConstantKernel(1.0) * RBF(np.ones(8), (1e-2, 1e3)) + WhiteKernel(1.0)
    model = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit((few.X - centre) / scale, few.Y)
    begin = time.perf_counter()
    mean, std = model.predict((test.X - centre) / scale, return_std=True)
    return time.perf_counter() - begin, gaussian_nll(test.Y, mean, std**2)


def scale(n_large: int = 100_000, n_huge: int = 1_000_000) -> Rows:
    """Mean and noise of six outputs: seconds at 100,000 rows, seconds and peak memory at 1,000,000."""
    code = """
import json, sys, time
sys.path[:0] = [{root!r}]
from bench.bench_learning import fit_mean_and_noise, make_problem
problem = make_problem({n}, 1)
begin = time.perf_counter()
fit_mean_and_noise(problem)
seconds = time.perf_counter() - begin
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([seconds, int(peak.split()[1]) / 1024**2]))
"""
    (large_s, large_gb), (huge_s, huge_gb) = (child(code.format(root=str(_ROOT), n=n)) for n in (n_large, n_huge))
    return {
        "train_100k_s": entry(large_s, "s"),
        "train_100k_peak_gb": entry(large_gb, "GB"),
        "train_1m_s": entry(huge_s, "s"),
        "train_1m_peak_gb": entry(huge_gb, "GB"),
    }


def honesty(fit: Fit, test: Problem, seconds: float) -> Rows:
    """20,000 rows of known truth: nats per output above the true density, and what one sigma covers."""
    mean, var = fit.predict(test.X)
    covered = float(np.mean(np.abs(test.Y - mean) < np.sqrt(var)))
    return {
        "known_truth_nll": entry(gaussian_nll(test.Y, mean, var), "nats", "the true density", test.true_nll()),
        "known_truth_coverage_1_sigma": entry(covered, "share", "a Gaussian", 0.6827),
        "train_20k_mean_and_noise_s": entry(seconds, "s"),
    }


def child(code: str) -> list[float]:
    """What a fresh interpreter prints as JSON."""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(out.stdout)


def run() -> Rows:
    """All of it: about four minutes."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            train, test = make_problem(20_000, 1), make_problem(20_000, 101)
            begin = time.perf_counter()
            fit = fit_mean_and_noise(train)
            seconds = time.perf_counter() - begin
            rows = make_problem(500, 7).X
            out = prediction(fit, rows) | loading(fit) | honesty(fit, test, seconds)
            return out | training(make_problem(4000, 2)) | scale()
    finally:
        torch.set_num_threads(threads)


if __name__ == "__main__":
    print(json.dumps(run(), indent=1))
