"""How much of the motions' errors adds up, by the poses that they add up to.

White and bias are fitted to sums of single axes, in the camera frame. A pose shows more: errors are rotated and act
over lever arms along the path, and errors that belong to a place, such as a turn and the shift that undoes it, cancel
part of what the axes seem to add up to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from gpvo.accumulation import adjoints_to_end, persistent_sum
from gpvo.learning.rows import significant_gain
from gpvo.learning.spans import SPANS, Chains, cut
from gpvo.stats.consistency import nees
from gpvo.types import Array

_LONG, _LEAST_WINDOWS = 10, 3
_PRIOR_SPREAD = 0.3
"""Expected deviation of the factor's log from 0."""
_LEAST_FACTOR, _LEAST_JITTER = 0.25, 0.01
_MOST_NEES = 16.0


@dataclass(frozen=True)
class Windows:
    """Separate windows of m motions each, of unbroken chains: the ``rows`` (w, m) of their motions. ``belongs`` (w, S):
    to which sequence, its columns summing to one: a sequence counts as one, however many windows it has, as its errors
    go together. ``to_end`` (w, m, 6, 6): adjoints that carry the error of each motion to the last."""

    rows: NDArray[np.int64]
    belongs: Array
    to_end: Array

    @classmethod
    def of(cls, chains: Chains, m: int, T_prev_cur: Array) -> Windows:
        """Of ``chains`` of rows, with the motions (n, 4, 4) of all rows."""
        rows = np.concatenate([cut(chain, m) for some in chains for chain in some])
        counts = [sum(len(chain) // m for chain in some) for some in chains]
        belongs = np.repeat(np.eye(len(chains)) / np.maximum(counts, 1.0), counts, axis=0)
        return cls(rows, belongs, adjoints_to_end(T_prev_cur[rows]))


def windows_of(chains: Chains, T_prev_cur: Array) -> list[Windows]:
    """Single motions, and windows of ten and more of them as far as there are enough; ``chains`` of rows, and the
    motions (n, 4, 4) of all."""
    counts = {m: sum(len(chain) // m for some in chains for chain in some) for m in SPANS if m == 1 or m >= _LONG}
    return [Windows.of(chains, m, T_prev_cur) for m, count in counts.items() if count >= _LEAST_WINDOWS]


def added_factor(poses: Sequence[Poses], share: Array) -> float:
    """Factor on white noise and bias (jitter is the remainder of each motion) under which poses are likeliest.

    ``share`` (3, D) of the parts. Spans of ten and more motions count alike, as they contain the same errors, and so do
    sequences. The factor is shrunk towards 1, and is 1 unless its gain is significant. Every axis keeps some jitter.
    """
    poses = [p for p in poses if p.windows.rows.shape[1] >= _LONG]
    if not poses:
        return 1.0
    most = max((1.0 - _LEAST_JITTER) / float((share[1] + share[2]).max()), 1.0)

    def loss(ln_factor: float) -> float:
        return float(pose_losses(poses, float(np.exp(ln_factor))).sum() + 0.5 * (ln_factor / _PRIOR_SPREAD) ** 2)

    bounds = (np.log(_LEAST_FACTOR), np.log(most))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3}).x
    factor = float(np.exp(found))
    return factor if significant_gain(pose_losses(poses) - pose_losses(poses, factor)) else 1.0


def pose_losses(poses: Sequence[Poses], factor: float = 1.0) -> Array:
    """(S,) mean negative log-likelihood, without its constant, of the poses of each sequence, with ``factor`` on what
    adds up; all spans count alike."""
    return np.asarray(np.mean([p.losses(factor) for p in poses], axis=0))


def with_added(share: Array, factor: float) -> Array:
    """(3, D) shares with white noise and bias times the factor; jitter, some on every axis, is the remainder."""
    added = share[1:] * factor
    added *= np.minimum(1.0, (1.0 - _LEAST_JITTER) / added.sum(axis=0))
    return np.vstack([1.0 - added.sum(axis=0), added])


@dataclass(frozen=True)
class Poses:
    """Errors (w, 6) of the poses after windows of motions, in the axes of the last camera, and covariances (w, 6, 6):
    that of ``jitter`` and calibration, of what has ``added`` up, and of the first and last motion's part of that, were
    it jitter too (``at_ends``)."""

    windows: Windows
    error: Array
    jitter: Array
    added: Array
    at_ends: Array

    @classmethod
    def over(cls, windows: Windows, error: Array, jitter: Array, white: Array, root: Array, phi: Array) -> Poses:
        """As :class:`gpvo.accumulation.PoseError` adds up, for all windows at once and with one time step.

        Of all motions the errors (n, 6), the covariances ``jitter`` and ``white`` (n, 6, 6), and the ``root``
        (n, 6, 12) of the bias and of what a wrong calibration adds; ``phi`` (12,): correlation of the latter two from
        one motion to the next.
        """
        rows, ends, to_end = windows.rows, [0, -1], windows.to_end
        at_both = _carried(to_end[:, ends], jitter[rows[:, ends]])
        whites, bias = _carried(to_end, white[rows]), to_end @ root[..., :6][rows]
        phis = np.broadcast_to(phi, (*rows.shape, len(phi)))
        added = whites.sum(axis=1) + persistent_sum(bias, phis[..., :6])
        lasting = np.zeros_like(added)
        if root[..., 6:].any():  # mostly, no part of the errors is the calibration's
            lasting = persistent_sum(to_end @ root[..., 6:][rows], phis[..., 6:])
        at_ends = whites[:, ends] + bias[:, ends] @ np.swapaxes(bias[:, ends], -1, -2)
        summed = (to_end @ error[rows][..., None]).sum(axis=1)[..., 0]
        return cls(windows, summed, 0.5 * at_both.sum(axis=1) + lasting, added, 0.5 * at_ends.sum(axis=1))

    def losses(self, factor: float) -> Array:
        """(S,) negative log-likelihood of each sequence, without its constant; 0 for one without a window. Gross errors
        count as four sigma."""
        C = self.jitter + self.at_ends + factor * (self.added - self.at_ends)
        squared = np.minimum(nees(self.error, C), _MOST_NEES * 6.0)
        return np.asarray((0.5 * (np.linalg.slogdet(C)[1] + squared)) @ self.windows.belongs)


def _carried(adjoint: Array, C: Array) -> Array:
    """Covariances (w, m, 6, 6), carried by adjoints (w, m, 6, 6) to the end of each window, where one motion is."""
    return C if C.shape[1] == 1 else np.asarray(adjoint @ C @ np.swapaxes(adjoint, -1, -2))
