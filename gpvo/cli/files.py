"""``gpvo info`` and ``gpvo import``: what files are, and turning other people's logs into runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from gpvo.cli import common as options
from gpvo.cli.describe import as_lines, describe
from gpvo.cli.output import Json, answer, note, numbers, one_of, progress
from gpvo.cli.output import time_offset as read_offset
from gpvo.dataset.clock import estimate_time_offset
from gpvo.dataset.errors import interpolate_truth
from gpvo.dataset.hand_eye import FixedTransform, align_frames
from gpvo.errors import GpvoError, SourceError
from gpvo.files import plain
from gpvo.io.foreign import COVARIANCE_AXES, T_FLU_OPTICAL, ForeignLog, check_same_rows, read_foreign
from gpvo.io.foreign_csv import NO_HEADER
from gpvo.io.run import write_run
from gpvo.io.stated import to_records
from gpvo.io.trajectory import check_overlap
from gpvo.types import Mounting, TruthLog, Vehicle, VoLog


@dataclass(frozen=True)
class ImportSummary:
    """Result of an import. ``rotation_deg``, ``lever_m``: the fitted fixed transform, and ``worlds_deg`` the angle
    between the worlds of the truth's attitudes and positions; None if not fitted."""

    frames: int
    methods: list[str]
    with_truth: int
    time_offset_s: float
    rotation_deg: float | None
    lever_m: float | None
    worlds_deg: float | None
    notes: list[str]

    def __str__(self) -> str:
        parts = [f"{self.frames} records", f"{self.with_truth} with truth"]
        if self.methods:
            parts.append(f"covariances: {', '.join(self.methods)}")
        if self.time_offset_s:
            parts.append(f"stamps shifted by {self.time_offset_s:+.4f} s")
        if self.rotation_deg is not None:
            parts.append(f"truth rotated by {self.rotation_deg:.2f} deg")
        if self.lever_m:
            parts.append(f"moved by {1e3 * self.lever_m:.0f} mm")
        if self.worlds_deg:
            parts.append(f"its attitudes rotated by {self.worlds_deg:.2f} deg relative to its positions")
        return "\n  ".join([", ".join(parts), *self.notes])


def import_log(
    log: ForeignLog,
    truth: ForeignLog | None,
    out: Path,
    *,
    frame: str = "auto",
    align: str = "none",
    time_offset_s: float | None = 0.0,
    truth_sigma: tuple[float, float] | None = None,
    vehicle: Vehicle | None = None,
    overwrite: bool = True,
) -> ImportSummary:
    """Make a run folder from another odometry's log, with ground truth of the same frame.

    ``frame``: whose poses these are, ``cam``, ``body``, or ``auto`` for the log's own
    :attr:`~gpvo.io.foreign.ForeignLog.frame`, with a note where it is a bag. ``align``: the fixed transform to fit
    between log and truth, ``rotation``, ``transform`` or ``none``. ``time_offset_s``: to add to the log's stamps, None
    to estimate it. ``truth_sigma``: noise of the truth per pose [m, rad]. ``vehicle``: the bounds by which slips are
    recognised, any by default. ``overwrite``: also replace a finished run. Raises SourceError: one line that names the
    file, the place and the cure.
    """
    frame = _frame(log) if frame == "auto" else frame
    place = T_FLU_OPTICAL if frame == "body" else np.eye(4)
    log, given, assumed = log.seen_from(place), None, list[str]()
    if truth is not None:
        check_same_rows(truth, log)
        sigma = truth_sigma or (0.0, 0.0)
        assumed = [f"{truth.path.name}: {n}" for n in truth.notes if n == NO_HEADER]
        given = TruthLog(truth.t_ns, truth.seen_from(place).trajectory.T_world_body, *sigma)
    if time_offset_s is None:
        if given is None:
            raise SourceError("a time offset can only be estimated against ground truth", cure="give --truth")
        time_offset_s = estimate_time_offset(VoLog(to_records(log)[0]), given)
    log = log.shifted(time_offset_s) if time_offset_s else log
    records, notes = to_records(log)
    notes += assumed
    read = truth.topic if truth is not None and truth.path.resolve() == log.path.resolve() else None
    if unread := ", ".join(t for t in log.other_topics if t != read):
        notes.append(f"poses on {unread} are not used: --topic takes them as the odometry, --truth-topic as truth")
    fixed: FixedTransform | None = None
    if given is not None and truth is not None:
        check_overlap(given, log.t_ns, truth.path, " --time-offset auto finds what lies between two clocks")
        if align != "none":
            fixed = align_frames(VoLog(records), given, align)
            given = replace(given, T_world_cam=fixed.in_log_frame(given.T_world_cam))
    meta: dict[str, Any] = {"source": log.path.name, "format": "import", "kind": "import"}
    write_run(
        out,
        VoLog(records),
        overwrite=overwrite,
        truth=given,
        mounting=Mounting(T_body_cam=T_FLU_OPTICAL if frame == "body" else None),
        config={"import": {"frame": frame, "align": align, "time_offset_s": time_offset_s}},
        meta=meta | {"notes": notes, "vehicle": asdict(vehicle or Vehicle())},
    )
    return ImportSummary(
        frames=len(records),
        methods=list(VoLog(records).methods),
        with_truth=0 if given is None else int(interpolate_truth(given, log.t_ns)[1].sum()),
        time_offset_s=time_offset_s,
        rotation_deg=None if fixed is None else fixed.angle_deg,
        lever_m=None if fixed is None else fixed.lever_m,
        worlds_deg=None if fixed is None else fixed.worlds_deg,
        notes=notes,
    )


