"""Several motions in one image: do the points that agree belong to something other than the scene?

A lorry alongside, smoke, or a texture that travels with the camera may have more corners than the static scene. The
number of corners then says nothing; the scene is recognised by the share of the image that its motion explains, and by
a motion that a vehicle could continue. Which motion is that of the scene is never certain: the covariance is that of
the mixture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera
from gpvo.vo.config import KNOWN_DEPTH_PX
from gpvo.vo.frontend import Matches
from gpvo.vo.motion import Motion, predict_uvd, residual_covariance, transfer

_CELLS = 96  # of the whole image
EXPLAINED = 0.8  # share of the cells; below, a rival is looked for
_LEAST = 8  # points: a motion through any three is found by chance, a tight one through eight is not
_NOISY = 3.0  # times the noise of a point, as the motion makes it: it may be off by as much
_STILL_PX = 0.5  # change of a measurement by noise alone
_SHARE = 1 / 8  # of the other's cells: a motion seen over less is that of an object
_NOISE = 9.0  # standard deviations of odometry's own noise that are no change of velocity
_AREA = 0.5  # power of the parts covered in the odds of being the scene, frame by frame: neighbours tell the same
_UNSEEN = -0.2  # log odds of the expected motion that nothing in the image makes
_REMEMBERED_S = 4.0  # for so long the parts that a motion explained speak for it
_SUREST = 3.0  # log odds at most: whoever is surer could not be put right
_IN_FRONT = 1.5  # times as near as usual: the farthest points of what hides the scene
LONGEST_DOUBT_NS = 30 * 10**9
_REGAINED = 0.3  # log odds, with each frame in which nothing speaks against the motion


@dataclass(frozen=True)
class Expected:
    """``T_prev_cur`` (4, 4) at the last velocity, off which a vehicle is by ``reach_m`` at most, and by ``sigma_m`` on
    each axis; ``C_turn`` (3, 3) covariance of its turn [rad^2]; ``odds``: log odds that this velocity is that against
    the scene, and not against something that moves in it. ``T_refused`` (4, 4), at a velocity that the vehicle could
    not have; ``T_left`` (4, 4), to ``left_reach_m``, at one that was left though an IMU says that it lasts."""

    T_prev_cur: Array
    reach_m: float
    sigma_m: float
    odds: float
    C_turn: Array = field(default_factory=lambda: np.zeros((3, 3)))
    T_refused: Array | None = None
    felt: bool = False  # an IMU says so
    T_left: Array | None = None
    left_reach_m: float = 0.0


@dataclass(frozen=True)
class Choice:
    """Which motion is taken; covariance (6, 6) of its being another one; whether a vehicle can have made it; whether it
    tells the velocity, and is not just too noisy to contradict; log odds of what is expected from now on; whether the
    velocity goes on from the last one; ``lasting``: covariance that is stated of the next motion, too, once this one is
    believed."""

    index: int = 0
    otherwise: Array = field(default_factory=lambda: np.zeros((6, 6)))
    plausible: bool = True
    tells: bool = True
    odds: float = 0.0
    goes_on: bool = True
    lasting: Array = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass
class Leaps:
    """Remembers a velocity from which the next one leapt as no vehicle does, as it does on to traffic and off it again.

    One of the two is not the scene's, and as long as the image holds one motion alone nothing tells which. So the
    later one is in doubt for as long as the earlier had lasted, or until a leap leads back to where the vehicle can
    have come from the earlier one meanwhile. Where an IMU felt otherwise than the later one changes, the doubt lasts
    as long as any may. By what an IMU felt, a velocity may also be left slowly.
    """

    began_ns: int
    before: Array | None = None  # (6,) the velocity that was left
    left_ns: int = 0
    until_ns: int = 0
    contradicted: bool = False  # by the IMU, since

    def step(self, t_ns: int, now: Array, last: Array, t_last_ns: int, reach_mps: float) -> None:
        """The velocity leapt to ``now`` (6,) at ``t_ns``, from ``last`` (6,) at ``t_last_ns``; a vehicle can be off the
        one that was left by ``reach_mps``."""
        if self.before is None or (self.contradicted and not self.differs(last, reach_mps)):
            self.before, self.left_ns, self.contradicted = last, t_last_ns, False
            self.until_ns = t_ns + min(t_last_ns - self.began_ns, LONGEST_DOUBT_NS)
        elif not self.differs(now, reach_mps):
            self.before = None
        self.began_ns = t_ns

    def differs(self, twist: Array, reach_mps: float) -> bool:
        """Whether a velocity (6,) can be told from the one that was left, which an IMU cannot carry on for ever."""
        return self.before is not None and float(np.linalg.norm((twist - self.before)[:3])) > reach_mps

    @property
    def reason(self) -> str:
        """Of the doubt, in words."""
        if self.contradicted:
            return "the IMU felt otherwise than the velocity changed"
        return "the velocity leapt: what it was before may be the scene's"

    def doubted(self, t_ns: int, *, hidden: bool = False) -> Array | None:
        """(6,) the velocity that may still be the scene's at ``t_ns`` instead; None where the one seen is believed.
        ``hidden``: whether what is seen may hide the scene."""
        until_ns = self.began_ns + LONGEST_DOUBT_NS if self.contradicted or hidden else self.until_ns
        if self.before is not None and t_ns > until_ns:
            self.before = None
        return self.before


@dataclass
class Horizon:
    """How far away the farthest points usually are in motions that nothing speaks against.

    What hides the scene lies in front of it. So a doubt does not end with time alone while the farthest points of the
    motion that is followed are nearer than usual: the other one is not seen, as something hides it.
    """

    mean: float = 0.0  # log of the disparity that a tenth of the points fall short of
    motions: int = 0

    def see(self, far_px: float) -> None:
        """A motion that nothing speaks against, of which a tenth of the points have less disparity than this."""
        self.motions += 1
        self.mean += (float(np.log(far_px)) - self.mean) / self.motions

    def hidden(self, far_px: float) -> bool:
        """Whether a motion with this disparity may be that of something in front of the scene."""
        return self.motions > 0 and float(np.log(far_px / _IN_FRONT)) > self.mean


@dataclass
class Standing:
    """How surely the motion that is followed is that of the scene: by the parts of the image that it explains, now and
    over the last seconds.

    Where a motion explains a share s of the parts, s / (1 - s) are its odds by this frame; what the frames before said
    is averaged, as neighbours tell the same. That both count once is right on flights through simulated traffic, where
    areas and velocities, by which the motion is chosen, tell next to nothing of whether the choice was right
    (:doc:`/failures`).
    """

    before: float | None = None  # log odds by the frames before; None at the beginning of a motion
    mean: Array = field(default_factory=lambda: np.zeros(6))  # of the velocities followed so far, per second
    square: Array = field(default_factory=lambda: np.diag([1.0] * 3 + [0.01] * 3))  # mean of their outer products
    age_s: float = 1.0

    def wrong(self, share: float, *, goes_on: bool, felt: float) -> float:
        """Probability that a motion that explains this share is not that of the scene; ``felt``: how far an IMU, which
        says it is, is to be trusted, from 0 to 1."""
        now = _log_odds(share)
        before = self.before if goes_on and self.before is not None else now
        return wrong_by(now + before, felt)

    def unseen(self, twist: Array) -> Array:
        """Second moment (6, 6) about a velocity (6,) of those that the vehicle has had: it may have any of them where
        nothing in the image shows the scene."""
        cross = np.outer(self.mean, twist)
        return np.asarray(self.square - cross - cross.T + np.outer(twist, twist))

    def follow(self, share: float, twist: Array, dt_s: float, *, goes_on: bool) -> None:
        """A motion with this velocity (6,), over so long a time, that explains this share of the parts is taken."""
        now, keep = _log_odds(share), np.exp(-dt_s / _REMEMBERED_S)
        self.before = keep * self.before + (1 - keep) * now if goes_on and self.before is not None else now
        self.age_s += dt_s
        self.mean = self.mean + dt_s / self.age_s * (twist - self.mean)
        self.square = self.square + dt_s / self.age_s * (np.outer(twist, twist) - self.square)


def _log_odds(share: float) -> float:
    p = min(max(share, 0.03), 0.97)  # of a few dozen parts
    return float(np.log(p / (1 - p)))


def wrong_by(odds: float, felt: float) -> float:
    """Probability that a motion of these log odds is not the scene's, if an IMU that says it is, is to be trusted so
    far, from 0 to 1."""
    return float(1 / (1 + np.exp(odds + _SUREST * felt)))


def choose(
    motions: Sequence[Motion],
    covered: Sequence[int],
    expected: Expected | None,
    wrong: Callable[[int, bool], float] = lambda index, goes_on: 0.0,
) -> Choice:
    """The likeliest of the motions to be the scene's: the one that goes on as expected, until the parts of the image
    have spoken long enough for another. Where none goes on, what was expected is a candidate of its own.

    Moments of the mixture: ``sum p_i (d_i d_i^T + C_i)``, with d_i from the chosen motion to another, and C_i of the
    other's translation. ``wrong(index, goes_on)``: probability that another is the scene's, however likely this one is.
    """
    candidates, sigma_m = [m.T_prev_cur for m in motions], [m.worst_translation_sigma_m for m in motions]
    weight, goes_on, tells, back = _weigh(motions, sigma_m, covered, expected)
    if len(weight) > len(motions) and expected is not None:
        candidates.append(expected.T_prev_cur)
        sigma_m.append(expected.sigma_m)
    best, likeliest = int(np.argmax(weight[: len(motions)])), int(np.argmax(weight))
    plausible = best == likeliest
    on, known = bool(goes_on[best] and not back[best]), plausible and bool(tells[best])
    if len(candidates) == 1:
        odds = (0.0 if expected is None else expected.odds) + _REGAINED
        return Choice(best, plausible=plausible, tells=known, odds=min(odds, _SUREST), goes_on=on)
    odds = float(weight[likeliest] - np.delete(weight, likeliest).max())
    share = np.exp(weight - weight.max())
    share /= share.sum()
    others = 1.0 - share[best]
    if others > 0.0:  # however often the same was seen, it may be wrong
        share *= max(others, wrong(best, on)) / others
    share[best] = 0.0
    d = np.stack([se3.log(se3.inverse(candidates[best]) @ T) for T in candidates])
    otherwise = np.einsum("i,ij,ik->jk", share, d, d)
    otherwise[:3, :3] += share @ np.square(np.where(np.isfinite(sigma_m), sigma_m, 0.0)) * np.eye(3)
    if len(candidates) > len(motions) and expected is not None:
        otherwise[3:, 3:] += share[-1] * expected.C_turn
    return Choice(best, otherwise, plausible, known, min(odds, _SUREST), on)


def _weigh(
    motions: Sequence[Motion], sigma_m: Sequence[float], covered: Sequence[int], expected: Expected | None
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Log odds of each motion, and of what was expected where none goes on; which goes on; which tell the velocity; and
    which goes on from a velocity that was left."""
    # Half a cell for one that explains none better than the other does.
    area = _AREA * np.log(np.maximum(covered[: len(motions)], 0.5))
    if expected is None:
        every = np.ones(len(motions), bool)
        return area, every, every, ~every
    off_m = np.array([_apart_m(expected.T_prev_cur, m.T_prev_cur) for m in motions])
    noise_m = _NOISE * np.array(sigma_m)
    within = off_m <= np.hypot(expected.reach_m, noise_m)
    goes_on = within & (off_m == off_m.min())
    if expected.T_refused is not None:  # what is nearer to it is the same thing's, however far a vehicle can have come
        goes_on &= off_m <= [_apart_m(expected.T_refused, m.T_prev_cur) for m in motions]
    back = _back(motions, expected, np.where(within, 0.0, off_m))
    goes_on = back if back.any() else goes_on
    odds, unseen = expected.odds, _UNSEEN
    if expected.felt and (goes_on.any() or not within.any()):  # no part of the image speaks against an IMU
        area, odds, unseen = np.zeros(len(motions)), odds + _REGAINED, 0.0
    weight = area + odds * goes_on
    if not goes_on.any():
        weight = np.append(weight, weight.max() + odds + unseen)
    return weight, goes_on, back | (np.minimum(off_m, noise_m) <= expected.reach_m), back


