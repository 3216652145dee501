"""What odometry keeps between two frames: the reference, the last believed motion, and the expected next one; and what
it asks of a frame: its order and size, and its time in each stage.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.types import Array, ImuMoments, StereoCamera, StereoFrame, TrackFrame
from gpvo.vo.config import VoConfig
from gpvo.vo.felt import Felt
from gpvo.vo.frontend import Observation
from gpvo.vo.motion import NO_TWIST
from gpvo.vo.rivals import EXPLAINED, LONGEST_DOUBT_NS, Choice, Expected, Horizon, Leaps, Standing, wrong_by

_RIVAL_STAYS = 0.85  # per frame
_SEVERAL = 1.5  # of the running sum: a second motion that was found time and again
_GUESS_S = 0.5  # for so long a velocity is taken to last
_SIGMAS_WITHIN_REACH = 5.0  # of what a vehicle can do
_TOO_FAST_NS = 200_000  # for three frames: by arrival, two may come at once
_MOST_JITTER_S, _JITTER_MEMORY = 0.01, 0.05  # of one motion; share of a motion in what is known
_SUSPICION_NS = 10 * 10**9  # and a motion that was refused may come back


@dataclass
class Jitter:
    """How far frames are off their stamps, by the motions that seem too long and too short in turn.

    With white errors n of the stamps and a steady velocity, a motion comes ``x = n_k - 2 n_(k-1) + n_(k-2)`` too late
    or too early, and two of these in a row have a mean product of ``-4 s^2``; that of a change of velocity is positive.
    """

    variance_s2: float = 0.0
    last_s: float = 0.0

    def see(self, off_s: float) -> None:
        """A motion came so much too late."""
        off_s = min(max(off_s, -_MOST_JITTER_S), _MOST_JITTER_S)
        self.variance_s2 += _JITTER_MEMORY * (-off_s * self.last_s / 4.0 - self.variance_s2)
        self.last_s = off_s

    @property
    def reach_s(self) -> float:
        """Five standard deviations of x."""
        return 5.0 * float(np.sqrt(6.0 * max(self.variance_s2, 0.0)))


@dataclass
class State:
    """The reference, the last believed motion, and from them the next one to expect."""

    t_ref_ns: int
    t_last_ns: int
    t_believed_ns: int  # end of the last believed motion
    T_ref_believed: Array
    twist: Array  # (6,) per second, of the last believed motion
    parallax_px: float  # median image motion between the last two believed frames
    reference_points: int
    parallax_from_reference_px: float = 0.0
    usual_inliers: float = 0.0
    rival: NDArray[np.bool_] | None = None  # the points of the last motion and of its rival, if there was one
    rivalry: float = 0.0  # running sum over the frames in which a second motion was seen
    t_rival_ns: int = 0  # when the last one was
    rival_stays: float = _RIVAL_STAYS  # share of the doubt that is left by a frame in which it was not
    horizon: Horizon = field(default_factory=Horizon)
    hidden: bool = False  # whether what was seen last may hide the scene
    in_doubt: Array = field(default_factory=lambda: np.zeros((6, 6)))  # covariance of having taken the wrong motion
    odds: float = 0.0  # log odds that the last velocity is that against the scene
    standing: Standing = field(default_factory=Standing)
    t_twist_ns: int | None = None  # when the velocity was last measured by a plausible motion
    twist_over_s: float = 0.0  # the step whose mean velocity it is
    leaps: Leaps = field(default_factory=lambda: Leaps(0))
    refused: Array | None = None  # (6,) per second: the latest velocity that no vehicle could have reached
    t_refused_ns: int = 0
    jitter: Jitter = field(default_factory=Jitter)
    felt: Felt | None = None  # None without an IMU in a known place
    twists: tuple[Array, Array] = (NO_TWIST, NO_TWIST)  # per second, at the reference and at the last believed frame

    @classmethod
    def begin(cls, t_ns: int, points: int, T_imu_cam: Array | None) -> State:
        """At rest, before any motion, with the frame at ``t_ns`` as reference."""
        state = cls(t_ns, t_ns, t_ns, np.eye(4), np.zeros(6), 0.0, points, leaps=Leaps(t_ns))
        if T_imu_cam is not None:
            state.place_imu(T_imu_cam)
        return state

    def place_imu(self, T_imu_cam: Array) -> None:
        """The camera sits there (4, 4) on the IMU, which has yet to prove itself."""
        self.felt = Felt(se3.inverse(T_imu_cam))

    def feel(self, t_ns: int, imu: ImuMoments) -> None:
        """Carry velocities on to the frame at ``t_ns``, over a step with these moments of the IMU."""
        if self.felt is not None:
            carry = self.felt.carry((t_ns - self.t_last_ns) * 1e-9, imu)
            if self.leaps.before is not None:
                self.leaps.before = carry(self.leaps.before)
            if self.refused is not None:
                self.refused = carry(self.refused)

    def frozen(self, seen: Observation) -> str:
        """What repeats although the camera was moving; empty if nothing does."""
        if seen.alone:
            return f"frozen {seen.alone} image"
        if self.parallax_px <= 0.3:
            return ""
        return "frozen image" if seen.repeated else "a part of the image is frozen" if seen.partly else ""

    def is_fresh(self, t_ns: int, many: int) -> bool:
        """Whether the reference has ``many`` points, and the last believed motion can still be prolonged."""
        return self.reference_points >= many and (t_ns - self.t_believed_ns) * 1e-9 < _GUESS_S

    def suffices(self, parallax_px: float, config: VoConfig) -> bool:
        """Whether the reference still serves when the image has moved by ``parallax_px`` since.

        Beside a rival it has to be fresh: what moves otherwise is seen in two frames or never.
        """
        return parallax_px < config.keyframe_parallax_px and not self.has_rival and self.leaps.before is None

    @property
    def has_rival(self) -> bool:
        """Whether a second motion was seen in one of the last ten frames."""
        return self.rivalry > 0.2

    @property
    def remembers_rival(self) -> bool:
        """Whether a second motion was seen time and again in the frames before."""
        return self.rivalry >= _SEVERAL

    def meet(self, t_ns: int, far_px: float, *, rival: bool) -> None:
        """A motion was found, a tenth of its points with less disparity than this, and a second one or not. What was
        found time and again is not forgotten while the first may hide it."""
        self.hidden = self.horizon.hidden(far_px)
        held = self.hidden and self.remembers_rival and t_ns - self.t_rival_ns < LONGEST_DOUBT_NS
        self.rival_stays = 1.0 if held else _RIVAL_STAYS
        self.rivalry = max(_RIVAL_STAYS * self.rivalry, _SEVERAL if held else 0.0) + float(rival)
        self.t_rival_ns = t_ns if rival else self.t_rival_ns

    @property
    def is_disputed(self) -> bool:
        """Whether another motion than the last may be that of the scene."""
        return self.has_rival or self.leaps.before is not None or self.refused is not None

    def stays(self, config: VoConfig) -> bool:
        """Whether the reference is expected to serve beyond the next frame."""
        return self.suffices(self.parallax_from_reference_px + self.parallax_px, config)

    def guess(self, t_ns: int) -> Array:
        """Motion from the reference to time ``t_ns`` at constant velocity, for at most half a second."""
        dt_s = min((t_ns - self.t_believed_ns) * 1e-9, _GUESS_S)
        return self.T_ref_believed @ se3.exp(self.twist * dt_s)

    def expected(self, t_ns: int, max_acceleration_mps2: float) -> Expected | None:
        """The motion to ``t_ns`` expected from the last velocity of the vehicle; None before there is one."""
        if self.t_twist_ns is None:
            return None
        step_s, age_s = ((t_ns - since) * 1e-9 for since in (self.t_believed_ns, self.t_twist_ns))
        age_s += 0.5 * (self.twist_over_s - step_s)  # from the middle of one step to that of the other
        jitter_m = self.jitter.reach_s * float(np.linalg.norm(self.twist[:3]))
        if self.refused is not None:
            was_off_m = float(np.linalg.norm((self.refused - self.twist)[:3])) * step_s
            if t_ns - self.t_refused_ns > _SUSPICION_NS or was_off_m < jitter_m:
                self.refused = None
        T_refused = None if self.refused is None else self.T_ref_believed @ se3.exp(self.refused * step_s)
        reach_mps = max_acceleration_mps2 * age_s
        sigma_m = reach_mps * step_s / _SIGMAS_WITHIN_REACH
        T_same = self.T_ref_believed @ se3.exp(self.twist * step_s)
        C_turn = step_s**2 * self.standing.unseen(self.twist)[3:, 3:]
        expected = Expected(T_same, reach_mps * step_s + jitter_m, sigma_m, self.odds, C_turn, T_refused)
        if self.leaps.before is not None and self.leaps.contradicted:
            left_reach_mps = _SIGMAS_WITHIN_REACH * self._sigma_left_mps(t_ns, max_acceleration_mps2)
            if self.leaps.differs(self.twist, left_reach_mps):
                T_left = self.T_ref_believed @ se3.exp(self.leaps.before * step_s)
                expected = replace(expected, T_left=T_left, left_reach_m=left_reach_mps * step_s)
        felt_mps = np.inf if self.felt is None else self.felt.reach_mps(suspicious=self.refused is not None)
        if self.felt is None or felt_mps >= reach_mps:
            return expected
        twist = np.concatenate([self.felt.expected(self._lag_s), self.twist[3:]])
        T, sigma_m = self.T_ref_believed @ se3.exp(twist * step_s), self.felt.sigma_mps() * step_s
        return replace(expected, T_prev_cur=T, reach_m=felt_mps * step_s + jitter_m, sigma_m=sigma_m, felt=True)

    def refuse(self, t_ns: int, T_ref_cur: Array) -> None:
        """No vehicle made this motion from the reference."""
        self.refused, self.t_refused_ns = self._velocity(t_ns, T_ref_cur), t_ns
        if self.felt is not None:
            self.felt.contradict((t_ns - self.t_last_ns) * 1e-9)

    def leap(self, t_ns: int, T_ref_cur: Array, max_acceleration_mps2: float) -> None:
        """The motion from the reference does not go on from the last velocity."""
        assert self.t_twist_ns is not None
        last = self.twist
        if self.felt is not None and self.felt.is_known:
            last = np.concatenate([self.felt.expected(), last[3:]])
        reach_mps = _SIGMAS_WITHIN_REACH * self._sigma_left_mps(t_ns, max_acceleration_mps2)
        self.leaps.step(t_ns, self._velocity(t_ns, T_ref_cur), last, self.t_twist_ns, reach_mps)
        self.refused = None

    def compare(self, t_ns: int, T_ref_cur: Array, sigma_m: float) -> None:
        """The motion from the reference, to ``sigma_m``, goes on from the last velocity; but if that has slowly become
        another than the IMU felt, it is in doubt as after a leap."""
        if self.felt is None or self.felt.span is None:
            return
        now = self._velocity(t_ns, T_ref_cur)
        alone_mps = self.felt.contradicted(now, self._lag_s, sigma_m / self._step_s(t_ns))
        if alone_mps is None:
            return
        if self.leaps.before is None:
            began_ns = t_ns - round(self.felt.span.age_s * 1e9)
            self.leaps.step(t_ns, now, np.concatenate([alone_mps, now[3:]]), began_ns, 0.0)
        self.leaps.contradicted = True

    def clock(self, t_ns: int, T_ref_cur: Array) -> None:
        """Learn from the motion from the reference, which may be refused, how far the stamps are off."""
        v = self.twist[:3]
        if self.refused is not None and self.t_refused_ns == self.t_believed_ns:
            v = self.refused[:3]
        if self.t_twist_ns is not None and v @ v > 0.0:
            off = (self._velocity(t_ns, T_ref_cur)[:3] - v) @ v / (v @ v)
            self.jitter.see(float(off) * (t_ns - self.t_believed_ns) * 1e-9)

    def unseen(self, share: float, expected: Expected | None, *, goes_on: bool) -> float:
        """Probability that the scene's motion is none that was seen, beside one that explains this share of the image;
        it is as likely to be another one that was."""
        return 0.5 * self.standing.wrong(share, goes_on=goes_on, felt=self._confirmed(expected, goes_on=goes_on))

    def _confirmed(self, expected: Expected | None, *, goes_on: bool) -> float:
        """How far an IMU that says the same as the motion is to be trusted, from 0 to 1."""
        agrees = goes_on and expected is not None and expected.felt and self.leaps.before is None
        return self.felt.proven if agrees and self.felt is not None else 0.0

    def follow(
        self, t_ns: int, T_ref_cur: Array, share: float, expected: Expected | None, max_acceleration_mps2: float, *,
        goes_on: bool,
    ) -> Array:  # fmt: skip
        """The motion from the reference explains this share of the image and is taken; covariance (6, 6) of the scene's
        being none that was seen, or, beside a rival, one that was refused."""
        twist = self._velocity(t_ns, T_ref_cur)
        step_s, dt_s = ((t_ns - since) * 1e-9 for since in (self.t_believed_ns, self.t_ref_ns))
        has_doubt = share < EXPLAINED and self.has_rival
        wrong = self.unseen(share, expected, goes_on=goes_on) if has_doubt else 0.0
        C = wrong * dt_s**2 * self.standing.unseen(twist)
        if self.refused is not None and (self.rival is not None or self.remembers_rival):
            # An IMU that felt changes of velocity wrongly carries a velocity on wrongly.
            wrongly = 1.0 if self.felt is None else 1.0 - self.felt.proven
            sigmas_mps = self._sigmas_since_mps(self.t_refused_ns, t_ns, max_acceleration_mps2)
            was = self._instead(t_ns, T_ref_cur, self.refused, max(wrongly * sigmas_mps[0], min(sigmas_mps)))
            C = C + wrong_by(self.odds, self._confirmed(expected, goes_on=goes_on)) * was
        self.standing.follow(share, twist, step_s, goes_on=goes_on)
        return C

    def otherwise(self, t_ns: int, T_ref_cur: Array, max_acceleration_mps2: float) -> Array | None:
        """Covariance (6, 6) of the motion from the reference while a velocity that was left may still be the scene's;
        None where there is no doubt."""
        before = self.leaps.doubted(t_ns, hidden=self.hidden)
        if before is None:
            return None
        return 0.5 * self._instead(t_ns, T_ref_cur, before, self._sigma_left_mps(t_ns, max_acceleration_mps2))

    def _instead(self, t_ns: int, T_ref_cur: Array, twist: Array, sigma_mps: float) -> Array:
        """Second moment (6, 6) about the motion from the reference of that at another velocity (6,), known to
        ``sigma_mps`` on each axis."""
        dt_s = (t_ns - self.t_ref_ns) * 1e-9
        d = se3.log(se3.inverse(T_ref_cur) @ se3.exp(twist * dt_s))
        C = np.outer(d, d) + np.diag([(sigma_mps * dt_s) ** 2] * 3 + [0.0] * 3)
        C[3:, 3:] += dt_s**2 * self.standing.unseen(twist)[3:, 3:]
        return C

    def _sigma_left_mps(self, t_ns: int, max_acceleration_mps2: float) -> float:
        """Standard deviation, on each axis, of the velocity before the leap, carried on to ``t_ns``."""
        return min(self._sigmas_since_mps(self.leaps.left_ns, t_ns, max_acceleration_mps2))

    def _sigmas_since_mps(self, since_ns: int, t_ns: int, max_acceleration_mps2: float) -> tuple[float, float]:
        """The same of a velocity measured last at ``since_ns``: by what a vehicle can do, and by what the IMU felt."""
        age_s = (t_ns - since_ns) * 1e-9
        felt_mps = np.inf if self.felt is None else self.felt.sigma_mps(age_s)
        return max_acceleration_mps2 * age_s / _SIGMAS_WITHIN_REACH, felt_mps

    @property
    def _lag_s(self) -> float:
        """How long before the middle of the latest step that of the time since the last believed motion was."""
        return 0.5e-9 * (self.t_last_ns - self.t_believed_ns)

    def moving(self, t_ns: int, T_ref_cur: Array) -> tuple[Array, Array]:
        """Velocities (6,) per second at the reference and at ``t_ns``, for this motion between them: from one step to
        the next they change evenly."""
        now = self._velocity(t_ns, T_ref_cur)
        change = 0.5 * (now - self.twist) if self.t_twist_ns == self.t_believed_ns else NO_TWIST
        return now - change if self.t_ref_ns == self.t_believed_ns else self.twists[0], now + change

    def _velocity(self, t_ns: int, T_ref_cur: Array) -> Array:
        """(6,) per second, since the last believed motion."""
        step = se3.log(se3.inverse(self.T_ref_believed) @ T_ref_cur)
        return np.asarray(step / self._step_s(t_ns))

    def _step_s(self, t_ns: int) -> float:
        """Time since the last believed motion, by which velocities divide."""
        return max((t_ns - self.t_believed_ns) * 1e-9, 1e-6)

    def believe(
        self, t_ns: int, T_ref_cur: Array, parallax_px: float, inliers: int, choice: Choice, sigma_m: float
    ) -> None:
        """Take over a measured motion from the reference; its velocity, to ``sigma_m``, only where it tells it."""
        self.twists, self.in_doubt = self.moving(t_ns, T_ref_cur), choice.lasting
        self.usual_inliers = inliers if self.usual_inliers == 0 else 0.9 * self.usual_inliers + 0.1 * inliers
        if choice.tells:
            self.twist, self.t_twist_ns = self._velocity(t_ns, T_ref_cur), t_ns
            self.twist_over_s = (t_ns - self.t_believed_ns) * 1e-9
            if self.felt is not None:
                sigma_mps = sigma_m / self._step_s(t_ns)
                doubted = self.leaps.before is not None
                self.felt.see(self.twist, sigma_mps, self._lag_s, leapt=not choice.goes_on, doubted=doubted)
        self.parallax_px = abs(parallax_px - self.parallax_from_reference_px)
        self.parallax_from_reference_px = parallax_px
        self.T_ref_believed = T_ref_cur
        self.t_believed_ns = self.t_last_ns = t_ns

    def restart(self, t_ns: int, points: int) -> None:
        """The frame at ``t_ns`` is the new reference."""
        self.twists = (self.twists[1] if t_ns == self.t_believed_ns else NO_TWIST, NO_TWIST)
        self.t_ref_ns = self.t_believed_ns = self.t_last_ns = t_ns
        self.T_ref_believed = np.eye(4)
        self.parallax_from_reference_px = 0.0
        self.reference_points = points


class Stopwatch:
    """Milliseconds of each stage of one frame."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Book the time since the last lap to ``stage``."""
        now = time.perf_counter()
        self.stages[stage] = self.stages.get(stage, 0.0) + (now - self._since) * 1e3
        self._since = now


