"""Is a mean of the error worth taking off? Per motion, summed along the path, and in the pose."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as t_distribution

from gpvo.geometry import se3
from gpvo.learning.rows import Rows
from gpvo.learning.spans import SPANS, span_variances
from gpvo.types import Array

_LONG = 10


def surely_positive(gain: Array, risk: float = 0.05) -> NDArray[np.bool_]:
    """(D,) whether the mean over groups of gain (G, D) is positive: one-sided t-test, risk shared among the D axes."""
    groups, axes = gain.shape
    if groups < 2:
        return np.zeros(axes, dtype=bool)
    statistic = gain.mean(axis=0) / np.maximum(gain.std(axis=0, ddof=1) / np.sqrt(groups), 1e-300)
    return statistic > t_distribution.ppf(1.0 - risk / axes, groups - 1)


def helps_over_distance(rows: Rows, oof_mean: Array, sigma: Array) -> NDArray[np.bool_]:
    """(6,) whether what the mean leaves is smaller than the error itself when summed over any number of motions.

    A mean given VO's own motion holds what was usual in training: it draws each motion towards that, which makes the
    single one better, but what it takes off of true motions adds up along the path.
    """
    plain, left = (span_variances(rows.chains(e / sigma)).mean_square for e in (rows.error, rows.error - oof_mean))
    return np.asarray((left <= plain).all(axis=0))


def pose_gain(rows: Rows, oof_mean: Array) -> float:
    """By how much the mean makes the pose better over many motions: log ratios of the mean squared errors of position
    and attitude, added. 0 unless one of them surely gains, beyond what sequences differ by chance, and none loses.

    Errors of axes belong together: a sideways error goes with a turn that undoes it on the way. A mean that takes off
    the one alone makes every motion better and the path worse.
    """
    motion = rows.chains(rows.motions())
    plain, left = (rows.chains(e) for e in (rows.error, rows.error - oof_mean))
    gains = [g for s in zip(motion, plain, left) if (g := _log_gain(*s)) is not None]
    if not gains:
        return 0.0
    gain = np.array(gains)
    mean = gain.mean(axis=0)
    return float(mean.sum()) if surely_positive(gain).any() and (mean > -1e-9).all() else 0.0


def _log_gain(motion: Sequence[Array], plain: Sequence[Array], left: Sequence[Array]) -> Array | None:
    """(2,) of one sequence: log of the mean squared error of position and attitude, what was over what is left, mean
    over the spans of ten motions and more; None where there is none."""
    before, after = (_pose_errors(motion, error) for error in (plain, left))
    return np.log((before + 1e-30) / (after + 1e-30)).mean(axis=0) if len(before) else None


def _pose_errors(motion: Sequence[Array], error: Sequence[Array]) -> Array:
    """(S, 2) mean squares of the pose's error [m^2, rad^2] after each long span that occurs in the chains."""
    found: dict[int, list[Array]] = {}
    for Ts, xis in zip(motion, error):
        poses = np.array(list(accumulate(Ts, np.matmul, initial=np.eye(4))))
        # To first order: every motion's error carried to the first frame, summed, and carried to the last one.
        carried = (se3.adjoint(poses[1:]) @ xis[:, :, None])[:, :, 0]
        total = np.cumsum(np.vstack([np.zeros(6), carried]), axis=0)
        for m in (m for m in SPANS if _LONG <= m <= len(xis)):
            ends = np.arange(m, len(total), max(m // 2, 1))
            at_end = (se3.adjoint(se3.inverse(poses[ends])) @ (total[ends] - total[ends - m])[:, :, None])[:, :, 0]
            found.setdefault(m, []).append(at_end**2)
    squares = [np.concatenate(found[m]).mean(axis=0) for m in sorted(found)]
    return np.array([[s[:3].sum(), s[3:].sum()] for s in squares])
