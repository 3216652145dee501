"""One engine for files, tests and every transport: messages in, odometry with its covariance and its health out.

What it keeps in a file lets a restart continue from it.
"""

from __future__ import annotations

import re
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from gpvo.dataset.check import odometry_problems, rate_problems
from gpvo.errors import GpvoError
from gpvo.files import read_json, refuse_foreign, write_json
from gpvo.geometry import se3
from gpvo.geometry.covariance import are_semidefinite, lost_covariance, symmetrise
from gpvo.geometry.se3 import is_rigid, rotate_covariance
from gpvo.io.trajectory import FARTHEST_M
from gpvo.live.intake import Arrival
from gpvo.live.late_truth import LateTruth
from gpvo.live.stages import Taken, lost
from gpvo.live.stereo_stage import Stage
from gpvo.online.guard import camera_problems
from gpvo.online.predictor import Predictor
from gpvo.publish.odometry import LEAST_VARIANCE, Odometry, OdometryBuilder, about_zero, lift
from gpvo.types import VEHICLES, Array, Prediction, Status, Vehicle, VoRecord

REPEAT_S = 10.0
"""How often a warning that still holds is repeated."""
_HEALTH_S, _STALE_S, _SAVE_S = 1.0, 2.0, 10.0
_RECENT = 100
_FAR_SCALE = 5.0  # no model that fits its odometry is so far off, either way
_FROM_OUTSIDE = (GpvoError, OSError, ValueError, ArithmeticError, LookupError, AttributeError, TypeError, struct.error)
"""What a message or a link can raise; neither must end the process."""
_POSITION_SIGMA_M, _ATTITUDE_SIGMA_RAD = 1.0, 0.1  # a source that starts again need not start where it stopped


@dataclass(frozen=True)
class Health:
    """What the diagnostics say. ``level``: 0 ok, 1 warning, 2 error. ``values``: by name, in words and numbers."""

    t_ns: int
    level: int
    text: str
    values: Mapping[str, str]


class Output(Protocol):
    """Where results go. One that has nothing to do with health, or at the end, inherits that."""

    def odometry(self, odometry: Odometry) -> None:
        """One frame; of a lost one ``twist_body`` is None."""

    def health(self, health: Health) -> None:
        """About once a second, and whenever the level changes."""
        return

    def close(self) -> None:
        """Nothing follows."""
        return


