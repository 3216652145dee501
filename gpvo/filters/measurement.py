"""A relative motion of the camera as a measurement of the IMU's state and of a cloned earlier pose.

The measured motion is ``T_est = Exp(-n_ref) T_true Exp(n_cur + b + w)`` (see :mod:`gpvo.accumulation`): the noise of
each frame enters the motion that ends there and, with opposite sign, the motion that starts there; ``b`` persists;
``w`` is independent. With
``r = Log(T_pred^-1 T_est)`` and right perturbations eta of the camera poses,

    r = eta_cur - Ad(T_pred^-1) (eta_ref + n_ref) + n_cur + b + w        (first order)
    eta = Ad(T_cam_imu) [R_world_imu^T dp ; dtheta]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import carry, from_start
from gpvo.filters import kernels
from gpvo.filters.propagation import TH, P
from gpvo.geometry import se3
from gpvo.types import Array, MotionError

# Joint error state: the core, the cloned pose of the reference frame, the reference frame's jitter, the
# normalised VO bias, and the jitter of the current frame while an update runs.
CLONE, CLONE_P, CLONE_TH = slice(15, 21), slice(15, 18), slice(18, 21)
JITTER_REF, BIAS, JITTER_CUR = slice(21, 27), slice(27, 39), slice(39, 45)
KEPT, JOINT = 39, 45


@dataclass(frozen=True)
class CameraOnImu:
    """Extrinsics ``T_imu_cam`` taken apart once for all updates: ``R_imu_cam``, ``t_imu_cam`` and products."""

    R_imu_cam: Array
    t_imu_cam: Array
    R_cam_imu: Array
    lever: Array  # -R_cam_imu [t_imu_cam]x: what an IMU rotation moves the camera by

    @staticmethod
    def of(T_imu_cam: Array | None) -> CameraOnImu:
        """From a 4x4 pose; None means that the state is the camera's own."""
        T = np.eye(4) if T_imu_cam is None else np.asarray(T_imu_cam, dtype=np.float64)
        R, t = T[:3, :3].copy(), T[:3, 3].copy()
        return CameraOnImu(R, t, R.T.copy(), -R.T @ kernels.skew(t[None])[0])

    def pose(self, position: Array, R_world_imu: Array) -> tuple[Array, Array]:
        """Camera rotations (B, 3, 3) and positions (B, 3) in the world."""
        return R_world_imu @ self.R_imu_cam, position + R_world_imu @ self.t_imu_cam


def relative_motion(R_ref: Array, p_ref: Array, R_cur: Array, p_cur: Array) -> tuple[Array, Array]:
    """``T_ref_cur`` as rotations (B, 3, 3) and translations (B, 3), from camera poses in the world."""
    Rt = kernels.transpose(R_ref)
    return Rt @ R_cur, (Rt @ (p_cur - p_ref)[:, :, None])[:, :, 0]


def jacobian(
    H: Array, camera: CameraOnImu, R_ref: Array, R_cur: Array, R_rel: Array, t_rel: Array, error: MotionError
) -> None:
    """Write d(measured motion)/d(joint error state) into ``H`` (B, 6, 45), in the right tangent of the prediction."""
    moved = carry(se3.from_rt(R_rel, t_rel))

    eta_ref = np.zeros((len(H), 6, 6))
    eta_ref[:, :3, :3] = kernels.transpose(R_ref)
    eta_ref[:, :3, 3:] = camera.lever
    eta_ref[:, 3:, 3:] = camera.R_cam_imu

    H[:, :3, P] = kernels.transpose(R_cur)
    H[:, :3, TH] = camera.lever
    H[:, 3:, TH] = camera.R_cam_imu
    np.negative(moved @ eta_ref, out=H[:, :, CLONE])
    H[:, :, JITTER_REF] = from_start(error, moved)
    length = error.persistent_root.shape[-1]
    H[:, :, BIAS.start : BIAS.start + length] = error.persistent_root
    H[:, :, BIAS.start + length : BIAS.stop] = 0.0


def residual(R_rel: Array, t_rel: Array, T_est: Array, mean: Array) -> Array:
    """``Log(T_pred^-1 T_est Exp(-mean))`` (B, 6), of predictions (B, ...) and measured motions (4, 4) or (B, 4, 4)."""
    R_m, t_m = kernels.motion_exp(-mean)
    R_est, t_est = T_est[..., :3, :3], T_est[..., :3, 3:]
    Rt = kernels.transpose(R_rel)
    R = Rt @ (R_est @ R_m)
    t = Rt @ (R_est @ t_m[:, :, None] + t_est - t_rel[:, :, None])
    return kernels.motion_log(R, t[:, :, 0])


@dataclass(frozen=True)
class Innovation:
    """One update: ``residual`` (B, 6), its covariance ``S`` (B, 6, 6), ``nis`` (B,), whether it passed and was used
    (B,), and whether it failed and the filter more than the measurement has to answer for it (B,)."""

    residual: Array
    S: Array
    nis: Array
    passed: NDArray[np.bool_]
    used: NDArray[np.bool_]
    own_fault: NDArray[np.bool_]

    def of_member(self, b: int) -> Innovation:
        """The same of one member."""
        one = slice(b, b + 1)
        return Innovation(**{name: getattr(self, name)[one] for name in self.__dataclass_fields__})
