"""Sparse GP regression: points by pivoted Cholesky, hyperparameters by the collapsed bound, one pass over all rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import Chunk, tight_bound
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.likelihood import start
from gpvo.learning.regressors.numerics import checked, fixed_threads
from gpvo.learning.regressors.rows import ArrayRows, Rows, draw
from gpvo.learning.regressors.streamed import close, exact_instead, standardised, streamed_scaling
from gpvo.types import Array


@dataclass(frozen=True)
class SparseRegressor:
    """For thousands to millions of rows: O(m^2) memory beside the rows, O(n m^2) time, m inducing points.

    Length scales are learnt on at most ``optimise_rows`` rows; signal and noise variances, and the posterior, on all.
    ``isotropic``, ``hyper``, ``centre_outputs``: as in
    :class:`~gpvo.learning.regressors.exact.ExactRegressor`.
    """

    inducing: int = 256
    isotropic: bool = False
    hyper: Hyperparameters | None = None
    centre_outputs: bool = True
    optimise_rows: int = 5000
    max_iterations: int = 25
    threads: int = 1

    name: ClassVar[str] = "sparse"

    def fit(
        self,
        X: Array,
        Y: Array,
        *,
        noise_weight: Array | None = None,
        sample_weight: Array | None = None,
        seed: int = 0,
    ) -> FittedGP:
        """See :class:`~gpvo.learning.regressors.base.Regressor`."""
        return self.fit_rows(ArrayRows(*checked(X, Y, noise_weight, sample_weight)), seed=seed)

    def fit_rows(self, rows: Rows, *, seed: int = 0) -> FittedGP:
        """The same from rows that may stream; they are read three times, and at most 8,000 are held.

        With every row an inducing point the posterior is the exact one, and is computed as such.
        """
        if len(rows) <= self.inducing:
            return exact_instead(rows, self, seed)
        with fixed_threads(self.threads):
            scaling = streamed_scaling(rows, centre_outputs=self.centre_outputs)
            sample = standardised(draw(rows, max(8000, self.optimise_rows), seed), scaling)
            if self.hyper is not None:
                hyper = scaling.scaled(self.hyper)
            else:
                hyper = self._learn(sample, seed)
            points = greedy_points(sample[0] / hyper.lengthscale, self.inducing, seed=seed)
            return close(rows, scaling, hyper, points, self.name, relearn=self.hyper is None)

    def _learn(self, sample: Chunk, seed: int) -> Hyperparameters:
        """First guess from the exact likelihood of a few hundred rows, then the bound of ``optimise_rows`` rows."""
        some = np.sort(np.random.default_rng(seed).permutation(len(sample[0]))[: self.optimise_rows])
        Xs, Ys, w, count = (part[some] for part in sample)
        hyper = start(Xs, Ys, w * count, isotropic=self.isotropic, seed=seed)
        bound, _ = tight_bound((Xs, Ys, w, count), hyper, self.inducing, seed=seed)
        return bound.maximise(hyper, isotropic=self.isotropic, iterations=self.max_iterations)
