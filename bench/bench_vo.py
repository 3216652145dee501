"""Stereo odometry: frames per second of the default preset and of the naive pipeline, decoding excluded."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from gpvo.geometry import se3
from gpvo.types import Array, StereoCamera, StereoFrame, VoLog
from gpvo.vo import opencv
from gpvo.vo.config import make_config
from gpvo.vo.covariance import covariances_by_method
from gpvo.vo.motion import transfer
from gpvo.vo.odometry import StereoOdometry
from numpy.typing import NDArray
from tests.vo.rendered_clip import pinhole, render_clip, wander

from bench import Rows, median_s, row

SIZES = ((640, 480), (752, 480), (848, 800))
FRAMES = 80


class Naive:
    """What a first version looks like: whole-pixel corners, full AKAZE, brute force, DLT, P3P in RANSAC."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera = camera
        self._before: tuple[Array, NDArray[np.uint8]] | None = None

    def step(self, frame: StereoFrame) -> Array:
        """``T_prev_cur`` (4, 4); identity where it fails."""
        akaze = cv2.AKAZE.create()
        found = []
        for image in (frame.left, frame.right):
            uv = opencv.corners(image, 500, 0.004, 9, None)
            keys, bits = akaze.compute(image, [cv2.KeyPoint(float(x), float(y), 8.0, -1, 0, 0, 0) for x, y in uv])
            found.append((np.array([k.pt for k in keys]), bits))
        (uv_l, bits_l), (uv_r, bits_r) = found
        pairs = opencv.match_mutual(bits_l, bits_r)
        left, right = uv_l[pairs[:, 0]], uv_r[pairs[:, 1]]
        good = (left[:, 0] - right[:, 0] > 1) & (np.abs(left[:, 1] - right[:, 1]) < 3)
        P_left = self._camera.K @ np.eye(3, 4)
        P_right = self._camera.K @ np.column_stack([np.eye(3), [-self._camera.baseline_m, 0, 0]])
        X = cv2.triangulatePoints(P_left, P_right, left[good].T.astype(np.float64), right[good].T.astype(np.float64))
        points = (X[:3] / X[3]).T
        bits, before = bits_l[pairs[good, 0]], self._before
        self._before = (points, bits)
        if before is None:
            return np.eye(4)
        m = opencv.match_mutual(before[1], bits)
        uv = left[good][m[:, 1]]
        pose = opencv.pose_from_points(before[0][m[:, 0]], uv, self._camera.K, 2.0, 200, 0)
        return np.eye(4) if pose is None else se3.inverse(pose)


def _timed(step: Callable[[StereoFrame], object], frames: list[StereoFrame]) -> tuple[float, list[object]]:
    """Frames per second after the first ten, and the results."""
    out = [step(f) for f in frames[:10]]
    start = time.perf_counter()
    out += [step(f) for f in frames[10:]]
    return (len(frames) - 10) / (time.perf_counter() - start), out


def _rmse_mm(motions: Array, T_world_cam: Array) -> float:
    true = se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:]
    E = se3.inverse(true) @ motions
    return 1e3 * float(np.sqrt((E[:, :3, 3] ** 2).sum(1).mean()))


def run() -> Rows:
    """Rates and errors at each size, and the cost of all covariances."""
    out = {}
    for width, height in SIZES:
        camera = pinhole(width, height)
        clip = render_clip(camera, wander(FRAMES))
        frames, T_world_cam = clip.frames, clip.T_world_cam
        odometry, naive = StereoOdometry(camera, make_config("fast")), Naive(camera)
        fps, records = _timed(odometry.step, frames)
        fps_naive, motions = _timed(naive.step, frames)
        size = f"{width}x{height}"
        out[f"stereo frames per second, {size}"] = row(fps, "1/s", "naive pipeline", fps_naive)
        T = VoLog(records, camera).trajectory()  # type: ignore[arg-type]
        ours = _rmse_mm(se3.inverse(T[:-1]) @ T[1:], T_world_cam)
        theirs = _rmse_mm(np.array(motions[1:]), T_world_cam)
        out[f"pose RMSE per frame, {size}"] = row(ours, "mm", "naive pipeline", theirs, smaller_wins=True)
    out["all covariances of a frame, 500 points"] = _covariances()
    return out


def _covariances() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    camera = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)
    uvd = np.column_stack([rng.uniform(0, 640, 500), rng.uniform(0, 480, 500), rng.uniform(3, 60, 500)])
    T = se3.exp(np.array([0.02, 0, 0.06, 0.01, 0.02, 0]))
    cur = transfer(T, uvd, camera).uvd.T
    config = make_config()

    def state(_: int) -> object:
        return covariances_by_method(config, (0.1, 0.5), T, uvd, cur, camera)

    return row(1e3 * median_s(state, 300), "ms", "bound", 0.5, smaller_wins=True)
