"""``gpvo evaluate`` and ``gpvo report``: a run against its truth."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.cli.common import refuse_twice
from gpvo.cli.output import Json, cell, numbers, print_json, progress, say, show, time_offset
from gpvo.cli.twin import TWINS, Seed, TwinOptions, say_simulated, twins_of
from gpvo.errors import GpvoError, counted
from gpvo.files import in_metres, refuse_folder, refuse_foreign
from gpvo.io.run import Run, read_run
from gpvo.io.source import open_source
from gpvo.io.trajectory import read_tum
from gpvo.online.predictor import Predictor
from gpvo.types import TruthLog

if TYPE_CHECKING:
    from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation
    from gpvo.evaluation.pictures import MatchPicture
    from gpvo.twin.replicate import TwinSettings

Runs = Annotated[list[Path], "Run folders."]


@dataclass(frozen=True)
class JudgeOptions:
    """How runs are judged."""

    model: Annotated[Path | None, "Error model: adds the rows constant, scaled, gp_thesis, base and learned."] = None
    truth: Annotated[Path | None, "Ground truth (TUM lines, left camera) to use instead of the run's own."] = None
    segments: Annotated[str | None, "Segment lengths [m]; default: 10,20,50,100, over 800 m 100 to 800."] = None
    truth_sigma: Annotated[
        str | None,
        "Noise of the truth per pose: metres[,radians[,seconds of jitter]]; 0 for none. Estimated by default.",
    ] = None
    align: Annotated[str, "Fit between log and truth: a fixed rotation, transform (with lever arm) or none."] = "none"
    time_offset: Annotated[str, "Seconds to add to the log's clock, or auto."] = "0"

    def options(self) -> EvaluateOptions:
        """The flags, parsed."""
        from gpvo.evaluation.evaluate import EvaluateOptions

        lengths, sigma = None, None
        if self.segments is not None:
            lengths = tuple(numbers("--segments", self.segments, "give lengths above 0 in metres", least=1e-9))
        if self.truth_sigma is not None:
            cure = "give metres, metres,radians, or metres,radians,seconds"
            given = numbers("--truth-sigma", self.truth_sigma, cure, counts=(1, 2, 3), least=0.0)
            sigma = (*given, *(0.0,) * (3 - len(given)))
        return EvaluateOptions(lengths, sigma, self.align, time_offset(self.time_offset))


def evaluate(
    ctx: typer.Context,
    runs: Runs,
    judge: JudgeOptions = JudgeOptions(),
    plots: Annotated[Path | None, "Folder for plots, as PNG and PDF, one set per run."] = None,
    tables: Annotated[Path | None, "Folder for trajectories (TUM, for evo) and tables (CSV, LaTeX)."] = None,
    stated: Annotated[Path | None, "Folder for the stated covariances of each method, as files for gpvo score."] = None,
    twins: Annotated[bool, f"{TWINS} A run that has truth gets a row 'twin'."] = False,
    twin_options: TwinOptions = TwinOptions(),
    seed: Seed = 1,
    json_: Json = False,
) -> None:
    """Score the trajectory and every stated covariance.

    Example: gpvo evaluate runs/mh01 --plots figures
    """
    from gpvo.evaluation.document import document, pooled
    from gpvo.evaluation.evaluate import distinct

    for folder in (stated, tables, plots):
        refuse_folder(folder)
    settings = twin_options.asked(ctx, twins, seed, "seed")
    if settings is not None:
        documents, found = _with_twins(*_loaded(runs, judge), judge.model, judge.options(), settings)
    else:
        found = _evaluate(runs, judge)
        documents = document(found)["runs"]
    if stated or tables or plots:
        with progress("files", len(found)) as advance:
            for evaluation, name in zip(found, distinct([e.run.name for e in found]), strict=True):
                _write_files(evaluation, name, stated=stated, tables=tables, plots=plots)
                advance()
    if json_:
        print_json({"schema": 1, "runs": documents})
    else:
        for about in documents:
            _print(about)
        if len(documents) > 1:
            _print_pooled(pooled(documents), len(documents))
    _tell_misfits(judge.model, found)


def _write_files(e: Evaluation, name: str, *, stated: Path | None, tables: Path | None, plots: Path | None) -> None:
    if stated is not None:
        from gpvo.evaluation.score import write_statements

        if not write_statements(e, stated, name):
            text = f"{name} states no covariance of single motions: {stated} holds its truth alone, nothing to score"
            warnings.warn(text, stacklevel=2)
    if tables is not None:
        from gpvo.evaluation.document import write_tables

        write_tables(e, tables, name)
    if plots is not None:
        from gpvo.evaluation.plots import save_all

        save_all(e, plots, name)


def report(
    runs: Runs,
    out: Annotated[Path, "HTML file to write."] = Path("report.html"),
    judge: JudgeOptions = JudgeOptions(),
    frames: Annotated[str | None, "Also show the matches of these frames, e.g. 5,80."] = None,
    sequence: Annotated[Path | None, "The sequence of the run, for --frames."] = None,
) -> None:
    """Write a report: one HTML page that opens with a verdict.

    For a run without ground truth, it shows what was stated, without judging it.

    Example: gpvo report runs/mh01 -o report.html
    """
    from gpvo.evaluation.report import PAGE, write_report

    if sequence is not None and frames is None:
        raise GpvoError("--sequence has no effect without --frames", cure="add --frames, such as 5,80")
    refuse_foreign(out, *PAGE)  # before the work, not after it
    found = _evaluate(runs, judge, unjudged=True)
    pictures = [] if frames is None else _pictures(runs, frames, sequence)
    with progress("pages", 1):
        write_report(found, out, pictures, judge.model.name if judge.model else "")
    print(out)
    _tell_misfits(judge.model, found)


def _pictures(runs: list[Path], frames: str, sequence: Path | None) -> list[MatchPicture]:
    from gpvo.evaluation.pictures import match_pictures
    from gpvo.runner import config_of

    if sequence is None or len(runs) != 1:
        raise GpvoError("--frames needs one run and its --sequence", cure="give --sequence PATH and one run")
    wanted = [int(f) for f in numbers("--frames", frames, "give numbers, separated by commas")]
    run = read_run(runs[0])
    opened: dict[str, Any] = run.meta.get("options") or {}
    options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in opened.items()}
    return match_pictures(open_source(sequence, **options), config_of(runs[0]), wanted, run.log)


def _loaded(runs: list[Path], judge: JudgeOptions) -> tuple[list[Run], Predictor | None]:
    refuse_twice(runs)
    model = judge.model
    predictor = None if model is None else Predictor.load(model).require_motions(model)
    loaded = [replace(read_run(path), imu=None) for path in runs]  # which no score asks for, and hours of it are large
    if judge.truth is not None:
        trajectory = read_tum(judge.truth)
        loaded = [replace(run, truth=TruthLog(trajectory.t_ns, trajectory.T_world_body)) for run in loaded]
    return loaded, predictor


def _evaluate(runs: list[Path], judge: JudgeOptions, unjudged: bool = False) -> list[Evaluation]:
    """``unjudged``: runs without truth are shown instead of refused."""
    from gpvo.dataset.check import warn_of_misfits
    from gpvo.evaluation.evaluate import evaluate_run, unjudged_run

    options, found = judge.options(), []
    with progress("runs", len(runs)) as advance:
        loaded, predictor = _loaded(runs, judge)
        misfits = [warn_of_misfits(judge.model, predictor, run) for run in loaded]
        for run, known in zip(loaded, misfits):
            alone = unjudged and run.truth is None
            found.append(
                unjudged_run(run, predictor, known) if alone else evaluate_run(run, predictor, options, misfits=known)
            )
            advance()
    return found


def _tell_misfits(model: Path | None, found: list[Evaluation]) -> None:
    """Say it again at the end, where it is read."""
    from gpvo.dataset.check import ENOUGH_INSIDE

    outside = [e for e in found if e.in_domain is not None and e.in_domain < ENOUGH_INSIDE]
    if model is not None and outside:
        names = ", ".join(f"{e.run.name} ({100 * (e.in_domain or 0):.0f} %)" for e in outside)
        warnings.warn(f"{model.name} covers too few of the frames of {names}: do not fly it there", stacklevel=2)


def _with_twins(
    runs: list[Run], predictor: Predictor | None, model: Path | None, options: EvaluateOptions, settings: TwinSettings
) -> tuple[list[dict[str, Any]], list[Evaluation]]:
    """Documents of the runs, and the evaluations behind them: a run's own if it has truth, else those of its twins."""
    from gpvo.dataset.check import warn_of_misfits
    from gpvo.evaluation.by_twins import by_twins

    documents, found, n = [], [], settings.replicates
    with twins_of([run.path for run in runs], settings) as made:
        for k, run in enumerate(runs):
            twins = [read_run(p) for p in made[k * n : (k + 1) * n]]
            judged = run if run.truth is not None else twins[0]
            about, own = by_twins(run, twins, predictor, options, warn_of_misfits(model, predictor, judged))
            documents.append(about)
            found += own
    return documents, found


