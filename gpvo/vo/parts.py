"""Small helpers of the odometry: the clock, the checks of a frame, the fields of a record."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.types import StereoCamera, StereoFrame, TrackFrame
from gpvo.vo.config import VoConfig
from gpvo.vo.frontend import Frontend, Matches, TrackFrontend
from gpvo.vo.image import ImageStats
from gpvo.vo.motion import Motion
from gpvo.vo.quality import log10_condition
from gpvo.vo.rig_error import RigError
from gpvo.vo.sigmas import ResidualMoments

_ENOUGH_FOR_SIGMAS = 8  # points


class Stopwatch:
    """Milliseconds of each stage of one frame."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap to ``stage``."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + (now - self._since) * 1e3
        self._since = now


def check_frame(frame: StereoFrame | TrackFrame, camera: StereoCamera, t_last_ns: int | None) -> None:
    """Refuse a frame out of order or of another size than the camera's."""
    if t_last_ns is not None and frame.t_ns <= t_last_ns:
        raise SourceError(
            f"frame at t_ns={frame.t_ns} is not later than the one before ({t_last_ns})",
            cure="feed frames in time order",
        )
    if isinstance(frame, StereoFrame):
        for side, image in (("left", frame.left), ("right", frame.right)):
            dtype, shape = getattr(image, "dtype", type(image).__name__), getattr(image, "shape", ())
            if dtype != np.uint8 or shape != (camera.height, camera.width):
                raise SourceError(
                    f"the {side} image is {dtype} {shape}, the camera takes uint8 {(camera.height, camera.width)}",
                    cure="rows before columns: give grey images of the calibration's resolution",
                )


def make_frontend(
    frame: StereoFrame | TrackFrame,
    camera: StereoCamera,
    rig_error: RigError,
    config: VoConfig,
    mask: NDArray[np.bool_] | None,
) -> Frontend:
    """The front end for this kind of frame and preset."""
    # Imported here: tracks need no image code.
    if isinstance(frame, TrackFrame):
        return TrackFrontend(rig_error, config)
    if config.preset == "thesis":
        from gpvo.vo.descriptors import DescriptorFrontend

        return DescriptorFrontend(camera, rig_error, config, mask)
    from gpvo.vo.klt import KltFrontend

    return KltFrontend(camera, rig_error, config, mask)


def motion_fields(matches: Matches, motion: Motion, camera: StereoCamera, moments: ResidualMoments) -> dict[str, Any]:
    """Fields of a :class:`gpvo.types.VoRecord` that describe the match and the solution."""
    uvd = matches.uvd_cur[motion.inliers]
    p10, p50, p90 = (float(p) for p in np.percentile(uvd[:, 2], [10, 50, 90]))
    depth_m = camera.fx_px * camera.baseline_m / max(float(p50), 1e-3)
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
        "log10_condition": log10_condition(motion.information, depth_m),
    }


def stats_fields(stats: ImageStats | None) -> dict[str, Any]:
    """Fields of a record that describe the image; empty for tracks."""
    if stats is None:
        return {}
    return {
        "brightness": stats.brightness,
        "contrast": stats.contrast,
        "sharpness": stats.sharpness,
        "noise_level": stats.noise_level,
    }
