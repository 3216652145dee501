"""When can a motion be trusted? No motion is ever made up silently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, Status, StereoCamera
from gpvo.vo.config import VoConfig
from gpvo.vo.frontend import Matches
from gpvo.vo.motion import Motion, predict_uvd


@dataclass(frozen=True)
class Verdict:
    """A status with its reason in words, empty for ``ok``."""

    status: Status
    reason: str = ""


def agrees(T_prev_cur: Array, matches: Matches, camera: StereoCamera, threshold_px: float) -> NDArray[np.bool_]:
    """(N,) whether the motion predicts each point where it was found, in the left image and in disparity."""
    uvd, in_front = predict_uvd(T_prev_cur, matches.uvd_prev, camera)
    off = matches.uvd_cur - uvd.T
    return in_front & (np.hypot(off[:, 0], off[:, 1]) < threshold_px) & (np.abs(off[:, 2]) < 1.5 * threshold_px)


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
        return Verdict(Status.LOST, f"no motion fits the {matches.n_tracked} points found again")
    inliers, tracked = int(motion.inliers.sum()), max(matches.n_tracked, 1)
    if inliers < config.min_inliers or inliers < 0.12 * tracked:
        return Verdict(Status.LOST, f"only {inliers} of {tracked} points agree")
    sigma_m = worst_translation_sigma_m(motion)
    if not sigma_m < 5 * camera.baseline_m:
        return Verdict(Status.LOST, "the points do not determine the translation")
    doubts = list(doubts)
    if inliers < usual_inliers / 3:
        doubts.append(f"only {inliers} points agree where {usual_inliers:.0f} usually do")
    if sigma_m > 0.5 * camera.baseline_m:
        doubts.append(f"translation uncertain by {sigma_m:.2g} m")
    if inliers < config.weak_inliers or inliers < 0.35 * tracked:
        doubts.append(f"only {inliers} of {tracked} points agree")
    if not motion.converged:
        doubts.append("the estimate did not settle")
    spread = np.std((motion.uvd_prev[:, :2] - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px], axis=0)
    # A twentieth of the image: rotation and translation can no longer be told apart.
    if spread.max() < 0.05 * camera.width / camera.fx_px:
        doubts.append("all points lie in a small part of the image")
    return Verdict(Status.DEGRADED, "; ".join(doubts)) if doubts else Verdict(Status.OK)


def worst_translation_sigma_m(motion: Motion) -> float:
    """Largest standard deviation of the translation in any direction [m], at the noise that the residuals show."""
    info = motion.information
    marginal = info[:3, :3] - info[:3, 3:] @ np.linalg.pinv(info[3:, 3:]) @ info[3:, :3]
    smallest = float(np.linalg.eigvalsh(marginal)[0])
    return motion.scale_px / np.sqrt(smallest) if smallest > 0 else np.inf


def log10_condition(information: Array, depth_m: float) -> float:
    """log10 of the condition number of a (6, 6) information matrix, lengths in units of the median depth."""
    scale = np.array([depth_m] * 3 + [1.0] * 3)
    values = np.linalg.eigvalsh(information * scale[:, None] * scale)
    return float(np.log10(values[-1] / values[0])) if values[0] > 0 else 16.0


def lost_covariance(dt_s: float, twist: Array) -> Array:
    """(6, 6) covariance of a motion that was not measured but extrapolated over ``dt_s``.

    A vehicle may have stopped, or doubled its speed, or started from rest at one m/s and half a radian per second.
    """
    speed, rate = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
    sigma_m, sigma_rad = dt_s * max(speed, 1.0), dt_s * max(rate, 0.5)
    return np.diag([max(sigma_m, 1e-3) ** 2] * 3 + [max(sigma_rad, 1e-3) ** 2] * 3)


def median_parallax_px(matches: Matches, inliers: NDArray[np.bool_]) -> float:
    """Median image motion of the inliers [px]."""
    off = matches.uvd_cur[inliers, :2] - matches.uvd_prev[inliers, :2]
    return float(np.median(np.hypot(off[:, 0], off[:, 1])))