def _print(d: dict[str, Any]) -> None:
    if about := d.get("simulated_truth"):
        say_simulated(about)
    say(
        f"{d['run']}: {d['frames']} frames, {d['lost']:.3g} lost, {in_metres(d['path_length_m'])};"
        f" ATE {d['ate_rmse_m']:.3g} m,"
        f" final error {cell(d['final_error_m'])} m"
    )
    if found := d.get("verdict"):
        for line in (f"  {found['headline']}", *(f"    {text}" for text in found["lines"])):
            say(line)
    if d["truth_moves_at_rest"]:
        at_rest = counted(d["truth_moves_at_rest"], "motion")
        say(f"  not scored: {at_rest}; the truth moves while the vehicle rests, or jumps")
    for text in d["odd_stretches"]:
        say(f"  {text}: odometry or truth is wrong there")
    errors = [(name, r["translation_m"], r["rotation_rad"]["rmse"]) for name, r in d["rpe"].items()]
    spans = {"frame": "over a frame", "1s": "over 1 s", "10m": "over 10 m"}
    relative = [f"{spans[n]} {cell(m['rmse'])} m, {cell(math.degrees(rad))} deg" for n, m, rad in errors if m["count"]]
    if relative:
        say(f"  relative error (rms): {'; '.join(relative)}")
    for s in (s for s in d["segments"] if s["count"]):
        say(
            f"  {s['length_m']:g} m segments: {s['translation_percent']:.2f} %, {s['rotation_deg_per_m']:.4f} deg/m"
            f" ({s['count']})"
        )
    if poses := d.get("poses"):
        blocks = (b for b in ("position", "orientation", "joint") if poses[b])
        shown = ", ".join(f"{b} {poses[b]['nees_dof']:.3g} (median {poses[b]['median']:.3g})" for b in blocks)
        say(f"  covariances of poses, after alignment: NEES/dof {shown}")
    _print_methods(d)


