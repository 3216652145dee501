"""A relative motion of the camera as a measurement of the IMU's state and of a cloned earlier pose; and the chi-square
gate: when it disagrees with the filter by more than both allow.

The measured motion is ``T_est = Exp(-n_ref) T_true Exp(n_cur + b + w)`` (see :mod:`gpvo.accumulation`): the noise of
each frame enters the motion that ends there and, with opposite sign, the motion that starts there; ``b`` persists;
``w`` is independent. With
``r = Log(T_pred^-1 T_est)`` and right perturbations eta of the camera poses,

    r = eta_cur - Ad(T_pred^-1) (eta_ref + n_ref) + n_cur + b + w        (first order)
    eta = Ad(T_cam_imu) [R_world_imu^T dp ; dtheta]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import carry, from_start
from gpvo.filters.propagation import TH, P, transpose
from gpvo.geometry import se3
from gpvo.types import Array, MotionError

# Joint error state: the core, the cloned pose of the reference frame, the reference frame's jitter, the
# normalised VO bias, and the jitter of the current frame while an update runs.
CLONE, CLONE_P, CLONE_TH = slice(15, 21), slice(15, 18), slice(18, 21)
JITTER_REF, BIAS, JITTER_CUR = slice(21, 27), slice(27, 39), slice(39, 45)
KEPT, JOINT = 39, 45
# Share of a Gaussian within three standard deviations: the confidence of a "3-sigma" gate in any dimension.
THREE_SIGMA = math.erf(3.0 / math.sqrt(2.0))


@dataclass(frozen=True)
class CameraOnImu:
    """Extrinsics ``T_imu_cam`` (4, 4), with what all updates need of them."""

    T_imu_cam: Array
    R_cam_imu: Array
    lever: Array  # -R_cam_imu [t_imu_cam]x: what an IMU rotation moves the camera by

    @staticmethod
    def of(T_imu_cam: Array | None) -> CameraOnImu:
        """From a 4x4 pose; None means that the state is the camera's own."""
        T = np.eye(4) if T_imu_cam is None else np.array(T_imu_cam, dtype=np.float64)
        R_cam_imu = T[:3, :3].T.copy()
        return CameraOnImu(T, R_cam_imu, -R_cam_imu @ se3.skew(T[:3, 3]))

    def pose(self, position: Array, R_world_imu: Array) -> Array:
        """Camera poses (B, 4, 4) in the world."""
        return se3.from_rt(R_world_imu, position) @ self.T_imu_cam


def jacobian(H: Array, camera: CameraOnImu, T_ref: Array, T_cur: Array, error: MotionError) -> None:
    """Write d(measured motion)/d(joint error state) into ``H`` (B, 6, 45), in the right tangent of the prediction, from
    camera poses (B, 4, 4) in the world."""
    moved = carry(se3.inverse(T_ref) @ T_cur)

    eta_ref = np.zeros((len(H), 6, 6))
    eta_ref[:, :3, :3] = transpose(T_ref[:, :3, :3])
    eta_ref[:, :3, 3:] = camera.lever
    eta_ref[:, 3:, 3:] = camera.R_cam_imu

    H[:, :3, P] = transpose(T_cur[:, :3, :3])
    H[:, :3, TH] = camera.lever
    H[:, 3:, TH] = camera.R_cam_imu
    np.negative(moved @ eta_ref, out=H[:, :, CLONE])
    H[:, :, JITTER_REF] = from_start(error, moved)
    length = error.persistent_root.shape[-1]
    H[:, :, BIAS.start : BIAS.start + length] = error.persistent_root
    H[:, :, BIAS.start + length : BIAS.stop] = 0.0


