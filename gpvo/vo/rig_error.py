"""Errors of the calibration between the cameras, estimated from the residuals of odometry itself.

Where the right image is displaced by (dx, dy) in normalised coordinates, measured disparity is too small by ``fx dx``
and the row in the right image too large by ``fy dy``. To first order a rotation (wx, wy, wz) of the right camera, a
relative error s of its focal length and a shift (c, e) of its centre displace a point at (x, y) by

    dx = -xy wx + (1 + x^2) wy - y wz + x s + c,    dy = -(1 + y^2) wx + xy wy + x wz + y s + e

(H. Longuet-Higgins, K. Prazdny, "The interpretation of a moving retinal image", 1980, eq. 2.12). Lenses add to each
term, and terms of higher order: a centre shifted under distortion of second and fourth order displaces the image by
polynomials of that order (D. Brown, "Decentering distortion of lenses", 1966). So the coefficients of both fourth-order
polynomials are free, but for the x term of the rows, which no lens makes: it shows a turn about the optical axis. Turns
are a part of the prior covariance. A Kalman filter of constant state estimates them:
dx from the residuals of each motion, with the motion as an unknown without a prior, and dy from the rows, which need no
motion. What cannot be told apart from motion: the depth's scale.

Three things keep it honest. Errors of neighbouring frames are alike (a feature is off in the same way for as long as it
is tracked): blocks of frames are compared with their expected scatter, and all information is divided by
the ratio. What persists of a point's disparity error dilutes the translation, as any error in a variable does (R.
Carroll et al., "Measurement error in nonlinear models", 2006, chapter 3), and over level ground a diluted translation
looks like a wrong disparity: the score may be off by a tenth of this dilution. And rigs are of several kinds, exact or
not, with a mounting and with lenses from good to bad: the estimate is the mean over the kinds by their probability, so
that an exact rig keeps its exact geometry, and a camera knocked out of place keeps its lens.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from gpvo.stats.series import median
from gpvo.types import Array, StereoCamera
from gpvo.vo.motion import Motion, Whitened, apply_whitener, persistent_direction

_HIGHEST = 4  # order
POWERS = np.array([(n - j, j) for n in range(_HIGHEST + 1) for j in range(n + 1)])  # of x and y, order by order
ORDER = POWERS.sum(axis=1)
N_TERMS = len(POWERS)
_DX, _DY = slice(0, N_TERMS), slice(N_TERMS, None)
# Standard deviations of the prior. Terms beyond the constant are given at half the width of the image.
_DISPARITY_PX = (0.1, 0.3)  # the constant, which motion tells least; the others
_ROW_PX = (3.0, 1.0)  # the constant, the others: rows are seen at once, and cost nothing to leave free
_ROW_X_PX = 0.1  # the x term of the rows, beyond the turn
_TURN_RAD = 2.5e-4  # of the right camera about its vertical and its optical axis
# Rigs that are not exact: their mounting, and apart from it their lenses, are so many times as wrong, equally likely.
# A camera can be knocked by any angle; a lens stays what it is.
_MOUNTINGS, _LENSES = (0.3, 1.0, 4.0, 16.0), (0.3, 1.0, 4.0)
_ROLLS = (1.0, 16.0)  # the same of the turn about the optical axis, which rows show at once
_NEGLIGIBLE = 1e-12  # probability of a kind
_BLOCK = 20  # motions, longer than most features live
_EXCESS = 16.0, 2.0  # of scatter to begin with, and the number of blocks that this guess is worth
_DILUTION = 0.1  # share of it, standard deviation: noise differs by direction, so what persists is known no better
_STEP, _STEPS = 5, 4  # motions between the times at which the cameras may have moved; how many of these are kept
_MOVED = 10.0  # log odds of two rigs over one from which the cameras have moved: on six real drives at most 5
_NEAR = 6.0  # disparity of the points used, in standard deviations of noise: that of far ones says nothing for sure


def terms(x: Array, y: Array) -> Array:
    """(15, N) the monomials of :data:`POWERS` at normalised coordinates (N,) each."""
    out, first = np.empty((N_TERMS, len(x))), 0
    out[0] = 1.0
    for n in range(1, _HIGHEST + 1):
        below, first = first, first + n
        out[first : first + n] = out[below:first] * x
        out[first + n] = out[first - 1] * y
    return out


def prior_covariance(camera: StereoCamera, mounting: float = 1.0, lens: float = 1.0, roll: float = 1.0) -> Array:
    """(30, 30) of the coefficients of dx, then of dy, each in the order of :data:`POWERS`.

    Of rigs whose right camera stands ``mounting`` times as wrong as usual, ``roll`` times about its optical axis, and
    whose lenses bend ``lens`` times as wrong.
    """
    reach = (0.5 * camera.width / camera.fx_px) ** ORDER
    vertical, optical = np.zeros((2, 2 * N_TERMS))
    vertical[[0, 3]] = 1.0
    optical[2], optical[N_TERMS + 1] = -1.0, 1.0
    rows_px = np.where(ORDER == 0, *_ROW_PX)
    rows_px[1] = _ROW_X_PX
    disparity_px = np.where(ORDER == 0, mounting * _DISPARITY_PX[0], lens * _DISPARITY_PX[1])
    free = np.concatenate([disparity_px / camera.fx_px / reach, rows_px / camera.fy_px / reach])
    turns = mounting**2 * np.outer(vertical, vertical) + roll**2 * np.outer(optical, optical)
    return np.diag(free**2) + _TURN_RAD**2 * turns


def principal_errors(state: RigState, camera: StereoCamera) -> Array:
    """(15, 15) columns whose sum, each times a standard normal number, is a draw of dx; those that displace the image
    most come first."""
    values, vectors = np.linalg.eigh(state.covariance[_DX, _DX])
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    y, x = (f.ravel() for f in np.mgrid[-1:1:7j, -1:1:9j])
    over = terms(0.5 * camera.width / camera.fx_px * x, 0.5 * camera.height / camera.fy_px * y)
    return np.asarray(root @ np.linalg.svd(over.T @ root)[2].T, np.float64)


@dataclass(frozen=True)
class RigState:
    """Coefficients of dx and dy as known: ``mean`` (30,) and ``covariance`` (30, 30), in the order of :data:`POWERS`.

    ``probability``: that the disparities are off at all.
    """

    mean: Array
    covariance: Array
    probability: float

    @classmethod
    def prior(cls, camera: StereoCamera) -> RigState:
        """Nothing known but the calibration."""
        return cls(np.zeros(2 * N_TERMS), prior_covariance(camera), 0.5)

    @classmethod
    def exact(cls) -> RigState:
        """The calibration is right beyond doubt."""
        return cls(np.zeros(2 * N_TERMS), np.zeros((2 * N_TERMS, 2 * N_TERMS)), 0.0)


class RigError:
    """The running estimate, and what it does to measurements.

    Parameters
    ----------
    camera : the rectified pair as calibrated.
    known : where to start; by default from nothing.
    learn : whether motions change it.

    Where the evidence is that the cameras moved against one another in the last 20 motions, what was learnt before is
    forgotten (R. Adams, D. MacKay, "Bayesian online changepoint detection", 2007). ``moved``: how often.
    """

    def __init__(self, camera: StereoCamera, known: RigState | None = None, *, learn: bool = True) -> None:
        self._camera, self.moved = camera, 0
        self.state = known or RigState.prior(camera)
        # What is right beyond doubt stays so.
        self._learn = learn and bool(self.state.covariance.any())
        if not self._learn:
            return
        precision = np.asarray(np.linalg.inv(self.state.covariance), np.float64)
        self._blocks = (_Blocks(precision[_DX, _DX]), _Blocks(precision[_DY, _DY]))
        self._motions, self._past = 0, deque[tuple[_Sums, _Sums]](maxlen=_STEPS)
        covariances = [prior_covariance(camera, *kind) for kind in product(_MOUNTINGS, _LENSES, _ROLLS)]
        self._any = _Gaussians.of(np.zeros(2 * N_TERMS), np.stack(covariances))
        # A state from a file is no calibration to return to.
        self._kinds = self._any if known is None else _Gaussians.of(known.mean, known.covariance[None])
        self._exact = _Gaussians.of(np.zeros(N_TERMS), prior_covariance(camera, roll=0.0)[None, _DY, _DY])
        self.state = self._mixed(np.zeros_like(precision), np.zeros(len(precision)))

    def correct(self, uvd: Array) -> Array:
        """Measurements (N, 3) of (u, v, d) as the right camera would have given them in its place [px]."""
        d_error, row_error = self.errors(uvd)
        return uvd - np.column_stack([np.zeros_like(d_error), 0.5 * row_error, d_error])

    def allows(
        self, uvd: Array, row_error: Array, min_disparity_px: float, max_disparity_px: float, max_row_error_px: float
    ) -> NDArray[np.bool_]:
        """(N,) whether disparity and row of a match are possible, given what is known and what is not."""
        with np.errstate(invalid="ignore"):
            d_expected, row_expected = self.errors(uvd)
            phi = self._terms(uvd)
            sigma = self._camera.fy_px * np.sqrt((phi * (self.state.covariance[_DY, _DY] @ phi)).sum(0))
            d = uvd[:, 2] - d_expected
            rows = np.abs(row_error - row_expected) <= max_row_error_px + 3.0 * sigma
            return (d >= min_disparity_px) & (d <= max_disparity_px) & rows

    def update(
        self, motion: Motion, white: Whitened, row_error: Array, min_disparity_px: float, *, sharp: bool = True
    ) -> Array:
        """Learn from a motion over corrected measurements and its whitened residuals; its inliers have these row errors
        (M,). Where the images are not equally ``sharp``, it teaches rows alone: what disparities teach lasts.

        Returns
        -------
        (6, 6) covariance that the state before this motion adds to it: ``K P K^T``, K the motion's derivative by dx.
        """
        fx, moved, scale_px = self._camera.fx_px, white.moved, max(motion.scale_px, 0.1)
        z = white.z / scale_px
        # At the points as smoothed by both frames: their noise is independent of the residual, that of the measured
        # ones is not and would be taken for an error of the rig.
        phi = self._terms(moved.uvd.T)
        M = fx * moved.G[:, 2][:, None] * self._terms(motion.uvd_prev)
        M[2] -= fx * phi
        B = apply_whitener(white.W, M)
        root = np.sqrt(np.minimum(1.0, 3.2 / np.sqrt((z**2).sum(0) + 1e-9)))
        by_motion, B = white.A * (root / scale_px), B * (root / scale_px)
        A = by_motion.transpose(0, 2, 1).reshape(-1, 6)
        B = np.column_stack([B.transpose(0, 2, 1).reshape(-1, N_TERMS), (z * root).reshape(-1)])
        K = np.linalg.solve(A.T @ A, A.T @ B[:, :-1])
        added: Array = K @ self.state.covariance[_DX, _DX] @ K.T
        if self._learn:
            sigma_px = motion.scale_px * np.sqrt(1.0 + motion.noise.persistent)
            near = motion.uvd_prev[:, 2] > min_disparity_px + _NEAR * sigma_px
            if sharp and near.sum() >= 8:
                # The derivatives by the translation are in proportion to the disparity, and so to its error.
                g = apply_whitener(white.W, persistent_direction(moved.G)) * (root / scale_px)
                along = (by_motion[:, :3] * g[:, None]).sum(0)
                dilution = along * motion.noise.persistent * motion.scale_px**2 / motion.uvd_prev[:, 2]
                rows = np.tile(near, 3)
                self._learn_disparities(A[rows], B[rows], dilution[:, near].sum(axis=1))
            self._learn_rows(phi * self._camera.fy_px, row_error)
            self._conclude()
        return added

    def _learn_disparities(self, A: Array, B: Array, dilution: Array) -> None:
        """``A`` (n, 6) and ``B`` (n, 16): whitened derivatives by the motion, by dx, and residuals; ``dilution``
        (3,) of the translation's score.
        """
        K = np.linalg.solve(A.T @ A, A.T @ B)
        rest = B - A @ K
        sums = rest.T @ rest
        information = sums[:-1, :-1]
        score = sums[:-1, -1] + information @ self.state.mean[_DX]
        self._blocks[0].add(information, score, -K[:3, :-1].T @ dilution)

    def _learn_rows(self, rows: Array, row_error: Array) -> None:
        """``rows`` (15, M): derivatives of the row errors by dy. Far points tell as much as near ones."""
        off = row_error - self.state.mean[_DY] @ rows
        sigma = max(1.4826 * median(np.abs(off)), 0.05)
        weighted = rows * np.minimum(1.0, 2.5 * sigma / np.maximum(np.abs(off), 1e-9)) / sigma**2
        self._blocks[1].add(weighted @ rows.T, weighted @ row_error)

    def update_rows(self, uvd: Array, row_error: Array) -> None:
        """Learn from rows (M,) at measurements (M, 3) alone: those of a pair whose rows leave no motion to be found."""
        if self._learn:
            self._learn_rows(self._terms(uvd) * self._camera.fy_px, row_error)
            self._conclude()

    def _look_back(self) -> None:
        """Forget what came before the cameras moved, if they did."""
        self._motions += 1
        if self._motions % _STEP:
            return
        now = self._blocks[0].sums, self._blocks[1].sums
        whole = self._evidence(self._kinds, now)
        for before in reversed(self._past):
            since = [n.since(b) for n, b in zip(now, before, strict=True)]
            if self._evidence(self._kinds, before) + self._evidence(self._any, since) - whole > _MOVED:
                for block, past in zip(self._blocks, before, strict=True):
                    block.forget(past)
                self._kinds, self.moved = self._any, self.moved + 1
                self._past.clear()
                return
        self._past.append(now)

    def _evidence(self, kinds: _Gaussians, sums: Sequence[_Sums]) -> float:
        """Log probability of what was learnt, up to a term that is the same in sum for its parts."""
        learnt = [block.believed(s) for s, block in zip(sums, self._blocks, strict=True)]
        evidence = kinds.given(*_joined(learnt))[2]
        if len(evidence) == 1:
            return float(evidence[0])
        exact = self._exact.given(*(x[None] for x in learnt[1]))[2]
        return float(np.logaddexp(np.logaddexp.reduce(evidence - np.log(len(evidence))), exact[0]) - np.log(2))

    def _conclude(self) -> None:
        """The state given all that was learnt."""
        self._look_back()
        self.state = self._mixed(*_joined([block.believed() for block in self._blocks]))
        for part, block in zip((_DX, _DY), self._blocks, strict=True):
            block.close(self.state.mean[part], self.state.covariance[part, part])

    def _mixed(self, information: Array, score: Array) -> RigState:
        """The posterior over rigs of every kind, as one Gaussian of its mean and covariance."""
        precision, means, evidence = self._kinds.given(information, score)
        if len(means) == 1:
            return RigState(means[0], np.asarray(np.linalg.inv(precision[0]), np.float64), 1.0)
        # A rig whose disparities are exact is as likely as all kinds of others.
        row_precision, row_means, exact_evidence = self._exact.given(information[_DY, _DY], score[_DY])
        log_weight = np.append(evidence, exact_evidence + np.log(len(evidence)))
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        # Inverting what is most unlikely would cost time and change nothing; one stays, as no variance is zero.
        likely = weight[:-1] >= min(_NEGLIGIBLE, weight[:-1].max())
        mean, means = weight[:-1] @ means, means[likely]
        mean[_DY] += weight[-1] * row_means[0]
        squares = np.linalg.inv(precision[likely]) + means[:, :, None] * means[:, None]
        covariance = np.tensordot(weight[:-1][likely], squares, 1)
        exact = np.linalg.inv(row_precision[0]) + np.outer(row_means[0], row_means[0])
        covariance[_DY, _DY] += weight[-1] * exact
        return RigState(mean, covariance - np.outer(mean, mean), float(1.0 - weight[-1]))

    def _terms(self, uvd: Array) -> Array:
        """(15, N) the terms at the place in the right image."""
        c = self._camera
        return terms((uvd[:, 0] - uvd[:, 2] - c.cx_px) / c.fx_px, (uvd[:, 1] - c.cy_px) / c.fy_px)

    def tilt(self, uvd: Array) -> Array:
        """(N,) the part of the row errors that a turn about the optical axis makes [px]."""
        return np.asarray(self._camera.fy_px * self.state.mean[N_TERMS + 1] * self._terms(uvd)[1], np.float64)

    def errors(self, uvd: Array) -> tuple[Array, Array]:
        """(N,) errors of disparity and of the row difference [px]."""
        phi, mean = self._terms(uvd), self.state.mean
        return -self._camera.fx_px * (mean[_DX] @ phi), self._camera.fy_px * (mean[_DY] @ phi)


@dataclass(frozen=True)
class _Gaussians:
    """K beliefs about n coefficients, of one mean: ``precision`` (K, n, n), ``score`` (K, n), precision times mean,
    ``log_det`` (K,) of the precision, and ``at_mean`` (K,), the mean times the score."""

    precision: Array
    score: Array
    log_det: Array
    at_mean: Array

    @classmethod
    def of(cls, mean: Array, covariance: Array) -> _Gaussians:
        """Of a mean (n,) and covariances (K, n, n)."""
        precision = np.asarray(np.linalg.inv(covariance), np.float64)
        score = precision @ mean
        return cls(precision, score, np.linalg.slogdet(precision)[1], score @ mean)

    def given(self, information: Array, score: Array) -> tuple[Array, Array, Array]:
        """Precisions (K, n, n), means (K, n) and log evidence (K,), up to a common term, after measurements."""
        precision, total = self.precision + information, self.score + score
        mean = np.asarray(np.linalg.solve(precision, total[..., None])[..., 0], np.float64)
        log_det = self.log_det - np.linalg.slogdet(precision)[1]
        return precision, mean, 0.5 * ((mean * total).sum(axis=1) - self.at_mean + log_det)


def _joined(learnt: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Information (30, 30) and score (30,) of both polynomials from those of each."""
    information, score = np.zeros((2 * N_TERMS, 2 * N_TERMS)), np.zeros(2 * N_TERMS)
    (information[_DX, _DX], score[_DX]), (information[_DY, _DY], score[_DY]) = learnt
    return information, score


