"""From a source to a run folder: odometry, and predictions where there is a model."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpvo.errors import SourceError
from gpvo.io.run import RunWriter
from gpvo.types import ImuLog, Prediction, Status, StereoFrame, TrackFrame, VoRecord
from gpvo.vo.config import VoConfig
from gpvo.vo.odometry import Followed, StereoOdometry

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

    def __str__(self) -> str:
        parts = ", ".join(f"{n} {s}" for s, n in self.status.items() if s != Status.START.value)
        return f"{self.frames} frames ({parts}), {self.path_length_m:.1f} m, {self.frames_per_s:.0f} frames/s"


def run(
    source: Source,
    out: Path,
    config: VoConfig | None = None,
    predictor: Predictor | None = None,
    on_frame: Callable[[Step, Prediction | None], None] | None = None,
) -> RunSummary:
    """Run stereo VO over a source and write the run folder ``out``.

    ``on_frame`` is called after every frame, for progress bars and live views. An interrupted run leaves a folder that
    can be read up to its last complete chunk.

    Raises
    ------
    SourceError
        If the source holds no frames, or its left and right images look swapped.
    """
    config = config or VoConfig()
    meta = {"source": str(source.name), "source_format": source.format, "kind": source.kind}
    if predictor is not None:
        meta["model_digest"] = predictor.digest
        predictor.reset(source.camera)
    status: Counter[str] = Counter()
    length_m = busy_s = 0.0
    with RunWriter(
        out,
        camera=source.camera,
        mounting=source.mounting,
        truth=source.truth,
        imu=source.imu,
        config=asdict(config),
        meta=meta,
        calibration=source.calibration,
    ) as writer:
        for step in steps(source, config):
            record = step.record
            prediction = None if predictor is None else predictor.step(record)
            writer.append(record, prediction)
            status[record.status.value] += 1
            length_m += float(np.linalg.norm(record.T_prev_cur[:3, 3])) if record.is_reference else 0.0
            busy_s += step.seconds
            if on_frame is not None:
                on_frame(step, prediction)
        frames = sum(status.values())
        if frames == 0:
            raise SourceError("no readable stereo pair", where=source.path, cure="look at the images of both cameras")
        summary = RunSummary(frames, dict(status), length_m, frames / max(busy_s, 1e-9), str(source.report))
        writer.note(source_report=source.report.as_dict(), summary=asdict(summary))
    return summary


@dataclass(frozen=True)
class Step:
    """One frame gone through odometry: its record, the points behind it, and the seconds that it took."""

    frame: StereoFrame | TrackFrame
    record: VoRecord
    followed: Followed
    seconds: float


def steps(source: Source, config: VoConfig) -> Iterator[Step]:
    """The frames of a source through odometry, one by one."""
    odometry = StereoOdometry(source.camera, config, source.mask)
    t_last_ns: int | None = None
    for k, frame in enumerate(source):
        if k < _FRAMES_BEFORE_TRUST and isinstance(frame, TrackFrame):
            _refuse_swapped(frame, source.path)
        samples = None if t_last_ns is None else imu_between(source.imu, t_last_ns, frame.t_ns)
        start = time.perf_counter()
        record = odometry.step(frame, samples)
        seconds = time.perf_counter() - start
        t_last_ns = frame.t_ns
        yield Step(frame, record, odometry.last, seconds)


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
        raise SourceError(
            f"left and right look swapped: {behind} of {len(disparity)} points have negative disparity",
            where=where,
            cure="exchange uv_left and uv_right",
        )