class Engine:
    """Steps stage, predictor and message builder, and hands the results to the outputs.

    The pose that is published does not jump where the source starts again or was away for long: an unknown motion
    stands between, with the covariance of what may have happened. Over a gap it follows the source, as uncertain.
    ``truth`` adapts the predictor's scale.
    ``tell``: called with each warning, at once and then every 10 s while it holds. ``topics``: those that should come.
    ``increment``: the pose's covariance is that of its last motion, not accumulated since the start. ``state``: file
    that holds where the odometry stood and what late truth taught; taken up at the start, written every 10 s and at the
    end. ``vehicle``: what slips are told by.
    """

    def __init__(
        self,
        stage: Stage,
        predictor: Predictor,
        outputs: Iterable[Output],
        *,
        tell: Callable[[str], None] = print,
        truth: LateTruth | None = None,
        topics: Iterable[str] = (),
        increment: bool = False,
        state: Path | None = None,
        vehicle: Vehicle = VEHICLES["any"],
    ) -> None:
        self.stage, self.predictor, self.outputs = stage, predictor, list(outputs)
        self._increment, self._state, self._vehicle = increment, state, vehicle
        self.counts: Counter[str] = Counter()
        self.sources: list[Mapping[str, int]] = [stage.counts, self.counts]
        self.last: Odometry | None = None
        self.tell = tell
        self._truth, self._unheard = truth, list(topics)
        self._told_s: dict[str, float] = {}
        self._builder: OdometryBuilder | None = None
        self._seen_ns: int | None = None  # arrival of the last message that was used
        self._now_s, self._used_s = time.monotonic(), np.nan  # of the messages' clock: a recording has its own
        self._used_counts: Counter[str] = Counter()  # of the stage, when a message was last used
        self._latency_ms: deque[float] = deque(maxlen=1000)
        self._motions: deque[VoRecord] = deque(maxlen=_RECENT)
        self._inside: deque[bool] = deque(maxlen=_RECENT)
        self._reported = (-np.inf, 0)  # seconds and level of the last health
        self._misfit: list[str] = []
        self._saved_s = -np.inf
        self._resume = load_state(state)
        self._scale = np.ones(6) if self._resume is None else self._resume.scale
        # Of the body, as last measured; before that, one as fast as vehicles were in training.
        usual = np.sqrt(predictor.model.velocities.usual_rate_var)
        self._twist = usual if self._resume is None else self._resume.twist
        if self._resume is not None and self._resume.model not in ("", predictor.digest):
            tell("the state is another model's: its pose is used, the scale learned from late truth is not")
            self._scale = np.ones(6)
        predictor.require_motions()

    def take(self, arrival: Arrival | None) -> list[Odometry]:
        """Everything that follows from one message; None where nothing came for a while."""
        self._now_s = time.monotonic() if arrival is None else arrival.received_ns * 1e-9
        if np.isnan(self._used_s):
            self._used_s = self._now_s
        if arrival is not None and arrival.topic in self._unheard:
            self._unheard.remove(arrival.topic)
        return self._use(arrival)

    def _use(self, arrival: Arrival | None) -> list[Odometry]:
        out: list[Odometry] = []
        start = time.perf_counter()
        try:
            if self._truth is not None and arrival is not None and arrival.topic == self._truth.topic:
                self._adapt(self._truth, arrival.message)
            for taken in self.stage.flush() if arrival is None else self.stage.take(arrival):
                out.append(self._step(taken))
                self._latency_ms.append(1e3 * (time.perf_counter() - start))
        except _FROM_OUTSIDE as error:  # what follows begins anew, across an unknown motion
            self.counts["failed"] += 1
            self._warn(f"a message on {arrival.topic if arrival else 'a topic'} could not be used: {error}")
            self.stage.reset()
        self._watch()
        return out

    def close(self) -> None:
        """Use what waits, save the state and close the outputs, each whatever becomes of the others.

        Raises GpvoError where an output cannot be finished, as on a full disk.
        """
        self._reported = (-np.inf, self._reported[1])  # what a short recording had no second for is said now
        self._use(None)
        self._save()
        failed = []
        for output in self.outputs:
            try:
                output.close()
            except GpvoError as error:
                failed.append(error)
        if failed:
            raise failed[0]

    def _deliver(self, give: Callable[[Output], None]) -> None:
        """Give something to every output; one that fails, as while a link is down, is counted and called out."""
        for output in self.outputs:
            try:
                give(output)
            except _FROM_OUTSIDE as error:
                self.counts["output_failed"] += 1
                self._warn(f"{type(output).__name__} failed: {error}")

    def _step(self, taken: Taken) -> Odometry:
        builder = self._builder
        if taken.begins:
            self.predictor.reset(self.stage.camera, self._scale, self._vehicle)
            if self._truth is not None:
                self._truth.forget()
        if builder is None:
            builder = self._builder = self._first_builder(taken)
        if taken.begins and self._seen_ns is not None:
            self._bridge(builder, taken, self._seen_ns)
        record = taken.record
        prediction = self.predictor.step(record)
        if self._truth is not None:
            self._truth.predicted(record, prediction)
        message = builder.step(record, prediction)
        message = replace(message, frame_id=taken.frame_id, child_frame_id=taken.child_frame_id)
        self._seen_ns, self._used_s, self.last = taken.received_ns, taken.received_ns * 1e-9, message
        self._used_counts = self.stage.counts.copy()
        self._twist = self._twist if message.twist_body is None else message.twist_body
        self.counts[f"frames_{message.status.value}"] += 1
        if record.dt_s > 0:
            self._motions.append(record)
        if prediction is not None and prediction.measured:
            self._inside.append(bool(prediction.in_domain > 0.5))
        # What is kept, also in the state, is the accumulated one: the next session begins with it.
        sent = self._of_increment(message, record, prediction) if self._increment else message
        self._deliver(lambda output: output.odometry(sent))
        return sent

    def _adapt(self, truth: LateTruth, message: Any) -> None:
        if self._builder is None:  # nothing was published that it could judge
            return
        for t_ns, xi in truth.take(message, self.stage.T_body_cam):
            self.predictor.observe(xi, t_ns)
            self.counts["truth"] += 1
        self._scale = self.predictor.scale

    def _first_builder(self, taken: Taken) -> OdometryBuilder:
        """Starts where the source says, or where the saved state stopped."""
        resume, start = self._resume, np.eye(4) if taken.T_parent_body is None else taken.T_parent_body
        T_odom_body = start if resume is None else resume.T_odom_body
        resets = 0 if resume is None else resume.resets
        builder = OdometryBuilder(self.stage.T_body_cam, T_odom_body, self.stage.method, resets=resets)
        if resume is not None:
            A = se3.adjoint(se3.inverse(self.stage.T_body_cam))
            in_body = rotate_covariance(T_odom_body[:3, :3].T, resume.pose_covariance)
            away_s = (taken.record.t_ns - resume.t_ns) * 1e-9
            away_s = away_s if away_s > 0 else 1.0  # nobody knows: the source's clock is another one
            away = _unknown(away_s, resume.twist)
            builder.step(lost(taken.record, away_s, A @ in_body @ A.T + away, self.stage.method))
        return builder

    def _bridge(self, builder: OdometryBuilder, taken: Taken, seen_ns: int) -> None:
        """The motion that nobody saw between the last message of before, received at ``seen_ns``, and this one."""
        away_s = max((taken.received_ns - seen_ns) * 1e-9, 0.0)
        self.counts["restarts"] += 1
        builder.place(self.stage.T_body_cam)
        builder.step(lost(taken.record, away_s, _unknown(away_s, self._twist), self.stage.method))

    def _of_increment(self, message: Odometry, record: VoRecord, prediction: Prediction | None) -> Odometry:
        C = record.covariances.get(self.stage.method)
        if prediction is not None:
            C = about_zero(prediction.covariance, prediction.mean)
        if C is None:
            return message
        A = se3.adjoint(self.stage.T_body_cam)
        in_odom = rotate_covariance(message.T_odom_body[:3, :3], A @ C @ A.T)
        return replace(message, pose_covariance=lift(in_odom, LEAST_VARIANCE))

    def _watch(self) -> None:
        """Warnings and diagnostics that are due."""
        now_s = self._now_s
        due = now_s - self._reported[0] >= _HEALTH_S
        if due:
            self._misfit = self._misfits()
        silence = []
        if self._now_s - self._used_s > _STALE_S:
            why = [f"nothing received on {', '.join(self._unheard)}"] if self._unheard else []
            why += [f"{n} {name}" for name, n in (self.stage.counts - self._used_counts).most_common()]
            silence = [f"no usable message for more than {_STALE_S:.0f} s{': ' if why else ''}{', '.join(why)}"]
        problems = [*silence, *self._misfit]
        for text in problems:
            self._warn(text)
        status = None if self.last is None else self.last.status
        level = 2 if silence or status is Status.LOST else 1 if problems or status is Status.DEGRADED else 0
        if due or level != self._reported[1]:
            self._reported = (now_s, level)
            report = self._health(level, problems)
            self._deliver(lambda output: output.health(report))
        if self._state is not None and now_s - self._saved_s >= _SAVE_S:
            self._saved_s = now_s
            self._save()

    def _misfits(self) -> list[str]:
        """What does not fit between source and model, looked at once a second."""
        out = camera_problems(self.predictor.camera, self.stage.camera)
        out += odometry_problems(self.predictor, self.stage.odometry)
        if np.abs(np.log(self._scale)).max() > np.log(_FAR_SCALE):
            factors = f"{self._scale.min():.2g} to {self._scale.max():.2g}"
            out.append(f"late truth does not fit: it scales sigma by {factors} (the same body, the same axes?)")
        if len(self._motions) >= 20:
            out += rate_problems(self.predictor, self._motions)
        if len(self._inside) >= 20 and np.mean(self._inside) < 0.5:
            share = 100 * float(np.mean(self._inside))
            given = {i.feature for i in self.predictor.explain() if np.isfinite(i.value)}
            absent = [name for name in self.predictor.features if name not in given]
            why = f": the input lacks {', '.join(absent)} (is the model of this odometry?)" if absent else ""
            out.append(f"only {share:.0f} % of the last motions lie inside the model's training domain{why}")
        return out + self.stage.problems()

    def _warn(self, text: str) -> None:
        kind = re.sub(r"\d[\d.e+]*", "", text.split(":")[0])[:40]  # the same one holds while its numbers change
        if self._now_s - self._told_s.get(kind, -np.inf) >= REPEAT_S:
            self._told_s[kind] = self._now_s
            self.tell(text)

    def _health(self, level: int, problems: list[str]) -> Health:
        last = self.last
        status = "waiting" if last is None else last.status.value
        values = {"status": status, "model": self.predictor.digest[:12], "driven_by": self._driven_by()}
        if last is not None:
            values["in_domain"] = "" if last.in_domain is None else f"{last.in_domain:.3f}"
            values["confidence"] = "" if last.confidence is None else f"{last.confidence:.3f}"
            values["resets"] = str(last.reset_counter)
        if self._truth is not None:
            values["scale"] = " ".join(f"{factor:.3g}" for factor in self._scale)
        if self._latency_ms:
            p50, p99 = np.percentile(self._latency_ms, [50, 99])
            values["latency_ms_p50_p99"] = f"{p50:.2f} {p99:.2f}"
        counts: Counter[str] = Counter()
        for source in self.sources:
            counts.update(source)
        values.update({name: str(n) for name, n in sorted(counts.items()) if n})
        return Health(0 if last is None else last.t_ns, level, "; ".join(problems) or status, values)

    def _driven_by(self) -> str:
        try:
            first = self.predictor.explain()
        except GpvoError:
            return ""
        return str(first[0]) if first else ""

    def _save(self) -> None:
        path, last = self._state, self.last
        if path is None or last is None:
            return
        T, C, resets = last.T_odom_body, last.pose_covariance, last.reset_counter
        kept = KeptState(T, C, self._scale, self.predictor.digest, resets, last.t_ns, self._twist)
        try:
            write_json(path, {"schema": 1, **vars(kept)}, (b'"T_odom_body"', "state"))
        except GpvoError as error:
            self._warn(f"the state is not saved: {error}")


