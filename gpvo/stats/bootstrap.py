"""Intervals for means of autocorrelated series and of sequences.

Moving blocks on a circle: D. Politis, J. Romano, "A circular block-resampling procedure for stationary data" (1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpvo.stats.series import moving_sums
from gpvo.types import Array


@dataclass(frozen=True)
class Interval:
    """A mean with its two-sided bootstrap percentile interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3g} [{self.low:.3g}, {self.high:.3g}]"

    def document(self) -> dict[str, float | None]:
        """As scripts read it: ``mean``, ``low``, ``high``; the latter None where there is no interval."""
        low, high = (x if np.isfinite(x) else None for x in (self.low, self.high))
        return {"mean": self.mean, "low": low, "high": high}

    def contains(self, value: float) -> bool:
        """Whether ``value`` lies inside, ends included."""
        return self.low <= value <= self.high


def block_bootstrap(
    values: Array, block: int | None = None, *, level: float = 0.95, draws: int = 2000, seed: int = 0
) -> Interval:
    """Interval for the mean of one autocorrelated series (n,), by circular blocks.

    ``block`` defaults to ``ceil(2 n^(1/3))``, at least 10 frames, at most n / 4. With fewer than 8 values the
    interval is (-inf, inf): nothing can be said.
    """
    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    if n == 0:
        return Interval(np.nan, -np.inf, np.inf)
    if n < 8:
        return Interval(float(values.mean()), -np.inf, np.inf)
    block = block or int(min(max(np.ceil(2 * n ** (1 / 3)), 10), n // 4))
    per_draw = int(np.ceil(n / block))
    rng = np.random.default_rng(seed)
    # Sum of each circular block from a running sum, so that a draw costs n / block look-ups.
    block_mean = moving_sums(np.concatenate([values, values[:block]]), block)[:n] / block
    means = block_mean[rng.integers(0, n, (draws, per_draw))].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(values.mean()), float(low), float(high))


def sequence_bootstrap(values: Array, *, level: float = 0.95, draws: int = 10000, seed: int = 0) -> Interval:
    """Interval for the mean over sequences (n,): whole sequences are drawn with replacement.

    For a paired comparison pass the differences. Fewer than three sequences show no spread: (-inf, inf).
    """
    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    if n < 3:
        return Interval(float(values.mean()) if n else np.nan, -np.inf, np.inf)
    rng = np.random.default_rng(seed)
    means = values[rng.integers(0, n, (draws, n))].mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(values.mean()), float(low), float(high))
