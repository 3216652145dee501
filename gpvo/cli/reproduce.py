"""``gpvo reproduce``: the thesis' tables and figures beside those of gpvo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from gpvo.cli.output import Json, answer, progress


def reproduce(
    out: Annotated[Path, "Folder for results. Finished stages are kept, so a second run continues."],
    quick: Annotated[bool, "One seed with images, flights of 20 s."] = False,
    seeds: Annotated[int | None, "Test seeds with images [5, quick: 1].", {"min": 0}] = None,
    points_seeds: Annotated[int | None, "Further test seeds without images [20, quick: 6].", {"min": 0}] = None,
    data: Annotated[Path | None, "Folder of real data: flown_paths/, tracks, logs.", {"envvar": "GPVO_DATA"}] = None,
    only: Annotated[str | None, "Tables or rows to make, such as 4.3,4.1-clean; all by default."] = None,
    jobs: Annotated[int, "Processes; -1: one per core."] = -1,
    backend: Annotated[str, "local, or dask."] = "local",
    scheduler: Annotated[str | None, "Address of a dask scheduler."] = None,
    json_: Json = False,
) -> None:
    """Reproduce every experiment of the thesis.

    Example: gpvo reproduce -o out/thesis --quick
    """
    from gpvo.reproduce.experiments import Plan
    from gpvo.reproduce.run import reproduce as run
    from gpvo.reproduce.stages import Workers

    given: dict[str, Any] = {"seeds": seeds, "points_seeds": points_seeds, "data": data}
    if only is not None:
        given["only"] = tuple(name.strip() for name in only.split(",") if name.strip())
    chosen = {k: v for k, v in given.items() if v is not None}
    plan = Plan.quick(**chosen) if quick else Plan(**chosen)
    result = run(plan, out, Workers(jobs, backend, scheduler, progress))
    answer(json_, result, lambda: _print_tables(result, out))


def _print_tables(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from gpvo.reproduce import tables

    console = Console(width=max(Console().width, 190), highlight=False, markup=False)
    for title, rows in tables.present(result, tables.TABLES):
        table = Table(*tables.HEADS, title=title)
        for row in rows:
            for line in tables.cells(row):
                table.add_row(*line)
            table.add_section()
        console.print(table)
    for c in result["claims"]:
        console.print(f"{c['verdict']}: {c['claim']} ({c['evidence']})")
    for line in result["failed"]:
        console.print(line)
    asked = [t["met"] for t in result["targets"]]
    console.print(
        f"targets of the full model: {asked.count(True)} met, {asked.count(False)} missed, {asked.count(None)} open"
    )
    console.print(str(out / "report.html"))
