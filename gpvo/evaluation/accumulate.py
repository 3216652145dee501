"""How the error of single motions adds up along a path.

Two-frame VO shares each frame's pixel noise between two motions, with opposite signs; calibration and depth bias
persist. So a motion's error is ``xi_k = w_k + b_k + n_k - Ad(T_k)^-1 n_(k-1)`` with white w, first-order Gauss-Markov
b and the frame's own jitter n, as if that frame's pose were off by n; and the error of the pose
``e_k = Ad(T_k)^-1 e_(k-1) + xi_k`` is carried with all three. The jitter then never adds up: of it the pose holds only
the last frame's and, from afar, the first one's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gpvo.geometry import se3
from gpvo.geometry.covariance import persistent_root, symmetrise
from gpvo.types import Array, Prediction


@dataclass(frozen=True)
class Step:
    """One motion: ``T_prev_cur``, its parts (6, 6) each, the bias' time constants (6,) [s] and its duration; and what
    calibration has of the bias (see :class:`gpvo.types.Prediction`)."""

    T_prev_cur: Array
    jitter: Array
    white: Array
    bias: Array
    bias_tau_s: Array
    dt_s: float
    calibration_root: Array = field(default_factory=lambda: np.zeros((6, 6)))
    calibration_tau_s: Array = field(default_factory=lambda: np.ones(6))

    @classmethod
    def independent(cls, T_prev_cur: Array, covariance: Array) -> Step:
        """A motion whose error has nothing to do with any other's."""
        zero = np.zeros((6, 6))
        return cls(T_prev_cur, zero, covariance, zero, np.ones(6), 0.0)

    @classmethod
    def predicted(cls, T_prev_cur: Array, prediction: Prediction) -> Step:
        """A motion with a model's prediction."""
        p = prediction
        jitter, white, bias = (p.parts[name] for name in ("jitter", "white", "bias"))
        lasting = (p.calibration_root, p.calibration_tau_s)
        return cls(T_prev_cur, jitter, white, bias, p.bias_tau_s, p.dt_s, *lasting)


class PoseError:
    """Covariance of the pose's error along a chain, right perturbation, in the axes of the last camera.

    The joint state is (e, n, u): error, jitter of the last frame, and the bias in units of its own deviation, that of
    calibration last, so that a bias whose size or sign changes stays correlated with what it was.
    """

    def __init__(self) -> None:
        self._P = np.zeros((24, 24))
        self._begun = False

    def copy(self) -> PoseError:
        """An independent copy, for a chain that branches."""
        twin = PoseError()
        twin._P, twin._begun = self._P.copy(), self._begun
        return twin

    @property
    def covariance(self) -> Array:
        """(6, 6) of the pose."""
        return symmetrise(self._P[:6, :6])

    def add(self, step: Step) -> Array:
        """Append a motion; the pose's covariance after it."""
        J = 0.5 * step.jitter
        moved = se3.adjoint(se3.inverse(step.T_prev_cur))
        if not self._begun:
            # The first frame's jitter is the other half of the first motion's; the bias starts in its steady state.
            back = se3.adjoint(step.T_prev_cur)
            self._P[6:12, 6:12] = back @ J @ back.T
            self._P[12:, 12:] = np.eye(12)
            self._begun = True
        tau_s = np.concatenate([step.bias_tau_s, step.calibration_tau_s])
        phi = np.exp(-step.dt_s / np.maximum(tau_s, 1e-6))
        L = persistent_root(step.bias, step.calibration_root)
        A = np.zeros((24, 24))
        A[:6, :6] = moved
        A[:6, 6:12] = -moved
        A[:6, 12:] = L * phi
        A[12:, 12:] = np.diag(phi)
        P = A @ self._P @ A.T
        # What is new: n_k enters both the error and its own place, the bias' innovation likewise.
        Q_u = np.diag(1.0 - phi**2)
        P[:6, :6] += step.white + J + L @ Q_u @ L.T
        P[:6, 6:12] += J
        P[6:12, :6] += J
        P[6:12, 6:12] += J
        P[:6, 12:] += L @ Q_u
        P[12:, :6] += Q_u @ L.T
        P[12:, 12:] += Q_u
        self._P = P
        return self.covariance


def along(steps: Sequence[Step], parent: Iterable[int]) -> Array:
    """(N, 6, 6) covariance of every pose; ``parent`` gives the pose each motion starts from, -1 for the origin."""
    states: dict[int, PoseError] = {}
    out = np.zeros((len(steps), 6, 6))
    for k, (step, p) in enumerate(zip(steps, parent, strict=True)):
        if p < 0:
            states[k] = PoseError()
            continue
        state = states[p].copy()
        out[k] = state.add(step)
        states[k] = state
        # No motion starts before the reference of this one.
        for old in [j for j in states if j < p]:
            del states[old]
    return out
