"""When can a motion be trusted, and do the two images of a pair belong together?

No motion is ever made up silently.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.geometry import se3
from gpvo.stats.series import median
from gpvo.types import Array, Status, StereoCamera
from gpvo.vo.config import KNOWN_DEPTH_PX, TELLING_PX, VoConfig
from gpvo.vo.frontend import Matches, Observation, RightSearch
from gpvo.vo.motion import Motion, predict_uvd, within
from gpvo.vo.opencv import ImageStats
from gpvo.vo.points import ResidualMoments

_ENOUGH_FOR_SIGMAS = 8  # points
_MEMORY = 0.8  # of the running sums: about five frames
_NAMED_FROM = 0.05  # share of the frames
_DARKER = 1.25
_BLURRED = 2.0  # times; a pair in focus is within a tenth
_LATE = 0.25  # frames between left and right
_RIG_PX = 1.0  # by which a wrong rig displaces rows at most, a shift of all apart (a focal length that is 1 % off)

_CURES = {
    "frozen": "one image repeats itself while the other changes; look at its camera's driver",
    "partly": "a part of an image is that of the frame before; look at the driver, its buffers, and the decoder",
    "late": "left and right are a frame apart; pair them by time stamp, or trigger both cameras together",
    "swapped": "most points lie behind the cameras; exchange left and right",
    "rows": "most points are in a different row on the right; calibrate the pair again",
    "few": "most points are not found in the right image; look at its exposure, focus and lens, and whether the"
    " calibration is of these images: ones that are rectified already have another; what is very near takes"
    " --set max_disparity_share=0.5",
    "blur": "one image is much more blurred than the other; focus and clean both lenses, and shorten their exposure",
    "light": "left and right differ in brightness; give both cameras the same exposure and gain",
    "woven": "every second row is of another moment; let the cameras scan progressively, or drop these rows",
    "held": "points stay in place while the image moves; mask what is fixed to the camera, and clean both lenses",
    "moved": "the cameras move against one another, or see other moments; fasten them, and trigger both together",
    "size": "the calibration is of images twice as large; scale it, or use images of full size",
}


@dataclass(frozen=True)
class Verdict:
    """A status with its reason in words, empty for ``ok``."""

    status: Status
    reason: str = ""


def agrees(T_prev_cur: Array, matches: Matches, camera: StereoCamera, threshold_px: float) -> NDArray[np.bool_]:
    """(N,) whether the motion predicts each point where it was found, in the left image and in disparity."""
    uvd, in_front = predict_uvd(T_prev_cur, matches.uvd_prev, camera)
    return in_front & within(matches.uvd_cur.T - uvd, threshold_px)


def judge(
    matches: Matches,
    motion: Motion | None,
    camera: StereoCamera,
    config: VoConfig,
    *,
    frozen: str = "",
    usual_inliers: float = 0.0,
    doubts: Sequence[str] = (),
) -> Verdict:
    """Status of a solved motion.

    ``frozen``: which images repeat exactly although the camera was moving. ``usual_inliers``: number in motions so far.
    ``doubts``: objections from other checks. Translation is measured against the baseline: a motion with a standard
    deviation of half a baseline is ``degraded``, of five baselines ``lost``.
    """
    if frozen:
        return Verdict(Status.LOST, frozen)
    if motion is None:
        return Verdict(Status.LOST, _no_motion(matches, config))
    inliers, tracked = int(motion.inliers.sum()), max(matches.n_tracked, 1)
    if inliers < config.min_inliers or inliers < 0.12 * tracked:
        return Verdict(Status.LOST, f"only {inliers} of {tracked} points agree")
    sigma_m = motion.worst_translation_sigma_m
    if not sigma_m < 5 * camera.baseline_m or _all_at_infinity(motion):
        return Verdict(Status.LOST, "the points do not determine the translation")
    doubts = list(doubts)
    if inliers < usual_inliers / 3:
        doubts.append(f"only {inliers} points agree where {usual_inliers:.0f} usually do")
    if sigma_m > 0.5 * camera.baseline_m:
        doubts.append(f"translation uncertain by {sigma_m:.2g} m")
    if inliers < config.weak_inliers or inliers < 0.35 * tracked:
        doubts.append(f"only {inliers} of {tracked} points agree")
    if not motion.converged:
        doubts.append("the estimate did not converge")
    spread = np.std((motion.uvd_prev[:, :2] - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px], axis=0)
    # A twentieth of the image: rotation and translation can no longer be told apart.
    if spread.max() < 0.05 * camera.width / camera.fx_px:
        doubts.append("all points lie in a small part of the image")
    return Verdict(Status.DEGRADED, "; ".join(doubts)) if doubts else Verdict(Status.OK)


def _no_motion(matches: Matches, config: VoConfig) -> str:
    """Why none was found: too far away is all that can be wrong with points before a motion is tried."""
    strong = matches.strong
    near, n = int((matches.uvd_prev[strong, 2] > TELLING_PX).sum()), int(strong.sum())
    if near < config.min_inliers <= n:
        return f"only {near} of {n} points are near enough to show a motion (disparity over {TELLING_PX:g} px)"
    return f"no motion fits the {matches.n_tracked} tracked points"


def _all_at_infinity(motion: Motion) -> bool:
    """Whether the disparities are no larger than noise would make those of points at infinity: then they tell no
    translation, however much information the noise pretends. Smoothed over both frames, each has the variance of one
    image coordinate."""
    n, sigma2 = len(motion.uvd_prev), motion.scale_px**2 * (1.0 + motion.noise.persistent)
    # Three standard deviations of chi-square.
    return float((motion.uvd_prev[:, 2] ** 2).sum()) < sigma2 * (n + 3.0 * np.sqrt(2.0 * n))


def _log10_condition(information: Array, depth_m: float) -> float:
    """log10 of the condition number of a (6, 6) information matrix, lengths in units of the median depth."""
    scale = np.array([depth_m] * 3 + [1.0] * 3)
    values = np.linalg.eigvalsh(information * scale[:, None] * scale)
    return float(np.log10(values[-1] / values[0])) if values[0] > 0 else 16.0


def median_parallax_px(matches: Matches, inliers: NDArray[np.bool_]) -> float:
    """Median image motion of the inliers [px], far ones apart if there are others: they stand still while one moves."""
    near = inliers & (matches.uvd_prev[:, 2] > KNOWN_DEPTH_PX)
    chosen = near if near.any() else inliers
    off = matches.uvd_cur[chosen, :2] - matches.uvd_prev[chosen, :2]
    return median(np.hypot(off[:, 0], off[:, 1]))


def disparities_px(matches: Matches, inliers: NDArray[np.bool_], *percentiles: float) -> Array:
    """Disparities [px] that so many percent of the inliers fall short of."""
    d = np.sort(matches.uvd_cur[inliers, 2])  # np.percentile, at a tenth of its time
    return np.maximum(np.interp(np.array(percentiles) / 100 * (len(d) - 1), np.arange(len(d)), d), KNOWN_DEPTH_PX)


class PairWatch:
    """Watches the pairs of a run: :meth:`step` says what is doubtful in one, :meth:`findings` what is in the run.

    ``late``: by how many frames the right image is older than the left one, 0 where nothing speaks for it.
    ``unsharp``: whether disparities of the last pair are not to be learned from: one image was far more blurred than
    the other, so that the search on the right stops near where it began, rows were of two moments, or an image, or a
    part of one, was that of the frame before.
    """

    def __init__(self, camera: StereoCamera) -> None:
        # A principal point in the lower right corner is the centre of an image of twice the size.
        doubled = 2 * np.array([camera.cx_px, camera.cy_px]) / [camera.width, camera.height]
        self._half_size = bool((np.abs(doubled - 2.0) < 0.4).all())
        self._rows = np.zeros(4)
        self.late = 0.0
        self.unsharp = self._woven = False
        self._frames = 0
        self._seen: Counter[str] = Counter()

    def step(self, seen: Observation, right: RightSearch | None) -> list[str]:
        """What is doubtful about this pair, in words; empty for a good one."""
        self._frames += 1
        self._seen["frozen"] += bool(seen.alone)
        self._seen["light"] += not 1 / _DARKER < seen.right_light < _DARKER
        blurred = not 1 / _BLURRED < seen.right_blur < _BLURRED
        self._seen["blur"] += blurred
        self._seen["woven"] += seen.woven
        woven, self._woven = seen.woven or self._woven, seen.woven
        self.unsharp = blurred or woven or bool(seen.alone) or seen.partly
        doubts = ["every second row is of another moment"] if woven else []
        if blurred:
            side, times = ("right", seen.right_blur) if seen.right_blur > 1.0 else ("left", 1.0 / seen.right_blur)
            doubts.append(f"the {side} image is {times:.1f} times as blurred as the other")
        if self._half_size:
            self._seen["size"] += 1
            doubts.append("the principal point lies in the corner of the image")
        if right is None or seen.alone:  # rows of an older image say nothing of the next one
            return doubts
        self.late = self._lateness(right)
        if self.late:
            self._seen["late"] += 1
            doubts.append(f"the {'right' if self.late > 0 else 'left'} image is {abs(self.late):.1f} frames older")
        lost = right.sought - right.found
        cause = "swapped" if right.behind > 0.5 * lost else "rows" if right.off_row > 0.5 * lost else "few"
        # A point that is not found may be in the dark; one found where it cannot be says that the images are no pair.
        if lost > (0.4 if cause == "few" else 0.2) * right.sought:
            self._seen[cause] += lost > 0.4 * right.sought and not self.late  # which moves points out of their rows
            doubts.append(f"only {right.found} of {right.sought} points are found in the right image")
        return doubts

    def note(self, cause: str, seen: bool) -> None:
        """Count a cause that others see in the last pair."""
        self._seen[cause] += seen

    def findings(self) -> list[str]:
        """What was wrong in more than a twentieth of the pairs, or lasts, with the remedy."""
        least = max(2, _NAMED_FROM * self._frames)
        no_pairs = any(self._seen[cause] > least for cause in ("late", "size", "swapped", "woven"))
        once = "" if no_pairs else "moved"
        often = [(n, cause) for cause, n in self._seen.items() if n > (0 if cause == once else least)]
        return [f"{_CURES[cause]} ({n} of {self._frames} pairs)" for n, cause in sorted(often, reverse=True)]

    def _lateness(self, right: RightSearch) -> float:
        """By how many frames the right image is older than the left one; 0 where rows agree, and what it was where they
        do not tell.

        Then a point's right row is where the left one was: the error of rows is the motion of rows, with a minus.
        """
        error, motion = _centred(right.row_error_px), _centred(right.row_motion_px)
        usual = _usual(error) & _usual(motion)  # a few false matches would outweigh all others
        error, motion = error[usual], motion[usual]
        now = np.array([len(error), error @ error, error @ motion, motion @ motion])
        self._rows = _MEMORY * self._rows + now
        n, ee, em, mm = self._rows
        if n < 20 or mm < n:  # rows must move by a pixel
            return self.late
        small = ee < _RIG_PX**2 * n
        # Noise of the left row is in both, with opposite signs, and that of the right one in the error and in the mean
        # row's motion alike: a delay shows against both motions, noise against one of them.
        mean_e, mean_m = em + ee / 2, mm + em + ee / 4
        if em**2 < 0.25 * ee * mm or mean_e**2 < 0.25 * ee * mean_m:  # motion must explain a quarter of its variance
            return 0.0 if small else self.late
        if small and not self.late:  # so may a wrong rig's; but an image that was late is not in time as it slows down
            return 0.0
        late = -em / mm
        return float(late) if _LATE < abs(late) < 2.0 else 0.0


def lateness_covariance(late: float, T_prev_cur: Array) -> Array:
    """(6, 6) of a motion seen by images ``late`` frames apart: what moves meanwhile displaces the right image as depth
    does, so that share of the motion may be missing, or seen twice, along any axis."""
    square = (late * se3.log(T_prev_cur)) ** 2
    return np.diag(np.repeat([square[:3].sum(), square[3:].sum()], 3))


def _centred(x: Array) -> Array:
    """Without its median: a vertical offset of the cameras is no delay."""
    return np.asarray(x, np.float64) - median(x)


def _usual(x: Array) -> NDArray[np.bool_]:
    """Which of these deviations from a median are within four of their standard deviations."""
    return np.asarray(np.abs(x) <= 4 * 1.4826 * median(np.abs(x)))


def motion_fields(matches: Matches, motion: Motion, camera: StereoCamera, moments: ResidualMoments) -> dict[str, Any]:
    """Fields of a :class:`gpvo.types.VoRecord` that describe the match and the solution."""
    uvd = matches.uvd_cur[motion.inliers]
    p10, p50, p90 = disparities_px(matches, motion.inliers, 10, 50, 90)
    depth_m = camera.fx_px * camera.baseline_m / float(p50)
    sigma_p, sigma_m = moments.sigmas if len(uvd) >= _ENOUGH_FOR_SIGMAS else (np.nan, np.nan)
    return {
        "n_tracked": matches.n_tracked,
        "n_inliers": len(uvd),
        "reproj_rms_px": float(np.sqrt((motion.residuals[:, :2] ** 2).sum(1).mean())),
        "residual_sigma_p_px": sigma_p,
        "residual_sigma_m_px": sigma_m,
        "disparity_p10_px": float(p10),
        "disparity_p50_px": float(p50),
        "disparity_p90_px": float(p90),
        "spread_u": float(np.std(uvd[:, 0]) / camera.fx_px),
        "spread_v": float(np.std(uvd[:, 1]) / camera.fy_px),
        "log10_condition": _log10_condition(motion.information, depth_m),
    }


def stats_fields(stats: ImageStats | None) -> dict[str, Any]:
    """Fields of a record that describe the image; empty for tracks."""
    return {} if stats is None else dict(vars(stats))
