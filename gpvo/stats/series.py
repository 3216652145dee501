"""Series: sums over windows, integrals, correlation in time (autocorrelation and Allan deviation), what in them is odd;
and intervals for means, of one series or over sequences.

D. W. Allan, "Statistics of atomic frequency standards" (1966); overlapping estimator as in IEEE Std 952-1997, annex C.
Moving blocks on a circle: D. Politis, J. Romano, "A circular block-resampling procedure for stationary data" (1992).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.stats import student_t
from gpvo.types import Array

T = TypeVar("T")
_LEVEL = 0.95  # of every interval


def median(values: Array) -> float:
    """Of (n,) numbers, NaN of none: ``np.median`` to the last bit, several times as fast for up to a thousand."""
    ordered, half = np.sort(values), len(values) // 2
    if not len(ordered) or np.isnan(ordered[-1]):
        return math.nan
    return float(ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2)


def moving_sums(values: Array, m: int) -> Array:
    """(n - m + 1, ...) sums over every m consecutive rows of values (n, ...)."""
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    return np.asarray(total[m:] - total[:-m])


def integral(values: Array, t_s: Array) -> Array:
    """(n, d) integral of values (n, d) from the first time to each of ``t_s`` (n,), by the trapezoidal rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])


def interpolated(at_s: Array, t_s: Array, values: Array) -> Array:
    """(m, d) at the times ``at_s`` (m,) between values (n, d) at ``t_s`` (n,), held beyond the ends."""
    return np.stack([np.interp(at_s, t_s, column) for column in values.T], axis=1)


def autocorrelation(values: Array, max_lag: int) -> Array:
    """Autocorrelation (max_lag + 1,) of a series (n,), 1 at lag 0; zeros where the series is constant."""
    x = np.asarray(values, dtype=np.float64) - np.mean(values)
    power = float(x @ x)
    if power == 0:
        return np.concatenate([[1.0], np.zeros(max_lag)])
    return np.array([1.0, *(float(x[:-k] @ x[k:]) / power for k in range(1, max_lag + 1))])


