"""One run published: messages made, checked against a consumer, and written."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.dataset.build import predictions_of
from gpvo.dataset.check import warn_of_misfits
from gpvo.errors import GpvoError, counted
from gpvo.files import refuse_foreign, write_text
from gpvo.io.run import Run, read_run
from gpvo.io.stamps import END_OF_ROS_NS
from gpvo.online.predictor import Predictor
from gpvo.publish import PublishSettings, consumers, mavlink, ros
from gpvo.publish.odometry import Odometry, OdometryBuilder, messages
from gpvo.types import Prediction

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
    predictions = predictions_of(run, predictor)
    odometry = odometry_of(run, predictions, settings)
    consumer = settings.consumer or ("px4" if settings.to == "mavlink" else "robot_localization")
    verdicts = consumers.check(odometry, consumer) if settings.check else []
    out, count = (None, 0) if settings.to is None else _write(run, odometry, settings)
    source = "the model" if settings.model or predictions else settings.method
    lost = sum(not o.tracked for o in odometry)
    outside = sum(mavlink.quality(o) < 0 for o in odometry) - lost
    asked = consumer if settings.check else None
    placed, body, of_poses = run.mounting.T_body_cam is not None, run.mounting.body, run.log.camera is None
    return Published(run.name, settings.to, out, count, lost, outside, source, asked, placed, body, of_poses, verdicts)


def odometry_of(run: Run, predictions: Mapping[int, Prediction], settings: PublishSettings) -> list[Odometry]:
    """All messages of a run, with ``predictions`` by ``t_ns``; its ``odom`` starts at the body's first pose."""
    usable = run.log.usable.any()
    if usable and not predictions and not any(r.covariances for r in run.log if r.usable):
        raise GpvoError("holds neither predictions nor covariances", where=run.path, cure="give --model")
    builder = OdometryBuilder(T_body_cam=run.mounting.T_body_cam, method=settings.method)
    body = run.mounting.body
    try:
        return [replace(o, child_frame_id=body) for o in messages(run.log, predictions, builder)]
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


def _check_stamps(run: Run, odometry: Sequence[Odometry], settings: PublishSettings) -> None:
    """Raise GpvoError where a stamp does not fit the messages: all count from 1970, those of ROS in 31 bits of
    seconds."""
    last_ns = max(o.t_ns for o in odometry)
    early = min(o.t_ns for o in odometry) < 0
    if early or (settings.to != "mavlink" and last_ns >= END_OF_ROS_NS):
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


def _write(run: Run, odometry: Sequence[Odometry], settings: PublishSettings) -> tuple[str, int]:
    _check_stamps(run, odometry, settings)
    if settings.link is not None:
        return settings.link, _replay(odometry, mavlink.Link(settings.link, settings.system))
    out = settings.out
    assert out is not None
    if settings.to == "mavlink":
        return str(out), mavlink.write_tlog(out, odometry, system=settings.system)
    if all(o.twist_body is None for o in odometry):
        raise GpvoError("no frame has a motion: nothing to put into a bag", where=run.path)
    kind = ros.kind_of(out, settings.to)
    count = ros.write_bag(out, odometry, settings.topic, kind)
    rate_hz = 1.0 / float(np.median(np.diff([o.t_ns for o in odometry])) * 1e-9)
    text = ros.robot_localization_yaml(
        settings.topic, rate_hz=max(30.0, rate_hz), ros1=kind == "ros1", base=odometry[0].child_frame_id
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
