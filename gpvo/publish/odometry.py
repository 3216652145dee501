"""From camera motion to body odometry: pose in ``odom``, twist in ``base_link``, both with a full 6x6 covariance."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from gpvo.accumulation import PoseError, between_ends, carry, measured
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite, lost_covariance, symmetrise
from gpvo.geometry.se3 import T_FLU_OPTICAL, rotate_covariance
from gpvo.types import IMPORTED_POSE, Array, MotionError, Prediction, Status, VoRecord


@dataclass(frozen=True)
class Odometry:
    """One odometry message before it is dressed for a transport. SI, FLU body, z-up ``odom``.

    ``T_odom_body`` (4, 4); ``pose_covariance`` (6, 6) in ``odom``'s fixed axes; ``twist_body`` (6,) linear then
    angular, expressed in the body; ``twist_covariance`` (6, 6) likewise. ``tracked`` is False for a frame that VO or
    the model calls lost: the pose is a guess, twist and its covariance are None. ``confidence`` and ``in_domain`` are
    None without a model.
    """

    t_ns: int
    T_odom_body: Array
    pose_covariance: Array
    twist_body: Array | None
    twist_covariance: Array | None
    status: Status
    tracked: bool
    confidence: float | None = None
    in_domain: float | None = None
    reset_counter: int = 0
    frame_id: str = "odom"
    child_frame_id: str = "base_link"


LEAST_VARIANCE = 1e-9
"""Smallest ever published, of any axis: robot_localization takes less for an error, and nothing replaces zeros well. A
larger one would hide predictions: a second between two frames leaves 1e-4 rad/s of sigma."""


def lift(covariance: Array, least: Array | float) -> Array:
    """Raise variances (6, 6) to at least ``least``, one for all or (6,), on the diagonal only.

    Adding to a diagonal keeps a matrix positive definite; clipping it would not keep its correlations valid.
    """
    out = symmetrise(covariance)
    return out + np.diag(np.maximum(least - np.diagonal(out), 0.0))


def about_zero(covariance: Array, mean: Array) -> Array:
    """Mean square (6, 6) of an error of this covariance about its ``mean`` (6,), which is not taken off."""
    return covariance + np.outer(mean, mean)


@dataclass(frozen=True)
class _Chain:
    """The pose at one frame and its error, in camera axes."""

    T_first_cam: Array
    error: PoseError
    t_ns: int

    def extended(self, record: VoRecord, error: MotionError) -> _Chain:
        """The chain one motion further."""
        return _Chain(self.T_first_cam @ record.T_prev_cur, self.error.after(record.T_prev_cur, error), record.t_ns)


@dataclass
class OdometryBuilder:
    """Turns records and predictions into messages, one per frame.

    Parameters
    ----------
    T_body_cam : (4, 4) mounting of the camera; None takes a forward-looking camera at the body's origin.
    T_odom_body : (4, 4) body pose of the first frame in ``odom``.
    method : geometric covariance used where there is no prediction.
    floor : smallest variance of any axis.
    resets : how often the pose was reset before.
    """

    T_body_cam: Array | None = None
    T_odom_body: Array = field(default_factory=lambda: np.eye(4))
    method: str | None = None
    floor: float = LEAST_VARIANCE
    resets: int = 0

    def __post_init__(self) -> None:
        self.place(T_FLU_OPTICAL if self.T_body_cam is None else np.asarray(self.T_body_cam, dtype=np.float64))
        self._T_odom_cam = self.T_odom_body @ self._T_body_cam
        self._chain: dict[int, _Chain] = {}
        self._last: tuple[_Chain, MotionError] | None = None  # the last good frame and what was stated of its motion
        self._speed: Array | None = None

    def place(self, T_body_cam: Array) -> None:
        """From here on, messages are of the body on which the camera sits at ``T_body_cam`` (4, 4)."""
        self._T_body_cam, self._Ad = T_body_cam, se3.adjoint(T_body_cam)

    def step(self, record: VoRecord, prediction: Prediction | None = None) -> Odometry:
        """The message of one frame; one whose motion is not finite is lost, one that is sent twice changes nothing.

        Raises GpvoError where neither a prediction nor the chosen geometric method gives a usable covariance.
        """
        newest = next(reversed(self._chain.values()), None)
        if newest is not None and record.t_ns == newest.t_ns:  # sent twice: the pose holds its motion already
            return self._message(record, prediction, newest, None, None)
        if not np.isfinite(record.T_prev_cur).all():
            record = replace(record, T_prev_cur=np.eye(4), status=Status.LOST)
        base = self._chain.get(record.t_prev_ns)
        is_break = record.is_reference and _status(record, prediction) is Status.LOST
        if base is None:
            self.resets += bool(self._chain) and not is_break
            base = newest or _Chain(np.eye(4), PoseError(), record.t_prev_ns)
            self._last = None
        if not record.usable or _status(record, prediction) is Status.LOST:
            return self._lost(record, prediction, base, is_break)
        if base.t_ns < record.t_prev_ns:
            base = self._over_gap(base, record.t_prev_ns)
        error = self._error(record, prediction)
        chain = base.extended(record, error)
        twist, twist_covariance = self._twist(record, error, chain)
        self._remember(record, chain)
        self._last = (chain, error)
        return self._message(record, prediction, chain, twist, twist_covariance)

    def _over_gap(self, base: _Chain, t_ns: int) -> _Chain:
        """The chain at a reference whose records were missed: as unsure as what may have happened since."""
        gap_s = (t_ns - base.t_ns) * 1e-9
        unseen = MotionError.independent(lost_covariance(gap_s, self._speed), dt_s=gap_s, status=Status.LOST)
        return _Chain(base.T_first_cam, base.error.after(np.eye(4), unseen), t_ns)

    def _error(self, record: VoRecord, prediction: Prediction | None) -> MotionError:
        if prediction is not None:
            if not is_positive_definite(prediction.covariance):
                raise GpvoError(f"the prediction at t_ns {record.t_ns} is not symmetric positive definite")
            return prediction
        of_motions = {m: C for m, C in record.covariances.items() if m != IMPORTED_POSE}
        covariance = of_motions.get(self.method or "")
        if covariance is None or not is_positive_definite(covariance):
            raise GpvoError(
                f"the frame at t_ns {record.t_ns} has neither a prediction nor a covariance of its motion"
                f" '{self.method}'",
                cure=" or ".join(["give --model", *(f"--method {m}" for m in of_motions)]),
            )
        return measured(record, self.method or "")

    def _twist(self, record: VoRecord, error: MotionError, chain: _Chain) -> tuple[Array, Array]:
        """Body twist since the last good frame, and its covariance.

        Usually that frame is the reference. Where it is not (the vehicle stood still, or a keyframe is kept), the
        motion is the difference of two motions from one reference, whose noise cancels, as does what persists in both;
        both frames' noise remains.
        """
        t_last = record.t_prev_ns if self._last is None else self._last[0].t_ns
        dt = (record.t_ns - t_last) * 1e-9
        if dt <= 0:
            raise GpvoError(f"the frame at t_ns {record.t_ns} does not follow the one at {t_last}")
        if self._last is None or t_last == record.t_prev_ns:
            xi, covariance = se3.log(record.T_prev_cur), about_zero(error.covariance, error.mean)
        else:
            last, stated = self._last
            T_rel = se3.inverse(last.T_first_cam) @ chain.T_first_cam
            mean = chain.error.mean - carry(T_rel) @ last.error.mean
            xi, covariance = se3.log(T_rel), about_zero(between_ends(T_rel, stated, error, dt), mean)
        self._speed = xi / dt
        twist = self._Ad @ xi / dt
        J = self._Ad @ se3.right_jacobian_inverse(xi)
        moved = J @ covariance @ J.T / dt**2
        return twist, lift(moved, self.floor)

    def _lost(self, record: VoRecord, prediction: Prediction | None, base: _Chain, is_break: bool) -> Odometry:
        """A frame without a motion to be believed: what VO says stands in, as uncertain as what may have happened."""
        stated = prediction.covariance if prediction is not None else record.covariances.get(self.method or "")
        if stated is None or not is_positive_definite(stated):
            dt = (record.t_ns - base.t_ns) * 1e-9
            stated = lost_covariance(dt, self._speed) if dt > 0 else np.zeros((6, 6))
        chain = base.extended(record, MotionError.independent(stated, dt_s=record.dt_s, status=Status.LOST))
        self._remember(record, chain)
        if is_break:
            # A reference that was not reached by a measurement is a break: what follows is placed by the guess alone,
            # and its twist must not begin before it.
            self.resets += 1
            self._last = None
        return self._message(record, prediction, chain, None, None)

    def _message(
        self,
        record: VoRecord,
        prediction: Prediction | None,
        chain: _Chain,
        twist: Array | None,
        twist_covariance: Array | None,
    ) -> Odometry:
        T = self._T_odom_cam @ chain.T_first_cam @ se3.inverse(self._T_body_cam)
        status = _status(record, prediction)
        # A mean is not taken off, as the pose must not jump; so it is part of the error, and adds up along the path.
        error = about_zero(chain.error.covariance, chain.error.mean)
        in_odom = rotate_covariance(T[:3, :3], self._Ad @ error @ self._Ad.T)
        return Odometry(
            t_ns=record.t_ns,
            T_odom_body=T,
            pose_covariance=lift(in_odom, self.floor),
            twist_body=twist,
            twist_covariance=twist_covariance,
            status=status,
            tracked=status is not Status.LOST,
            confidence=None if prediction is None else float(prediction.confidence),
            in_domain=None if prediction is None else float(prediction.in_domain),
            reset_counter=self.resets % 256,
        )

    def _remember(self, record: VoRecord, chain: _Chain) -> None:
        """Keep the reference and the newest frame; nothing else is ever started from."""
        if record.is_reference or not self._chain:
            self._chain = {record.t_ns: chain}


def _status(record: VoRecord, prediction: Prediction | None) -> Status:
    """The worse of what VO and the model call the frame: a slip looks well to VO."""
    if prediction is None:
        return record.status
    return max(record.status, prediction.status, key=lambda status: status.severity)


def messages(
    records: Iterable[VoRecord], stated: Callable[[VoRecord], Prediction | None], builder: OdometryBuilder
) -> Iterator[Odometry]:
    """Messages of a whole log, with the prediction ``stated`` of each record in turn."""
    for record in records:
        yield builder.step(record, stated(record))
