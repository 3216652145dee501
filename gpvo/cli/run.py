"""``gpvo run``: stereo odometry over a sequence; ``gpvo calibration``: what it found wrong with the rig."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gpvo.cli import common as flags
from gpvo.cli.output import Json, note, print_json, progress
from gpvo.errors import SourceError, counted
from gpvo.files import read_json, write_text
from gpvo.io.run import read_run
from gpvo.io.source import open_source
from gpvo.online.predictor import Predictor
from gpvo.types import Prediction, Status

if TYPE_CHECKING:
    from gpvo.runner import RunSummary

_MOST_NOTES = 5
_MOST_LOST = 0.5
_MUCH_LEFT = 1 / 3  # of a displacement: with 0.4 left, drive 0001 of KITTI drifts twice as far


def run(
    source: Annotated[Path, "EuRoC, TUM-VI or KITTI folder, bag, image folder or tracks."],
    out: Annotated[Path, "Run folder to write."],
    model: Annotated[Path | None, "Error model: store a prediction with each frame."] = None,
    odometry: flags.OdometryOptions = flags.OdometryOptions(),
    vehicle: flags.VehicleOptions = flags.VehicleOptions(),
    kind: flags.Kind = None,
    reading: flags.SequenceOptions = flags.SequenceOptions(),
    keep_tracks: Annotated[bool, "Keep the tracks of the points; 'gpvo twin' needs them."] = False,
    view: Annotated[bool, "Watch the run live in rerun (extra gpvo[viz])."] = False,
    record_view: Annotated[Path | None, "Write what --view would show to this .rrd file."] = None,
    overwrite: flags.Overwrite = False,
    json_: Json = False,
) -> None:
    """Run stereo VO over a sequence: log, trajectory and covariances.

    Example: gpvo run MH_01_easy/ -o runs/mh01
    """
    from gpvo import runner
    from gpvo.dataset.check import ENOUGH_INSIDE, odometry_problems

    config = odometry.config(vehicle.bounds())
    options = reading.given() | ({} if kind is None else {"kind": kind})
    sequence = open_source(source, **options)
    state = odometry.state(sequence.camera)
    predictor = None if model is None else Predictor.load(model)
    for problem in odometry_problems(predictor, asdict(config)) if predictor is not None else ():
        print(f"gpvo: {problem}", file=sys.stderr)
    show = None
    if view or record_view is not None:
        from gpvo.evaluation.pictures import LiveView

        show = LiveView(sequence.camera, str(sequence.name), record_view).show
    inside: list[bool] = []
    with progress("frames", len(sequence)) as advance:

        def on_frame(step: runner.Step, prediction: Prediction | None) -> None:
            advance()
            if prediction is not None and prediction.measured:
                inside.append(bool(prediction.in_domain > 0.5))
            if show is not None:
                show(step, prediction)

        summary = runner.run(
            sequence, out, config, predictor, on_frame, keep_tracks=keep_tracks, overwrite=overwrite,
            calibration_state=state, options=options, meta=None if model is None else {"model": str(model.resolve())},
        )  # fmt: skip
    if model is not None and inside and sum(inside) < ENOUGH_INSIDE * len(inside):
        share = 100 * sum(inside) / len(inside)
        told = f"{model.name} does not fit: only {share:.0f} % of the frames lie inside the training domain"
        print(f"gpvo: {told} (see gpvo check)", file=sys.stderr)
    _tell(out, summary, sequence.report.notes, json_)


def _tell(out: Path, summary: RunSummary, notes: Sequence[str], json_: bool) -> None:
    more = [f"{len(notes) - _MOST_NOTES} more in run.json"] if len(notes) > _MOST_NOTES else []
    for line in (*notes[:_MOST_NOTES], *more):
        note(f"source: {line}")
    if json_:
        print_json({"schema": 1, "run": str(out), **summary.__dict__})
    else:
        print(f"{out}: {summary}")
        if summary.reasons:
            print(f"not ok: {'; '.join(summary.reasons)}")
        if summary.source_report != counted(summary.frames, "frame"):
            print(f"source: {summary.source_report}")
        for line in summary.calibration:
            print(f"calibration: {line}")
        if not all(" ms late: " in line for line in summary.calibration):  # which no calibration corrects
            print(f"calibration: 'gpvo calibration {out} -o FILE' writes a corrected one")


def calibration(
    run: Annotated[Path, "Run folder of gpvo run."],
    out: Annotated[Path | None, "Corrected Kalibr camera chain to write."] = None,
    json_: Json = False,
) -> None:
    """Print the calibration errors that a run found; write a corrected calibration.

    If no error was found, the calibration is written as it was.

    Example: gpvo calibration runs/mine -o corrected.yaml
    """
    from gpvo.vo.rig_findings import (
        CAMCHAIN,
        camchain,
        corrected,
        displacements,
        document,
        explained_px,
        lateness,
        read_state,
        rig_of,
    )

    log = read_run(run).log
    if (camera := log.camera) is None:
        raise SourceError("holds no camera: it was not made by gpvo run", where=run)
    state = read_state(run, camera)
    found = document(state, camera)
    rig = rig_of(read_json(run / "rig.json").get("calibration"), camera)
    displaced = displacements(state, camera)
    found_px, left_px = explained_px(rig, state, camera)
    if out is not None:
        write_text(out, camchain(corrected(rig, state, camera) if displaced else rig), own=CAMCHAIN)
    if json_:
        print_json({"run": str(run), **found, "found_px": found_px, "unexplained_px": left_px})
        return
    none = "no calibration error was found between the cameras"
    if (lost := log.statuses.count(Status.LOST)) > _MOST_LOST * len(log):
        none = f"too few motions tell: {lost} of {len(log)} are lost; is the calibration of these images?"
    print("\n".join(found["findings"] or [none]))
    if out is not None and lateness(state, camera):
        note(f"gpvo: no camera chain holds the time between both images; 'gpvo run --calibration-state {run}' does")
    if out is not None and not displaced:
        print(f"{out}: the calibration, unchanged")
    elif out is not None:
        print(
            f"{out}: corrected calibration; images were displaced by {found_px:.2f} px (rms), {left_px:.2f} px remain"
        )
        if left_px > _MUCH_LEFT * found_px:
            note(
                "gpvo: rotation and focal length leave so much unexplained that odometry may get worse; better use"
                f" 'gpvo run --calibration-state {run}', which corrects all that was found"
            )
