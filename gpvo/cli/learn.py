"""``gpvo train``: error models, and the table of scores on the runs left out."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.cli.common import is_given, refuse_twice
from gpvo.cli.output import Json, cell, note, print_json, progress, say, show, status, time_offset
from gpvo.cli.twin import TwinOptions, Twins, in_place_of_runs_without_truth
from gpvo.dataset.errors import motion_errors
from gpvo.dataset.truth_noise import made_from_odometry
from gpvo.errors import GpvoError, counted
from gpvo.files import refuse_folder
from gpvo.io.run import read_run
from gpvo.io.run_read import read_meta
from gpvo.learning.config import TrainConfig, lacking

if TYPE_CHECKING:
    from gpvo.dataset.build import TrainingSet
    from gpvo.learning.train import OnFit, TrainedModel

_MOST_COLUMNS = 3  # of folds: more do not fit into 80 columns
_MOST_NAMES = 24

Runs = Annotated[list[Path], "Run folders with ground truth, or one file of training rows."]


def train(
    ctx: typer.Context,
    runs: Runs,
    out: Annotated[Path, "Model file to write."],
    options: TrainConfig = TrainConfig(),
    time_offset_s: Annotated[str, "--time-offset", "Seconds to add to the logs' clock, or auto (for each)."] = "0",
    update: Annotated[
        Path | None, "Add the runs to the training rows of this model and train again, with its settings."
    ] = None,
    twins: Twins = False,
    twin_options: TwinOptions = TwinOptions(),
    statements: Annotated[
        Path | None, "Folder for the covariances that each method states for the runs left out, for gpvo score."
    ] = None,
    jobs: Annotated[int, "Folds to fit in parallel; -1 for all cores."] = 1,
    backend: Annotated[str, "local or dask."] = "local",
    scheduler: Annotated[str | None, "Address of a Dask scheduler."] = None,
    json_: Json = False,
) -> None:
    """Train an error model; score it by leaving each run out.

    Of more than 24 runs, a 24th is left out at a time. Interrupted training resumes from its finished folds when
    started again.

    Example: gpvo train runs/a runs/b runs/c -o errors.gpvo
    """
    with status("starting"):
        from gpvo.learning.store import config_of, folds_path, refuse_foreign_model, save_model

    refuse_foreign_model(out)
    config = replace(options, time_offset_s=time_offset(time_offset_s))
    if update is not None:  # which keeps its own settings
        config = replace(config_of(update), **{k: v for k, v in vars(config).items() if is_given(ctx, k)})
    keep = str(folds_path(out)) if backend == "local" else None
    config = replace(config, jobs=jobs, backend=backend, scheduler=scheduler, keep=keep)
    refuse_folder(statements)
    if statements is not None:
        _check_statements(runs, config, update)
    drawn = twin_options.asked(ctx, twins, options.seed)
    with in_place_of_runs_without_truth(runs, drawn, jobs) as paths:
        with progress("models") as on_fit:
            trained = _with_origin(_train(paths, config, update, on_fit), paths, update)
        if statements is not None:
            _write_statements(trained, paths, config, statements)
    _tell(trained, config)
    save_model(trained, out)
    document = {**trained.table, "model": str(out)}
    if json_:
        print_json(document)
    else:
        _print_table(document)
        kept = sum(len(s) for s in trained.sets)
        given = trained.header.get("rows", {}).get("given", kept)
        streamed = f", sampled from {given}" if given > kept else ""
        print(f"{out}: {kept} rows of {counted(len(trained.sets), 'run')}{streamed}")


def _tell(trained: TrainedModel, config: TrainConfig) -> None:
    """Notes on what a model could not learn, and on truths whose noise it did not."""
    from gpvo.learning.train import unseen_axes

    if trained.header["target"] != "position":
        if axes := unseen_axes(trained.sets):
            note(
                f"gpvo: log and truth never differ in {', '.join(axes)} (planar?): the model states almost no error"
                " there"
            )
        for name, missing in lacking(trained.sets, config).items():
            note(
                f"gpvo: {name} holds no {', '.join(missing)}, as other runs do: the model does without them. If it is"
                " another odometry's, train a model for each"
            )
    if noisy := [s.name for s in trained.sets if s.told is not None]:
        note(
            f"gpvo: the ground truth of {', '.join(noisy)} is noisy: the model learns the odometry's errors without its"
            " noise, and is judged with it ('gpvo evaluate' says how large it is)"
        )


def _rows(paths: list[Path], config: TrainConfig) -> Iterator[TrainingSet]:
    """Of one run after the other, with a note if its poses or stamps, or those of its truth, seem not to be what they
    are taken for."""
    from gpvo.dataset.build import aligned
    from gpvo.dataset.misread import Misread, late_by

    as_is = replace(config, align="none", time_offset_s=0.0)
    for path in paths:
        run = aligned(read_run(path), config.align, config.time_offset_s)[0]
        # A twin's truth is of the same frames and clock by construction.
        if run.truth is not None and len(run.truth.t_ns) > 1 and not run.meta.get("twin"):
            truth = run.truth
            if late_by(run.log, truth) or Misread.of(run.log, truth).grossly:
                note(
                    f"gpvo: odometry and truth of {path} contradict each other, and a model learns that as the"
                    f" odometry's error; 'gpvo evaluate {path}' says in what"
                )
            if made_from_odometry(motion_errors(run.log, truth), run.log):
                note(
                    f"gpvo: the truth of {path} seems to be made from odometry, as by closing loops: the model learns"
                    " hardly any noise from it"
                )
        yield as_is.rows_of(run)


def _check_statements(runs: list[Path], config: TrainConfig, update: Path | None) -> None:
    """Raise GpvoError, before any work, if training would leave out no run that ``gpvo score`` could judge."""
    whole = len(runs) > 1 and all(p.is_dir() for p in runs) and update is None
    if not whole or config.target != "frame" or config.backend != "local":
        text = "--statements needs two or more run folders, --target frame and --backend local, without --update"
        raise GpvoError(text, cure="or give one run at a time to gpvo evaluate RUN --model MODEL --stated FOLDER")


def _write_statements(trained: TrainedModel, paths: list[Path], config: TrainConfig, folder: Path) -> None:
    from gpvo.evaluation.score import write_left_out

    write_left_out(trained, [read_run(p) for p in paths], config, folder)
    note(f"gpvo: {folder} holds the covariances stated for the runs left out; to score them: gpvo score {folder}")


def _with_origin(trained: TrainedModel, paths: list[Path], update: Path | None) -> TrainedModel:
    """The header also says which sequences are twins, whose truth was simulated; those of an updated model too."""
    from gpvo.online import modelfile
    from gpvo.twin.gap import simulated_truth

    before = [] if update is None else modelfile.load(update)[1].get("simulated_truth") or []
    origin = before + simulated_truth([read_meta(p) for p in paths if p.is_dir()])
    return replace(trained, header={**trained.header, "simulated_truth": origin}) if origin else trained


def _train(paths: list[Path], config: TrainConfig, update: Path | None, on_fit: OnFit) -> TrainedModel:
    from gpvo.dataset.table import write_sets
    from gpvo.learning import store
    from gpvo.learning import train as learning

    refuse_twice(paths)
    config.refuse_unknown()
    if config.regressor != "auto" and config.target != "position":
        note("gpvo: --regressor applies only to --target position; the log-variance GP is always sparse")
    if update is not None and config.target == "position":
        raise GpvoError("a model of positions cannot be updated", where=update, cure="train again from all runs")
    if any(p.is_file() for p in paths):
        if len(paths) > 1 or update is not None:
            raise GpvoError("a file of training rows must be given alone", where=paths[0], cure="or give run folders")
        return store.train_stored(paths[0], config, on_fit=on_fit)
    runs = _rows(paths, config)
    if update is not None:
        return store.update(update, runs, config, tell=lambda what: note(f"gpvo: {what}"), on_fit=on_fit)
    frames = (read_meta(p).get("frames") or 0 for p in paths if (p / "run.json").is_file())  # as the runs say
    if sum(map(int, frames)) > config.max_rows:
        # They do not fit into memory together: their rows pass through a file, one run at a time.
        with _file_of_rows(config.keep) as rows:
            write_sets(rows, runs)
            return store.train_stored(rows, config, on_fit=on_fit)
    return learning.train_sets(list(runs), config, on_fit=on_fit)


@contextmanager
def _file_of_rows(keep: str | None) -> Iterator[Path]:
    """A file for as long as the context is open: among the folds that are kept, if any are, where the next call
    replaces one that a killed process left."""
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="gpvo-") as folder:
            yield Path(folder) / "rows.parquet"
        return
    rows = Path(keep) / "rows.parquet"
    try:
        yield rows
    finally:
        rows.unlink(missing_ok=True)
        with suppress(OSError):  # it holds folds
            rows.parent.rmdir()


def _print_table(document: dict[str, Any]) -> None:
    from gpvo.learning.store import with_interval

    if not document["folds"]:
        print("one short run alone: nothing could be left out, so there is no table")
        return
    few = len(document["folds"]) <= _MOST_COLUMNS
    columns = [str(k + 1) for k in range(len(document["folds"]))] if few else ["least", "most"]
    rows = []
    for method, mean in document["mean"].items():
        per_fold = [_nees(f["methods"][method]["nees_dof"]) for f in document["folds"]]
        rest = [_nees(mean["nees_dof"]), _nees(mean["nees_dof_median"]), mean["coverage"]["1"]]
        rest += [mean["nll_per_dim"], mean["nll_stated_per_dim"]]
        if not few and (known := [v for v in per_fold if v is not None]):
            per_fold = [min(known), max(known)]
        if any(v is not None for v in (*per_fold, *rest)):
            rows.append([method, *(cell(v) for v in (*per_fold, *rest))])
    what = (
        "run" if document.get("folds_are") != "time blocks" else "part of one run (this says nothing about other runs)"
    )
    say(f"NEES per degree of freedom on each {what} left out (1 is right), then means")
    names = [f"{k + 1}: {f['held_out']} ({f['rows']} rows)" for k, f in enumerate(document["folds"])]
    say(", ".join(names) if len(names) <= _MOST_NAMES else f"{len(names)} runs; --json has a line for each")
    show(("method", *columns, "mean", "median", "1 sig", "NLL", "stated"), rows)
    say("1 sig: share within 1 sigma (0.68 is right). NLL: nats per axis, as a Gaussian, lower is better;")
    say("stated: under the stated density, where it has heavier tails. _vt: for the translation alone.")
    at_rest, odd = (
        ", ".join(f"{n} of {f['held_out']}" for f in document["folds"] if (n := f.get(count)))
        for count in ("truth_moves_at_rest", "odd")
    )
    if at_rest:
        why = "because the truth moves while the vehicle stands still, or jumps"
        say(f"left out, {why}: {at_rest} (--stationary keep keeps them)")
    if odd:
        say(f"motions in which odometry and truth differ far more than elsewhere: {odd}")
        say("('gpvo evaluate' lists them; 'gpvo train --odd drop' trains and scores without them)")
    slips = [f["slips"] for f in document["folds"] if "slips" in f]
    total = {k: sum(s[k] for s in slips) for k in ("caught", "missed", "falsely_flagged")}
    if any(total.values()):
        counted_in = (
            f"{method} {sum(s['nees_dof_with_slips'][method] for s in slips) / len(slips):.3g}"
            for method in ("learned", "constant")
        )
        say(
            f"slips: {total['caught']} caught, {total['missed']} missed, {total['falsely_flagged']} falsely flagged;"
            f" NEES including the flagged ones: {', '.join(counted_in)}"
        )
    c = document["comparison"]
    if c is not None:
        rival, base = (with_interval(c[name]) for name in ("nll_per_dim_difference", "learned_less_base"))
        say(f"best row by NLL: {c['best_row']}; learned minus {c['rival']}: {rival}")
        say(f"learned minus base (what the Gaussian process adds): {base}")


def _nees(block: dict[str, float | None]) -> float | None:
    return block["joint"] if block["joint"] is not None else block["translation"]
