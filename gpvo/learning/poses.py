"""How much of the motions' errors adds up, by the poses that they add up to.

White and bias are fitted to sums of single axes, in the camera frame. A pose shows more: errors are rotated and act
over lever arms along the path, and errors that belong to a place, such as a turn and the shift that undoes it, cancel
part of what the axes seem to add up to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from gpvo.accumulation import adjoints_to_end, persistent_sum
from gpvo.learning.rows import significant_gain
from gpvo.learning.spans import SPANS, cut
from gpvo.stats.consistency import nees
from gpvo.types import Array

_LONG, _LEAST_WINDOWS = 10, 3
_PRIOR_SPREAD = 0.3
"""Expected deviation of the factor's log from 0."""
_LEAST_FACTOR, _LEAST_JITTER = 0.25, 0.01
_MOST_NEES = 16.0


@dataclass(frozen=True)
class Motions:
    """One unbroken chain of n motions of a sequence: ``T_prev_cur`` (n, 4, 4), ``error`` (n, 6), and of what is stated
    the covariances ``jitter`` and ``white`` (n, 6, 6), and ``root`` (n, 6, 12) of the bias and of what a wrong
    calibration adds."""

    sequence: int
    T_prev_cur: Array
    error: Array
    jitter: Array
    white: Array
    root: Array


def added_factor(poses: Sequence[Poses], share: Array) -> float:
    """Factor on white noise and bias (jitter is the remainder of each motion) under which poses are likeliest.

    ``share`` (3, D) of the parts. Spans of ten and more motions count alike, as they contain the same errors, and so do
    sequences. The factor is shrunk towards 1, and is 1 unless its gain is significant. Every axis keeps some jitter.
    """
    poses = [p for p in poses if p.span >= _LONG]
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
    """Errors (w, 6) of the poses after ``span`` motions each, in the axes of the last camera, and covariances
    (w, 6, 6): that of ``jitter`` and calibration, of what has ``added`` up, and of the first and last motion's part of
    that, were it jitter too (``at_ends``). ``belongs`` (w, S): to which sequence, its columns summing to one: a
    sequence counts as one, however many windows it has, as its errors go together."""

    span: int
    error: Array
    jitter: Array
    added: Array
    at_ends: Array
    belongs: Array

    @classmethod
    def over(cls, chains: Sequence[Motions], m: int, phi: Array) -> Poses:
        """Of the separate windows of all chains; ``phi`` (12,): correlation of bias and calibration from one motion to
        the next."""
        long = [c for c in chains if len(c.error) >= m]
        every = zip(*((c.T_prev_cur, c.error, c.jitter, c.white, c.root) for c in long))
        error, jitter, added, at_ends = _sums(phi, *(np.concatenate([cut(v, m) for v in of]) for of in every))
        sequence = np.concatenate([np.full(len(c.error) // m, c.sequence) for c in long])
        belongs = (sequence[:, None] == np.unique([c.sequence for c in chains])).astype(np.float64)
        return cls(m, error, jitter, added, at_ends, belongs / np.maximum(belongs.sum(axis=0), 1.0))

    def losses(self, factor: float) -> Array:
        """(S,) negative log-likelihood of each sequence, without its constant; 0 for one without a window. Gross errors
        count as four sigma."""
        C = self.jitter + self.at_ends + factor * (self.added - self.at_ends)
        squared = np.minimum(nees(self.error, C), _MOST_NEES * 6.0)
        return np.asarray((0.5 * (np.linalg.slogdet(C)[1] + squared)) @ self.belongs)


def poses_of(chains: Sequence[Motions], phi: Array) -> list[Poses]:
    """Single motions, and the poses after ten and more of them as far as a span has enough windows."""
    counts = {m: sum(len(c.error) // m for c in chains) for m in SPANS if m == 1 or m >= _LONG}
    return [Poses.over(chains, m, phi) for m, count in counts.items() if count >= _LEAST_WINDOWS]


def _sums(
    phi: Array, T_prev_cur: Array, error: Array, jitter: Array, white: Array, root: Array
) -> tuple[Array, Array, Array, Array]:
    """Error, jitter, added and at_ends of :class:`Poses`, of windows (w, m, ...) of motions: as
    :class:`gpvo.accumulation.PoseError` adds up, for all at once and with one time step."""
    to_end, ends = adjoints_to_end(T_prev_cur), [0, -1]
    jitter, white, root = _carried(jitter[:, ends], to_end[:, ends]), _carried(white, to_end), to_end @ root
    bias, calibration = root[..., :6], root[..., 6:]
    phi = np.broadcast_to(phi, (*root.shape[:2], len(phi)))
    added = white.sum(axis=1) + persistent_sum(bias, phi[..., :6])
    lasting = persistent_sum(calibration, phi[..., 6:]) if calibration.any() else np.zeros_like(added)
    return (
        (to_end @ error[..., None]).sum(axis=1)[..., 0],
        0.5 * jitter.sum(axis=1) + lasting,
        added,
        0.5 * (white[:, ends] + bias[:, ends] @ np.swapaxes(bias[:, ends], -1, -2)).sum(axis=1),
    )


def _carried(C: Array, adjoint: Array) -> Array:
    return np.asarray(adjoint @ C @ np.swapaxes(adjoint, -1, -2))