def residual(T_ref: Array, T_cur: Array, T_est: Array, mean: Array) -> Array:
    """``Log(T_pred^-1 T_est Exp(-mean))`` (B, 6), of predictions from camera poses (B, 4, 4) in the world and measured
    motions (4, 4) or (B, 4, 4)."""
    return se3.log(se3.inverse(T_cur) @ T_ref @ (T_est @ se3.exp(-mean)))


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

    @property
    def surprise(self) -> Array:
        """(B,) minus twice the log of its likelihood, but for a constant."""
        return np.asarray(self.nis + np.linalg.slogdet(self.S)[1])


def chi2_cdf(x: float, dof: int) -> float:
    """Lower regularised incomplete gamma function P(dof/2, x/2), by its power series."""
    if x <= 0:
        return 0.0
    a, h = 0.5 * dof, 0.5 * x
    term = total = 1.0 / a
    n = 0
    while term > total * 1e-16 and n < 10000:
        n += 1
        term *= h / (a + n)
        total += term
    return min(1.0, total * math.exp(a * math.log(h) - h - math.lgamma(a)))


@cache
def chi2_quantile(probability: float, dof: int) -> float:
    """Value that a chi-square variable of ``dof`` degrees stays below with the given probability, by bisection."""
    if not 0.0 < probability < 1.0 or dof < 1:
        raise ValueError(f"probability {probability} must lie in (0, 1) and dof {dof} be positive")
    low, high = 0.0, float(dof)
    while chi2_cdf(high, dof) < probability:
        high *= 2.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if chi2_cdf(middle, dof) < probability else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class Gate:
    """A test on the normalised innovation squared: ``probability`` that a right measurement passes.

    ``on_fail``: ``discard`` drops what fails; ``inflate`` widens its covariance until it just passes;
    ``accept`` uses it as it is (the gate then only counts).

    A filter that discards goes astray once it has believed a slip: everything after disagrees with it. Its own
    covariance is then widened until a measurement passes again: after ``recover_after_s`` without one that passed,
    and after ``doubt_after_s`` in which every failure was its own (:class:`Wait`). Were the first as short, a long
    burst of bad motions would get in. PX4's EKF2 calls flight by the IMU alone valid for 5 s (EKF2_NOAID_TOUT).
    """

    probability: float = THREE_SIGMA
    on_fail: Literal["discard", "inflate", "accept"] = "discard"
    recover_after_s: float = 5.0
    doubt_after_s: float = 1.0

    def threshold(self, dof: int) -> float:
        """Largest NIS that passes."""
        return chi2_quantile(self.probability, dof)


@dataclass(frozen=True)
class Wait:
    """What each of B members waits for: ``passed_ns`` (B,), when a motion last passed or there was none to judge;
    ``sound_ns`` (B,), when one last passed or failed by VO's fault.

    Whose fault: of the NIS ``r^T S^-1 r`` the likeliest error of the predicted motion, over its own covariance
    ``P_r``, makes ``r^T S^-1 P_r S^-1 r``; the rest is VO's. Where the filter's part is more than half, VO is so much
    the surer of the two that an error usual for VO and one unusual for the filter explain the failure best.
    """

    passed_ns: NDArray[np.int64]
    sound_ns: NDArray[np.int64]

    @staticmethod
    def since(t_ns: int, batch: int) -> Wait:
        """A filter that has just started."""
        now = np.full(batch, t_ns, dtype=np.int64)
        return Wait(now, now)

    def over(self, t_ns: int, gate: Gate) -> NDArray[np.bool_]:
        """(B,) members that are to be widened if they fail again at ``t_ns``."""
        too_long = t_ns - self.passed_ns > gate.recover_after_s * 1e9
        return too_long | (t_ns - self.sound_ns > gate.doubt_after_s * 1e9)

    def after(self, t_ns: int, passed: NDArray[np.bool_] | bool, own_fault: NDArray[np.bool_] | bool) -> Wait:
        """The same once a record has been judged; ``own_fault``: failed, and the filter has to answer for it."""
        return Wait(np.where(passed, t_ns, self.passed_ns), np.where(own_fault, self.sound_ns, t_ns))
