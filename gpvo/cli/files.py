"""``gpvo info`` and ``gpvo import``: what files are, and turning other people's logs into runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.cli import common as options
from gpvo.cli.describe import as_lines, describe
from gpvo.cli.output import Json, answer, note, numbers, one_of, progress
from gpvo.cli.output import time_offset as read_offset
from gpvo.dataset.clock import estimate_time_offset
from gpvo.dataset.errors import held_poses, interpolate_truth
from gpvo.dataset.hand_eye import FixedTransform, align_frames
from gpvo.errors import GpvoError, SourceError, counted
from gpvo.files import plain
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.io.foreign import COVARIANCE_AXES, PLACES, ForeignLog, check_same_rows, read_foreign
from gpvo.io.foreign_csv import NO_HEADER
from gpvo.io.run import Run, copy_run, read_run, write_run
from gpvo.io.run_read import is_run
from gpvo.io.stated import to_records
from gpvo.io.trajectory import UNKNOWN, carry, check_overlap
from gpvo.online.slip import flag_slips
from gpvo.types import Mounting, TruthLog, Vehicle, VoLog

_OF_LOGS = (
    "format_", "map_", "topic", "frame", "covariance_of", "covariance_axes", "vehicle", "max_acceleration", "max_turn",
)  # fmt: skip


@dataclass(frozen=True)
class ImportSummary:
    """Result of an import. ``rotation_deg``, ``lever_m``: the fitted fixed transform, and ``worlds_deg`` the angle
    between the worlds of the truth's attitudes and positions; None if not fitted."""

    frames: int
    methods: list[str]
    with_truth: int
    time_offset_s: float
    notes: list[str]
    rotation_deg: float | None = None
    lever_m: float | None = None
    worlds_deg: float | None = None

    def __str__(self) -> str:
        parts = [counted(self.frames, "record"), f"{self.with_truth} with truth"]
        if self.methods:
            parts.append(f"covariances: {', '.join(self.methods)}")
        if self.time_offset_s:
            parts.append(f"time offset {self.time_offset_s:+.4f} s")
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

    ``frame``: whose poses these are, of :data:`~gpvo.io.foreign.PLACES`, or ``auto`` for the log's own
    :attr:`~gpvo.io.foreign.ForeignLog.frame`, with a note where it is a bag. ``align``: the fixed transform to fit
    between log and truth, ``rotation``, ``transform`` or ``none``. ``time_offset_s``: to add to the log's stamps, None
    to estimate it. ``truth_sigma``: noise of the truth per pose [m, rad]. ``vehicle``: the bounds by which slips are
    recognised, any by default. ``overwrite``: also replace a finished run. Raises SourceError: one line that names the
    file, the place and the cure.
    """
    frame = _frame(log) if frame == "auto" else frame
    held, place = held_poses(log.t_ns, log.trajectory.T_world_body), PLACES[frame]
    if truth is not None:
        check_same_rows(truth, log)
    log = log.rows(~held).seen_from(place)
    given = None if truth is None else carry(truth.trajectory, place, truth_sigma or UNKNOWN)
    if time_offset_s is None:
        if given is None:
            raise SourceError("a time offset can only be estimated against ground truth", cure="give --truth")
        time_offset_s = estimate_time_offset(VoLog(to_records(log)[0]), given)
    records, notes = to_records(log.shifted(time_offset_s))
    made = VoLog(records)
    if held.any():
        notes.append(
            f"left out: {held.sum()} of {len(held)} poses, which only repeat the one before while the vehicle moves, as"
            " of odometry that stalls, is lost, or comes at a lower rate"
        )
    notes += _assumed(truth)
    read = truth.topic if truth is not None and truth.path.resolve() == log.path.resolve() else None
    if unread := ", ".join(t for t in log.other_topics if t != read):
        notes.append(f"poses on {unread} are not used: --topic takes them as the odometry, --truth-topic as truth")
    fixed: FixedTransform | None = None
    if given is not None and truth is not None:
        given, fixed = _fitted(made, given, truth.path, align)
    meta: dict[str, Any] = {"source": log.path.name, "format": "import", "kind": "import"}
    write_run(
        out,
        made,
        overwrite=overwrite,
        truth=given,
        mounting=_mounting(log, frame),
        config={"import": {"frame": frame, "align": align, "time_offset_s": time_offset_s}},
        meta=meta | {"notes": notes, "vehicle": asdict(vehicle or Vehicle())},
    )
    return _summary(made, given, time_offset_s, fixed, notes)


def add_truth(
    run: Run,
    truth: ForeignLog | None,
    out: Path,
    *,
    align: str = "none",
    time_offset_s: float | None = 0.0,
    truth_sigma: tuple[float, float] | None = None,
    overwrite: bool = True,
) -> ImportSummary:
    """Copy a run with ground truth of its rectified left camera, by default with its own.

    ``align``, ``time_offset_s``: as for :func:`import_log`, but it is truth that is moved, to the run's clock and
    frame: records, IMU and tracks stay as they are. Raises SourceError: one line that names the file and the cure.
    """
    from gpvo.dataset.build import aligned

    given, path = run.truth, run.path
    if truth is not None:
        given, path = TruthLog(truth.t_ns, truth.trajectory.T_world_body), truth.path
    if given is None or (truth is None and align == "none" and time_offset_s == 0.0):
        cure = "give it with --truth, or fit its own with --align or --time-offset"
        raise SourceError("a run is imported to give it ground truth", where=run.path, cure=cure)
    if truth_sigma is not None:
        given = TruthLog(given.t_ns, given.T_world_cam, *truth_sigma)
    run, offset_s = aligned(replace(run, truth=given), "none", time_offset_s)
    log = run.log if align == "none" else flag_slips(run.log)
    given, fixed = _fitted(log, run.truth or given, path, align)
    origin = {"file": path.name, "align": align, "time_offset_s": offset_s}
    copy_run(run, out, given, {"truth": origin}, overwrite=overwrite)
    return _summary(run.log, given, offset_s, fixed, _assumed(truth))


def _assumed(truth: ForeignLog | None) -> list[str]:
    return [] if truth is None else [f"{truth.path.name}: {n}" for n in truth.notes if n == NO_HEADER]


def _fitted(log: VoLog, truth: TruthLog, path: Path, align: str) -> tuple[TruthLog, FixedTransform | None]:
    """The truth from ``path`` in the frame of the log, and what took it there."""
    check_overlap(truth, log.t_ns, path, " --time-offset auto finds what lies between two clocks")
    if align == "none":
        return truth, None
    fixed = align_frames(log, truth, align)
    return replace(truth, T_world_cam=fixed.in_log_frame(truth.T_world_cam)), fixed


def _summary(
    log: VoLog, truth: TruthLog | None, offset_s: float, fixed: FixedTransform | None, notes: list[str]
) -> ImportSummary:
    known = 0 if truth is None else int(interpolate_truth(truth, log.t_ns)[1].sum())
    fit = () if fixed is None else (fixed.angle_deg, fixed.lever_m, fixed.worlds_deg)
    return ImportSummary(len(log), list(log.methods), known, offset_s, notes, *fit)


def _mounting(log: ForeignLog, frame: str) -> Mounting:
    """Of a body, at its origin. The frame that a bag names has its axes only where they were read as they are."""
    if frame == "cam":
        return Mounting()
    return Mounting(T_FLU_OPTICAL, body=log.body) if frame == "body" else Mounting(T_FLU_OPTICAL)


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
    ctx: typer.Context,
    log: Annotated[Path, "Trajectory, CSV or bag of another odometry; or a run, to give it ground truth."],
    out: Annotated[Path, "Run folder to write."],
    truth: Annotated[Path | None, "Ground truth of the same frame, or see --align: a trajectory, CSV or bag."] = None,
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
        "Frame of the poses: cam (left optical frame), body (FLU), frd (a body, y right, z down, as PX4 logs it), or "
        "auto: body for a bag, unless its frame name contains optical; cam for a file.",
    ] = "auto",
    align: Annotated[
        str,
        "Fit a fixed transform between log and truth: rotation, transform (with lever arm, and the truth's "
        "attitudes against its positions) or none.",
    ] = "none",
    time_offset: Annotated[str, "Seconds to add to the stamps of the log, or auto."] = "0",
    truth_sigma: Annotated[str | None, "White noise of the truth per pose, METRES,RADIANS."] = None,
    covariance_of: Annotated[str, "Whether the covariances in a CSV are of poses or motions."] = "pose",
    covariance_axes: options.CovarianceAxes = "auto",
    vehicle: options.VehicleOptions = options.VehicleOptions(),
    overwrite: options.Overwrite = False,
    json_: Json = False,
) -> None:
    """Turn another odometry's log into a run folder; give any run ground truth.

    Example: gpvo import 00_est.txt --truth 00_gt.txt -o runs/kitti00
    """
    offset, sigma = read_offset(time_offset), None
    if truth_sigma is not None:
        cure = "give metres,radians, such as 0.003,0.0002"
        translation, rotation = numbers("--truth-sigma", truth_sigma, cure, counts=(2,), least=0.0)
        sigma = (translation, rotation)
    one_of("--covariance-of", covariance_of, ("pose", "motion"))
    one_of("--covariance-axes", covariance_axes, COVARIANCE_AXES)
    one_of("--frame", frame, ("auto", *PLACES))
    one_of("--align", align, ("none", "rotation", "transform"))
    mapping, truth_mapping = _mapping("--map", map_ or []), _mapping("--truth-map", truth_map or [])
    stated: dict[str, Any] = {"covariance_of": covariance_of, "covariance_axes": covariance_axes}
    of_truth: dict[str, Any] = {"mapping": truth_mapping, "topic": truth_topic, "complete": True}
    read = partial(read_foreign, times=times, rate_hz=rate_hz)
    fit: dict[str, Any] = {"align": align, "time_offset_s": offset, "truth_sigma": sigma, "overwrite": overwrite}
    of_run = is_run(log) or log.suffix == ".parquet"  # a run's own table is no log, as reading it as a run says
    if of_run:  # which knows what it holds, and of which only truth changes
        cure = "leave it out; --align transform fits a truth of another frame"
        options.refuse_idle(ctx, _OF_LOGS, f"on a run, as {log} is", cure)
    if truth is None:
        idle = ("truth_format", "truth_map", "truth_topic", *(() if of_run else ("align", "truth_sigma")))
        options.refuse_idle(ctx, idle, "without ground truth", "give it with --truth")
    with progress("logs", 1):
        given = None if truth is None else read(truth, truth_format, **of_truth)
        if of_run:
            summary = add_truth(read_run(log), given, out, **fit)
        else:
            foreign = read(log, format_, mapping=mapping, topic=topic, **stated)
            summary = import_log(foreign, given, out, frame=frame, vehicle=vehicle.bounds(), **fit)
    answer(json_, {"schema": 1, "run": str(out), **vars(summary)}, lambda: print(f"{out}: {summary}"))


def _mapping(option: str, texts: list[str]) -> dict[str, str]:
    out = {}
    for text in texts:
        column, _, name = text.rpartition("=")
        if not column or not name:
            raise GpvoError(f"{option} is '{text}'", cure="give COLUMN=NAME, such as var_x=cov_00")
        out[column.strip()] = name.strip()
    return out