def _frame(log: ForeignLog) -> str:
    """The frame that a log is taken to be of; of a bag, it is said which."""
    if log.topic is not None:
        of, other = ("a body", "cam") if log.frame == "body" else ("a camera", "body")
        axes = "x ahead, y left, z up" if log.frame == "body" else "x right, y down, z ahead"
        note(f"poses on {log.topic} ('{log.frame_id}') are taken as those of {of}: {axes} (if not, --frame {other})")
    return log.frame


def info(
    path: Annotated[Path, "Sequence, run folder, trajectory, calibration, bag, table or model."],
    kind: options.Kind = None,
    reading: options.SequenceOptions = options.SequenceOptions(),
    json_: Json = False,
) -> None:
    """Describe a file or folder.

    Example: gpvo info MH_01_easy/
    """
    with progress("files", 1):
        document = plain(describe(path, kind, reading.given()))
    short = {k: v for k, v in document.items() if k != "header"}  # of a model: hundreds of lines, for --json
    whole = {"schema": 1, "path": str(path), **document}
    answer(json_, whole, lambda: print("\n".join([str(path), *as_lines(short, "  ")])))


def import_(
    log: Annotated[Path, "Trajectory, CSV or bag of another odometry."],
    out: Annotated[Path, "Run folder to write."],
    truth: Annotated[Path | None, "Ground truth: a trajectory, CSV or bag."] = None,
    format_: Annotated[str | None, "tum, kitti, csv or bag; guessed by default."] = None,
    truth_format: Annotated[str | None, "The same for the ground truth."] = None,
    map_: Annotated[list[str] | None, "Columns of a CSV, e.g. var_x=cov_00.", {"metavar": "COLUMN=NAME"}] = None,
    truth_map: Annotated[
        list[str] | None, "The same for a CSV of the ground truth.", {"metavar": "COLUMN=NAME"}
    ] = None,
    topic: Annotated[str | None, "Topic of the odometry in a bag."] = None,
    truth_topic: Annotated[str | None, "Topic of the ground truth in a bag."] = None,
    times: Annotated[Path | None, "File of stamps in seconds, one line per pose, for KITTI poses."] = None,
    rate_hz: Annotated[float | None, "Frame rate, for KITTI poses without stamps."] = None,
    frame: Annotated[
        str,
        "Frame of the poses: cam (left optical frame), body (FLU), or auto: body for a bag, unless its frame "
        "name contains optical; cam for a file.",
    ] = "auto",
    align: Annotated[
        str,
        "Fit a fixed transform between log and truth: rotation, transform (with lever arm, and the truth's "
        "attitudes against its positions) or none.",
    ] = "none",
    time_offset: Annotated[str, "Seconds to add to the stamps of the log, or auto."] = "0",
    truth_sigma: Annotated[str | None, "White noise of the truth per pose, METRES,RADIANS."] = None,
    covariance_of: Annotated[str, "Whether the covariances in a CSV are of poses or motions."] = "pose",
    covariance_axes: Annotated[
        str,
        "Axes of covariances of poses: world, body, mixed (those of the rotation alone are the body's), or auto: mixed "
        "for columns of OpenVINS' names, else world.",
    ] = "auto",
    vehicle: options.VehicleOptions = options.VehicleOptions(),
    overwrite: options.Overwrite = False,
    json_: Json = False,
) -> None:
    """Turn another odometry's log into a run folder.

    Example: gpvo import 00_est.txt --truth 00_gt.txt -o runs/kitti00
    """
    offset, sigma = read_offset(time_offset), None
    if truth_sigma is not None:
        cure = "give metres,radians, such as 0.003,0.0002"
        translation, rotation = numbers("--truth-sigma", truth_sigma, cure, counts=(2,), least=0.0)
        sigma = (translation, rotation)
    one_of("--covariance-of", covariance_of, ("pose", "motion"))
    one_of("--covariance-axes", covariance_axes, COVARIANCE_AXES)
    one_of("--frame", frame, ("auto", "cam", "body"))
    one_of("--align", align, ("none", "rotation", "transform"))
    mapping, truth_mapping = _mapping("--map", map_ or []), _mapping("--truth-map", truth_map or [])
    stated: dict[str, Any] = {"covariance_of": covariance_of, "covariance_axes": covariance_axes}
    of_truth: dict[str, Any] = {"mapping": truth_mapping, "topic": truth_topic, "complete": True}
    read = partial(read_foreign, times=times, rate_hz=rate_hz)
    with progress("logs", 1):
        summary = import_log(
            read(log, format_, mapping=mapping, topic=topic, **stated),
            None if truth is None else read(truth, truth_format, **of_truth),
            out,
            frame=frame,
            align=align,
            time_offset_s=offset,
            truth_sigma=sigma,
            vehicle=vehicle.bounds(),
            overwrite=overwrite,
        )
    answer(json_, {"schema": 1, "run": str(out), **vars(summary)}, lambda: print(f"{out}: {summary}"))


def _mapping(option: str, texts: list[str]) -> dict[str, str]:
    out = {}
    for text in texts:
        column, _, name = text.rpartition("=")
        if not column or not name:
            raise GpvoError(f"{option} is '{text}'", cure="give COLUMN=NAME, such as var_x=cov_00")
        out[column.strip()] = name.strip()
    return out
