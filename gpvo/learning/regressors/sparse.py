"""Sparse GP regression: points by pivoted Cholesky, hyperparameters by the collapsed bound, one pass over all rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from gpvo.learning.regressors import exact
from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import Chunk, Eigenbasis, accumulate, tight_bound
from gpvo.learning.regressors.inducing import greedy_points
from gpvo.learning.regressors.likelihood import start
from gpvo.learning.regressors.numerics import Scaling, checked, fixed_threads
from gpvo.learning.regressors.rows import ArrayRows, RawChunk, Rows, draw

if TYPE_CHECKING:
    from gpvo.learning.regressors.svgp import SvgpRegressor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SparseRegressor:
    """For thousands to millions of rows: O(m^2) memory beside the rows, O(n m^2) time, m inducing points.

    Length scales are learnt on at most ``optimise_rows`` rows; signal and noise variances, and the posterior, on all.
    ``isotropic``, ``hyper``, ``guess``, ``centre_outputs``: as in
    :class:`~gpvo.learning.regressors.exact.ExactRegressor`.
    """

    inducing: int = 256
    isotropic: bool = False
    hyper: Hyperparameters | None = None
    guess: Hyperparameters | None = None
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
                guess = None if self.guess is None else scaling.scaled(self.guess)
                hyper = self._learn(sample, guess, seed)
            points = greedy_points(sample[0] / hyper.lengthscale, self.inducing, seed=seed)
            return close(rows, scaling, hyper, points, self.name, relearn=self.hyper is None)

    def _learn(self, sample: Chunk, guess: Hyperparameters | None, seed: int) -> Hyperparameters:
        """First guess from the exact likelihood of a few hundred rows, then the bound of ``optimise_rows`` rows."""
        some = np.sort(np.random.default_rng(seed).permutation(len(sample[0]))[: self.optimise_rows])
        Xs, Ys, w, count = (part[some] for part in sample)
        hyper = guess or start(Xs, Ys, w * count, isotropic=self.isotropic, seed=seed)
        bound, _ = tight_bound((Xs, Ys, w, count), hyper, self.inducing, seed=seed)
        return bound.maximise(hyper, isotropic=self.isotropic, iterations=self.max_iterations)


def exact_instead(rows: Rows, like: SparseRegressor | SvgpRegressor, seed: int) -> FittedGP:
    """The exact fit of few rows, under the name and options of ``like``."""
    X, Y, w, count = draw(rows, len(rows), seed)
    regressor = exact.ExactRegressor(
        isotropic=like.isotropic,
        hyper=like.hyper,
        centre_outputs=like.centre_outputs,
        threads=like.threads,
        device="cpu",
    )
    fitted = regressor.fit(X, Y, noise_weight=w, sample_weight=count, seed=seed)
    return replace(fitted, regressor=like.name)


def streamed_scaling(rows: Rows, *, centre_outputs: bool) -> Scaling:
    """Weighted moments of streamed rows, the pieces merged by their means and scatters (stable, one pass)."""
    total, mean, scatter, d = 0.0, np.zeros(0), np.zeros(0), 0
    for X, Y, noise, sample in rows:
        values, w, d = np.hstack([X, Y]), noise * sample, X.shape[1]
        part_total = float(w.sum())
        part_mean = w @ values / part_total
        part_scatter = w @ (values - part_mean) ** 2
        if total == 0.0:
            total, mean, scatter = part_total, part_mean, part_scatter
            continue
        delta, both = part_mean - mean, total + part_total
        mean = mean + delta * (part_total / both)
        scatter = scatter + part_scatter + delta**2 * (total * part_total / both)
        total = both
    if total == 0.0:
        raise ValueError("there are no rows")
    scale = np.sqrt(scatter / total)
    constant = ~(scale > 1e-12 * (1 + np.abs(mean)))
    constant[d:] = ~(scale[d:] > 0)
    scale[constant] = 1.0
    y_centre = mean[d:] if centre_outputs else np.zeros(len(mean) - d)
    return Scaling(mean[:d], scale[:d], y_centre, scale[d:])


def standardised(chunk: RawChunk, scaling: Scaling) -> Chunk:
    """A chunk of rows as zero-mean, unit-variance columns."""
    return scaling.inputs(chunk[0]), scaling.outputs(chunk[1]), chunk[2], chunk[3]


def close(rows: Rows, scaling: Scaling, hyper: Hyperparameters, points: Array, name: str, *, relearn: bool) -> FittedGP:
    """One pass over all rows: with ``relearn`` the signal and noise variances too, then the optimal posterior.

    ``hyper`` and ``points`` (m, d) (over the length scales) belong to the standardised data.
    """

    def stream() -> Iterator[Chunk]:
        for chunk in rows:
            yield standardised(chunk, scaling)

    sums = accumulate(stream(), points, hyper.lengthscale)
    basis = Eigenbasis.of(sums, points)
    if relearn:
        hyper = basis.maximise(sums, hyper)
    evidence = basis.bound(sums, hyper) - sums.count * np.log(scaling.y_scale).sum()
    gp = basis.posterior(hyper, scaling, points)
    return FittedGP(gp, scaling.unscaled(hyper), float(evidence), name, len(rows))