def _back(motions: Sequence[Motion], expected: Expected, off_m: Array) -> NDArray[np.bool_]:
    """(N,) which motion goes on from a velocity that was left, and is nearer to it than to the last one; off that, each
    is by ``off_m`` (N,)."""
    if expected.T_left is None:
        return np.zeros(len(motions), bool)
    off_left_m = np.array([_apart_m(expected.T_left, m.T_prev_cur) for m in motions])
    nearer = (off_left_m <= expected.left_reach_m) & (off_left_m < off_m)
    return nearer & (off_left_m == off_left_m.min(where=nearer, initial=np.inf))


def _apart_m(first: Array, second: Array) -> float:
    return float(np.linalg.norm((se3.inverse(first) @ second)[:3, 3]))


def cells(uv: NDArray[np.floating[Any]], camera: StereoCamera) -> NDArray[np.int64]:
    """(N,) number of the square cell of the image in which each pixel (N, 2) lies."""
    side_px = (camera.width * camera.height / _CELLS) ** 0.5
    column, row = (np.asarray(uv)[:, :2] / side_px).astype(np.int64).T
    return row * (int(camera.width / side_px) + 1) + column


def unexplained(
    motion: Motion, share: float, matches: Matches, camera: StereoCamera, near_px: float, usual_px: float
) -> NDArray[np.bool_] | None:
    """(N,) the points, spare ones too, that moved otherwise, by over ``near_px`` and by more than their noise makes at
    the scale ``usual_px`` of the last motions; None where the ``share`` that the motion explains is most of the
    image."""
    if share >= EXPLAINED:
        return None
    off_px = _off_px(motion.T_prev_cur, matches, camera)
    allowed_px = np.full(len(off_px), max(near_px, 6 * motion.scale_px))
    if 2 * motion.inliers.sum() > matches.strong.sum():  # what most points contradict cannot call them noisy
        # A compromise between two motions has larger residuals than the last motions had.
        noise_px = _NOISY * min(usual_px, motion.scale_px) * _amplified(motion, matches, camera)
        allowed_px = np.maximum(allowed_px, noise_px)
    free = (matches.uvd_prev[:, 2] > KNOWN_DEPTH_PX) & (off_px > allowed_px)
    return free if free.sum() >= _LEAST else None