def allan_deviation(rate: Array, dt_s: float) -> tuple[Array, Array]:
    """Averaging times [s] and Allan deviations, in the rate's unit, of a rate (n,) sampled every ``dt_s``.

    White noise falls with the root of time, a bias that wanders makes it flat and then rise.
    """
    rate = np.asarray(rate, dtype=np.float64)
    n = len(rate)
    if n < 4:
        return np.empty(0), np.empty(0)
    sizes = np.unique(np.geomspace(1, n // 3 or 1, 25).astype(int))
    deviations = []
    for m in sizes:
        means = moving_sums(rate, int(m)) / m
        steps = means[m:] - means[:-m]
        deviations.append(np.sqrt(0.5 * np.mean(steps**2)))
    return sizes * dt_s, np.array(deviations)


class Doubt(Generic[T]):
    """Holds what looks odd beside all before, a jump of a clock or of a reading, until ``enough`` in a row agree."""

    def __init__(self, enough: int = 2) -> None:
        self._enough, self._count = enough, 0
        self._last: T | None = None

    def is_settled_by(self, odd: T, agrees: Callable[[T, T], bool]) -> bool:
        """Whether the next odd one is to be believed; ``agrees`` says whether it goes with the odd one before it."""
        self._count = self._count + 1 if self._last is not None and agrees(self._last, odd) else 1
        self._last = odd
        if self._count < self._enough:
            return False
        self.clear()
        return True

    def clear(self) -> None:
        """What came now is not odd."""
        self._count, self._last = 0, None


@dataclass(frozen=True)
class Interval:
    """A mean with its two-sided 95 % bootstrap percentile interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.3g} [{self.low:.3g}, {self.high:.3g}]"

    def document(self) -> dict[str, float | None]:
        """As scripts read it: ``mean``, ``low``, ``high``; the latter None where there is no interval."""
        low, high = (x if np.isfinite(x) else None for x in (self.low, self.high))
        return {"mean": self.mean, "low": low, "high": high}


def block_bootstrap(values: Array, block: int | None = None, *, draws: int = 2000, seed: int = 0) -> Interval:
    """Interval for the mean of one autocorrelated series (n,), by circular blocks.

    ``block`` defaults to ``ceil(2 n^(1/3))``, at least 10 frames and three times as long as the series remembers, at
    most n / 4. With fewer than 8 values the interval is (-inf, inf): nothing can be said.
    """
    values = np.asarray(values, dtype=np.float64)
    n = len(values)
    if n == 0:
        return Interval(np.nan, -np.inf, np.inf)
    if n < 8:
        return Interval(float(values.mean()), -np.inf, np.inf)
    block = block or int(min(max(np.ceil(2 * n ** (1 / 3)), 10, np.ceil(3 * _memory(values))), n // 4))
    per_draw = int(np.ceil(n / block))
    rng = np.random.default_rng(seed)
    # Sum of each circular block from a running sum, so that a draw costs n / block look-ups.
    block_mean = moving_sums(np.concatenate([values, values[:block]]), block)[:n] / block
    means = block_mean[rng.integers(0, n, (draws, per_draw))].mean(axis=1)
    return _expanded(float(values.mean()), means, max(n // block, 4))


def _expanded(mean: float, means: Array, k: int) -> Interval:
    """Interval from the ``means`` of draws of k blocks or sequences: as their spread is itself an estimate, percentiles
    are expanded by Student's t with k - 1 degrees of freedom (T. Hesterberg, "What teachers should know about the
    bootstrap", 2015, section 4.3)."""
    outside = NormalDist().cdf(-student_t.quantile(_LEVEL, k - 1) * math.sqrt(k / (k - 1)))
    low, high = np.quantile(means, [outside, 1 - outside])
    return Interval(mean, float(low), float(high))


_DIRECT_LAGS = 500


def _memory(values: Array) -> float:
    """Integrated autocorrelation time [rows], at least 1, over the first window of five times its length (A. Sokal,
    "Monte Carlo methods in statistical mechanics", 1997, section 3)."""
    x = values - values.mean()
    power, time = max(float(x @ x), 1e-300), 1.0
    products = np.zeros(0)
    for lag in range(1, len(x) // 2):
        if lag == _DIRECT_LAGS:  # Where a series changes its level, lag by lag would cost the square of its length.
            products = np.fft.irfft(np.abs(np.fft.rfft(x, 1 << (2 * len(x)).bit_length())) ** 2)
        time += 2.0 * float(x[:-lag] @ x[lag:] if lag < _DIRECT_LAGS else products[lag]) / power
        if lag >= 5.0 * time:
            break
    return max(time, 1.0)


_REACHED_BY = 7
"""Sequences whose draws reach well beyond the expanded percentiles."""


def sequence_bootstrap(values: Array, *, draws: int = 10000) -> Interval:
    """Interval for the mean over sequences (n,): whole sequences are drawn with replacement.

    For a paired comparison pass the differences. Fewer than three sequences show no spread: (-inf, inf).
    """
    values = np.asarray(values, dtype=np.float64)
    return bootstrap_over(len(values), lambda pick: values[pick].mean(axis=1), draws=draws)


def bootstrap_over(n: int, statistic: Callable[[NDArray[np.int64]], Array], *, draws: int = 10000) -> Interval:
    """The same for any ``statistic`` (draws,) of n sequences, given the indices (draws, n) of those that were drawn.

    The percentiles that up to six sequences call for lie beyond the most extreme draw or near it, which they reach too
    often: their interval is that of Student's t, by the draws' standard deviation.
    """
    value = float(statistic(np.arange(n)[None])[0]) if n else np.nan
    if n < 3:
        return Interval(value, -np.inf, np.inf)
    drawn = statistic(np.random.default_rng(0).integers(0, n, (draws, n)))
    if n >= _REACHED_BY:
        return _expanded(value, drawn, n)
    half = student_t.quantile(_LEVEL, n - 1) * math.sqrt(n / (n - 1)) * float(drawn.std())
    return Interval(value, value - half, value + half)
