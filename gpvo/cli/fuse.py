"""``gpvo fuse`` and ``gpvo publish``: what a filter gains, and messages for the filter that flies."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gpvo.cli.common import refuse_twice
from gpvo.cli.output import Json, answer, one_of, print_json, progress, say, status
from gpvo.cli.twin import Seed, TwinOptions, Twins, in_place_of_runs_without_truth, say_simulated
from gpvo.files import refuse_folder
from gpvo.publish import PublishSettings


def fuse(
    ctx: typer.Context,
    runs: Annotated[list[Path], "Run folders to filter."],
    model: Annotated[Path | None, "Error model; default: predictions stored in the runs."] = None,
    train: Annotated[
        list[Path] | None, "Training run for the constants; repeatable. Default: the model's.", {"metavar": "<path>"}
    ] = None,
    policies: Annotated[str, "Policies to compare, comma-separated; all by default."] = "",
    init: Annotated[str, "Start from the truth, or at rest (static)."] = "truth",
    gate: Annotated[str, "What to do with a measurement beyond 3 sigma: discard or inflate."] = "discard",
    no_imu: Annotated[bool, "Use a constant-velocity model instead of the IMU."] = False,
    twins: Twins = False,
    twin_options: TwinOptions = TwinOptions(),
    seed: Seed = 1,
    plot: Annotated[Path | None, "Write a plot of all policies to this image."] = None,
    log: Annotated[Path | None, "Folder for innovations, NIS and rejections, as CSV."] = None,
    json_: Json = False,
) -> None:
    """Fuse VO with an IMU, once with each covariance.

    Example: gpvo fuse runs/flight7 --model models/tunnel.gpvo --plot fuse.png
    """
    with status("starting"):
        from gpvo.evaluation.fusion import FusionSettings, document, fuse_runs, write_log
        from gpvo.filters.measurement import Gate
        from gpvo.filters.policies import LEARNED
        from gpvo.filters.run import FuseOptions
        from gpvo.filters.study import table

    refuse_twice(runs)
    refuse_folder(log)
    judging = twin_options.asked(ctx, twins, seed, "seed")
    options = FuseOptions(
        init=one_of("--init", init, ("truth", "static")),
        gate=Gate(on_fail=one_of("--gate", gate, ("discard", "inflate"))),
    )
    if plot is not None:
        from gpvo.evaluation import plots

        plots.require_picture(plot)  # before the work, not after it
    wanted = tuple(p.strip() for p in policies.split(",") if p.strip())
    teaching = replace(judging, seed=0) if judging else None
    with (
        in_place_of_runs_without_truth(runs, judging) as flown,
        in_place_of_runs_without_truth(train or [], teaching) as taught,
        status("reading") as tell,
    ):
        report = fuse_runs(
            flown,
            FusionSettings(wanted, model, tuple(taught), use_imu=not no_imu, options=options),
            tell=tell,
            on_run=lambda fused: write_log(log / f"{fused.name}_{fused.policy}.csv", fused) if log else None,
        )
    for warning in report.warnings:
        print(f"gpvo: {warning}", file=sys.stderr)
    if plot is not None:
        plots.save(plots.fusion(report.traces), plot, dpi=120)
    if json_:
        print_json(document(report))
        return
    for about in report.simulated_truth:
        say_simulated(about)
    print(table(report.study))
    if LEARNED in report.study.scores:
        print()
        against = [report.study.compare(LEARNED, p) for p in report.study.scores if p != LEARNED]
        known = [compared for compared in against if compared.gain_percent == compared.gain_percent]
        for compared in known:
            say(str(compared))
        if any(compared.difference_m.high == float("inf") for compared in known):
            say("With fewer than three runs there is no interval.")


def publish(
    run: Annotated[Path, "Run folder."],
    options: PublishSettings = PublishSettings(),
    json_: Json = False,
) -> None:
    """Write messages for robot_localization, PX4, ArduPilot and FusionCore.

    Example: gpvo publish runs/flight7 --to mavlink -o flight7.tlog --consumer px4 --check
    """
    from gpvo.publish.job import publish_run

    with progress("runs", 1):
        result = publish_run(run, options)
    answer(json_, result.document(), lambda: list(map(say, str(result).splitlines())))
