"""Errors of the calibration between the cameras, estimated from the residuals of odometry itself.

Where the right image is displaced by (dx, dy) in normalised coordinates, measured disparity is too small by ``fx dx``
and the row in the right image too large by ``fy dy``. To first order a rotation (wx, wy, wz) of the right camera, a
relative error s of its focal length and a shift (c, e) of its centre displace a point at (x, y) by

    dx = -xy wx + (1 + x^2) wy - y wz + x s + c,    dy = -(1 + y^2) wx + xy wy + x wz + y s + e

(H. Longuet-Higgins, K. Prazdny, "The interpretation of a moving retinal image", 1980, eq. 2.12). Lenses add to each
term, and terms of higher order: a centre shifted under distortion of second and fourth order displaces the image by
polynomials of that order (D. Brown, "Decentering distortion of lenses", 1966). So the coefficients of both fourth-order
polynomials are free, but for the x term of the rows, which no lens makes: it shows a turn about the optical axis. Turns
are a part of the prior covariance. A Kalman filter of constant state estimates them: dx from the residuals of each
motion, with the motion as an unknown without a prior, and dy from the rows, which need no motion. What cannot be told
apart from motion: the depth's scale. One more coefficient is the time by which the right image is later than the left
one: it displaces a point by its velocity in that image, which the motion and its depth tell.

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
from gpvo.vo.beliefs import Blocks, Gaussians, Sums
from gpvo.vo.motion import NO_TWIST, Apart, Motion, Whitened, apply_whitener, mistakable, right_velocity

_HIGHEST = 4  # order
POWERS = np.array([(n - j, j) for n in range(_HIGHEST + 1) for j in range(n + 1)])  # of x and y, order by order
ORDER = POWERS.sum(axis=1)
N_TERMS = len(POWERS)
LATE = 2 * N_TERMS  # place of the right image's delay, after the terms of dx and of dy
N_COEFFICIENTS = LATE + 1
_DX, _DY = np.append(np.arange(N_TERMS), LATE), np.arange(N_TERMS, N_COEFFICIENTS)
_TURNS = np.zeros((N_COEFFICIENTS, 3))  # what turns of the right camera about x, y and z displace
_TURNS[[4, N_TERMS, N_TERMS + 5], 0] = -1.0
_TURNS[[0, 3, N_TERMS + 4], 1] = 1.0
_TURNS[[2, N_TERMS + 1], 2] = -1.0, 1.0
_IN_DX, _IN_DY = np.ix_(_DX, _DX), np.ix_(_DY, _DY)
_N = len(_DX)  # coefficients that displace one coordinate
# Standard deviations of the prior. Terms beyond the constant are given at half the width of the image.
_DISPARITY_PX = (0.1, 0.3)  # the constant, which motion tells least; the others
_ROW_PX = (3.0, 1.0)  # the constant, the others: rows are seen at once, and cost nothing to leave free
_ROW_X_PX = 0.1  # the x term of the rows, beyond the turn
_TURN_RAD = 2.5e-4  # of the right camera about its vertical and its optical axis
_LATE_S = 2e-3  # of cameras that are not triggered together: software that starts one after the other takes so long
# Rigs that are not exact: their mounting, and apart from it their lenses, are so many times as wrong, equally likely.
# A camera can be knocked by any angle; a lens stays what it is.
_MOUNTINGS, _LENSES = (0.3, 1.0, 4.0, 16.0), (0.3, 1.0, 4.0)
_EXACT_LENS = 0.01  # times as wrong as usual, as good as exact
_ROLLS = (1.0, 16.0)  # the same of the turn about the optical axis, which rows show at once
_NEGLIGIBLE = 1e-30  # probability: no variance is so many times another
_STEP, _STEPS = 5, 20  # motions from one look for a move of the cameras to the next; of those looked back over
_LIKELY_RAD, _KNOCK_RAD = 1.7e-3, 0.05  # by which a knock turns a camera about each axis, usually and at most
_JOLT = 0.01  # and by which it moves a lens, in units of the prior
_MOVED = 50.0  # log odds of two rigs over one from which the cameras have moved: on real drives at most 26
_UNDISPLACED = 0.9  # share of the points that lie alike, in rows that are allowed
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
    """(31, 31) of the coefficients of dx, then of dy, each in the order of :data:`POWERS`, and of the delay [s].

    Of rigs whose right camera stands ``mounting`` times as wrong as usual, ``roll`` times about its optical axis, and
    whose lenses bend ``lens`` times as wrong.
    """
    reach = (0.5 * camera.width / camera.fx_px) ** ORDER
    vertical, optical = np.where(np.arange(N_COEFFICIENTS) < N_TERMS, _TURNS[:, 1], 0.0), _TURNS[:, 2]
    rows_px = np.where(ORDER == 0, *_ROW_PX)
    rows_px[1] = _ROW_X_PX
    disparity_px = np.where(ORDER == 0, mounting * _DISPARITY_PX[0], lens * _DISPARITY_PX[1])
    free = np.concatenate([disparity_px / camera.fx_px / reach, rows_px / camera.fy_px / reach, [_LATE_S]])
    turns = mounting**2 * np.outer(vertical, vertical) + roll**2 * np.outer(optical, optical)
    return np.diag(free**2) + _TURN_RAD**2 * turns


@dataclass(frozen=True)
class RigState:
    """Coefficients as known: ``mean`` (31,) and ``covariance`` (31, 31), of dx, then of dy, each in the order of
    :data:`POWERS`, and the delay of the right image [s].

    ``probability``: that the disparities are off at all.
    """

    mean: Array
    covariance: Array
    probability: float

    @classmethod
    def prior(cls, camera: StereoCamera) -> RigState:
        """Nothing known but the calibration."""
        return cls(np.zeros(N_COEFFICIENTS), prior_covariance(camera), 0.5)

    @classmethod
    def exact(cls) -> RigState:
        """The calibration is right beyond doubt."""
        return cls(np.zeros(N_COEFFICIENTS), np.zeros((N_COEFFICIENTS, N_COEFFICIENTS)), 0.0)


class RigError:
    """The running estimate, and what it does to measurements.

    Parameters
    ----------
    camera : the rectified pair as calibrated.
    known : where to start; by default from nothing.
    learn : whether motions change it.

    Where the evidence is that the right camera has turned in the last 20 motions, how it stood before is forgotten (R.
    Adams, D. MacKay, "Bayesian online changepoint detection", 2007). ``moved``: how often. ``twist``: the camera's
    velocity (6,) per second where none is given: that expected of the frame at hand.
    """

    def __init__(self, camera: StereoCamera, known: RigState | None = None, *, learn: bool = True) -> None:
        self._camera, self._displaced, self.moved, self.twist = camera, False, 0, NO_TWIST
        self.state = known or RigState.prior(camera)
        # What is right beyond doubt stays so.
        self._learn = learn and bool(self.state.covariance.any())
        if not self._learn:
            return
        precision = np.asarray(np.linalg.inv(self.state.covariance), np.float64)
        self._blocks = tuple(Blocks(precision[part]) for part in (_IN_DX, _IN_DY))
        self._undisputed, self._apart = 0, Apart()  # motions since one was disputed; whether two bodies move
        self._motions, self._past = 0, deque[tuple[tuple[Sums, ...], RigState]](maxlen=_STEPS)
        # A state from a file is no calibration to return to.
        self._kinds = _rigs(self.state.mean, camera, _LENSES) if known is None else _rig(known.mean, known.covariance)
        self._exact = _rig(np.zeros(_N), prior_covariance(camera, roll=0.0)[_IN_DY])
        self._exact_lenses = _rigs(self.state.mean, camera, (_EXACT_LENS,), (1.0,))
        self.state = self._mixed(np.zeros_like(precision), np.zeros(len(precision)))

    def correct(self, uvd: Array, twist: Array | None = None) -> Array:
        """Measurements (N, 3) of (u, v, d) as the right camera would have given them in its place and time [px], from a
        camera that moves with ``twist`` (6,), or (6, N)."""
        d_error, row_error = self.errors(uvd, twist)
        if self.is_late:  # the velocity depends on the depth, and so on the disparity without its error
            d_error, row_error = self.errors(uvd - d_error[:, None] * (1.0, 0.0, 1.0), twist)
        return uvd - np.column_stack([np.zeros_like(d_error), 0.5 * row_error, d_error])

    @property
    def is_late(self) -> bool:
        """Whether the right image is known to be earlier or later than the left one by more than a thought."""
        return bool(abs(self.state.mean[LATE]) > _LATE_S / 10)

    def allows(
        self, uvd: Array, row_error: Array, min_disparity_px: float, max_disparity_px: float, max_row_error_px: float
    ) -> NDArray[np.bool_]:
        """(N,) whether disparity and row of a match are possible, given what is known and what is not."""
        with np.errstate(invalid="ignore"):
            d_expected, row_expected = self.errors(uvd)
            d = uvd[:, 2] - d_expected
            rows = np.abs(row_error - row_expected) <= max_row_error_px + self._rows_known_px(uvd)
            return (d >= min_disparity_px) & (d <= max_disparity_px) & rows

    def _rows_known_px(self, uvd: Array) -> Array:
        """(N,) to how many pixels the rows of measurements (N, 3) are known: three standard deviations."""
        phi = np.concatenate([self._at(uvd), right_velocity(self.twist, uvd, self._camera)[1:]])
        variance = (phi * (self.state.covariance[N_TERMS:, N_TERMS:] @ phi)).sum(0)
        return np.asarray(3.0 * (self._camera.fy_px * np.sqrt(variance)))

    def displaced(self, uvd: Array, row_error: Array, max_row_error_px: float) -> tuple[Array, Array] | None:
        """Measurements (m, 3) and row errors (m,) of the points that lie as many rows too low or too high alike: where
        most do, and a tenth of these is not allowed for it. Those that are would not say how many rows. A point with a
        number that is not finite is none."""
        known = np.isfinite(uvd).all(axis=1) & np.isfinite(row_error)
        uvd, row_error = uvd[known], row_error[known]
        off = row_error - self.errors(uvd)[1]
        alike = np.abs(off - median(off)) <= max_row_error_px
        off, uvd, row_error = off[alike], uvd[alike], row_error[alike]
        if not len(off) or 2 * len(off) < len(alike):
            return None
        near = np.abs(off) <= max_row_error_px + self._rows_known_px(uvd)
        return None if near.mean() >= _UNDISPLACED else (uvd, row_error)

    def update(
        self,
        motion: Motion,
        white: Whitened,
        row_error: Array,
        min_disparity_px: float,
        *,
        displaced: tuple[Array, Array] | None = None,
        disputed: bool = False,
        of_depth: bool = True,
        twists: tuple[Array, Array] = (NO_TWIST, NO_TWIST),
    ) -> tuple[Array, Array]:
        """Learn from a motion over corrected measurements and its whitened residuals; its inliers have these row errors
        (M,), which do not count where all points of the image are ``displaced``. Where the images tell nothing
        ``of_depth``, it teaches rows alone: what disparities teach lasts. ``disputed``: another motion may be that of
        the scene. ``twists``: the camera's velocity at its begin and at its end.

        Returns
        -------
        Covariances (6, 6) to add: ``K P K^T`` of the state before, K the motion's derivative by dx, which all motions
        share; and that of two bodies.
        """
        fx, moved, scale_px = self._camera.fx_px, white.moved, max(motion.scale_px, 0.1)
        z = white.z / scale_px
        # At the points as smoothed by both frames: their noise is independent of the residual, that of the measured
        # ones is not and would be taken for an error of the rig.
        late_s = float(self.state.mean[LATE])
        phi = self._terms(moved.uvd.T, twists[1], late_s)
        M = fx * moved.G[:, 2][:, None] * self._terms(motion.uvd_prev, twists[0], late_s)[0]
        M[2] -= fx * phi[0]
        B = apply_whitener(white.W, M)
        root = np.sqrt(np.minimum(1.0, 3.2 / np.sqrt((z**2).sum(0) + 1e-9)))
        by_motion, B = white.A * (root / scale_px), B * (root / scale_px)
        A = by_motion.transpose(0, 2, 1).reshape(-1, 6)
        B = np.column_stack([B.transpose(0, 2, 1).reshape(-1, _N), (z * root).reshape(-1)])
        K = np.linalg.solve(A.T @ A, A.T @ B[:, :-1])
        added: Array = K @ self.state.covariance[_IN_DX] @ K.T
        of_bodies: Array = np.zeros((6, 6))
        if self._learn and self._lasts(displaced is not None):
            self._undisputed = 0 if disputed else self._undisputed + 1
            sigma_px = motion.scale_px * np.sqrt(1.0 + motion.noise.persistent)
            near = motion.uvd_prev[:, 2] > min_disparity_px + _NEAR * sigma_px
            if of_depth and near.sum() >= 8:
                # The derivatives by the translation are in proportion to the disparity, and so to its error.
                by_d = motion.scale_px**2 / motion.uvd_prev[:, 2] * (root / scale_px)
                mistaken = (apply_whitener(white.W, q) * by_d for q in mistakable(motion, white))
                dilution = np.stack([(by_motion[:, :3] * q[:, None])[..., near].sum((0, 2)) for q in mistaken], axis=1)
                of_near = np.tile(near, 3)
                of_bodies = self._learn_disparities(A[of_near], B[of_near], dilution)
            by_dy, of = (phi, row_error) if displaced is None else (self._terms(displaced[0], twists[1]), displaced[1])
            self._learn_rows(by_dy[1], of)
            self._conclude()
        return added, of_bodies

    def _learn_disparities(self, A: Array, B: Array, dilution: Array) -> Array:
        """``A`` (n, 6), ``B`` (n, 17): whitened derivatives by the motion, by dx, and residuals; ``dilution`` (3, 3)
        of the translation's score, each column for another part of the noise. Covariance (6, 6) of two bodies."""
        rest = B - A @ (K := np.linalg.solve(A.T @ A, A.T @ B))
        information, score = (sums := rest.T @ rest)[:-1, :-1], sums[:-1, -1]
        by_rig = float(sums[-1, -1] - score @ np.linalg.lstsq(information, score, rcond=None)[0])
        if not self._apart.see(A, B[:, -1], by_rig):
            self._blocks[0].add(information, score + information @ self.state.mean[_DX], -K[:3, :-1].T @ dilution)
        return self._apart.otherwise

    def _learn_rows(self, by_dy: Array, row_error: Array) -> None:
        """``by_dy`` (16, M): derivatives by dy. Far points tell as much as near ones. Cameras that have moved displace
        all rows, which is no noise of single ones."""
        rows = self._camera.fy_px * by_dy
        off = row_error - self.state.mean[_DY] @ rows
        off = np.abs(off - np.linalg.lstsq(rows[:3].T, off, rcond=None)[0] @ rows[:3])  # without a shift and a turn
        sigma = max(1.4826 * median(off), 0.05)
        weighted = rows * np.minimum(1.0, 2.5 * sigma / np.maximum(off, 1e-9)) / sigma**2
        self._blocks[1].add(weighted @ rows.T, weighted @ row_error)

    def update_rows(self, displaced: tuple[Array, Array] | None) -> None:
        """Learn from rows alone, as of :meth:`displaced`, of a pair without a motion; None where they tell nothing."""
        if self._learn and self._lasts(displaced is not None) and displaced is not None:
            self._learn_rows(self._terms(displaced[0], self.twist)[1], displaced[1])
            self._conclude()

    def _lasts(self, displaced: bool) -> bool:
        """Whether this pair tells of the cameras: rows that it alone displaces, not the pair before, were lost."""
        before, self._displaced = self._displaced, displaced
        return before or not displaced

    def _look_back(self) -> None:
        """If the cameras were turned against one another, forget how they stood, and nothing else."""
        self._motions += 1
        if self._motions % _STEP or not self._past:
            return
        ages = range(1, len(self._past) + 1)
        if max(self._turned(age) for age in ages[::_STEP]) > _MOVED:
            sums, state = self._past[-max(ages, key=self._turned)]
            for block, before in zip(self._blocks, sums, strict=True):
                block.forget(before)
            turned = _KNOCK_RAD**2 * _TURNS @ _TURNS.T + _JOLT**2 * prior_covariance(self._camera)
            self._kinds = _rig(state.mean, state.covariance + turned)
            self.moved += 1
            self._past.clear()

    def _turned(self, age: int) -> float:
        """Log odds that the right camera has turned in the last ``age`` motions: what it displaces has to fit together.
        While another motion was in the image, the rows alone must say so as well."""
        sums, state = self._past[-age]
        of_dx, of_dy = (block.believed(block.sums.since(b)) for block, b in zip(self._blocks, sums, strict=True))
        if age > self._undisputed:
            odds = _odds_of_a_turn(state, *_joined([(0.0 * of_dx[0], 0.0 * of_dx[1]), of_dy]))
            if odds <= 0.0:
                return odds
        return _odds_of_a_turn(state, *_joined([of_dx, of_dy]))

    def _conclude(self) -> None:
        """The state given all that was learnt."""
        self._look_back()
        self.state = self._mixed(*_joined([block.believed() for block in self._blocks]))
        for part, square, block in zip((_DX, _DY), (_IN_DX, _IN_DY), self._blocks, strict=True):
            block.close(self.state.mean[part], self.state.covariance[square])
        self._past.append((tuple(block.sums for block in self._blocks), self.state))

    def _mixed(self, information: Array, score: Array) -> RigState:
        """The posterior over rigs of every kind, as one Gaussian of its mean and covariance."""
        rigs = self._kinds.given(information, score)
        means, n_kinds = rigs.mean.reshape(-1, N_COEFFICIENTS), rigs.evidence.size
        if n_kinds == 1:
            return RigState(means[0], rigs.C[0], 1.0)
        # A rig whose disparities are exact is as likely as all kinds of others.
        exact = self._exact.given(information[N_TERMS:, N_TERMS:], score[_DY])
        log_weight = np.append(rigs.evidence, exact.evidence + np.log(n_kinds))
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        mean, is_exact = weight[:-1] @ means, weight[-1:, None]
        mean[_DY] += weight[-1] * exact.mean[0, 0]
        covariance = rigs.covariance(weight[:-1].reshape(rigs.evidence.shape)) + weight[:-1] * means.T @ means
        if weight[-1] > _NEGLIGIBLE:
            squares = exact.covariance(is_exact) + weight[-1] * np.outer(exact.mean, exact.mean)
            covariance[N_TERMS:, N_TERMS:] += squares
            untold = self._untold(information, score, float(exact.evidence[0, 0]))
            covariance[:N_TERMS, :N_TERMS] += weight[-1] * untold
        return RigState(mean, covariance - np.outer(mean, mean), float(1.0 - weight[-1]))

    def _untold(self, information: Array, score: Array, exact_evidence: float) -> Array:
        """(15, 15) of the disparities of a rig that looks exact: exact lenses tell nothing of how they are mounted."""
        rigs = self._exact_lenses.given(information, score)
        evidence = rigs.evidence
        every = np.append(evidence, exact_evidence + np.log(evidence.size))
        return rigs.covariance(np.exp(evidence - np.logaddexp.reduce(every)))[:N_TERMS, :N_TERMS]

    def _terms(self, uvd: Array, twist: Array, late_s: float = 0.0) -> Array:
        """(2, 16, N) derivatives of dx and of dy by their coefficients, at the place in the right image, from where
        ``late_s`` may be still to come."""
        out = np.empty((2, _N, len(uvd)))
        out[:, :-1], out[:, -1] = self._at(uvd), right_velocity(twist, uvd, self._camera, late_s)
        return out

    def _at(self, uvd: Array) -> Array:
        """(15, N) the terms at the place in the right image."""
        c = self._camera
        return terms((uvd[:, 0] - uvd[:, 2] - c.cx_px) / c.fx_px, (uvd[:, 1] - c.cy_px) / c.fy_px)

    def tilt(self, uvd: Array) -> Array:
        """(N,) the part of the row errors that a turn about the optical axis makes [px]."""
        return np.asarray(self._camera.fy_px * self.state.mean[N_TERMS + 1] * self._at(uvd)[1], np.float64)

    def errors(self, uvd: Array, twist: Array | None = None) -> tuple[Array, Array]:
        """(N,) errors of disparity and of the row difference [px]; ``twist`` as for :meth:`correct`."""
        c, mean = self._camera, self.state.mean
        displaced = mean[:LATE].reshape(2, -1) @ self._at(uvd)
        displaced += mean[LATE] * right_velocity(self.twist if twist is None else twist, uvd, c)
        return -c.fx_px * displaced[0], c.fy_px * displaced[1]


