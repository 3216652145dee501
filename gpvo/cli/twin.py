"""``gpvo twin``: runs simulated again from their own tracks, for those without ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from gpvo.errors import GpvoError

if TYPE_CHECKING:
    from gpvo.twin.replicate import TwinSettings

Replicates = Annotated[int, typer.Option(min=2, max=1000, help="Twins of each run.")]
ToleranceOption = Annotated[
    str,
    typer.Option(
        "--tolerance",
        help="Tolerance of the calibration: none, t265, d455, zed2, oak-d, kitti, euroc, or a TOML file"
        " with baseline and focal (fractions) and rotation_rad. Each twin draws its own.",
    ),
]


def twin(
    runs: Annotated[list[Path], typer.Argument(help="Run folders made with --keep-tracks.")],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for the twins.")] = None,
    against: Annotated[
        bool, typer.Option("--against", help="Compare with the runs' ground truth: ratios of real to twin error.")
    ] = False,
    replicates: Replicates = 8,
    tolerance: ToleranceOption = "none",
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    jobs: Annotated[int, typer.Option(help="Twins to make in parallel; -1 for one per core.")] = 1,
    json_: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Simulate runs again, so that their errors are known.

    Each twin is a run folder with exact truth, made from the run's own tracks.

    Example: gpvo twin runs/mine -o twins --tolerance d455
    """
    from gpvo.cli.output import print_json

    settings = settings_of(replicates, tolerance, seed)
    if out is None and not against:
        raise GpvoError("nowhere to put the twins", cure="give a folder with -o, or compare with --against")
    with nullcontext(out) if out is not None else TemporaryDirectory(prefix="gpvo-twins-") as folder:
        made = make_all(runs, Path(folder), settings, jobs)
        if against:
            _print_ratios(runs, [made[i : i + replicates] for i in range(0, len(made), replicates)], json_)
            return
    if json_:
        print_json({"schema": 1, "twins": [str(p) for p in made]})
    else:
        print(f"{out}: {len(made)} twins of {len(runs)} runs")


def _print_ratios(runs: Sequence[Path], twins: Sequence[Sequence[Path]], json_: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    from gpvo.cli.output import print_json
    from gpvo.io.run import read_run
    from gpvo.online.features import AXES
    from gpvo.twin.against import SPANS, compare

    found = compare([read_run(r) for r in runs], [[read_run(t) for t in of_run] for of_run in twins])
    mean, spread = found.pooled
    if json_:
        by_run = {n: dict(zip(SPANS, r.tolist())) for n, r in zip(found.runs, found.ratio)}
        pooled = {s: {"ratio": m.tolist(), "spread": d.tolist()} for s, m, d in zip(SPANS, mean, spread)}
        print_json({"schema": 1, "axes": AXES, "runs": by_run, "pooled": pooled})
        return
    table = Table("run", "over", *AXES)
    for name, ratio in zip(found.runs, found.ratio):
        for span, row in zip(SPANS, ratio):
            table.add_row(name, span, *(f"{v:.2f}" for v in row))
    for span, m, d in zip(SPANS, mean, spread):
        if len(runs) > 1:
            table.add_row("all, times or over", span, *(f"{v:.2f} ({w:.2f})" for v, w in zip(m, d)))
    Console(width=120, highlight=False).print(table)
    print("real over twin error, root mean square; the real one holds the errors of the truth as well")


def settings_of(replicates: int, tolerance: str, seed: int) -> TwinSettings:
    """The flags, parsed. Raises GpvoError for an unknown tolerance."""
    from gpvo.twin.replicate import TwinSettings, read_tolerance

    name, sigma = read_tolerance(tolerance)
    return TwinSettings(replicates, sigma, name, seed)


def make_all(runs: Sequence[Path], out: Path, settings: TwinSettings, jobs: int = 1) -> list[Path]:
    """Twins of all runs, with a progress bar; names of runs that are alike are told apart."""
    from gpvo.cli.output import progress
    from gpvo.evaluation.evaluate import distinct
    from gpvo.twin.replicate import make_twins

    made: list[Path] = []
    names = distinct([run.resolve().name for run in runs])
    with progress("twins", settings.replicates * len(runs)) as advance:
        for run, name in zip(runs, names, strict=True):
            made += make_twins(run, out / name, settings, jobs=jobs, on_twin=advance)
    return made


@contextmanager
def in_place_of_runs_without_truth(paths: list[Path], settings: TwinSettings, jobs: int = 1) -> Iterator[list[Path]]:
    """Runs with truth, and twins of the others, kept for as long as the context is open."""
    from gpvo.io.run import read_run

    without = [p for p in paths if read_run(p).truth is None]
    with TemporaryDirectory(prefix="gpvo-twins-") as folder:
        yield [p for p in paths if p not in without] + make_all(without, Path(folder), settings, jobs)


def register(app: typer.Typer) -> None:
    """Add this file's commands to the application."""
    app.command()(twin)
