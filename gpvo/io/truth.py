"""Ground truth carried to the rectified left camera, with the noise that each kind of truth has itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.trajectory import Trajectory
from gpvo.types import Array, TruthLog


@dataclass(frozen=True)
class TruthNoise:
    """White noise of a truth, per pose and axis: ``translation_m``, ``rotation_rad``."""

    translation_m: float
    rotation_rad: float


# Per pose and axis. GPS/INS: a motion between two poses carries sqrt(2) times as much, about 4 mm; measured as the
# fourth difference of vertical and lateral position over seven KITTI drives (1 to 6 mm per motion).
GPS_INS = TruthNoise(3e-3, 2e-4)
# Optical motion capture at 120 Hz, unfiltered (fourth difference of TUM-VI room 1: 0.09 mm and 0.8 mrad).
MOTION_CAPTURE = TruthNoise(1e-4, 8e-4)
# Smoothed by a batch estimator with an IMU (EuRoC: below 0.01 mm and 0.1 mrad): its white part is nothing, what
# remains is slow.
BATCH_ESTIMATE = TruthNoise(0.0, 0.0)
UNKNOWN = TruthNoise(0.0, 0.0)


def carry(trajectory: Trajectory, T_body_cam: Array, noise: TruthNoise) -> TruthLog:
    """Truth of a body as truth of the camera that sits at ``T_body_cam`` (4, 4) on it.

    The rotation noise acts at the lever arm too; at the decimetres of a head that is far below the translation noise
    and is left out.
    """
    return TruthLog(
        t_ns=trajectory.t_ns,
        T_world_cam=trajectory.T_world_body @ T_body_cam,
        sigma_translation_m=noise.translation_m,
        sigma_rotation_rad=noise.rotation_rad,
    )


def check_overlap(truth: TruthLog, t_ns: NDArray[np.int64], path: Path) -> None:
    """Refuse a truth that does not overlap the frames in time.

    Raises
    ------
    SourceError
        Naming both intervals and how far they are apart.
    """
    if len(t_ns) == 0 or len(truth.t_ns) == 0:
        return
    if truth.t_ns[-1] < t_ns[0] or truth.t_ns[0] > t_ns[-1]:
        apart = max(int(t_ns[0]) - int(truth.t_ns[-1]), int(truth.t_ns[0]) - int(t_ns[-1])) * 1e-9
        raise SourceError(
            f"the ground truth ({truth.t_ns[0] * 1e-9:.3f} to {truth.t_ns[-1] * 1e-9:.3f} s) does not overlap the"
            f" frames ({t_ns[0] * 1e-9:.3f} to {t_ns[-1] * 1e-9:.3f} s): they are {apart:.3f} s apart",
            where=path,
            cure="is it the truth of this sequence, and of the same clock?",
        )
