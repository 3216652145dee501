"""One run published: messages made, checked against a consumer, and written."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.dataset.check import warn_of_misfits
from gpvo.errors import GpvoError, counted
from gpvo.files import refuse_foreign, write_text
from gpvo.io.run import Run, read_run
from gpvo.io.stamps import END_OF_ROS_NS
from gpvo.online.predictor import Predictor
from gpvo.publish import PublishSettings, consumers, mavlink, ros
from gpvo.publish.odometry import Odometry, OdometryBuilder, messages
from gpvo.types import Prediction, VoRecord

TARGETS = ("bag", "mcap", "mavlink")
_PARAMETERS = (b"^# robot_localization fed by gpvo", "file of parameters")
_UNPLACED = (
    "base_link here is the left camera, x ahead: the run does not know where it sits on a body (gpvo run BAG "
    "--base-frame NAME; of a log of a body's poses, gpvo import --frame body); the filter must be told, or the camera "
    "look straight ahead"
)
_SUFFIXES = {".bag": "bag", ".mcap": "mcap", ".tlog": "mavlink"}


@dataclass(frozen=True)
class Published:
    """What was written, and what the consumer will make of it. ``outside``: frames with a motion that are marked by a
    MAVLink quality of -1 as far outside the model's domain; ArduPilot refuses them. ``is_placed``: whether the run
    knows where the camera sits on the ``body``, as messages call it; if not, it is the left camera, x ahead.
    ``of_poses``: whether it is that of poses that were imported."""

    run: str
    to: str | None
    out: str | None
    messages: int
    lost: int
    outside: int
    source: str
    consumer: str | None
    is_placed: bool
    body: str
    of_poses: bool
    verdicts: Sequence[consumers.Verdict]

    def document(self) -> dict[str, Any]:
        """Machine-readable form."""
        told = {k: v for k, v in vars(self).items() if k != "verdicts"}
        return {"schema": 1, **told, "checks": [v.document() for v in self.verdicts]}

    def __str__(self) -> str:
        written = f"{self.out}: {counted(self.messages, 'message')}" if self.out else f"{self.run}: nothing written"
        head = f"{written}, covariance from {self.source}, {counted(self.lost, 'lost frame')}"
        if self.outside:
            head += f", {self.outside} far outside the model's domain (MAVLink quality -1: ArduPilot refuses them)"
        if not self.is_placed:
            head += f"\n{_UNPLACED}"
        elif self.of_poses:
            head += f"\n{self.body} here is the body whose poses were imported"
        return "\n".join([head, *(f"{self.consumer} {v}" for v in self.verdicts)])


def publish_run(path: Path, settings: PublishSettings) -> Published:
    """Publish one run folder.

    With ``check`` and neither ``to``, ``out`` nor ``link`` nothing is written. Raises GpvoError where the run lacks a
    covariance, the target cannot be written, or an option is unknown.
    """
    settings = replace(settings, to=_target(settings))
    _require(settings)
    run = read_run(path)
    if settings.to is not None and settings.link is None:
        name = f"{run.name}.tlog" if settings.to == "mavlink" else f"{run.name}_{settings.to}"
        settings = replace(settings, out=settings.out or Path(name))
        _refuse_other(settings)  # before the work, not after it
    model = settings.model
    predictor = None if model is None else Predictor.load(model).require_motions(model)
    warn_of_misfits(model, predictor, run)
    stated, source = _stated(run, predictor, settings)
    consumer = settings.consumer or ("px4" if settings.to == "mavlink" else "robot_localization")
    passed = _Passed(run, settings.to, consumers.Check(consumer) if settings.check else None)
    out, count = _write(run, passed.of(odometry_of(run, stated, settings)), settings)
    placed, body, of_poses = run.mounting.T_body_cam is not None, run.mounting.body, run.log.camera is None
    of = passed.lost, passed.refused - passed.lost, source, consumer if settings.check else None, placed, body, of_poses
    return Published(run.name, settings.to, out, count, *of, passed.verdicts)


def _stated(
    run: Run, predictor: Predictor | None, settings: PublishSettings
) -> tuple[Callable[[VoRecord], Prediction | None], str]:
    """What is predicted of each record in turn, and whose the covariances are."""
    if predictor is not None:
        predictor.reset(run.log.camera, vehicle=run.log.vehicle)
        return predictor.step, "the model"
    if stored := run.predictions_of_motions:
        return (lambda r: stored.get(r.t_ns)), "the model"
    if run.log.usable.any() and not any(r.covariances for r in run.log if r.usable):
        raise GpvoError("holds neither predictions nor covariances", where=run.path, cure="give --model")
    return (lambda _: None), settings.method


class _Passed:
    """What is told of the messages of a run that have passed by. At their end, before anything is put in place, it
    raises GpvoError where a ``check`` or a bag has nothing to hold on to."""

    def __init__(self, run: Run, to: str | None, check: consumers.Check | None) -> None:
        self._run, self._to, self._check = run, to, check
        self.lost = self.refused = 0
        self.verdicts: list[consumers.Verdict] = []

    def of(self, odometry: Iterable[Odometry]) -> Iterator[Odometry]:
        """The same messages."""
        moves = False
        for o in odometry if self._check is None else self._check.passing(odometry):
            self.lost += not o.tracked
            self.refused += mavlink.quality(o) < 0
            moves |= o.twist_body is not None
            yield o
        if self._check is not None:
            self.verdicts = self._check.verdicts()
        if self._to in ("bag", "mcap") and not moves:
            raise GpvoError("no frame has a motion: nothing to put into a bag", where=self._run.path)


def odometry_of(
    run: Run, stated: Callable[[VoRecord], Prediction | None], settings: PublishSettings
) -> Iterator[Odometry]:
    """All messages of a run, with the prediction ``stated`` of each record; its ``odom`` starts at the body's first
    pose."""
    builder = OdometryBuilder(T_body_cam=run.mounting.T_body_cam, method=settings.method)
    try:
        for o in messages(run.log, stated, builder):
            yield replace(o, child_frame_id=run.mounting.body)
    except GpvoError as error:
        raise GpvoError(error.what, where=run.path, cure=error.cure) from None


def _target(settings: PublishSettings) -> str | None:
    """What to write: ``to``, else what the name of the output tells, else a bag; None where nothing is written.
    GpvoError where they contradict each other, or its suffix tells nothing."""
    told = None if settings.out is None else _SUFFIXES.get(settings.out.suffix.lower())
    if settings.to in TARGETS and told not in (None, settings.to):
        cure = f"use --to {told}, or another -o"
        raise GpvoError(f"is not a file name for --to {settings.to}", where=settings.out, cure=cure)
    if settings.out is not None and settings.out.suffix and not (settings.to or told):
        cure = f"end it in {', '.join(_SUFFIXES)}, or say with --to what to write"
        raise GpvoError("its suffix does not tell what to write", where=settings.out, cure=cure)
    only_check = settings.check and not (settings.out or settings.link)
    return settings.to or told or (None if only_check else "bag")


def _require(settings: PublishSettings) -> None:
    if settings.to is not None and settings.to not in TARGETS:
        raise GpvoError(f"--to is '{settings.to}'", cure=f"choose {', '.join(TARGETS)}")
    if settings.consumer is not None and settings.consumer not in consumers.CONSUMERS:
        raise GpvoError(f"--consumer is '{settings.consumer}'", cure=f"choose {', '.join(consumers.CONSUMERS)}")
    if settings.consumer is not None and not settings.check:
        raise GpvoError("--consumer changes nothing that is written", cure="add --check to see what it will do")
    if not 1 <= settings.system <= 255:
        raise GpvoError(f"--system is {settings.system}", cure="give an id of 1 to 255")
    ros.check_topic(settings.topic)
    if settings.link is not None and settings.to != "mavlink":
        raise GpvoError("--link sends MAVLink", cure="add --to mavlink")
    if settings.to == "mavlink":
        mavlink.dialect()


def _check_stamps(run: Run, settings: PublishSettings) -> None:
    """Raise GpvoError where a stamp does not fit the messages: all count from 1970, those of ROS in 31 bits of
    seconds."""
    early = run.log.t_ns[0] < 0
    if early or (settings.to != "mavlink" and run.log.t_ns[-1] >= END_OF_ROS_NS):
        when = "before 1970" if early else "after January 2038, where those of ROS end"
        raise GpvoError(f"has stamps {when}", where=run.path, cure="subtract an offset from the stamps of its source")


def _parameters(bag: Path) -> Path:
    return bag.with_name(f"{bag.stem}_robot_localization.yaml")


def _refuse_other(settings: PublishSettings) -> None:
    """Raise GpvoError where what is to be written would replace somebody's, or cannot be written."""
    assert settings.out is not None
    if settings.to == "mavlink":
        refuse_foreign(settings.out, *mavlink.TLOG)
    else:
        ros.refuse_other(settings.out, settings.topic, ros.kind_of(settings.out, settings.to))
        refuse_foreign(_parameters(settings.out), *_PARAMETERS)