def _rig(mean: Array, covariance: Array) -> Gaussians:
    """One kind of rig, of a mean (n,) and covariance (n, n)."""
    return Gaussians.of(mean, covariance[None, None])


def _rigs(mean: Array, camera: StereoCamera, lenses: Sequence[float], rolls: Sequence[float] = _ROLLS) -> Gaussians:
    """Kinds of rigs of this mean (31,): a row for each kind of lens."""
    rows = [[prior_covariance(camera, m, lens, roll) for m, roll in product(_MOUNTINGS, rolls)] for lens in lenses]
    return Gaussians.of(mean, np.array(rows))


def _odds_of_a_turn(state: RigState, information: Array, score: Array) -> float:
    """Log odds that the right camera has turned since it was known as ``state``, by what was measured since then."""
    score, evidence = score - information @ state.mean, []
    for turn_rad in (0.0, _LIKELY_RAD):
        covariance = state.covariance + turn_rad**2 * _TURNS @ _TURNS.T
        A = np.eye(N_COEFFICIENTS) + covariance @ information
        evidence.append(0.5 * float(score @ np.linalg.solve(A, covariance @ score) - np.linalg.slogdet(A)[1]))
    return evidence[1] - evidence[0]


def _joined(learnt: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Information (31, 31) and score (31,) of all coefficients from those of dx and of dy, which share the delay."""
    information, score = np.zeros((N_COEFFICIENTS, N_COEFFICIENTS)), np.zeros(N_COEFFICIENTS)
    for part, square, (more, more_score) in zip((_DX, _DY), (_IN_DX, _IN_DY), learnt, strict=True):
        information[square] += more
        score[part] += more_score
    return information, score