def explained(motion: Motion, matches: Matches, camera: StereoCamera, near_px: float, margin_px: float) -> float:
    """Share of the cells with points of the reference, but for those that the motion puts out of sight, in which one
    agrees to ``near_px``; 1 where they are not known. ``margin_px`` of the image's border, points are not found.

    Points at infinity do not count: they agree with any translation.
    """
    if matches.sought_uvd is None:
        return 1.0
    off_px = _off_px(motion.T_prev_cur, matches, camera)
    (u, v, d), in_front = predict_uvd(motion.T_prev_cur, matches.sought_uvd, camera)
    inside = (u - d > margin_px) & (u < camera.width - margin_px) & (v > margin_px) & (v < camera.height - margin_px)
    tells, told = (uvd[:, 2] > KNOWN_DEPTH_PX for uvd in (matches.sought_uvd, matches.uvd_prev))
    sought = np.unique(cells(matches.sought_uvd[in_front & inside & tells], camera))
    agree = np.isin(sought, cells(matches.uvd_prev[(off_px < near_px) & told], camera))
    return float(agree.sum() / max(len(sought), 1))


def untangled(
    motion: Motion,
    matches: Matches,
    camera: StereoCamera,
    estimate: Callable[[Matches, NDArray[np.bool_]], Motion | None],
) -> tuple[Motion, bool]:
    """The motion, and whether that of the scene was told from points that something holds in place in the image.

    A bonnet, dirt on a lens or lettering stay in place with their disparity while the scene moves by pixels, and as all
    are within reach of a compromise, one through both would have small residuals. So the points that move have a motion
    of their own; where it contradicts those that stay and covers more of the image, these are left out. Of points that
    stay, those at infinity do not count: they tell no translation, but may be dirt.
    """
    still = np.linalg.norm(matches.uvd_cur - matches.uvd_prev, axis=1) < _STILL_PX
    if min(still.sum(), (~still).sum()) < _LEAST:
        return motion, False
    moving = estimate(matches, ~still)
    if moving is None:
        return motion, False
    off_px = _off_px(moving.T_prev_cur, matches, camera)
    if (off_px[still] > 4 * _STILL_PX).sum() < _LEAST:  # by less, far points of the scene stay beside a car
        return motion, False
    held = still & (off_px > 2 * _STILL_PX)
    told = matches.uvd_prev[:, 2] > KNOWN_DEPTH_PX
    n_held, n_moving = (len(np.unique(cells(matches.uvd_cur[of & told], camera))) for of in (held, moving.inliers))
    freed = estimate(matches, ~held) if n_held <= n_moving else None
    return (motion, False) if freed is None else (freed, True)


