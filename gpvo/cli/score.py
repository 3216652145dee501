"""``gpvo score``: whose covariance is honest? Stated motions against truth, from files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.errors import GpvoError


def score(
    stated: Annotated[list[Path], typer.Argument(help="Files of stated motions, one per sequence.")],
    truth: Annotated[list[Path], typer.Option("--truth", help="TUM poses of the same camera, in the same order.")],
    truth_sigma: Annotated[str | None, typer.Option(help="Noise of the truth per pose: metres[,radians].")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Score anybody's stated covariances from files alone.

    `gpvo evaluate RUN --stated FOLDER` writes such files for every method of a run.

    Example: gpvo score mine/00.txt mine/02.txt --truth gt/00.txt --truth gt/02.txt
    """
    from gpvo.cli.evaluate import options_of
    from gpvo.cli.output import print_json
    from gpvo.evaluation.score import score as score_files

    if len(stated) != len(truth):
        raise GpvoError(f"{len(stated)} files of stated motions and {len(truth)} truths", cure="one --truth per file")
    found = score_files(list(zip(stated, truth)), options_of(None, truth_sigma, "none", "0"))
    if json_:
        print_json(found)
    else:
        _print(found)


def _print(found: dict[str, Any]) -> None:
    from gpvo.cli.output import console as new_console
    from gpvo.cli.output import new_table

    table = new_table("sequence", "motions", "lost", "energy [mm]", "[mrad]", "NLL", "NEES", "1 s", "10 m", "100 m")
    for s in found["sequences"]:
        energy = (1e3 * s["energy_translation_m"], 1e3 * s["energy_rotation_rad"])
        over = (s["nees_dof_over"][name] for name in ("1s", "10m", "100m"))
        numbers = (*energy, s["nll_per_dim"], s["nees_dof"], *over)
        cells = ("-" if x is None else f"{x:.3g}" for x in numbers)
        table.add_row(s["sequence"], str(s["motions"]), str(s["lost"]), *cells)
    console = new_console()
    console.print(table)
    pooled = found["pooled"]
    for name, unit, factor in (
        ("energy_translation_m", "mm", 1e3),
        ("nll_per_dim", "nats", 1.0),
        ("nees_dof", "", 1.0),
    ):
        i = pooled[name]
        told = "too few sequences for an interval"
        if i["low"] is not None:
            told = f"[{factor * i['low']:.4g}, {factor * i['high']:.4g}] (95 %, by whole sequences)"
        console.print(f"{name}: {factor * i['mean']:.4g} {unit} {told}")


def register(app: typer.Typer) -> None:
    """Add this file's commands to the application."""
    app.command()(score)
