"""Several motions in one picture: does something else than the scene move with the points that agree?

A lorry alongside, smoke, or a texture that travels with the camera may hold more corners than what stands still. Counts
of corners then say nothing; a scene shows itself by the share of the picture that its motion explains.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array, StereoCamera
from gpvo.vo.config import VoConfig
from gpvo.vo.frontend import Matches
from gpvo.vo.motion import Motion, transfer

_CELLS = 96  # of the whole picture
_EXPLAINED = 0.8  # share of the cells; below, a rival is looked for
_LEAST = 8  # points: a motion through any three is found by chance, a tight one through eight is not
_SHARE = 1 / 8  # of the other's cells: a motion seen over less is that of an object


def cells(uv: NDArray[np.floating[Any]], camera: StereoCamera) -> NDArray[np.int64]:
    """(N,) number of the square cell of the image in which each pixel (N, 2) lies."""
    side_px = (camera.width * camera.height / _CELLS) ** 0.5
    column, row = (np.asarray(uv)[:, :2] / side_px).astype(np.int64).T
    return row * (int(camera.width / side_px) + 1) + column


def unexplained(motion: Motion, matches: Matches, camera: StereoCamera, config: VoConfig) -> NDArray[np.bool_] | None:
    """(N,) the points, spare ones too, that moved otherwise; None where the motion explains most of the picture.

    That is the share of the cells with points of the reference, but for those that the motion puts out of sight, in
    which one agrees.
    """
    if matches.sought_uvd is None:
        return None
    off_px = _off_px(motion.T_prev_cur, matches, camera)
    moved = transfer(motion.T_prev_cur, matches.sought_uvd, camera)
    u, v, d = moved.uvd
    margin = config.klt_window_px
    inside = (u - d > margin) & (u < camera.width - margin) & (v > margin) & (v < camera.height - margin)
    sought = np.unique(cells(matches.sought_uvd[moved.in_front & inside], camera))
    agree = np.isin(sought, cells(matches.uvd_prev[off_px < config.ransac_threshold_px], camera))
    free = off_px > max(config.ransac_threshold_px, 6 * motion.scale_px)
    return free if free.sum() >= _LEAST and agree.sum() < _EXPLAINED * len(sought) else None


def areas(first: Motion, second: Motion, matches: Matches, camera: StereoCamera, config: VoConfig) -> tuple[int, int]:
    """Cells of the image in which each of two motions explains points better than the other does.

    The second has none where it is that of an object, or a chance agreement: that is loose, as any place within the
    threshold is as likely.
    """
    off_px = np.stack([_off_px(m.T_prev_cur, matches, camera) for m in (first, second)])
    close = (off_px < config.ransac_threshold_px) & (off_px == off_px.min(axis=0))
    n_first, n_second = (len(np.unique(cells(matches.uvd_cur[c], camera))) for c in close)
    loose = second.scale_px > max(2 * first.scale_px, 0.25 * config.ransac_threshold_px)
    chance = loose or second.inliers.sum() < _LEAST or n_second < _SHARE * n_first
    return n_first, 0 if chance else n_second


def _off_px(T_prev_cur: Array, matches: Matches, camera: StereoCamera) -> Array:
    """(N,) distance [px] of each point from where the motion puts it, in image and disparity."""
    moved = transfer(T_prev_cur, matches.uvd_prev, camera)
    off = np.linalg.norm(matches.uvd_cur - moved.uvd.T, axis=1)
    return np.where(moved.in_front, off, np.inf)
