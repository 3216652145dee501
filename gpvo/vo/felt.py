"""The last velocity, carried on by what an IMU felt: how fast the vehicle must be, whatever the image shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gpvo.geometry import se3
from gpvo.types import MOST_MPS2, MOST_RADPS, STANDARD_GRAVITY_MPS2, Array, ImuMoments

_FORCE_MPS2 = 0.1  # error of the mean specific force, besides its noise: scale, alignment, the clock
_WALK_MPS2 = 0.03  # per root second: what is left of a gyro's bias turns gravity away
_MARGIN_MPS2 = 1.0  # that no IMU is believed beyond: its axes and its clock are never quite as stated
_OTHERWISE_RADPS = 0.2  # no car beside the vehicle turns by as much
_MOST_BIAS_RADPS = 0.02  # that a motion may teach at once
_UNKNOWN_MPS2 = 10.0  # gravity, before anything is known of its direction
_KNOWN_MPS2 = 0.3  # and when enough is
_PATIENCE_S = 10.0  # of contradiction, until its variance is taken to be e times as large
_UNPROVEN = (0.02, 0.02)  # squared errors of changes of velocity, and these squared [m^2/s^2], before any is seen
_SPAN_S = (1.0, 3.0)  # over which changes of velocity are compared as a whole: longer, gravity on a wrong axis adds up
_SPAN_MARGIN_MPS = 1.0  # over a span, for the same reason
_SPAN_UNPROVEN = (0.25, 1.0)  # as _UNPROVEN, of changes over spans
_OFF_GRAVITY_MPS2 = 3.0  # beyond, the unit is another or gravity is taken out; on the Moon nobody drives past
_DISTRUSTED = 1e6  # times P: of no use
_MEMORY = 0.01  # share of a motion in what is known of the filter's own error
_BIAS_MEMORY = 0.05  # and of the gyro's bias


@dataclass
class _Span:
    """What an IMU alone felt since it agreed with odometry: the velocity that it carried on, and how far that has
    changed, both (3,) in camera axes, with the reaction to gravity (3,) as it was known then; ``variance`` (2,) of
    velocity and reaction on each axis, then."""

    velocity_mps: Array
    reaction_mps2: Array
    variance: Array
    changed_mps: Array = field(default_factory=lambda: np.zeros(3))
    age_s: float = 0.0

    def carry(self, R: Array, force_mps2: Array, dt_s: float) -> None:
        """On by a step with this mean specific force (3,), into axes that have turned by ``R`` (3, 3)."""
        self.reaction_mps2 = R @ self.reaction_mps2
        change = (force_mps2 - self.reaction_mps2) * dt_s
        self.velocity_mps, self.changed_mps = R @ self.velocity_mps + change, R @ self.changed_mps + change
        self.age_s += dt_s

    def confirms(self, velocity_mps: Array) -> bool:
        """Whether the IMU alone came to the same velocity (3,), within what a good one errs."""
        off_mps, changed_mps = (np.linalg.norm(v) for v in (velocity_mps - self.velocity_mps, self.changed_mps))
        return bool(off_mps < 2.0 * self._sigma_mps() + 0.1 * changed_mps + 0.1)

    def contradicts(self, velocity_mps: Array, sigma_mps: float, share: float) -> bool:
        """Whether a velocity (3,), to ``sigma_mps``, has changed by far more or less than was felt, though a share of
        that may be wrong.

        An IMU whose axes are not as stated feels as much, but elsewhere: so only the amounts are compared.
        """
        seen_mps = np.linalg.norm(velocity_mps - (self.velocity_mps - self.changed_mps))
        felt_mps = np.linalg.norm(self.changed_mps)
        margin_mps = 5.0 * np.hypot(self._sigma_mps(), sigma_mps) + _SPAN_MARGIN_MPS
        return bool(abs(seen_mps - felt_mps) > share * felt_mps + margin_mps)

    def _sigma_mps(self) -> float:
        return float(np.sqrt(self.variance @ [1.0, self.age_s**2]))


@dataclass
class Felt:
    """A Kalman filter of the IMU's velocity and of the reaction to gravity, the accelerometer's bias in it, both (3,)
    in camera axes.

    No axis is known better than another: ``P`` (2, 2) is the covariance of the two on each. ``T_cam_imu`` (4, 4).
    """

    T_cam_imu: Array
    velocity_mps: Array = field(default_factory=lambda: np.zeros(3))
    reaction_mps2: Array = field(default_factory=lambda: np.zeros(3))
    P: Array = field(default_factory=lambda: np.diag([np.inf, _UNKNOWN_MPS2**2]))
    excess: float = 1.0  # of squared innovations over what P says, at least 1
    wrong: Array = field(default_factory=lambda: np.array(_UNPROVEN))  # running sums of the same
    span: _Span | None = None  # since odometry last agreed
    span_wrong: Array = field(default_factory=lambda: np.array(_SPAN_UNPROVEN))  # sums as in wrong, over spans
    age_s: float = 0.0  # since the velocity was measured
    changed_mps: float = 0.0  # how far it has changed since
    bias_radps: Array = field(default_factory=lambda: np.zeros(3))  # of the gyro, in camera axes
    force_mps2: Array | None = None  # (3,) over the latest step
    force_variance: float = 0.0  # of that force, as a mean of noisy samples
    turn_radps: Array = field(default_factory=lambda: np.zeros(3))  # (3,) over the latest step
    acceleration_mps2: Array = field(default_factory=lambda: np.zeros(3))  # (3,) over the latest step

    def carry(self, dt_s: float, imu: ImuMoments) -> Callable[[Array], Array]:
        """On by a step over which the IMU had these moments, from the middle of the step before; without samples that
        can be, the velocity becomes unknown. What it does to any velocity (6,) of the camera in its axes."""
        if not _can_be(imu):
            self._forget()
            return lambda twist: twist
        self.age_s += dt_s
        R_cam_imu = self.T_cam_imu[:3, :3]
        turn, force = R_cam_imu @ imu.mean[:3] - self.bias_radps, R_cam_imu @ imu.mean[3:]
        R = se3.exp(np.concatenate([np.zeros(3), -turn * dt_s]))[:3, :3]
        before = force if self.force_mps2 is None else R @ self.force_mps2
        self.reaction_mps2 = R @ self.reaction_mps2
        over_step = 0.5 * (force + before)
        self.acceleration_mps2 = over_step - self.reaction_mps2
        change = self.acceleration_mps2 * dt_s
        self.changed_mps += float(np.linalg.norm(change))
        of_lever_before = R @ self._of_lever()
        self.velocity_mps = R @ self.velocity_mps + change
        self.force_mps2, self.turn_radps = force, turn
        if self.span is not None:
            self.span.carry(R, over_step, dt_s)
        change_of_camera = change - (self._of_lever() - of_lever_before)
        of_turn, of_force = imu.variance.reshape(2, 3).mean(axis=1) / imu.n
        turned = of_turn * dt_s**2
        pushed = (0.5 * (of_force + self.force_variance) + _FORCE_MPS2**2) * dt_s**2
        self.force_variance = of_force
        turns = turned * np.array([self.velocity_mps @ self.velocity_mps, self.reaction_mps2 @ self.reaction_mps2])
        if self.is_known:
            F = np.array([[1.0, -dt_s], [0.0, 1.0]])
            self.P = F @ self.P @ F.T
        self.P = self.P + np.diag(turns + [pushed, _WALK_MPS2**2 * dt_s])
        return lambda twist: np.concatenate([R @ twist[:3] + change_of_camera, twist[3:]])

    @property
    def is_known(self) -> bool:
        """Whether the velocity is."""
        return bool(np.isfinite(self.P[0, 0]))

    @property
    def proven(self) -> float:
        """How far it has been right about changes of velocity, from 0 to 1: of a car that accelerates as the vehicle
        does, an IMU that knows no gravity yet feels none."""
        return max(0.0, 1.0 - float(np.sqrt(self.wrong[0] / self.wrong[1])))

    def expected(self, lag_s: float = 0.0) -> Array:
        """(3,) velocity of the camera in its axes, in the middle of the latest step or so long before."""
        return np.asarray(self.velocity_mps - lag_s * self.acceleration_mps2 - self._of_lever())

    def sigma_mps(self, age_s: float | None = None) -> float:
        """Standard deviation of it on each axis; with an age, of another velocity that was carried on for so long."""
        variance = self.P[0, 0] if age_s is None else self.P[1, 1] * age_s**2
        return float(np.sqrt(self.excess * variance))

    def reach_mps(self, *, suspicious: bool) -> float:
        """By how much it may be wrong. While nothing else speaks against the image, no IMU is believed beyond a margin:
        a velocity that leaps has to rouse suspicion first."""
        wrong_mps = np.sqrt(self.wrong[0] / self.wrong[1]) * self.changed_mps
        if suspicious:
            return float(3.0 * self.sigma_mps() + 5.0 * wrong_mps)
        return float(5.0 * (self.sigma_mps() + wrong_mps) + _MARGIN_MPS2 * self.age_s)

    def see(self, twist: Array, sigma_mps: float, lag_s: float, *, leapt: bool, doubted: bool = False) -> None:
        """Odometry measured a velocity (6,) of the camera in its axes, so long before the middle of the latest step.
        ``leapt``: not from the last one, ``doubted``: since a leap; neither teaches the filter anything of the IMU."""
        if np.linalg.norm(self.turn_radps - twist[3:]) > _OTHERWISE_RADPS:  # axes, units or the clock are wrong
            self._forget()
        changed_mps, off_mps = self.changed_mps, twist[:3] - self.expected(lag_s)
        self.age_s = self.changed_mps = 0.0
        noise = sigma_mps**2 + 0.25 * lag_s**2 * float(self.acceleration_mps2 @ self.acceleration_mps2)
        S = self.P[0, 0] + noise
        if leapt or doubted or not self.is_known:
            self.velocity_mps, self.P = self.velocity_mps + off_mps, np.diag([noise, self.P[1, 1]])
            self.span = None if leapt else self.span or self._begun()
            return
        off, changed = float(off_mps @ off_mps), changed_mps**2
        telling = changed / (changed + S) if self.P[1, 1] < _KNOWN_MPS2**2 else 0.0
        wrong = (1 - _MEMORY * telling) * self.wrong + telling * np.array([off - 3 * S, changed])
        self.wrong = np.maximum(wrong, 0.0)
        self.excess = max(1.0, self.excess + _MEMORY * telling * (off / (3 * S) - self.excess))
        self.bias_radps = self.bias_radps + _BIAS_MEMORY * np.clip(
            self.turn_radps - twist[3:], -_MOST_BIAS_RADPS, _MOST_BIAS_RADPS
        )
        gain = self.P[:, 0] / S
        self.velocity_mps = self.velocity_mps + gain[0] * off_mps
        self.reaction_mps2 = self.reaction_mps2 + gain[1] * off_mps
        self.P = self.P - np.outer(gain, self.P[0])
        self._compare()

    def contradicted(self, twist: Array, lag_s: float, sigma_mps: float = 0.0) -> Array | None:
        """(3,) the camera's velocity by the IMU alone where that contradicts a measured one (6,), to ``sigma_mps``,
        else None."""
        if self.span is None:
            return None
        velocity_mps = self.velocity_mps + twist[:3] - self.expected(lag_s)
        share = float(np.sqrt(self.span_wrong[0] / self.span_wrong[1]))
        is_contradicted = self.span.contradicts(velocity_mps, sigma_mps, share)
        return self.span.velocity_mps - self._of_lever() if is_contradicted else None

    def _compare(self) -> None:
        """End a span that is confirmed or too long, and begin one."""
        if self.span is not None:
            ended = self.span.confirms(self.velocity_mps) or self.span.age_s > _SPAN_S[1]
            if self.span.age_s < _SPAN_S[0] or not ended:
                return
            errors = np.stack([self.velocity_mps - self.span.velocity_mps, self.span.changed_mps])
            self.span_wrong = self.span_wrong + (errors**2).sum(axis=1)
        self.span = self._begun()

    def _begun(self) -> _Span | None:
        """A new span; None where gravity is not known, or cannot be what is taken for it."""
        off_mps2 = abs(float(np.linalg.norm(self.reaction_mps2)) - STANDARD_GRAVITY_MPS2)
        if self.P[1, 1] > _KNOWN_MPS2**2 or off_mps2 > _OFF_GRAVITY_MPS2:
            return None
        return _Span(self.velocity_mps, self.reaction_mps2, self.excess * np.diag(self.P))

    def contradict(self, dt_s: float) -> None:
        """For so long the image moved by a velocity out of reach: the IMU is trusted less, as it may be wrong."""
        self.excess = min(self.excess * float(np.exp(dt_s / _PATIENCE_S)), _DISTRUSTED)

    def _forget(self) -> None:
        self.P, self.force_mps2, self.span = np.diag([np.inf, _UNKNOWN_MPS2**2]), None, None

    def _of_lever(self) -> Array:
        """(3,) velocity of the IMU about the camera."""
        (x, y, z), (a, b, c) = self.turn_radps, self.T_cam_imu[:3, 3]
        return np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def _can_be(imu: ImuMoments) -> bool:
    """Whether a working IMU may have had these moments: in its range, and not one reading again and again."""
    in_range = np.abs(imu.mean) < np.repeat([MOST_RADPS, MOST_MPS2], 3)
    return imu.n > 0 and bool(in_range.all()) and (imu.n == 1 or bool(imu.variance.any()))
