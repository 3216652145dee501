"""Beliefs about coefficients that stay: sums of what motions tell of them, and Gaussians given those."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

_BLOCK = 20  # motions, longer than most features live
_EXCESS = 16.0, 2.0  # of scatter to begin with, and the number of blocks that this guess is worth
# Shares, as standard deviations, by which the noise may be another than stated: what persists, as noise differs by
# direction, and the variances of the column and of the row, which edges one way alone make any.
_DILUTION = np.array([0.1, 1.0, 1.0])


@dataclass(frozen=True)
class Sums:
    """Information (n, n) and score (n,) of errors of the rig as if frames were independent, and the dilutions (n, 3) of
    the score by what persists and by the variances of column and row, were all of each not there."""

    information: Array
    score: Array
    dilution: Array

    def since(self, before: Sums) -> Sums:
        """What was added to ``before``."""
        a, b = self, before
        return Sums(a.information - b.information, a.score - b.score, a.dilution - b.dilution)


class Blocks:
    """The sums of all motions, and by how much blocks of frames scatter more than if frames were independent."""

    def __init__(self, precision: Array) -> None:
        none = np.zeros((len(precision), len(_DILUTION)))
        self.sums = self._before = Sums(0.0 * precision, 0.0 * precision[0], none)
        self._count = 0
        freedom = _EXCESS[1] * len(precision)
        self._scatter = self._scatter_earlier = (_EXCESS[0] * freedom, freedom)
        self._floor = 1e-6 * precision

    @property
    def excess(self) -> float:
        """Variance of a block's score over its information."""
        return self._scatter[0] / self._scatter[1]

    def believed(self, among: Sums | None = None) -> tuple[Array, Array]:
        """Information and score, of which the excess and a share of the dilution may be no signal: of all, or ``among``
        a part, by the excess of a block ago."""
        sums, (chi2, freedom) = (self.sums, self._scatter) if among is None else (among, self._scatter_earlier)
        excess = chi2 / freedom
        if not sums.dilution.any():
            return sums.information / excess, sums.score / excess
        dilution = _DILUTION * sums.dilution
        diluted = np.linalg.solve(sums.information + self._floor, dilution)
        part = dilution @ np.linalg.inv(excess * np.eye(len(_DILUTION)) + dilution.T @ diluted)
        return (
            (sums.information - part @ dilution.T) / excess,
            (sums.score - part @ (diluted.T @ sums.score)) / excess,
        )

    def add(self, information: Array, score: Array, dilution: Array | float = 0.0) -> None:
        """Take in one motion; the score is that of a state of zero."""
        s = self.sums
        self.sums = Sums(s.information + information, s.score + score, s.dilution + dilution)
        self._count += 1

    def close(self, mean: Array, covariance: Array) -> None:
        """At the end of a block, compare its score at the estimate with what is expected of it."""
        if self._count < _BLOCK:
            return
        block = self.sums.since(self._before)
        left = block.score - block.information @ mean
        chi2 = float(left @ np.linalg.solve(block.information + self._floor, left))
        freedom = len(mean) - float((block.information * covariance).sum()) / self.excess
        self._scatter_earlier, self._scatter = self._scatter, (self._scatter[0] + chi2, self._scatter[1] + freedom)
        self._count, self._before = 0, self.sums

    def forget(self, before: Sums) -> None:
        """Only what was added to ``before`` counts, and blocks that the change lies in tell nothing of their excess."""
        self.sums = self.sums.since(before)
        self._count, self._before, self._scatter = 0, self.sums, self._scatter_earlier


@dataclass(frozen=True)
class Gaussians:
    """L times K beliefs about n coefficients, of one mean: those of a row differ at few ``places`` (s,).

    ``precision`` (L, n, n) of each row's last, ``more`` (L, K, s, s) of each than that at the places, ``score`` (L, K,
    n), precision times mean, ``log_det`` (L, K) of the precision, and ``at_mean`` (L, K), the mean times the score.
    """

    precision: Array
    places: NDArray[np.intp]
    more: Array
    score: Array
    log_det: Array
    at_mean: Array

    @classmethod
    def of(cls, mean: Array, covariance: Array) -> Gaussians:
        """Of a mean (n,) and covariances (L, K, n, n)."""
        precision = np.asarray(np.linalg.inv(covariance), np.float64)
        more, score = precision - precision[:, -1:], precision @ mean
        places = np.flatnonzero(more.any(axis=(0, 1, 2)))
        more = more[..., places[:, None], places]
        return cls(precision[:, -1], places, more, score, np.linalg.slogdet(precision)[1], score @ mean)

    def given(self, information: Array, score: Array) -> Posterior:
        """After measurements: by one inverse for each row, M. Woodbury, "Inverting modified matrices", 1950."""
        precision, total = self.precision + information, self.score + score
        C = np.asarray(np.linalg.inv(precision), np.float64)
        across = C[:, self.places]
        A = np.eye(len(self.places)) + across[:, None, :, self.places] @ self.more
        less, mean = self.more @ np.linalg.inv(A), total @ C
        mean = mean - (less @ mean[..., self.places, None])[..., 0] @ across
        log_det = self.log_det - np.linalg.slogdet(precision)[1][:, None] - np.linalg.slogdet(A)[1]
        return Posterior(C, across, less, mean, 0.5 * ((mean * total).sum(axis=-1) - self.at_mean + log_det))


@dataclass(frozen=True)
class Posterior:
    """Covariances ``C - across^T less across``, of C (L, n, n), across (L, s, n) and less (L, K, s, s), means (L, K, n)
    and log evidence (L, K), up to a common term, of :class:`Gaussians`."""

    C: Array
    across: Array
    less: Array
    mean: Array
    evidence: Array

    def covariance(self, weight: Array) -> Array:
        """(n, n) the sum of their covariances by weights (L, K)."""
        less = (weight[..., None, None] * self.less).sum(axis=1)
        of_rows = weight.sum(axis=1)[:, None, None] * self.C - self.across.transpose(0, 2, 1) @ less @ self.across
        return np.asarray(of_rows.sum(axis=0))
