"""A seeded regression problem shaped like odometry errors, whose true density is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RUN_ROWS = 500


@dataclass(frozen=True)
class Problem:
    """X (n, 8) inputs, Y (n, 6) outputs, ``mean`` and ``sigma`` (n, 6) of the true density, ``run`` (n,) labels."""

    X: Array
    Y: Array
    mean: Array
    sigma: Array
    run: NDArray[np.int64]

    def true_nll(self) -> float:
        """Mean negative log density of Y under the truth, per output."""
        return gaussian_nll(self.Y, self.mean, self.sigma**2)


def make_problem(n: int, seed: int) -> Problem:
    """n rows in runs of 500 consecutive ones, each run a first-order Gauss-Markov walk through the inputs."""
    rng = np.random.default_rng(seed)
    n_runs = -(-n // RUN_ROWS)
    state = rng.standard_normal((n_runs, 6))
    states = np.empty((n_runs, RUN_ROWS, 6))
    for k in range(RUN_ROWS):
        states[:, k] = state
        state = 0.9 * state + np.sqrt(1 - 0.81) * rng.standard_normal((n_runs, 6))
    speed, turn, texture, depth, light, shake = states.reshape(-1, 6)[:n].T
    X = np.stack(
        [
            np.logaddexp(0.0, 1.2 * speed) - 0.9,
            np.abs(turn) ** 1.2 - 0.8,
            2.0 * np.tanh(0.8 * texture + 0.4 * light),
            1.5 * np.tanh(1.0 + texture - 0.6 * np.abs(turn)),
            0.7 * depth - 0.5 * texture,
            0.4 * np.logaddexp(0.0, speed) + 0.6 * np.abs(turn) + 0.3 * rng.standard_normal(n),
            light,
            shake,
        ],
        axis=1,
    )
    mean, log_sigma = _mean(X), _log_sigma(X)
    sigma = np.exp(log_sigma)
    return Problem(X, mean + sigma * rng.standard_normal((n, 6)), mean, sigma, np.arange(n) // RUN_ROWS)


def _mean(X: Array) -> Array:
    return 0.8 * np.stack(
        [
            np.tanh(X[:, 0]) * (1.0 - 0.4 * X[:, 2]) + 0.4 * np.sin(1.3 * X[:, 4]),
            0.7 * X[:, 1] * np.exp(-0.3 * X[:, 3] ** 2) + 0.4 * np.cos(1.1 * X[:, 6]),
            0.8 * np.sin(1.2 * X[:, 4] + 0.8 * X[:, 0]) + 0.3 * X[:, 5],
            0.7 * np.tanh(X[:, 1] * X[:, 2]) + 0.4 * X[:, 7],
            0.8 * np.sin(1.5 * X[:, 5]) * np.tanh(1 - X[:, 3]),
            0.5 * X[:, 0] * X[:, 4] / (1 + 0.5 * X[:, 4] ** 2) + 0.4 * X[:, 1],
        ],
        axis=1,
    )


def _log_sigma(X: Array) -> Array:
    common = -0.6 + 0.6 * np.tanh(-X[:, 3]) + 0.35 * X[:, 4]
    own = np.stack([0.15 * (j % 3) * X[:, 5] + 0.2 * np.sin(X[:, 6] + j) for j in range(6)], axis=1)
    return np.clip(common[:, None] + own, -2.3, 0.8)


def gaussian_nll(Y: Array, mean: Array, var: Array) -> float:
    """Mean over rows and outputs [nats]."""
    return float(np.mean(0.5 * np.log(2 * np.pi * var) + 0.5 * (Y - mean) ** 2 / var))
