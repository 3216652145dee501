"""The chi-square gate: when a measurement disagrees with the filter by more than both admit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

# Share of a Gaussian within three standard deviations: the confidence of a "3-sigma" gate in any dimension.
THREE_SIGMA = math.erf(3.0 / math.sqrt(2.0))


def chi2_cdf(x: float, dof: int) -> float:
    """Lower regularised incomplete gamma function P(dof/2, x/2), by its power series."""
    if x <= 0:
        return 0.0
    a, h = 0.5 * dof, 0.5 * x
    term = total = 1.0 / a
    n = 0
    while term > total * 1e-16 and n < 10000:
        n += 1
        term *= h / (a + n)
        total += term
    return min(1.0, total * math.exp(a * math.log(h) - h - math.lgamma(a)))


@cache
def chi2_quantile(probability: float, dof: int) -> float:
    """Value that a chi-square variable of ``dof`` degrees stays below with the given probability, by bisection."""
    if not 0.0 < probability < 1.0 or dof < 1:
        raise ValueError(f"probability {probability} must lie in (0, 1) and dof {dof} be positive")
    low, high = 0.0, float(dof)
    while chi2_cdf(high, dof) < probability:
        high *= 2.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if chi2_cdf(middle, dof) < probability else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class Gate:
    """A test on the normalised innovation squared: ``probability`` that a right measurement passes.

    ``on_fail``: ``discard`` drops what fails; ``inflate`` widens its covariance until it just passes;
    ``accept`` uses it as it is (the gate then only counts).

    A filter that discards cannot tell whether it or the measurement is wrong. So after ``recover_after_s`` without
    one that passed, the state's own covariance is widened until one passes again. Later, and a filter that once
    believed a slip goes astray; sooner, and a long burst of bad motions gets in. PX4's EKF2 calls flight by the IMU
    alone valid for 5 s (EKF2_NOAID_TOUT).
    """

    probability: float = THREE_SIGMA
    on_fail: Literal["discard", "inflate", "accept"] = "discard"
    recover_after_s: float = 5.0

    def threshold(self, dof: int) -> float:
        """Largest NIS that passes."""
        return chi2_quantile(self.probability, dof)
