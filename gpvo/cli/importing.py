"""Composition of ``gpvo import``: read, put into the camera's frame and the truth's clock, write the run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gpvo.dataset.align import interpolate_truth
from gpvo.dataset.clock import estimate_time_offset
from gpvo.dataset.hand_eye import FixedTransform, fit_fixed_transform, windowed_motions
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.foreign import T_FLU_OPTICAL, ForeignLog, read_foreign, to_records
from gpvo.io.run import write_run
from gpvo.io.truth import check_overlap
from gpvo.types import Array, Mounting, TruthLog, VoLog


@dataclass(frozen=True)
class ImportSettings:
    """What the command was asked; ``time_offset_s`` None means to estimate it."""

    log: Path
    truth: Path | None
    kind: str | None = None
    truth_kind: str | None = None
    mapping: Mapping[str, str] = field(default_factory=dict)
    truth_mapping: Mapping[str, str] = field(default_factory=dict)
    topic: str | None = None
    truth_topic: str | None = None
    times: Path | None = None
    rate_hz: float | None = None
    frame: str = "cam"
    align: str = "none"
    time_offset_s: float | None = 0.0
    truth_sigma: tuple[float, float] | None = None
    covariance_of: str = "pose"
    covariance_axes: str = "world"


@dataclass(frozen=True)
class ImportSummary:
    """What came of an import. ``rotation_deg``, ``lever_m``: the fitted fixed transform, None without one."""

    frames: int
    methods: list[str]
    with_truth: int
    time_offset_s: float
    rotation_deg: float | None
    lever_m: float | None
    notes: list[str]

    def __str__(self) -> str:
        parts = [f"{self.frames} records", f"{self.with_truth} with truth"]
        parts += [f"covariances: {', '.join(self.methods)}"] if self.methods else []
        parts += [f"stamps moved by {self.time_offset_s:+.4f} s"] if self.time_offset_s else []
        parts += [f"truth turned by {self.rotation_deg:.2f} deg"] if self.rotation_deg is not None else []
        parts += [f"moved by {1e3 * self.lever_m:.0f} mm"] if self.lever_m else []
        return "\n  ".join([", ".join(parts), *self.notes])


def import_log(settings: ImportSettings, out: Path, *, overwrite: bool = True) -> ImportSummary:
    """Make a run folder of another odometry's log; ``overwrite``: also in place of a finished run.

    Raises
    ------
    SourceError
        One line that names the file, the place and the cure.
    """
    log = read_foreign(
        settings.log,
        settings.kind,
        mapping=settings.mapping,
        topic=settings.topic,
        times=settings.times,
        rate_hz=settings.rate_hz,
        covariance_of=settings.covariance_of,
        covariance_axes=settings.covariance_axes,
    )
    place = T_FLU_OPTICAL if settings.frame == "body" else np.eye(4)
    log = log.seen_from(place)
    truth = None if settings.truth is None else _read_truth(settings, settings.truth, place)
    log, offset_s = _shift(log, truth, settings)
    records, notes = to_records(log)
    fixed: FixedTransform | None = None
    if truth is not None and settings.truth is not None:
        check_overlap(truth, log.t_ns, settings.truth)
        if settings.align != "none":
            motions = windowed_motions(VoLog(records), truth)
            fixed = fit_fixed_transform(*motions, lever_arm=settings.align == "transform")
            truth = replace(truth, T_world_cam=truth.T_world_cam @ se3.inverse(fixed.T_log_truth))
    write_run(
        out,
        VoLog(records),
        overwrite=overwrite,
        truth=truth,
        mounting=Mounting(T_body_cam=T_FLU_OPTICAL if settings.frame == "body" else None),
        config={"import": {"frame": settings.frame, "align": settings.align, "time_offset_s": offset_s}},
        meta={"source": settings.log.name, "format": "import", "kind": "import", "notes": notes},
    )
    inside = 0 if truth is None else int(interpolate_truth(truth, log.t_ns)[1].sum())
    return ImportSummary(
        frames=len(records),
        methods=list(VoLog(records).methods),
        with_truth=inside,
        time_offset_s=offset_s,
        rotation_deg=None if fixed is None else fixed.angle_deg,
        lever_m=None if fixed is None else fixed.lever_m,
        notes=notes,
    )


def _read_truth(settings: ImportSettings, path: Path, place: Array) -> TruthLog:
    truth = read_foreign(
        path,
        settings.truth_kind,
        mapping=settings.truth_mapping,
        topic=settings.truth_topic,
        times=settings.times,
        rate_hz=settings.rate_hz,
        complete=True,
    ).seen_from(place)
    sigma_t, sigma_r = settings.truth_sigma or (0.0, 0.0)
    return TruthLog(truth.t_ns, truth.trajectory.T_world_body, sigma_t, sigma_r)


def _shift(log: ForeignLog, truth: TruthLog | None, settings: ImportSettings) -> tuple[ForeignLog, float]:
    offset = settings.time_offset_s
    if offset is None:
        if truth is None:
            raise SourceError("a time offset is estimated against a truth", cure="give --truth")
        offset = estimate_time_offset(VoLog(to_records(log)[0]), truth)
    return (log.shifted(offset), offset) if offset else (log, 0.0)
