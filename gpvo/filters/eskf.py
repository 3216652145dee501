"""Error-state Kalman filter: 15 states driven by an IMU, a cloned pose, the jitter of its frame; a VO bias considered.

Joint error state (45): position, velocity (world), attitude (body), accelerometer and gyroscope bias; the cloned
pose of VO's reference frame; that frame's jitter; the normalised VO bias; and, while an update runs, the jitter of the
current frame, which then replaces the reference's. So two motions that share a frame are not treated as independent.

J. Sola, "Quaternion kinematics for the error-state Kalman filter" (2017), sections 5 to 7; stochastic cloning:
S. Roumeliotis, J. Burdick (2002). Arrays carry a leading axis of B members that see the same clock and statuses: 1 in
flight, many where one run is filtered under many noise settings.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import first_jitter, from_end, independent_part, persistence
from gpvo.filters import measurement as me
from gpvo.filters.measurement import (
    BIAS,
    CLONE,
    CLONE_P,
    JITTER_CUR,
    JITTER_REF,
    JOINT,
    KEPT,
    CameraOnImu,
    Gate,
    Innovation,
)
from gpvo.filters.propagation import (
    BA,
    BG,
    CORE,
    TH,
    ConstantVelocityNoise,
    Nominal,
    P,
    V,
    constant_velocity_densities,
    constant_velocity_step,
    imu_densities,
    imu_step,
    process_noise,
    transpose,
)
from gpvo.geometry import se3
from gpvo.geometry.covariance import variances
from gpvo.types import STANDARD_GRAVITY_MPS2, Array, ImuNoise, MotionError

_POSE = np.array([0, 1, 2, 6, 7, 8])  # position and attitude inside the core
_STATE = CLONE.stop  # core and clone; what follows is VO's
_CARRIED = slice(0, BA.start)  # what the error of the attitude is carried with
_MOST_SPEED_VAR, _MOST_ANGLE_VAR = 100.0, 0.1  # (10 m/s)^2, (18 deg)^2: no state is doubted beyond
_SPOILT, _SMALL, _ROUNDINGS = 0.01, 1e-3, 64.0  # share of a variance that rounding may be; how many roundings add up
_UNSEEN_TURN_RAD, _UNSEEN_TILT_RAD = 1.0, 0.2  # about and from the vertical, while nothing is heard


class ErrorStateFilter:
    """The state, its covariance and the three things that happen to them: propagate, update, clone.

    Parameters
    ----------
    nominal : estimate to start from, arrays of B members.
    covariance : (15, 15) or (B, 15, 15), symmetric positive definite.
    T_imu_cam : (4, 4) extrinsics, None where the state is the camera's own.
    imu_noise : densities of the IMU; None selects the constant-velocity model.
    motion_noise : of the constant-velocity model.
    gravity_world : (3,) [m/s^2]; default 9.80665 along -z.
    """

    def __init__(
        self,
        nominal: Nominal,
        covariance: Array,
        *,
        T_imu_cam: Array | None = None,
        imu_noise: ImuNoise | None = None,
        motion_noise: ConstantVelocityNoise | None = None,
        gravity_world: Array | None = None,
    ) -> None:
        self.x = nominal.copy()
        self.batch = len(nominal.position)
        self.camera = CameraOnImu.of(T_imu_cam)
        self.gravity = (
            np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2]) if gravity_world is None else np.asarray(gravity_world)
        )
        self._with_imu = imu_noise is not None
        self._densities = (
            constant_velocity_densities(motion_noise or ConstantVelocityNoise())
            if imu_noise is None
            else imu_densities(imu_noise)
        )
        self.P = np.zeros((self.batch, JOINT, JOINT))
        self.P[:, :CORE, :CORE] = covariance
        self.P[:, BIAS, BIAS] = np.eye(12)
        self.dx = np.zeros((self.batch, JOINT))
        self.clone_p: Array = self.x.position
        self.clone_R: Array = self.x.R_world_imu
        self.jitter_cur_mean = np.zeros((self.batch, 6))
        self.jitter_mean = np.zeros((self.batch, 6))
        self.jitter_known = False
        self._F = np.tile(np.eye(CORE), (self.batch, 1, 1))
        self._H = np.zeros((self.batch, 6, JOINT))
        self._H[:, :, JITTER_CUR] = np.eye(6)
        self._FP = np.empty((self.batch, CORE, JOINT))
        # Of many members, an array like the covariance is larger than what memory is kept for from one to the next, and
        # to fetch it takes longer than to fill it. Nothing stays in it, so copies share it.
        self._room = np.empty_like(self.P)
        self._Q: tuple[float, Array] = (-1.0, np.zeros((CORE, CORE)))
        self.clone()

    @property
    def covariance(self) -> Array:
        """(B, 15, 15) of the error (position, velocity, attitude, accelerometer bias, gyroscope bias)."""
        return self.P[:, :CORE, :CORE]

    def copy(self) -> ErrorStateFilter:
        """An independent filter in the same state."""
        other = copy.copy(self)
        other.x = self.x.copy()
        for name in ("P", "dx", "jitter_mean", "clone_R", "clone_p", "_F", "_H", "_FP"):
            setattr(other, name, getattr(self, name).copy())
        return other

    # -- time ---------------------------------------------------------------------------------------------------

    def propagate_imu(self, dt: float, gyro0: Array, acc0: Array, gyro1: Array, acc1: Array) -> None:
        """Move over one IMU interval of ``dt`` seconds with raw samples (b, 3) at both ends."""
        imu_step(self.x, self._F, dt, gyro0, acc0, gyro1, acc1, self.gravity)
        self._propagate_covariance(dt)

    def propagate_constant_velocity(self, dt: float) -> None:
        """Move ``dt`` seconds without an IMU."""
        constant_velocity_step(self.x, self._F, dt)
        self._propagate_covariance(dt)

    def _propagate_covariance(self, dt: float) -> None:
        if self._Q[0] != dt:
            self._Q = (dt, process_noise(self._densities, dt, self._with_imu))
        # The biases stay as they are, and so does what is known of them and of the rest.
        np.matmul(self._F[:, _CARRIED], self.P[:, :CORE], out=self._FP[:, _CARRIED])
        self._FP[:, _CARRIED.stop :] = self.P[:, _CARRIED.stop : CORE]
        core = self._FP[:, :, :CORE] @ transpose(self._F)
        core += transpose(core)
        core *= 0.5
        core += self._Q[1]
        self.P[:, :CORE, :CORE] = core
        rest = self._FP[:, _CARRIED, CORE:KEPT]
        self.P[:, _CARRIED, CORE:KEPT] = rest
        self.P[:, CORE:KEPT, _CARRIED] = transpose(rest)

    def doubt_readings(self, sigma: Array) -> None:
        """Widen by constant errors of the readings, gyroscope first, of standard deviations ``sigma`` (6,) [rad/s,
        m/s^2] over the interval just passed, as where its samples are missing: they act as biases do."""
        G = self._F[:, : BA.start, BA.start :] * np.roll(sigma, 3)
        self.P[:, : BA.start, : BA.start] += G @ transpose(G)

    def doubt_passage(self, before: Nominal) -> None:
        """Widen by all that has changed since ``before``: maybe a clock was set, and no time has passed."""
        moved = np.zeros((self.batch, CORE, 1))
        moved[:, P, 0], moved[:, V, 0] = self.x.position - before.position, self.x.velocity - before.velocity
        moved[:, TH, 0] = se3.so3_log(transpose(before.R_world_imu) @ self.x.R_world_imu)
        self.P[:, :CORE, :CORE] += moved @ transpose(moved)

    def lose_track(self, dt: float) -> None:
        """Widen by what may have happened in ``dt`` seconds of which nothing is known, if they have passed at all and
        no clock was set: the vehicle has gone on as fast as before, or at a metre per second, in any direction, or
        stopped, or turned."""
        speed = np.maximum(np.linalg.norm(self.x.velocity, axis=1), 1.0)[:, None]
        up = self.x.R_world_imu[:, 2, :, None]  # in the axes of the body
        turned = _UNSEEN_TILT_RAD**2 * np.eye(3) + (_UNSEEN_TURN_RAD**2 - _UNSEEN_TILT_RAD**2) * (
            up * up[:, None, :, 0]
        )
        self.P[:, range(P.start, P.stop), range(P.start, P.stop)] += (dt * speed) ** 2
        self.P[:, range(V.start, V.stop), range(V.start, V.stop)] += speed**2
        self.P[:, TH, TH] += turned

    def decay_bias(self, dt: float, tau_s: Array) -> None:
        """Let the normalised VO bias forget over ``dt`` by its time constants (P,), variance kept at one."""
        phi = np.ones(BIAS.stop - BIAS.start)
        phi[: len(tau_s)] = persistence(dt, tau_s)
        self.P[:, BIAS, :] *= phi[:, None]
        self.P[:, :, BIAS] *= phi
        self.P[:, range(BIAS.start, BIAS.stop), range(BIAS.start, BIAS.stop)] += 1.0 - phi * phi

    # -- measurements ---------------------------------------------------------------------------------------------

    def update_motion(
        self, T_est: Array, noise: MotionError, gate: Gate | None = None, recover: NDArray[np.bool_] | None = None
    ) -> Innovation:
        """Use VO's motion from the cloned pose to the present one, ``T_est`` (4, 4) in the camera frame.

        ``recover`` (B,): members that have waited too long (:class:`gpvo.filters.measurement.Wait`). Where the
        measurement fails again, the state is doubted instead: its covariance grows until the measurement can move it.
        """
        gate = gate or Gate()
        if not (self.jitter_known or noise.lost):
            self.P[:, JITTER_REF, JITTER_REF] = first_jitter(T_est, noise.jitter)
            self.jitter_known = True
        self.P[:, JITTER_CUR, JITTER_CUR] = from_end(noise)
        T_ref = self.camera.pose(self.clone_p, self.clone_R)
        T_cur = self.camera.pose(self.x.position, self.x.R_world_imu)
        H = self._H
        me.jacobian(H, self.camera, T_ref, T_cur, noise)
        alone = independent_part(noise)
        r = me.residual(T_ref, T_cur, T_est, noise.mean)
        r = r - (H[:, :, JITTER_REF] @ self.jitter_mean[:, :, None])[:, :, 0]
        # How the size of VO's bias follows the conditions is known only roughly. A filter that believes it to the
        # letter reads the bias off that, and is too sure: so it is considered, not estimated.
        innovation = self.correct(H, r, alone, gate, consider=BIAS)
        if recover is not None and (stuck := recover & ~innovation.used).any():
            self._doubt(np.where(stuck, innovation.nis / gate.threshold(6), 1.0))
            again = self.correct(H, r, alone, replace(gate, on_fail="inflate"), ~stuck, consider=BIAS)
            innovation = replace(innovation, residual=again.residual, S=again.S, used=innovation.used | stuck)
        if innovation.used.any():
            self.inject(innovation.passed)
        return innovation

    def correct(
        self,
        H: Array,
        residual: Array,
        R: Array,
        gate: Gate | None = None,
        leave: NDArray[np.bool_] | None = None,
        consider: slice = slice(0),
    ) -> Innovation:
        """Linear update of the error's mean and covariance, Joseph form; :meth:`inject` moves it into the estimate.

        ``H`` (B, m, 39), ``residual`` (B, m) at the estimate, ``R`` (b, m, m). ``leave`` (B,): members to leave alone.
        ``consider``: states of unit variance that count with their covariance but are not estimated (S. Schmidt,
        "Application of state-space methods to navigation problems" (1966)). With an IMU, the others follow what it
        tells of these. Without one nothing does: the size of VO's bias follows the measured motion, so that noise and
        changes of speed are in it and in the residual alike, and look like news of the bias. The place, which depends
        on it by the whole path, would drift with their squares.
        """
        r = residual - (H @ self.dx[:, :, None])[:, :, 0]
        PHt = self.P @ transpose(H)
        HPHt = H @ PHt
        R = self._with_rounding(H, HPHt, R)
        S = HPHt + R
        L = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
        whitened: Array = np.linalg.solve(L, np.concatenate([transpose(PHt), r[:, :, None]], axis=2))
        z = whitened[:, :, -1]
        nis = (z * z).sum(1)
        limit = gate.threshold(H.shape[1]) if gate else np.inf
        passed = nis <= limit
        own_fault = ~passed if passed.all() else ~passed & (self._own_part(H, S, r) > 0.5 * nis)
        used = passed
        alpha = np.ones(self.batch)
        if gate and not passed.all() and gate.on_fail != "discard":
            used = np.ones_like(passed)
            if gate.on_fail == "inflate":
                alpha = np.maximum(nis / limit, 1.0)
        if leave is not None:
            used = used & ~leave
        if used.any():
            whitened_H = np.asarray(whitened[:, :, :-1], dtype=np.float64)
            K = np.asarray(np.linalg.solve(transpose(L), whitened_H), dtype=np.float64).transpose(0, 2, 1)
            if not self._with_imu:
                # Less what comes by way of the considered states.
                K -= self.P[:, :, consider] @ K[:, consider]
            K[:, consider] = 0.0
            # A wider R turns S into alpha S, and the gain into a 1/alpha of itself.
            R = R + (alpha - 1.0)[:, None, None] * S
            K *= (used / alpha)[:, None, None]
            self._joseph(K, H, PHt, R)
            self.dx += (K @ r[:, :, None])[:, :, 0]
        return Innovation(r, S, nis, passed, used, own_fault)

    def _with_rounding(self, H: Array, HPHt: Array, R: Array) -> Array:
        """``R`` (b, m, m), more where a motion is the small difference of two places, so unsure that their variance
        leaves its own too few digits: by what it is read off less well."""
        places = variances(self.P)[:, P].max(axis=1)[:, None] * np.square(H[:, :, P]).sum(axis=2)
        lost = np.finfo(float).eps * places
        spoilt = ((lost > _SPOILT * variances(R)) & (variances(HPHt) < _SMALL * places)).any(axis=1)
        return R + (_ROUNDINGS * spoilt[:, None] * lost)[:, :, None] * np.eye(H.shape[1]) if spoilt.any() else R

    def _own_part(self, H: Array, S: Array, r: Array) -> Array:
        """How much of the NIS (B,) state and clone have to answer for (see the gate's ``Wait``)."""
        y = np.asarray(np.linalg.solve(S, r[:, :, None]), dtype=np.float64)
        v = transpose(H[:, :, :_STATE]) @ y
        return np.asarray(transpose(v) @ self.P[:, :_STATE, :_STATE] @ v)[:, 0, 0]

    def _doubt(self, factor: Array) -> None:
        """Multiply the variances of all but the positions and VO's own parts by ``factor`` (B,), within reason."""
        variance = variances(self.P)
        room = np.minimum(_MOST_SPEED_VAR / variance[:, V].max(axis=1), _MOST_ANGLE_VAR / variance[:, TH].max(axis=1))
        D = np.ones((self.batch, JOINT))
        for block in (V, TH, BA, BG, me.CLONE_TH):
            D[:, block] = np.sqrt(np.maximum(np.minimum(factor, room), 1.0))[:, None]
        self.P = self.P * (D[:, :, None] * D[:, None, :])

    def _joseph(self, K: Array, H: Array, PHt: Array, R: Array) -> None:
        """``A P A^T + K R K^T`` with ``A = I - K H``, which is never formed: its rank is that of the measurement."""
        AP = np.subtract(self.P, K @ transpose(PHt), out=self._room)
        new = (K @ R - AP @ transpose(H)) @ transpose(K)
        new += AP
        self._keep(new)

    def _keep(self, P: Array) -> None:
        """The mean of ``P`` and its transpose becomes the covariance."""
        np.add(P, transpose(P), out=self._room)
        np.multiply(self._room, 0.5, out=self.P)

    def inject(self, passed: NDArray[np.bool_] | None = None) -> None:
        """Move the error's mean into the estimate and carry the covariance there.

        It is carried as that of the right-invariant error, of which heading and place of the whole are the same states
        for every estimate: no measurement tells them, and with the Jacobian of the attitude alone each update would
        seem to, and the heading's variance stop growing. A. Barrau, S. Bonnabel, "The invariant extended Kalman filter
        as a stable observer" (2017); J. Hesch et al., "Consistency analysis and improvement of vision-aided inertial
        navigation" (2014). Not so members that have not ``passed`` (B,) their gate: a move that the covariance does
        not explain would widen it without end.
        """
        dx, x = self.dx, self.x
        (E, J), (E_clone, J_clone) = (se3.so3_exp_and_right_jacobian(dx[:, block]) for block in (TH, me.CLONE_TH))
        sound = np.ones(self.batch, bool) if passed is None else passed
        G = np.tile(np.eye(_STATE), (self.batch, 1, 1))
        of_state, of_clone = (
            (TH, x.R_world_imu, E, J, (P, V)),
            (me.CLONE_TH, self.clone_R, E_clone, J_clone, (CLONE_P,)),
        )
        for turned, R, turn, jacobian, moved in (of_state, of_clone):
            G[:, turned, turned] = np.where(sound[:, None, None], transpose(turn), jacobian)
            for block in moved:
                G[sound, block, turned] = -(se3.skew(dx[:, block]) @ R)[sound]
        x.position = x.position + dx[:, P]
        x.velocity = x.velocity + dx[:, V]
        x.R_world_imu = _orthonormalised(x.R_world_imu @ E)
        x.acc_bias = x.acc_bias + dx[:, BA]
        x.gyro_bias = x.gyro_bias + dx[:, BG]
        self.clone_p = self.clone_p + dx[:, CLONE_P]
        self.clone_R = _orthonormalised(self.clone_R @ E_clone)
        self.jitter_mean = self.jitter_mean + dx[:, JITTER_REF]
        self.jitter_cur_mean = dx[:, JITTER_CUR].copy()
        # Of all others, what is carried is what was.
        for block in (_CARRIED, CLONE):
            self.P[:, block] = G[:, block, block] @ self.P[:, block]
        for block in (_CARRIED, CLONE):
            self.P[:, :, block] = self.P[:, :, block] @ transpose(G[:, block, block])
        self._keep(self.P)
        dx[:] = 0.0

    def clone(self, *, measured: bool = False) -> None:
        """Make the present pose the reference of the next motion.

        ``measured``: the present frame ended an update of this moment, so its jitter becomes the reference's;
        otherwise the new reference's jitter is taken from the next motion's noise.
        """
        self.clone_p, self.clone_R = self.x.position.copy(), self.x.R_world_imu.copy()
        self.P[:, CLONE, :] = self.P[:, _POSE, :]
        self.P[:, :, CLONE] = self.P[:, :, _POSE]
        if measured:
            self.P[:, JITTER_REF, :] = self.P[:, JITTER_CUR, :]
            self.P[:, :, JITTER_REF] = self.P[:, :, JITTER_CUR]
            self.jitter_mean = self.jitter_cur_mean
        else:
            self.P[:, JITTER_REF, :] = 0.0
            self.P[:, :, JITTER_REF] = 0.0
            self.jitter_mean = np.zeros((self.batch, 6))
        self.jitter_known = measured
        self.forget_current()

    def forget_current(self) -> None:
        """Drop the present frame's jitter: it is not the reference of what follows."""
        self.P[:, JITTER_CUR, :] = 0.0
        self.P[:, :, JITTER_CUR] = 0.0
        self.jitter_cur_mean = np.zeros((self.batch, 6))


def _orthonormalised(R: Array) -> Array:
    """One Newton step towards the nearest rotations: ``R (3 I - R^T R) / 2``, enough for rounding drift."""
    return R @ (1.5 * np.eye(3) - 0.5 * (transpose(R) @ R))
