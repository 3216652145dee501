"""From a VO motion in the camera to body odometry: pose in ``odom``, twist in ``base_link``, both with full 6x6."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite, persistent_root, symmetrise
from gpvo.geometry.frames import R_FLU_OPTICAL, rotate_covariance
from gpvo.types import Prediction, Status, VoRecord

Array = NDArray[np.float64]


_NO_BIAS = (np.zeros((6, 12)), np.full(12, np.inf))
"""Root of a bias, and its time constants [s], where there is none."""


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


@dataclass(frozen=True)
class Floors:
    """Smallest variances ever published: what receivers replace zeros and underflows by is worse."""

    translation_m2: float = 1e-6
    rotation_rad2: float = 1e-6
    velocity_m2ps2: float = 1e-6
    rate_rad2ps2: float = 1e-6


def lift(covariance: Array, first: float, second: float) -> Array:
    """Raise variances (6, 6) to at least ``first`` (translation) and ``second`` (rotation), on the diagonal only.

    Adding to a diagonal keeps a matrix positive definite; clipping it would not keep its correlations valid.
    """
    out = symmetrise(covariance)
    missing = np.maximum(np.repeat([first, second], 3) - np.diagonal(out), 0.0)
    return out + np.diag(missing)


@dataclass
class _Chain:
    """Accumulated error of the pose at one frame, in camera axes: what walks and persists, and what is shared."""

    T_first_cam: Array
    walked: Array  # (6, 6) white and bias, of the pose
    cross: Array  # (6, 6) between the pose's error and the normalised bias
    t_ns: int


@dataclass
class OdometryBuilder:
    """Turns records and predictions into messages, one per frame.

    Parameters
    ----------
    T_body_cam : (4, 4) mounting of the camera; None takes a forward-looking camera at the body's origin.
    T_odom_body : (4, 4) body pose of the first frame in ``odom``.
    method : geometric covariance used where there is no prediction.
    correct_twist : take the mean error off the twist. The pose stays VO's own: it must not jump.
    """

    T_body_cam: Array | None = None
    T_odom_body: Array = field(default_factory=lambda: np.eye(4))
    method: str | None = None
    correct_twist: bool = False
    floors: Floors = field(default_factory=Floors)

    def __post_init__(self) -> None:
        forward = se3.from_rt(R_FLU_OPTICAL, np.zeros(3))
        self._T_body_cam = forward if self.T_body_cam is None else np.asarray(self.T_body_cam, dtype=np.float64)
        self._Ad = se3.adjoint(self._T_body_cam)
        self._chain: dict[int, _Chain] = {}
        self._last: tuple[int, Array, Array] | None = None  # stamp, T_first_cam, noise of the last good frame
        self._speed = np.zeros(6)
        self._resets = 0
        self._first_jitter: Array | None = None

    def step(self, record: VoRecord, prediction: Prediction | None = None) -> Odometry:
        """The message of one frame.

        Raises
        ------
        GpvoError
            Where neither a prediction nor the chosen geometric method gives a usable covariance.
        """
        base = self._chain.get(record.t_prev_ns)
        if base is None:
            self._resets += bool(self._chain)
            base = self._latest() or _Chain(np.eye(4), np.zeros((6, 6)), np.zeros((6, 12)), record.t_prev_ns)
            self._last = None
        if not record.usable or _status(record, prediction) is Status.LOST:
            return self._lost(record, prediction, base)
        white, jitter, root, tau_s = self._parts(record, prediction)
        chain = _extend(base, record, white, root, tau_s)
        own = 0.5 * jitter
        if self._first_jitter is None:
            self._first_jitter = own
        twist, twist_covariance = self._twist(record, prediction, chain, own, white + root @ root.T)
        self._remember(record, chain)
        self._last = (record.t_ns, chain.T_first_cam, own + white)
        A = se3.adjoint(se3.inverse(chain.T_first_cam))
        total = chain.walked + own + A @ self._first_jitter @ A.T
        return self._message(record, prediction, chain, total, twist, twist_covariance)

    def _parts(self, record: VoRecord, prediction: Prediction | None) -> tuple[Array, Array, Array, Array]:
        """White and jitter covariance, root (6, 12) of the bias' covariance and its time constants (12,)."""
        zero = np.zeros((6, 6))
        if prediction is not None:
            if not is_positive_definite(prediction.covariance):
                raise GpvoError(f"the prediction at t_ns {record.t_ns} is not symmetric positive definite")
            jitter, bias = prediction.parts.get("jitter", zero), prediction.parts.get("bias", zero)
            white = prediction.covariance - jitter - bias
            if not self.correct_twist:  # what is not taken off remains part of the error
                white = white + np.outer(prediction.mean, prediction.mean)
            tau_s = np.concatenate([prediction.bias_tau_s, prediction.calibration_tau_s])
            return white, jitter, persistent_root(bias, prediction.calibration_root), tau_s
        covariance = record.covariances.get(self.method or "")
        if covariance is None or not is_positive_definite(covariance):
            raise GpvoError(
                f"the frame at t_ns {record.t_ns} has neither a prediction nor a '{self.method}' covariance",
                cure=f"give --model, or --method with one of {', '.join(record.covariances) or 'what the run holds'}",
            )
        return np.asarray(covariance, dtype=np.float64), zero, *_NO_BIAS

    def _twist(
        self, record: VoRecord, prediction: Prediction | None, chain: _Chain, own: Array, independent: Array
    ) -> tuple[Array, Array]:
        """Body twist since the last good frame, and its covariance.

        Usually that frame is the reference. Where it is not (the vehicle stood still, or a keyframe is kept), the
        motion is the difference of two motions from one reference, whose noise cancels; both frames' noise remains.
        """
        t_last, T_last, noise_last = self._last or (record.t_prev_ns, se3.inverse(record.T_prev_cur), own)
        dt = (record.t_ns - t_last) * 1e-9
        if dt <= 0:
            raise GpvoError(f"the frame at t_ns {record.t_ns} does not follow the one at {t_last}")
        if t_last == record.t_prev_ns:
            xi, covariance = se3.log(record.T_prev_cur), independent + 2.0 * own
            if self.correct_twist and prediction is not None:
                xi = se3.log(record.T_prev_cur @ se3.exp(-prediction.mean))
        else:
            # Both motions have the mean of their reference in them: nothing is left of it to take off.
            T_rel = se3.inverse(T_last) @ chain.T_first_cam
            A = se3.adjoint(se3.inverse(T_rel))
            xi, covariance = se3.log(T_rel), independent + own + A @ noise_last @ A.T
        self._speed = xi / dt
        twist = self._Ad @ xi / dt
        moved = self._Ad @ covariance @ self._Ad.T / dt**2
        return twist, lift(moved, self.floors.velocity_m2ps2, self.floors.rate_rad2ps2)

    def _lost(self, record: VoRecord, prediction: Prediction | None, base: _Chain) -> Odometry:
        """A frame without a motion to be believed: what VO says stands in, as uncertain as what may have happened."""
        stated = prediction.covariance if prediction is not None else record.covariances.get(self.method or "")
        if stated is None or not is_positive_definite(stated):
            dt = (record.t_ns - base.t_ns) * 1e-9
            stated = np.diag((np.abs(self._speed) * dt) ** 2)
        chain = _extend(base, record, stated, *_NO_BIAS)
        self._remember(record, chain)
        if record.is_reference and _status(record, prediction) is Status.LOST:
            # A reference that was not reached by a measurement is a break: what follows is placed by the guess alone,
            # and its twist must not begin before it.
            self._resets += 1
            self._last = None
        first = np.zeros((6, 6)) if self._first_jitter is None else self._first_jitter
        return self._message(record, prediction, chain, chain.walked + first, None, None)

    def _message(
        self,
        record: VoRecord,
        prediction: Prediction | None,
        chain: _Chain,
        total: Array,
        twist: Array | None,
        twist_covariance: Array | None,
    ) -> Odometry:
        T = self.T_odom_body @ self._T_body_cam @ chain.T_first_cam @ se3.inverse(self._T_body_cam)
        status = _status(record, prediction)
        in_odom = rotate_covariance(T[:3, :3], self._Ad @ total @ self._Ad.T)
        return Odometry(
            t_ns=record.t_ns,
            T_odom_body=T,
            pose_covariance=lift(in_odom, self.floors.translation_m2, self.floors.rotation_rad2),
            twist_body=twist,
            twist_covariance=twist_covariance,
            status=status,
            tracked=status is not Status.LOST,
            confidence=None if prediction is None else prediction.confidence,
            in_domain=None if prediction is None else prediction.in_domain,
            reset_counter=self._resets % 256,
        )

    def _latest(self) -> _Chain | None:
        return next(reversed(self._chain.values())) if self._chain else None

    def _remember(self, record: VoRecord, chain: _Chain) -> None:
        """Keep the reference and the newest frame; nothing else is ever started from."""
        if record.is_reference or not self._chain:
            self._chain = {record.t_ns: chain}


def _extend(base: _Chain, record: VoRecord, white: Array, root: Array, tau_s: Array) -> _Chain:
    """The chain one motion further: the pose's error moves with the adjoint, the bias forgets and adds."""
    phi = np.diag(np.exp(-record.dt_s / np.maximum(tau_s, 1e-9)))
    A = se3.adjoint(se3.inverse(record.T_prev_cur))
    cross = A @ base.cross @ phi
    persistent = cross @ root.T
    walked = A @ base.walked @ A.T + white + root @ root.T + persistent + persistent.T
    return _Chain(base.T_first_cam @ record.T_prev_cur, symmetrise(walked), cross + root, record.t_ns)


def _status(record: VoRecord, prediction: Prediction | None) -> Status:
    """The worse of what VO and the model call the frame: a slip looks well to VO."""
    if prediction is None:
        return record.status
    return max(record.status, prediction.status, key=lambda status: status.severity)


def messages(
    records: Iterable[VoRecord], predictions: Mapping[int, Prediction], builder: OdometryBuilder
) -> Iterator[Odometry]:
    """Messages of a whole log; ``predictions`` by ``t_ns``."""
    for record in records:
        yield builder.step(record, predictions.get(record.t_ns))