def own_frame(
    frame: StereoFrame | TrackFrame, camera: StereoCamera, t_last_ns: tuple[int, ...]
) -> StereoFrame | TrackFrame:
    """The frame with images of its own, as its giver may write the next pair into the same memory; ``t_last_ns``: the
    stamps of the last two frames.

    Raises SourceError for a stamp that is no whole number, not later than the last or the third within 0.2 ms, and for
    images of another size.
    """
    if not isinstance(frame.t_ns, int | np.integer):
        cure = "give whole nanoseconds: round(1e9 * seconds)"
        raise SourceError(f"the frame's t_ns is {frame.t_ns!r}, no whole number", cure=cure)
    if t_last_ns and frame.t_ns <= t_last_ns[-1]:
        cure = "feed frames in time order"
        raise SourceError(f"frame at t_ns={frame.t_ns} is not later than the one before ({t_last_ns[-1]})", cure=cure)
    if len(t_last_ns) == 2 and frame.t_ns - t_last_ns[0] <= _TOO_FAST_NS:
        cure = "give whole nanoseconds, not seconds, ms or us: round(1e9 * seconds)"
        raise SourceError(f"frames at t_ns={t_last_ns[0]}, {t_last_ns[1]}, {frame.t_ns} follow too fast", cure=cure)
    if isinstance(frame, TrackFrame):
        return replace(frame, t_ns=int(frame.t_ns))
    for side, image in (("left", frame.left), ("right", frame.right)):
        dtype, shape = getattr(image, "dtype", type(image).__name__), getattr(image, "shape", ())
        if dtype != np.uint8 or shape != (camera.height, camera.width):
            raise SourceError(
                f"the {side} image is {dtype} {shape}, the camera takes uint8 {(camera.height, camera.width)}",
                cure="rows before columns: give grey images of the calibration's resolution",
            )
    return replace(frame, t_ns=int(frame.t_ns), left=np.array(frame.left), right=np.array(frame.right))
