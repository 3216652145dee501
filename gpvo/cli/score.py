"""``gpvo score``: whose covariance is honest? Stated motions against truth, from files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.cli.common import refuse_twice
from gpvo.cli.evaluate import JudgeOptions
from gpvo.cli.output import Json, cell, new_table, print_json, progress, say, show
from gpvo.errors import GpvoError


def score(
    stated: Annotated[
        list[Path], typer.Argument(help="Files of stated motions (or CSV), one per sequence; or one folder of methods.")
    ],
    truth: Annotated[
        list[Path] | None,
        typer.Option("--truth", metavar="<path>", help="TUM poses of the same camera, in the same order."),
    ] = None,
    truth_sigma: Annotated[
        str | None, typer.Option(help="Noise of the truth per pose: metres[,radians]; none by default.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="With a folder of methods: write METHOD.json and board.csv here.")
    ] = None,
    json_: Json = False,
) -> None:
    """Score anyone's stated covariances from files alone.

    `gpvo evaluate RUN --stated FOLDER` writes such files for every method of a
    run. Such a folder, with METHOD/SEQUENCE.txt and truth/SEQUENCE.txt, is
    scored as a whole.

    Example: gpvo score mine/00.txt mine/02.txt --truth gt/00.txt --truth gt/02.txt
    """
    from gpvo.evaluation.score import board, on_other_axes, score_folder, write_board
    from gpvo.evaluation.score import score as score_files

    refuse_twice(stated)
    truth = truth or []
    options = JudgeOptions(truth_sigma=truth_sigma).options()
    if len(stated) == 1 and stated[0].is_dir() and not truth:
        with progress("folders", 1):
            methods = score_folder(stated[0], options)
        if out is not None:
            write_board(methods, out)
        if json_:
            print_json({"schema": 1, "methods": list(methods.values())})
        else:
            _print_board(board(methods), truth_sigma is None)
            for method, axes in on_other_axes(methods).items():
                say(f"{method}: NLL and NEES are of {', '.join(axes)} alone: not comparable with those of others.")
        return
    if len(stated) != len(truth):
        raise GpvoError(f"{len(stated)} files of stated motions and {len(truth)} truths", cure="one --truth per file")
    with progress("files", 1):
        found = score_files(list(zip(stated, truth)), options)
    if json_:
        print_json(found)
    else:
        _print(found, truth_sigma is None)


_EXACT = "The truth is taken as exact: an honest covariance seems overconfident if it is not. Give --truth-sigma."
_LEGEND = "E: energy score, lower is better. NEES: per motion, then over 1 s, 10 m and 100 m; 1 is right."


def _print_board(columns: dict[str, list[Any]], exact: bool) -> None:
    table = new_table("method", "E [mm]", "[mrad]", "NLL", "NEES", "1 s", "10 m", "100 m", "easy", "hard")
    for row in zip(*columns.values()):
        name, *numbers = row  # NEES and shares to two digits: the table fits 80 columns
        table.add_row(name, *map(cell, numbers[:3]), *(cell(v, 2) for v in numbers[3:]))
    show(table)
    say(_LEGEND)
    say("easy, hard: share within 1 sigma (0.68 is right) of the motions that the method calls easiest and hardest.")
    if exact:
        say(_EXACT)


def _print(found: dict[str, Any], exact: bool) -> None:
    table = new_table("sequence", "motions", "lost", "E [mm]", "[mrad]", "NLL", "NEES", "1 s", "10 m", "100 m")
    for s in found["sequences"]:
        energy = (1e3 * s["energy_translation_m"], 1e3 * s["energy_rotation_rad"])
        over = (s["nees_dof_over"][name] for name in ("1s", "10m", "100m"))
        numbers = (*energy, s["nll_per_dim"], s["nees_dof"], *over)
        table.add_row(s["sequence"], str(s["motions"]), str(s["lost"]), *map(cell, numbers))
    show(table)
    say(_LEGEND)
    if exact:
        say(_EXACT)
    pooled = found["pooled"]
    if pooled["nees_dof"]["low"] is None:
        say("With fewer than three sequences there is no mean with an interval.")
        return
    for name, unit, factor in (
        ("energy_translation_m", " mm", 1e3),
        ("nll_per_dim", " nats", 1.0),
        ("nees_dof", "", 1.0),
    ):
        i = pooled[name]
        interval = f"[{factor * i['low']:.4g}, {factor * i['high']:.4g}]"
        say(f"{name}: {factor * i['mean']:.4g}{unit} {interval} (95 %, by whole sequences)")
