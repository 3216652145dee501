"""``gpvo evaluate`` and ``gpvo report``: a run against its truth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.errors import GpvoError

if TYPE_CHECKING:
    from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation
    from gpvo.evaluation.matches import MatchPicture

Runs = Annotated[list[Path], typer.Argument(help="Run folders.")]
Model = Annotated[Path | None, typer.Option(help="Error model: adds constant, scaled and learned.")]
Truth = Annotated[
    Path | None, typer.Option(help="Ground truth (TUM lines, left camera), taken as exact unless --truth-sigma.")
]
Segments = Annotated[str | None, typer.Option(help="Segment lengths [m], such as 10,20,50,100.")]
TruthSigma = Annotated[str | None, typer.Option(help="Noise of the truth per pose: metres[,radians]; 0 for none.")]
Align = Annotated[str, typer.Option(help="rotation: fit a fixed rotation between log and truth; none.")]
TimeOffset = Annotated[str, typer.Option(help="Seconds to add to the log's clock, or auto.")]


def evaluate(
    runs: Runs,
    model: Model = None,
    truth: Truth = None,
    segments: Segments = None,
    truth_sigma: TruthSigma = None,
    align: Align = "none",
    time_offset: TimeOffset = "0",
    plots: Annotated[Path | None, typer.Option(help="Folder for pictures, one set per run.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Trajectory errors, and whether each stated covariance is honest.

    Example: gpvo evaluate runs/mh01 --plots pictures
    """
    from gpvo.cli.output import print_json
    from gpvo.evaluation.evaluate import document

    found = _evaluate(runs, model, truth, options_of(segments, truth_sigma, align, time_offset))
    if plots is not None:
        from gpvo.evaluation.evaluate import distinct
        from gpvo.evaluation.plots import save_all

        for evaluation, name in zip(found, distinct([e.run.name for e in found]), strict=True):
            save_all(evaluation, plots, name)
    if json_:
        print_json(document(found))
    else:
        for evaluation in found:
            _print(evaluation)
        if truth is not None and truth_sigma is None:
            print(f"{truth.name} states no noise of its own and is taken as exact; --truth-sigma says otherwise")


def report(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="HTML file to write.")] = Path("report.html"),
    model: Model = None,
    truth: Truth = None,
    segments: Segments = None,
    truth_sigma: TruthSigma = None,
    align: Align = "none",
    time_offset: TimeOffset = "0",
    frames: Annotated[str | None, typer.Option(help="Also show the matches of these frames, e.g. 5,80.")] = None,
    sequence: Annotated[Path | None, typer.Option(help="The sequence of the run, for --frames.")] = None,
) -> None:
    """One self-contained page: trajectory, error against bounds, reliability, features, the table.

    Example: gpvo report runs/mh01 -o report.html
    """
    from gpvo.evaluation.report import write_report

    found = _evaluate(runs, model, truth, options_of(segments, truth_sigma, align, time_offset))
    write_report(found, out, [] if frames is None else _pictures(runs, frames, sequence))
    print(out)


def _pictures(runs: list[Path], frames: str, sequence: Path | None) -> list[MatchPicture]:
    from gpvo.evaluation.matches import config_of, match_pictures
    from gpvo.io import open_source

    if sequence is None or len(runs) != 1:
        raise GpvoError("--frames needs one run and its --sequence", cure="give --sequence PATH and one run")
    return match_pictures(open_source(sequence), config_of(runs[0]), [int(f) for f in _numbers("--frames", frames)])


def options_of(segments: str | None, truth_sigma: str | None, align: str, time_offset: str) -> EvaluateOptions:
    """The flags, parsed."""
    from gpvo.evaluation.evaluate import EvaluateOptions

    lengths = None if segments is None else tuple(_numbers("--segments", segments))
    if lengths is not None and min(lengths) <= 0:
        raise GpvoError(f"--segments is '{segments}'", cure="give lengths above 0 in metres")
    sigma = None
    if truth_sigma is not None:
        given = _numbers("--truth-sigma", truth_sigma)
        if len(given) > 2 or min(given) < 0:
            raise GpvoError(f"--truth-sigma is '{truth_sigma}'", cure="give metres, or metres,radians")
        sigma = (given[0], given[1] if len(given) == 2 else 0.0)
    offsets = None if time_offset == "auto" else _numbers("--time-offset", time_offset)
    if offsets is not None and len(offsets) != 1:
        raise GpvoError(f"--time-offset is '{time_offset}'", cure="give seconds, or auto")
    return EvaluateOptions(lengths, sigma, align, None if offsets is None else offsets[0])


