"""Small sequences on disk whose images say which frame they are: the grey value of both sides is the index."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from gpvo.geometry import se3

WIDTH, HEIGHT = 64, 48
START_NS = 1_403_636_579_763_555_584
STEP_NS = 50_000_000
T_RIGHT_LEFT = se3.exp(np.array([-0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
T_BODY_LEFT = se3.exp(np.array([0.05, 0.02, -0.01, 1.0, -1.1, 0.9]))


def grey(index: int) -> np.ndarray:
    """An image of one value, which a rectified view keeps."""
    return np.full((HEIGHT, WIDTH), 10 + index, dtype=np.uint8)


def stamps(n: int) -> list[int]:
    return [START_NS + k * STEP_NS for k in range(n)]


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def sensor_yaml(T_BS: np.ndarray, size=(WIDTH, HEIGHT)) -> str:
    data = ", ".join(repr(float(v)) for v in T_BS.ravel())
    return (
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
        f"resolution: [{size[0]}, {size[1]}]\ncamera_model: pinhole\nintrinsics: [60.0, 60.0, 31.5, 23.5]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )


def camchain_yaml() -> str:
    rows = "[" + ", ".join(str([float(v) for v in row]) for row in T_RIGHT_LEFT) + "]"
    block = (
        "  camera_model: pinhole\n  intrinsics: [60.0, 60.0, 31.5, 23.5]\n  distortion_model: radtan\n"
        f"  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]\n  resolution: [{WIDTH}, {HEIGHT}]\n"
    )
    return f"cam0:\n{block}cam1:\n{block}  T_cn_cnm1: {rows}\n"


def true_poses(n: int) -> np.ndarray:
    """(n, 4, 4) of a body on a smooth path."""
    k = np.arange(n)[:, None]
    return se3.exp(np.hstack([0.05 * k, 0.02 * np.sin(k), 0.01 * k, 0.01 * k, 0.0 * k, 0.02 * k]))


def write_euroc(root: Path, n: int = 12, *, truth: bool = True) -> Path:
    """A EuRoC folder with IMU and truth of the body."""
    mav = root / "mav0"
    T_body_right = T_BODY_LEFT @ se3.inverse(T_RIGHT_LEFT)
    for camera, T in (("cam0", T_BODY_LEFT), ("cam1", T_body_right)):
        for k, t in enumerate(stamps(n)):
            write_image(mav / camera / "data" / f"{t}.png", grey(k))
        (mav / camera / "sensor.yaml").write_text(sensor_yaml(T))
        lines = [f"{t},{t}.png" for t in stamps(n)]
        (mav / camera / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(lines) + "\n")
    (mav / "imu0").mkdir()
    imu = [f"{START_NS + k * 5_000_000},0.1,0.2,0.3,0.0,0.0,9.81" for k in range(n * 10)]
    (mav / "imu0" / "data.csv").write_text("#timestamp [ns],w...\n" + "\n".join(imu) + "\n")
    if truth:
        write_euroc_truth(mav / "state_groundtruth_estimate0" / "data.csv", n)
    return root


def write_euroc_truth(path: Path, n: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"]
    for t, T in zip(stamps(n), true_poses(n), strict=True):
        x, y, z, w = se3.rotation_to_quaternion_xyzw(T[:3, :3])
        lines.append(",".join(map(str, [t, *(float(v) for v in (*T[:3, 3], w, x, y, z)), 0.0, 0.0])))
    path.write_text("\n".join(lines) + "\n")


def write_kitti(root: Path, n: int = 12, *, folders=("image_0", "image_1"), poses: bool = True) -> Path:
    """A KITTI odometry folder."""
    for folder in folders:
        for k in range(n):
            write_image(root / folder / f"{k:06d}.png", grey(k))
    P = "60 0 31.5 {} 0 60 23.5 0 0 0 1 0"
    (root / "calib.txt").write_text("".join(f"P{i}: {P.format(tx)}\n" for i, tx in enumerate((0, -6, 3, -3))))
    (root / "times.txt").write_text("".join(f"{k * 0.1:e}\n" for k in range(n)))
    if poses:
        lines = [" ".join(f"{v:e}" for v in T[:3].ravel()) for T in true_poses(n)]
        (root / "poses.txt").write_text("\n".join(lines) + "\n")
    return root


def write_folder(root: Path, n: int = 12, *, left="left", right="right") -> Path:
    """Pairs named by stamp beside a Kalibr camera chain."""
    for folder in (left, right):
        for k, t in enumerate(stamps(n)):
            write_image(root / folder / f"{t}.png", grey(k))
    (root / "camchain.yaml").write_text(camchain_yaml())
    return root


def frames_of(source) -> list[tuple[int, int]]:
    """(stamp, index) of every frame; fails where left and right are of different frames."""
    out = []
    for frame in source:
        left, right = (int(np.median(image)) for image in (frame.left, frame.right))
        assert left == right, "left and right are of different frames"
        assert frame.left.dtype == np.uint8
        out.append((frame.t_ns, left - 10))
    return out
