"""Runs whose errors are drawn from exactly the covariance that their records state."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from gpvo.geometry import se3
from gpvo.types import Status, StereoCamera, TruthLog, VoLog, VoRecord

CAMERA = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
START_NS = 1_403_636_579_763_555_584
SIGMA = np.array([1.0, 0.6, 2.0, 0.3, 0.5, 0.2]) * 1e-3


def stated_covariance() -> np.ndarray:
    """(6, 6), with correlations between translation and rotation."""
    R = np.eye(6)
    R[0, 4] = R[4, 0] = 0.6
    R[1, 3] = R[3, 1] = -0.5
    return np.outer(SIGMA, SIGMA) * R


def curved_path(n: int, step_m: float = 0.05) -> np.ndarray:
    """(n, 4, 4) true motions: forward, turning and climbing slowly."""
    k = np.arange(n)
    xi = np.zeros((n, 6))
    xi[:, 2] = step_m * (1 + 0.2 * np.sin(0.05 * k))
    xi[:, 4] = 0.02 * np.cos(0.03 * k)
    xi[:, 3] = 0.004 * np.sin(0.02 * k)
    return se3.exp(xi)


def make_run(
    n: int = 2000, seed: int = 0, *, period_ns: int = 50_000_000, lost: Collection[int] = (), v_t: bool = True
) -> tuple[VoLog, TruthLog]:
    """n motions at 20 Hz. A frame in ``lost`` has no motion, and the next motion starts from before it."""
    rng = np.random.default_rng(seed)
    T_true, C = curved_path(n), stated_covariance()
    poses = [se3.exp(np.array([3.0, -2, 1, 0.4, -0.8, 1.2]))]
    for T in T_true:
        poses.append(poses[-1] @ T)
    xi = rng.standard_normal((n, 6)) @ np.linalg.cholesky(C).T
    t = START_NS + np.arange(n + 1) * period_ns
    records, here = [VoRecord(int(t[0]), int(t[0]), Status.START, np.eye(4))], 0
    for k in range(1, n + 1):
        T = se3.inverse(poses[here]) @ poses[k] @ se3.exp(xi[k - 1])
        stamps = int(t[k]), int(t[here])
        if k in lost:
            records.append(VoRecord(*stamps, Status.LOST, np.eye(4), is_reference=False, reason="few points"))
            continue
        # V_T is stated in the axes of the reference camera.
        V_T = T[:3, :3] @ C[:3, :3] @ T[:3, :3].T
        said = {"triangulation": V_T} if v_t else {}
        records.append(VoRecord(*stamps, Status.OK, T, n_inliers=100, covariances={"triangulation": C}, v_t=said))
        here = k
    return VoLog(records, CAMERA), TruthLog(t, np.array(poses))