def _numbers(option: str, text: str) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise GpvoError(f"{option} is '{text}'", cure="give numbers, separated by commas")
    return numbers


def _evaluate(runs: list[Path], model: Path | None, truth: Path | None, options: EvaluateOptions) -> list[Evaluation]:
    from dataclasses import replace

    from gpvo.evaluation.evaluate import evaluate_run
    from gpvo.io.run import read_run
    from gpvo.io.trajectory import read_tum
    from gpvo.online.predictor import Predictor
    from gpvo.types import TruthLog

    predictor = None if model is None else Predictor.load(model)
    if predictor is not None:
        predictor.require_motions(model)
    given = None
    if truth is not None:
        trajectory = read_tum(truth)
        given = TruthLog(trajectory.t_ns, trajectory.T_world_body)
    loaded = [read_run(path) for path in runs]
    if given is not None:
        loaded = [replace(run, truth=given) for run in loaded]
    return [evaluate_run(run, predictor, options) for run in loaded]


def _print(e: Evaluation) -> None:
    from rich.console import Console
    from rich.table import Table

    from gpvo.evaluation.evaluate import document

    d: dict[str, Any] = document([e])["runs"][0]
    console = Console(width=max(Console().width, 130), highlight=False, markup=False)
    console.print(
        f"{d['run']}: {d['frames']} frames, {d['lost']} lost, {d['path_length_m']:.1f} m; ATE {d['ate_rmse_m']:.3g} m,"
        f" final error {d['final_error_m']:.3g} m"
    )
    if d["truth_moves_at_rest"]:
        console.print(
            f"  {d['truth_moves_at_rest']} motions are not scored: the vehicle stands there, and the truth moves"
        )
    errors = [(name, r["translation_m"]["rmse"], r["rotation_rad"]["rmse"]) for name, r in d["rpe"].items()]
    relative = (f"{name} {_text(m)} m, {_text(math.degrees(rad))} deg" for name, m, rad in errors)
    console.print(f"  relative error (rms) over a {'; '.join(relative)}")
    for s in (s for s in d["segments"] if s["count"]):
        console.print(
            f"  {s['length_m']:g} m segments: {s['translation_percent']:.2f} %, {s['rotation_deg_per_m']:.4f} deg/m"
            f" ({s['count']})"
        )
    table = Table("method", "NEES/dof", "interval", "median", "over 1 s", "1, 2, 3 sigma [%]", "NLL", "final [m]")
    for method, m in d["methods"].items():
        block = "joint" if m["nees_dof"]["joint"] is not None else "translation"
        if m["nees_dof"][block] is None:
            continue
        low, high = m["nees_dof_interval"][block]
        table.add_row(
            method + (" (translation)" if block == "translation" else ""),
            _pair(m["nees_dof"][block], m["nees_dof_truth_noise"][block]),
            f"{_text(low)} to {_text(high)}",
            _text(m["nees_dof_median"][block]),
            _pair(m["one_second"]["nees_dof"], m["one_second"]["nees_dof_truth_noise"]),
            " ".join(f"{100 * c:.0f}" for c in m["coverage"].values()),
            _text(m["nll_per_dim"]),
            _text(m["predicted_final_error_m"]),
        )
    if table.row_count:
        console.print(table)
        console.print(
            "over 1 s: NEES of the motion over a second. final: predicted error of the last position, 1 sigma."
        )
        sigma = d["truth_sigma"]
        if sigma["translation_m"] or sigma["rotation_rad"]:
            noise = f"{1e3 * sigma['translation_m']:.3g} mm, {1e3 * sigma['rotation_rad']:.3g} mrad per pose"
            console.print(f"In brackets: with the truth's own noise ({noise}) added to what is stated.")


def _text(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.3g}"


def _pair(plain: float | None, with_truth_noise: float | None) -> str:
    """Both in one cell; one number where the truth has no noise."""
    if plain is None or _text(plain) == _text(with_truth_noise):
        return _text(plain)
    return f"{_text(plain)} ({_text(with_truth_noise)})"


def register(app: typer.Typer) -> None:
    """Add this file's commands to the application."""
    app.command()(evaluate)
    app.command()(report)
