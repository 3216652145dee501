"""``gpvo info`` and ``gpvo import``: what files are, and other people's logs as runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.cli import common as options
from gpvo.cli.output import Json, numbers, one_of, print_json
from gpvo.errors import GpvoError


def info(
    path: Annotated[Path, typer.Argument(help="Sequence, run folder, trajectory, calibration, bag or model.")],
    kind: options.Kind = None,
    calibration: options.Calibration = None,
    pair_tolerance: options.PairTolerance = None,
    left_topic: options.LeftTopic = None,
    right_topic: options.RightTopic = None,
    json_: Json = False,
) -> None:
    """Say what a file or folder is.

    Example: gpvo info MH_01_easy/
    """
    from gpvo.cli.describe import as_lines, describe
    from gpvo.io.jsonfile import plain

    given = options.source_options(
        calibration=calibration, tolerance_s=pair_tolerance, left_topic=left_topic, right_topic=right_topic
    )
    document = plain(describe(path, kind, given))
    if json_:
        print_json({"schema": 1, "path": str(path), **document})
    else:
        document.pop("header", None)  # of a model: hundreds of lines, for --json
        print("\n".join([str(path), *as_lines(document, "  ")]))


def import_(
    log: Annotated[Path, typer.Argument(help="Trajectory, CSV or bag of another odometry.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Run folder to write.")],
    truth: Annotated[Path | None, typer.Option(help="Ground truth: a trajectory, CSV or bag.")] = None,
    format_: Annotated[str | None, typer.Option("--format", help="tum, kitti, csv or bag; guessed by default.")] = None,
    truth_format: Annotated[str | None, typer.Option(help="The same for the ground truth.")] = None,
    map_: Annotated[
        list[str] | None,
        typer.Option("--map", metavar="COLUMN=NAME", help="Columns of a CSV, e.g. var_x=cov_00."),
    ] = None,
    truth_map: Annotated[
        list[str] | None, typer.Option(metavar="COLUMN=NAME", help="The same for a CSV of the ground truth.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Topic of the odometry in a bag.")] = None,
    truth_topic: Annotated[str | None, typer.Option(help="Topic of the ground truth in a bag.")] = None,
    times: Annotated[
        Path | None, typer.Option(help="File of stamps in seconds, one line per pose, for KITTI poses.")
    ] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Frame rate, for KITTI poses without stamps.")] = None,
    frame: Annotated[str, typer.Option(help="Frame of the poses: cam (left optical frame) or body (FLU).")] = "cam",
    align: Annotated[
        str,
        typer.Option(
            help="Fit a fixed transform between log and truth: rotation, transform (with lever arm, and the truth's "
            "attitudes against its positions) or none."
        ),
    ] = "none",
    time_offset: Annotated[str, typer.Option(help="Seconds to add to the stamps of the log, or auto.")] = "0",
    truth_sigma: Annotated[str | None, typer.Option(help="White noise of the truth per pose, METRES,RADIANS.")] = None,
    covariance_of: Annotated[
        str, typer.Option(help="Whether the covariances in a CSV are of poses or motions.")
    ] = "pose",
    covariance_axes: Annotated[str, typer.Option(help="Axes of the covariances in a CSV: world or body.")] = "world",
    vehicle: options.VehicleName = "any",
    max_acceleration: options.MaxAcceleration = None,
    max_turn: options.MaxTurn = None,
    overwrite: options.Overwrite = False,
    json_: Json = False,
) -> None:
    """Turn another odometry's log into a run folder.

    Example: gpvo import 00_est.txt --truth 00_gt.txt -o runs/kitti00
    """
    from gpvo.cli.importing import import_log
    from gpvo.io.foreign import read_foreign

    offset, sigma = None, None
    if time_offset != "auto":
        (offset,) = numbers("--time-offset", time_offset, "give seconds, such as -0.02, or auto", counts=(1,))
    if truth_sigma is not None:
        cure = "give metres,radians, such as 0.003,0.0002"
        translation, rotation = numbers("--truth-sigma", truth_sigma, cure, counts=(2,), least=0.0)
        sigma = (translation, rotation)
    stamps: dict[str, Any] = {"times": times, "rate_hz": rate_hz}
    covariances: dict[str, Any] = {
        "covariance_of": one_of("--covariance-of", covariance_of, ("pose", "motion")),
        "covariance_axes": one_of("--covariance-axes", covariance_axes, ("world", "body")),
    }
    chosen: dict[str, Any] = {
        "frame": one_of("--frame", frame, ("cam", "body")),
        "align": one_of("--align", align, ("none", "rotation", "transform")),
    }
    mapping, truth_mapping = _mapping("--map", map_ or []), _mapping("--truth-map", truth_map or [])
    summary = import_log(
        read_foreign(log, format_, mapping=mapping, topic=topic, **stamps, **covariances),
        None
        if truth is None
        else read_foreign(truth, truth_format, mapping=truth_mapping, topic=truth_topic, complete=True, **stamps),
        out,
        **chosen,
        time_offset_s=offset,
        truth_sigma=sigma,
        vehicle=options.vehicle_of(vehicle, max_acceleration, max_turn),
        overwrite=overwrite,
    )
    if json_:
        print_json({"schema": 1, "run": str(out), **summary.__dict__})
    else:
        print(f"{out}: {summary}")


def _mapping(option: str, texts: list[str]) -> dict[str, str]:
    out = {}
    for text in texts:
        column, _, name = text.rpartition("=")
        if not column or not name:
            raise GpvoError(f"{option} is '{text}'", cure="give COLUMN=NAME, such as var_x=cov_00")
        out[column.strip()] = name.strip()
    return out