def _print_methods(d: dict[str, Any]) -> None:
    sigma = d["truth_sigma"]
    noisy = bool(sigma["translation_m"] or sigma["rotation_rad"])
    given = ("+truth", "1 s", "coverage", "NLL", "stated")
    rows = []
    for method, m in d["methods"].items():
        block = "joint" if m["nees_dof"]["joint"] is not None else "translation"
        if m["nees_dof"][block] is None:
            continue
        low, high = m["nees_dof_interval"][block]
        rest = (
            m["nees_dof_truth_noise"][block],
            m["one_second"]["nees_dof_truth_noise"],
            " ".join(f"{100 * c:.0f}" for c in m["coverage"].values()),
            m["nll_per_dim"],
            m["nll_stated_per_dim"],
        )
        cells = [cell(c) for c in rest[0 if noisy else 1 :]]
        rows.append([method, cell(m["nees_dof"][block]), f"{cell(low, 2)}-{cell(high, 2)}", *cells])
    if not rows:
        return
    show(("method", "NEES", "interval", *given[0 if noisy else 1 :]), rows)
    say("NEES: per degree of freedom, for one motion; 1 is right. _vt: for the translation alone.")
    say("1 s: over a second. coverage [%]: within 1, 2, 3 sigma.")
    say("NLL: nats per axis, as a Gaussian; stated: under the stated density, where it has heavier tails.")
    if noisy:
        noise = f"{1e3 * sigma['translation_m']:.2g} mm, {1e3 * sigma['rotation_rad']:.2g} mrad per pose"
        say(f"All but NEES and its interval: with the truth's own noise ({noise}, rms over axes) taken into account.")


def _print_pooled(pooled: dict[str, Any], runs: int) -> None:
    rows = []
    for method, scores in pooled.items():
        cells = [method]
        for s in (scores["nll_per_dim"], scores["nees_dof"]):
            cells += [cell(s["mean"]), "-" if s["low"] is None else f"{cell(s['low'])} to {cell(s['high'])}"]
        rows.append(cells)
    if rows:
        few = "" if runs > 2 else ": too few for an interval"
        say(f"mean of the {runs} runs{few}")
        say("(with the truth's own noise taken into account)")
        show(("method", "NLL", "interval", "NEES", "interval"), rows)
