"""A ground truth as it may have been without its own noise, so that a model learns odometry's errors and not the
truth's.

The truth's noise adds to the square of every error, and nothing in a single motion tells the two apart. Over many it is
known how large each is, and what is left open is drawn: multiple imputation (D. Rubin, "Multiple Imputation for
Nonresponse in Surveys" (1987)) by data augmentation (M. Tanner, W. Wong, "The calculation of posterior distributions by
data augmentation" (1987)). Errors drawn so have the spread, the tails and the correlations of odometry's own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.errors import MotionErrors, interpolate_truth, motion_errors
from gpvo.dataset.truth_noise import TruthNoise, estimate_truth_noise, rates_of
from gpvo.geometry import se3
from gpvo.geometry.covariance import variances, where_stated
from gpvo.stats import student_t
from gpvo.stats.consistency import SEEN, rms
from gpvo.types import Array, TruthLog, VoLog

_ROUNDS = 50
_NEGLIGIBLE = 1e-3
"""Of odometry's errors, as noise where there is none: what is exact has no information matrix."""
_FARTHEST = 20
"""References between the ends of a motion. Odometry begins at the last one; what a log says beyond it is no chain."""
_ABSURD = 1e4  # times the median error: of no use, and beyond the algebra
_D = 6
Frames = NDArray[np.int64]


def without_noise(log: VoLog, truth: TruthLog) -> tuple[TruthLog, TruthNoise]:
    """The truth drawn without the noise that it shows beside a log, and that noise."""
    noise = estimate_truth_noise(motion_errors(log, truth), log)
    return drawn_without_noise(log, truth, noise), noise


def drawn_without_noise(log: VoLog, truth: TruthLog, noise: TruthNoise) -> TruthLog:
    """Poses at the frames with truth, drawn from what they may have been given that ``noise`` is in those told, and
    that errors of odometry's motions are white and a multivariate Student-t's, of the shape that geometry states, if it
    states any, and of a scale that is found with them.

    The truth itself where there is no noise.
    """
    if not noise:
        return truth
    errors = motion_errors(log, truth)
    start, end = log.parent[errors.index], errors.index
    inner = np.unique(start)
    near = (start >= 0) & (np.searchsorted(inner, end) - np.searchsorted(inner, start) <= _FARTHEST)
    near &= ~errors.far(_ABSURD)
    if near.sum() < _D:
        return truth
    T, known = interpolate_truth(truth, log.t_ns)
    errors, start, end = errors.rows(near), start[near], end[near]
    prior = noise.of_poses(rates_of(T, log.t_ns, known)) + np.diag(_least(errors.xi) ** 2)
    off = _Chain(errors, start, end, prior, _shape(log, end)).draw(np.random.default_rng(0))
    return TruthLog(log.t_ns[known], (T @ se3.exp(-off))[known])


def _least(error: Array) -> Array:
    """(6,) what is negligible beside errors (M, 6), those of a robot in a plane too."""
    return np.asarray(_NEGLIGIBLE * np.maximum(rms(error), SEEN))


def _shape(log: VoLog, end: Frames) -> Array:
    """(M, 6) how large the errors of motions are by geometry, over the usual ones; 1 where it says nothing."""
    if not log.methods:
        return np.ones((len(end), _D))
    stated = variances(where_stated(log.covariance(log.methods[0])[end]))
    known = np.asarray(np.isfinite(stated).all(axis=1))
    usual = np.median(stated[known], axis=0) if known.any() else np.ones(_D)
    return np.where(known[:, None], np.sqrt(stated / usual), 1.0)


