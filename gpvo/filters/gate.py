"""The chi-square gate: when a measurement disagrees with the filter by more than both allow."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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

    A filter that discards goes astray once it has believed a slip: everything after disagrees with it. Its own
    covariance is then widened until a measurement passes again: after ``recover_after_s`` without one that passed,
    and after ``doubt_after_s`` in which every failure was its own (:class:`Wait`). Were the first as short, a long
    burst of bad motions would get in. PX4's EKF2 calls flight by the IMU alone valid for 5 s (EKF2_NOAID_TOUT).
    """

    probability: float = THREE_SIGMA
    on_fail: Literal["discard", "inflate", "accept"] = "discard"
    recover_after_s: float = 5.0
    doubt_after_s: float = 1.0

    def threshold(self, dof: int) -> float:
        """Largest NIS that passes."""
        return chi2_quantile(self.probability, dof)


@dataclass(frozen=True)
class Wait:
    """What each of B members waits for: ``passed_ns`` (B,), when a motion last passed or there was none to judge;
    ``sound_ns`` (B,), when one last passed or failed by VO's fault.

    Whose fault: of the NIS ``r^T S^-1 r`` the likeliest error of the predicted motion, over its own covariance
    ``P_r``, makes ``r^T S^-1 P_r S^-1 r``; the rest is VO's. Where the filter's part is more than half, VO is so much
    the surer of the two that an error usual for VO and one unusual for the filter explain the failure best.
    """

    passed_ns: NDArray[np.int64]
    sound_ns: NDArray[np.int64]

    @staticmethod
    def since(t_ns: int, batch: int) -> Wait:
        """A filter that has just started."""
        now = np.full(batch, t_ns, dtype=np.int64)
        return Wait(now, now)

    def over(self, t_ns: int, gate: Gate) -> NDArray[np.bool_]:
        """(B,) members that are to be widened if they fail again at ``t_ns``."""
        too_long = t_ns - self.passed_ns > gate.recover_after_s * 1e9
        return too_long | (t_ns - self.sound_ns > gate.doubt_after_s * 1e9)

    def after(self, t_ns: int, passed: NDArray[np.bool_] | bool, own_fault: NDArray[np.bool_] | bool) -> Wait:
        """The same once a record has been judged; ``own_fault``: failed, and the filter has to answer for it."""
        return Wait(np.where(passed, t_ns, self.passed_ns), np.where(own_fault, self.sound_ns, t_ns))