def areas(first: Motion, second: Motion, matches: Matches, camera: StereoCamera, near_px: float) -> tuple[int, int]:
    """Cells of the image in which each of two motions explains points to ``near_px``, and better than the other does.

    The second has none where it is that of an object, or a chance agreement: that is loose, as any place within the
    threshold is as likely.
    """
    off_px = np.stack([_off_px(m.T_prev_cur, matches, camera) for m in (first, second)])
    close = (off_px < near_px) & (off_px == off_px.min(axis=0))
    n_first, n_second = (len(np.unique(cells(matches.uvd_cur[c], camera))) for c in close)
    loose = second.scale_px > max(2 * first.scale_px, 0.25 * near_px)
    chance = loose or second.inliers.sum() < _LEAST or n_second < _SHARE * n_first
    return n_first, 0 if chance else n_second


def _off_px(T_prev_cur: Array, matches: Matches, camera: StereoCamera) -> Array:
    """(N,) distance [px] of each point from where the motion puts it, in image and disparity."""
    uvd, in_front = predict_uvd(T_prev_cur, matches.uvd_prev, camera)
    off = np.linalg.norm(matches.uvd_cur - uvd.T, axis=1)
    return np.where(in_front, off, np.inf)


def _amplified(motion: Motion, matches: Matches, camera: StereoCamera) -> Array:
    """(N,) how many times as strong as between two frames at rest a point's noise is along its residual: where the
    camera comes near, a small error of depth is a large one of where the motion puts it."""
    moved, S = transfer(motion.T_prev_cur, matches.uvd_prev, camera), motion.noise.S
    C, r = residual_covariance(moved.G, S, S, motion.noise.persistent), matches.uvd_cur.T - moved.uvd
    at_rest, now = 2.0 * np.einsum("in,ij,jn->n", r, S, r), np.einsum("in,ijn,jn->n", r, C, r)
    return np.sqrt(now / np.maximum(at_rest, 1e-12))
