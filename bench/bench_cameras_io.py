"""Rectification of a T265-like pair against float maps, and records written per second. CPU time."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from gpvo.cameras.models import KannalaBrandt
from gpvo.cameras.rectify import Rectifier
from gpvo.cameras.rig import StereoRig
from gpvo.geometry import se3
from gpvo.io.run import RunWriter
from gpvo.types import Status, VoRecord

from bench import Rows, row

_SIZE = (848, 800)


def run() -> Rows:
    """Results by name."""
    return {"rectify_848x800": _rectify(), "run_folder_records": _write_records()}


def _cpu_ms(action: Callable[[], object], repeats: int) -> float:
    """Best CPU time [ms] of one call."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        action()
        best = min(best, time.process_time() - start)
    return 1e3 * float(best)


def _rectify() -> dict[str, Any]:
    lens = KannalaBrandt(282.0, 281.0, 416.0, 397.0, *_SIZE, (-0.0033, 0.054, -0.0516, 0.0107))
    rectifier = Rectifier(StereoRig(lens, lens, se3.exp(np.array([-0.0627, 0, 0, 0.001, -0.004, 0.002]))))
    rng = np.random.default_rng(0)
    images = [cv2.GaussianBlur(rng.integers(0, 255, _SIZE[::-1], dtype=np.uint8), (0, 0), 3) for _ in range(2)]
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    maps = [
        cv2.fisheye.initUndistortRectifyMap(K, np.array(lens.distortion), R, rectifier.camera.K, _SIZE, cv2.CV_32FC1)
        for R in (rectifier.R_rect_left, rectifier.R_rect_right)
    ]

    def with_floats() -> list[object]:
        return [cv2.remap(image, *m, cv2.INTER_LINEAR) for image, m in zip(images, maps, strict=True)]

    ours, theirs = _cpu_ms(lambda: rectifier.apply(*images), 30), _cpu_ms(with_floats, 30)
    return row(ours, "ms CPU per pair", "cv2.remap with float maps", theirs, smaller_wins=True)


def _write_records() -> dict[str, Any]:
    n = 1000
    C = np.eye(6) * 1e-4
    records = [
        VoRecord(
            k * 50_000_000,
            max(k - 1, 0) * 50_000_000,
            Status.OK if k else Status.START,
            np.eye(4),
            n_inliers=100,
            covariances={"triangulation": C, "pointing_matching": C},
            v_t={"triangulation": C[:3, :3]},
        )
        for k in range(n)
    ]

    def write() -> None:
        with tempfile.TemporaryDirectory() as folder, RunWriter(Path(folder) / "run") as writer:
            for record in records:
                writer.append(record)

    return row(1e3 * n / _cpu_ms(write, 3), "records/s")
