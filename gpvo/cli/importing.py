"""Composition of ``gpvo import``: a log put into the camera's frame and the truth's clock, and written as a run."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from gpvo.dataset.align import interpolate_truth
from gpvo.dataset.clock import estimate_time_offset
from gpvo.dataset.hand_eye import FixedTransform, fit_fixed_transform, windowed_motions
from gpvo.errors import SourceError
from gpvo.io.foreign import T_FLU_OPTICAL, ForeignLog, to_records
from gpvo.io.run import write_run
from gpvo.io.trajectory import check_overlap
from gpvo.types import Mounting, TruthLog, Vehicle, VoLog


@dataclass(frozen=True)
class ImportSummary:
    """What came of an import. ``rotation_deg``, ``lever_m``: the fitted fixed transform, and ``worlds_deg`` the angle
    between the worlds of the truth's attitudes and positions; None where it was not fitted."""

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
        parts += [f"covariances: {', '.join(self.methods)}"] if self.methods else []
        parts += [f"stamps moved by {self.time_offset_s:+.4f} s"] if self.time_offset_s else []
        parts += [f"truth turned by {self.rotation_deg:.2f} deg"] if self.rotation_deg is not None else []
        parts += [f"moved by {1e3 * self.lever_m:.0f} mm"] if self.lever_m else []
        parts += [f"its attitudes by {self.worlds_deg:.2f} deg against its positions"] if self.worlds_deg else []
        return "\n  ".join([", ".join(parts), *self.notes])


def import_log(
    log: ForeignLog,
    truth: ForeignLog | None,
    out: Path,
    *,
    frame: str = "cam",
    align: str = "none",
    time_offset_s: float | None = 0.0,
    truth_sigma: tuple[float, float] | None = None,
    vehicle: Vehicle | None = None,
    overwrite: bool = True,
) -> ImportSummary:
    """Make a run folder of another odometry's log, with a truth of the same frame.

    ``frame``: whose poses these are, ``cam`` or ``body``. ``align``: the fixed transform to fit between log and truth,
    ``rotation``, ``transform`` or ``none``. ``time_offset_s``: to add to the log's stamps, None to estimate it.
    ``truth_sigma``: noise of the truth per pose [m, rad]. ``vehicle``: what slips are told by, any by
    default. ``overwrite``: also in place of a finished run. Raises SourceError: one line that names the file, the place
    and the cure.
    """
    place = T_FLU_OPTICAL if frame == "body" else np.eye(4)
    log, given, carrier = log.seen_from(place), None, vehicle or Vehicle()
    if truth is not None:
        sigma = truth_sigma or (0.0, 0.0)
        given = TruthLog(truth.t_ns, truth.seen_from(place).trajectory.T_world_body, *sigma)
    if time_offset_s is None:
        if given is None:
            raise SourceError("a time offset can only be estimated against ground truth", cure="give --truth")
        time_offset_s = estimate_time_offset(VoLog(to_records(log)[0]), given)
    log = log.shifted(time_offset_s) if time_offset_s else log
    records, notes = to_records(log)
    fixed: FixedTransform | None = None
    if given is not None and truth is not None:
        check_overlap(given, log.t_ns, truth.path)
        if align != "none":
            A, B, attitudes = windowed_motions(VoLog(records), given)
            whole = align == "transform"
            fixed = fit_fixed_transform(A, B, attitudes if whole else None, lever_arm=whole)
            given = replace(given, T_world_cam=fixed.in_log_frame(given.T_world_cam))
    write_run(
        out,
        VoLog(records),
        overwrite=overwrite,
        truth=given,
        mounting=Mounting(T_body_cam=T_FLU_OPTICAL if frame == "body" else None),
        config={"import": {"frame": frame, "align": align, "time_offset_s": time_offset_s}},
        meta={
            "source": log.path.name,
            "format": "import",
            "kind": "import",
            "notes": notes,
            "vehicle": asdict(carrier),
        },
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