def _unknown(away_s: float, twist: Array) -> Array:
    """(6, 6) covariance of what may have happened while nothing was heard, or the source began elsewhere."""
    start = np.diag([_POSITION_SIGMA_M**2] * 3 + [_ATTITUDE_SIGMA_RAD**2] * 3)
    return lost_covariance(min(away_s, 1e3), twist) + start


@dataclass(frozen=True)
class KeptState:
    """Pose (4, 4) and its covariance (6, 6) in ``odom``; the scale (6,) of sigma that late truth taught a ``model``,
    by its digest (empty: unknown); how often the pose was reset; when, by the source's clock, and how fast (6,) the
    body then moved."""

    T_odom_body: Array
    pose_covariance: Array
    scale: Array
    model: str = ""
    resets: int = 0
    t_ns: int = 0
    twist: Array = field(default_factory=lambda: np.zeros(6))


def load_state(path: Path | None) -> KeptState | None:
    """Of a state file; None where there is none yet. Raises GpvoError, one line, for a pose, covariance or scale that
    cannot be, and where no file can be written."""
    if path is None:
        return None
    refuse_foreign(path, b"", "state")
    if not path.exists():
        return None
    try:
        document = read_json(path)
        T, C = (np.array(document[k], dtype=np.float64) for k in ("T_odom_body", "pose_covariance"))
        scale = np.array(document.get("scale", np.ones(6)), dtype=np.float64)
        model, (resets, t_ns) = str(document.get("model", "")), (int(document.get(k, 0)) for k in ("resets", "t_ns"))
        twist = np.array(document.get("twist", np.zeros(6)), dtype=np.float64)
        if T.shape != (4, 4) or not is_rigid(T, FARTHEST_M):
            raise ValueError("it holds no pose")
        if C.shape != (6, 6) or not are_semidefinite(C[None]).all():
            raise ValueError("its covariance is not positive semidefinite")
        if scale.shape != (6,) or not ((scale > 1e-3) & (scale < 1e3)).all():
            raise ValueError("it holds an impossible scale")
        if twist.shape != (6,) or not (np.abs(twist) < FARTHEST_M).all():
            raise ValueError("it holds no twist")
    except (GpvoError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise GpvoError(f"is not a state file of gpvo live: {error}", where=path, cure="remove it") from None
    return KeptState(T, symmetrise(C), scale, model, resets, t_ns, twist)
