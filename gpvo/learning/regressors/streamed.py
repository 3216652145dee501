"""Rows that stream, for the sparse regressors: their scaling, and the one pass that closes a fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gpvo.learning.regressors import exact
from gpvo.learning.regressors.base import FittedGP, Hyperparameters
from gpvo.learning.regressors.collapsed import Chunk, Eigenbasis, accumulate
from gpvo.learning.regressors.numerics import Scaling
from gpvo.learning.regressors.rows import RawChunk, Rows, draw
from gpvo.types import Array


def exact_instead(rows: Rows, like: Any, seed: int) -> FittedGP:
    """The exact fit of few rows, under the name and options of a sparse regressor: every row an inducing point."""
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