class _Chain:
    """Gibbs sampling of how far each pose n (N, 6) is off, ``T_told = T exp(n)``, and of each motion's own scale.

    The error of a motion by such poses is ``y = e - n_end + Ad(T)^-1 n_start`` to first order. Given the scales of the
    errors e all is Gaussian. Poses where motions start are drawn together, by an information matrix that is banded, as
    each is the reference of the next; all others, of a vehicle that hardly moves, by the one motion that ends there.
    """

    def __init__(self, errors: MotionErrors, start: Frames, end: Frames, prior: Array, shape: Array) -> None:
        self._y, self._start, self._end, self._shape = errors.xi, start, end, shape
        self._carry = se3.adjoint(se3.inverse(errors.T_true))
        self._prior = np.linalg.inv(prior)
        self._least = np.maximum(_least(errors.xi), _NEGLIGIBLE * np.sqrt(variances(prior).mean(axis=0)))
        self._inner, self._from = np.unique(start, return_inverse=True)
        place = np.full(len(prior), -1)
        place[self._inner] = np.arange(len(self._inner))
        self._to = place[end]
        self._last = self._to < 0
        self._band = _D * (1 + int((self._to - self._from).max(initial=0)))

    def draw(self, rng: np.random.Generator) -> Array:
        """(N, 6), by the last of the rounds; 0 for a pose of which no motion tells. They begin with all of the error
        charged to odometry: what no noise of the truth explains stays there."""
        e, off = self._y, np.zeros((len(self._prior), _D))
        least, shapes = self._least, self._shape[:, :, None] * self._shape[:, None, :]
        for _ in range(_ROUNDS):
            u = e / self._shape
            unit = np.maximum(rms(u), least)
            unseen = np.diag(np.maximum(1.0 - rms(u / unit) ** 2, 0.0))
            information = np.linalg.inv((student_t.scatter(u / unit) + unseen) * np.outer(unit, unit))
            squared = np.einsum("ni,ij,nj->n", u, information, u)
            scale = rng.gamma(0.5 * (student_t.NU_MIN + _D), 2.0 / (student_t.NU_MIN + squared))
            off = self._given(scale[:, None, None] * information / shapes, rng)
            e = self._y + off[self._end] - self._carried(off)
        return off

    def _carried(self, off: Array) -> Array:
        """(M, 6) what each motion's start is off, where it ends."""
        return np.einsum("nij,nj->ni", self._carry, off[self._start])

    def _given(self, W: Array, rng: np.random.Generator) -> Array:
        """(N, 6) drawn given the information W (M, 6, 6) of the errors."""
        off, last, end = np.zeros((len(self._prior), _D)), self._last, self._end[self._last]
        whole = self._prior[end] + W[last]
        told = W.copy()  # with the noise of a pose that no other motion tells of
        told[last] -= W[last] @ np.linalg.solve(whole, W[last])
        off[self._inner] = self._together(told, rng)
        push = np.einsum("nij,nj->ni", W, self._carried(off) - self._y)[last]
        root = np.linalg.cholesky(whole)
        half = np.linalg.solve(root, push[..., None]) + rng.standard_normal((len(end), _D, 1))
        off[end] = np.linalg.solve(np.swapaxes(root, 1, 2), half)[..., 0]
        return off

    def _together(self, W: Array, rng: np.random.Generator) -> Array:
        """(k, 6) of the poses where motions start."""
        from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded  # of training, as nothing before it

        k, inner = len(self._inner), ~self._last
        back = np.swapaxes(self._carry, 1, 2) @ W
        own, push = self._prior[self._inner], np.zeros((k, _D))
        np.add.at(own, self._from, back @ self._carry)
        np.add.at(push, self._from, np.einsum("nij,nj->ni", back, self._y))
        start, end, W = self._from[inner], self._to[inner], W[inner]
        np.add.at(own, end, W)
        np.add.at(push, end, -np.einsum("nij,nj->ni", W, self._y[inner]))
        between = -W @ self._carry[inner]
        lower = np.zeros((self._band, _D * k))  # row d, column j: element (j + d, j)
        for i in range(_D):
            for j in range(_D):
                if i >= j:
                    lower[i - j, j::_D] += own[:, i, j]
                np.add.at(lower, (_D * (end - start) + i - j, _D * start + j), between[:, i, j])
        root = cholesky_banded(lower, lower=True)
        upper = np.zeros_like(root)
        for d in range(self._band):
            upper[-1 - d, d:] = root[d, : root.shape[1] - d]
        mean = cho_solve_banded((root, True), push.ravel())
        return (mean + solve_banded((0, self._band - 1), upper, rng.standard_normal(_D * k))).reshape(k, _D)