def _write(run: Run, odometry: Iterable[Odometry], settings: PublishSettings) -> tuple[str | None, int]:
    """Write or send the messages as they come; where, and how many. All of them pass, also if none is written."""
    if settings.to is None:
        deque(odometry, maxlen=0)
        return None, 0
    _check_stamps(run, settings)
    if settings.link is not None:
        # What cannot be published is refused before anything is sent.
        return settings.link, _replay(list(odometry), mavlink.Link(settings.link, settings.system))
    out = settings.out
    assert out is not None
    if settings.to == "mavlink":
        return str(out), mavlink.write_tlog(out, odometry, system=settings.system)
    kind = ros.kind_of(out, settings.to)
    count = ros.write_bag(out, odometry, settings.topic, kind)
    rate_hz = 1.0 / float(np.median(np.diff(run.log.t_ns)) * 1e-9)
    text = ros.robot_localization_yaml(
        settings.topic, rate_hz=max(30.0, rate_hz), ros1=kind == "ros1", base=run.mounting.body
    )
    write_text(_parameters(out), text, own=_PARAMETERS)
    return str(out), count


def _replay(odometry: Sequence[Odometry], link: mavlink.Link) -> int:
    """Send at the pace of the recording."""
    begin, first = time.monotonic(), odometry[0].t_ns
    for item in odometry:
        wait = (item.t_ns - first) * 1e-9 - (time.monotonic() - begin)
        if wait > 0:
            time.sleep(wait)
        link.send(item)
    return len(odometry)
