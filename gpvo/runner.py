"""From a source to a run folder: odometry, and predictions where there is a model."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpvo.errors import GpvoError, SourceError, counted
from gpvo.files import in_metres, plain, read_toml, write_json
from gpvo.io.run import RunWriter, as_stored
from gpvo.io.snapshot import digest_of
from gpvo.types import ImuLog, Prediction, Status, StereoFrame, TrackFrame, VoRecord, frequent_reasons
from gpvo.vo.config import VoConfig, make_config
from gpvo.vo.frontend import Followed, TrackRecorder
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.rig_error import RigState
from gpvo.vo.rig_findings import STATE_FILE, document, findings

if TYPE_CHECKING:
    from gpvo.io.source import Source
    from gpvo.online.predictor import Predictor

# Frames in which the order of left and right is checked.
_FRAMES_BEFORE_TRUST = 5


@dataclass(frozen=True)
class RunSummary:
    """What a run came to: counts by status, the length of the path [m], and frames per second of odometry alone."""

    frames: int
    status: dict[str, int]
    path_length_m: float
    frames_per_s: float
    source_report: str
    calibration: list[str] = field(default_factory=list)  # what it has wrong
    reasons: list[str] = field(default_factory=list)  # why motions are not ok, if many are not

    def __str__(self) -> str:
        named = ((s.value, self.status.get(s.value, 0)) for s in Status if s is not Status.START)
        parts = ", ".join(f"{n} {name}" for name, n in named if n)
        frames = counted(self.frames, "frame")
        return f"{frames} ({parts}), {in_metres(self.path_length_m)}, {self.frames_per_s:.0f} frames/s"


def run(
    source: Source,
    out: Path,
    config: VoConfig | None = None,
    predictor: Predictor | None = None,
    on_frame: Callable[[Step, Prediction | None], None] | None = None,
    *,
    keep_tracks: bool = False,
    overwrite: bool = True,
    calibration_state: RigState | None = None,
    amend: Callable[[VoRecord], VoRecord] | None = None,
    meta: Mapping[str, object] | None = None,
    options: Mapping[str, object] | None = None,
) -> RunSummary:
    """Run stereo VO over a source and write the run folder ``out``.

    ``on_frame`` is called after every frame, for progress bars and live views. ``keep_tracks``: the folder also keeps
    what odometry saw. ``overwrite``: whether a finished run in ``out`` is replaced, once this one is whole.
    ``calibration_state``: what is known of the calibration's errors. ``amend`` may complete a record before it is
    written; ``meta``: further keys of ``run.json``. An interrupted run leaves a folder that can be read up to its last
    complete chunk. ``options``: those that the source was opened with, kept in ``run.json``. A run of the same source,
    options and settings that broke off in ``out`` is resumed, and ends with the same bytes apart from times; None
    begins anew. Raises SourceError if the source holds no frames, or its left and right images look swapped.
    """
    config = config or VoConfig()
    known: dict[str, object] = {"source": str(source.name), "source_format": source.format, "kind": source.kind}
    known |= {"vehicle": asdict(config.vehicle), **(meta or {})}
    if options:
        known["options"] = options = plain(options, lambda path: str(Path(str(path)).resolve()))
    if predictor is not None:
        known["model_digest"] = predictor.digest
        predictor.reset(source.camera, vehicle=config.vehicle)
    status, reasons = Counter[str](), list[str]()
    length_m = busy_s = 0.0
    recorder = TrackRecorder() if keep_tracks else None
    odometry = StereoOdometry(source.camera, config, source.mask, calibration_state, source.mounting.T_imu_cam)
    of_model = "" if predictor is None else predictor.digest
    key = None if options is None else digest_of(options, of_model, keep_tracks, odometry, *_content(source))
    begun: list[RunWriter] = []
    with (
        _gone_on_with(begun),
        RunWriter(
            out,
            overwrite=overwrite,
            camera=source.camera,
            mounting=source.mounting,
            truth=source.truth,
            imu=source.imu,
            config=asdict(config),
            meta=known,
            calibration=source.calibration,
            resume=key,
        ) as writer,
    ):
        begun.append(writer)
        done = [] if writer.kept is None else writer.kept.records
        if writer.kept is not None:
            odometry, recorder = writer.kept.state
            if (odometry.config, odometry.camera) != (config, source.camera):
                raise ValueError("its state is from other settings")
        for k, step in enumerate(steps(source, config, odometry, done)):
            record = as_stored(step.record if amend is None else amend(step.record))
            prediction = None if predictor is None else predictor.step(record)
            tracks = None if recorder is None or k < len(done) else recorder.step(record, step.followed)
            writer.append(record, prediction, tracks, (odometry, recorder))
            status[record.status.value] += 1
            reasons.append(record.reason)
            length_m += float(np.linalg.norm(record.T_prev_cur[:3, 3])) if record.is_reference else 0.0
            busy_s += step.seconds
            if on_frame is not None:
                on_frame(step, prediction)
        frames = sum(status.values())
        if frames == 0:
            raise SourceError("no readable stereo pair", where=source.path, cure="look at the images of both cameras")
        state = odometry.rig_error.state
        write_json(writer.path / STATE_FILE, document(state, source.camera, calibration_state))
        wrong = findings(state, source.camera)
        summary = RunSummary(
            frames, dict(status), length_m, frames / max(busy_s, 1e-9), str(source.report), wrong,
            frequent_reasons(reasons),
        )  # fmt: skip
        writer.note(source_report=asdict(source.report), summary=asdict(summary))
    return summary


@contextmanager
def _gone_on_with(begun: list[RunWriter]) -> Iterator[None]:
    """What fails after the state of an interrupted run was taken up, to the closing of its files, may be that state's
    fault: it is a file as any."""
    try:
        yield
    except Exception as error:
        kept = [writer for writer in begun if writer.kept is not None]
        if not kept or isinstance(error, (GpvoError, OSError)):
            raise
        reason = f"{type(error).__name__}: {error}"
        cure = "remove the folder to start afresh"
        raise SourceError(f"cannot be resumed: {reason}", where=kept[0].path, cure=cure) from error


@dataclass(frozen=True)
class Step:
    """One frame gone through odometry: its record, the points behind it, and the seconds that it took."""

    frame: StereoFrame | TrackFrame
    record: VoRecord
    followed: Followed
    seconds: float


def steps(
    source: Source, config: VoConfig, odometry: StereoOdometry | None = None, done: Sequence[VoRecord] = ()
) -> Iterator[Step]:
    """The frames of a source through odometry, one by one; the records of the first ones may be known already.

    Raises SourceError where these are of other frames.
    """
    odometry = odometry or StereoOdometry(source.camera, config, source.mask, T_imu_cam=source.mounting.T_imu_cam)
    t_last_ns: int | None = None
    for k, frame in enumerate(source):
        if k < _FRAMES_BEFORE_TRUST and isinstance(frame, TrackFrame):
            _refuse_swapped(frame, source.path)
        if k < len(done):
            if done[k].t_ns != frame.t_ns:
                cure = "remove the run folder to start afresh"
                raise SourceError("is not the source of the interrupted run", where=source.path, cure=cure)
            t_last_ns = frame.t_ns
            yield Step(frame, done[k], odometry.last, sum(done[k].stage_ms.values()) * 1e-3)
            continue
        samples = None if t_last_ns is None else imu_between(source.imu, t_last_ns, frame.t_ns)
        start = time.perf_counter()
        record = odometry.step(frame, samples)
        seconds = time.perf_counter() - start
        t_last_ns = frame.t_ns
        yield Step(frame, record, odometry.last, seconds)
    for finding in odometry.pair.findings():
        source.report.note(finding)


def _content(source: Source) -> list[object]:
    """What a source is known by: its files by name, size and times, its IMU, its truth, and its calibration, which may
    lie elsewhere and not show in the rectified camera.

    Whoever changes a file can set its time of modification back, as copying tools do, but not that of its last change
    (``ctime``), which another file in its place has from when it was put there. A file that was only touched counts as
    changed, too: the run then begins anew.
    """
    path = Path(source.path)
    stats = ((p, p.stat()) for p in ([path] if path.is_file() else _files(path)))
    known = [(str(p.relative_to(path.parent)), s.st_size, s.st_mtime_ns, s.st_ctime_ns) for p, s in stats]
    return [source.format, known, source.imu, source.truth, source.calibration]


def _files(folder: Path) -> list[Path]:
    """All files below a folder, also behind links to folders, of which one may lead back."""
    found, seen = list[Path](), set[str]()
    for place, below, names in os.walk(folder, followlinks=True):
        below[:] = [] if (real := os.path.realpath(place)) in seen else sorted(below)
        found += [] if real in seen else [p for name in names if (p := Path(place, name)).is_file()]
        seen.add(real)
    return sorted(found)


def imu_between(imu: ImuLog | None, t_from_ns: int, t_to_ns: int) -> ImuLog | None:
    """IMU samples in ``(t_from_ns, t_to_ns]``."""
    if imu is None:
        return None
    i, j = np.searchsorted(imu.t_ns, [t_from_ns, t_to_ns], side="right")
    return replace(imu, t_ns=imu.t_ns[i:j], gyro_radps=imu.gyro_radps[i:j], acc_mps2=imu.acc_mps2[i:j])


def _refuse_swapped(frame: TrackFrame, where: object) -> None:
    """Say so if most points of a frame of tracks lie behind the cameras; images are checked by their source."""
    disparity = frame.uv_left[:, 0] - frame.uv_right[:, 0]
    behind = int((disparity < -1.0).sum())
    if behind >= 10 and behind > 0.8 * len(disparity):
        text = f"left and right look swapped: {behind} of {len(disparity)} points have negative disparity"
        raise SourceError(text, where=where, cure="exchange uv_left and uv_right")


def config_of(run: Path) -> VoConfig:
    """The settings a run was made with. Raises GpvoError where they cannot be read."""
    path = run / "config.toml"
    # What is None is left out of the file.
    values = {"sigma_p_px": None, "sigma_m_px": None, **read_toml(path)}
    values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    try:
        return make_config(values.pop("preset"), **values)
    except (GpvoError, KeyError, TypeError) as problem:
        raise GpvoError(
            f"the settings of this run cannot be read: {problem}", where=path, cure="run it again"
        ) from None