@dataclass(frozen=True)
class _Sums:
    """Information (15, 15) and score (15,) of one polynomial as if frames were independent, and the dilution (15,) of
    the score."""

    information: Array
    score: Array
    dilution: Array

    def since(self, before: _Sums) -> _Sums:
        """What was added to ``before``."""
        a, b = self, before
        return _Sums(a.information - b.information, a.score - b.score, a.dilution - b.dilution)


class _Blocks:
    """The sums of one polynomial, and by how much blocks of frames scatter more than if frames were independent."""

    def __init__(self, precision: Array) -> None:
        self.sums = self._before = _Sums(np.zeros((N_TERMS, N_TERMS)), np.zeros(N_TERMS), np.zeros(N_TERMS))
        self._count = 0
        freedom = _EXCESS[1] * N_TERMS
        self._scatter = self._scatter_earlier = (_EXCESS[0] * freedom, freedom)
        self._floor = 1e-6 * precision

    @property
    def excess(self) -> float:
        """Variance of a block's score over its information."""
        return self._scatter[0] / self._scatter[1]

    def believed(self, among: _Sums | None = None) -> tuple[Array, Array]:
        """Information and score, of which the excess and a share of the dilution may be no signal: of all, or ``among``
        a part, by the excess of a block ago."""
        sums, (chi2, freedom) = (self.sums, self._scatter) if among is None else (among, self._scatter_earlier)
        excess = chi2 / freedom
        if not sums.dilution.any():
            return sums.information / excess, sums.score / excess
        dilution = _DILUTION * sums.dilution
        diluted = np.linalg.solve(sums.information + self._floor, dilution)
        part = dilution / (excess + dilution @ diluted)
        return (
            (sums.information - np.outer(part, dilution)) / excess,
            (sums.score - part * (diluted @ sums.score)) / excess,
        )

    def add(self, information: Array, score: Array, dilution: Array | float = 0.0) -> None:
        """Take in one motion; the score is that of a state of zero."""
        s = self.sums
        self.sums = _Sums(s.information + information, s.score + score, s.dilution + dilution)
        self._count += 1

    def close(self, mean: Array, covariance: Array) -> None:
        """At the end of a block, compare its score at the estimate with what is expected of it."""
        if self._count < _BLOCK:
            return
        block = self.sums.since(self._before)
        left = block.score - block.information @ mean
        chi2 = float(left @ np.linalg.solve(block.information + self._floor, left))
        freedom = N_TERMS - float((block.information * covariance).sum()) / self.excess
        self._scatter_earlier, self._scatter = self._scatter, (self._scatter[0] + chi2, self._scatter[1] + freedom)
        self._count, self._before = 0, self.sums

    def forget(self, before: _Sums) -> None:
        """Only what was added to ``before`` counts, and blocks that the change lies in tell nothing of their excess."""
        self.sums = self.sums.since(before)
        self._count, self._before, self._scatter = 0, self.sums, self._scatter_earlier
