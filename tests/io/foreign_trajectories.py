"""Trajectories in the formats of others, as files to read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gpvo.geometry import se3
from gpvo.types import Array
from numpy.typing import NDArray


def write_kitti_poses(path: Path, T_world_body: Array) -> None:
    """KITTI poses, 12 numbers a line."""
    path.write_text("".join(" ".join(f"{v:.9e}" for v in T[:3].ravel()) + "\n" for T in T_world_body))


def write_euroc_csv(path: Path, t_ns: NDArray[np.int64], T_world_body: Array) -> None:
    """EuRoC's eight columns: stamp [ns], position, quaternion w x y z."""
    lines = ["#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"]
    for t, T in zip(t_ns, T_world_body, strict=True):
        q = se3.rotation_to_quaternion_xyzw(T[:3, :3])[[3, 0, 1, 2]]
        lines.append(",".join([str(int(t)), *(f"{v:.9f}" for v in (*T[:3, 3], *q))]))
    path.write_text("\n".join([*lines, ""]))
