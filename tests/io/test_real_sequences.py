"""Real sequences: every frame, truth of the right frame, rows that match."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.io import guess, open_source


def _row_errors(frame) -> tuple[np.ndarray, np.ndarray]:
    """(disparity, row difference) of corners followed from left to right and back."""
    p = cv2.goodFeaturesToTrack(frame.left, 500, 0.01, 8)
    options = {"winSize": (15, 15), "maxLevel": 5}
    q, ok, _ = cv2.calcOpticalFlowPyrLK(frame.left, frame.right, p, None, **options)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(frame.right, frame.left, q, None, **options)
    good = (ok & ok_back)[:, 0].astype(bool) & (np.linalg.norm((back - p)[:, 0], axis=1) < 0.3)
    d = (p - q)[good][:, 0]
    plausible = np.abs(d[:, 1]) < 5
    return d[plausible, 0], d[plausible, 1]


@pytest.mark.parametrize(
    ("name", "kind", "count", "options"),
    [
        ("kitti_2011_09_26_0001", "kitti", 108, {}),
        ("tumvi_room1_60", "euroc", 60, {}),
        ("tumvi_room1_60", "euroc", 60, {"hfov_deg": 90.0}),
        ("tumvi_room1_60", "euroc", 60, {"hfov_deg": 120.0, "size": (640, 480)}),
    ],
)
def test_rows_match(real_data, name, kind, count, options):
    path = real_data / name
    assert guess(path) == kind
    source = open_source(path, **options)
    assert len(source) == count
    frames = list(source)
    assert len(frames) == count
    assert str(source.report).startswith(f"{count} frames")
    disparity, rows = (np.concatenate(c) for c in zip(*(_row_errors(f) for f in frames[::12]), strict=True))
    assert len(rows) > 200
    assert np.median(np.abs(rows)) < 0.5
    assert (disparity > -0.5).mean() > 0.98
    assert source.truth is not None
    assert source.truth.t_ns[0] <= frames[0].t_ns
    assert source.truth.t_ns[-1] >= frames[-1].t_ns


def test_motion_capture_agrees_with_the_gyroscope(real_data):
    """Truth and IMU, both carried to one frame, turn alike: extrinsics and their sense are right."""
    source = open_source(real_data / "tumvi_room1_60")
    imu, truth = source.imu, source.truth
    step = 20
    T = truth.T_world_cam[::step]
    t = truth.t_ns[::step]
    turned = se3.so3_log(np.swapaxes(T[:-1, :3, :3], 1, 2) @ T[1:, :3, :3])
    sums = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(imu.gyro_radps[:-1] * np.diff(imu.t_ns)[:, None] * 1e-9, axis=0)]
    )
    at = np.stack([np.interp(t, imu.t_ns, sums[:, i]) for i in range(3)], axis=1)
    gyro_cam = np.diff(at, axis=0) @ source.mounting.T_imu_cam[:3, :3]
    small = np.linalg.norm(turned, axis=1) < 0.2
    assert small.sum() > 200
    difference = np.linalg.norm((turned - gyro_cam)[small], axis=1)
    assert np.median(difference) < 0.1 * np.median(np.linalg.norm(turned[small], axis=1)) + 5e-3


@pytest.mark.slow
def test_memory_stays_flat_over_ten_thousand_frames(tmp_path):
    """Reading, rectifying and writing a run in a process of its own, measured between frame 2,000 and the end."""
    import subprocess
    import sys

    psutil = pytest.importorskip("psutil")
    assert psutil
    from sequences import write_folder

    path = write_folder(tmp_path / "s", 100)
    code = f"""
import numpy as np, psutil
from gpvo.io import RunWriter, open_source
from gpvo.types import Status, VoRecord
source, k, marks = open_source({str(path)!r}, hfov_deg=50.0, size=(640, 480)), 0, []
C = {{"triangulation": np.eye(6), "pointing_matching": np.eye(6)}}
with RunWriter({str(tmp_path / "run")!r}, camera=source.camera) as writer:
    for _ in range(100):
        for frame in source:
            status = Status.OK if k else Status.START
            writer.append(VoRecord(k * 10**7, max(k - 1, 0) * 10**7, status, np.eye(4), covariances=C))
            k += 1
        marks.append(psutil.Process().memory_info().rss / 1e6)
marks.append(psutil.Process().memory_info().rss / 1e6)
print(k, marks[20], max(marks))
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300).stdout
    count, early, top = (float(v) for v in out.split())
    assert count == 10_000
    assert top < 400
    assert top - early < 60
