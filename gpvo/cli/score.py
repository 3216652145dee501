"""``gpvo score``: whose covariance is honest? Stated motions against truth, from files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from gpvo.cli.common import refuse_twice
from gpvo.cli.evaluate import JudgeOptions
from gpvo.cli.output import Json, answer, cell, progress, say, show
from gpvo.errors import GpvoError, SourceError, counted
from gpvo.files import refuse_folder


def score(
    stated: Annotated[list[Path], "Files of stated motions (or CSV), one per sequence; or one folder of methods."],
    truth: Annotated[
        list[Path] | None, "TUM poses of the same camera, in the same order.", {"metavar": "<path>"}
    ] = None,
    truth_sigma: Annotated[
        str | None, "Noise of the truth per pose: metres[,radians[,seconds of jitter]]; none by default."
    ] = None,
    out: Annotated[Path | None, "With a folder of methods: write METHOD.json and board.csv here."] = None,
    json_: Json = False,
) -> None:
    """Score anyone's stated covariances from files alone.

    `gpvo evaluate RUN --stated FOLDER` writes such files for every method of a
    run. Such a folder, with METHOD/SEQUENCE.txt and truth/SEQUENCE.txt, is
    scored as a whole.

    Example: gpvo score mine/00.txt mine/02.txt --truth gt/00.txt --truth gt/02.txt
    """
    from gpvo.evaluation.score import score as score_files
    from gpvo.evaluation.score import score_folder, write_board

    refuse_twice(stated)
    refuse_folder(out)
    truth = truth or []
    if missing := [path for path in (*stated, *truth) if not path.exists()]:
        raise SourceError("no such file or folder", where=missing[0])
    options = JudgeOptions(truth_sigma=truth_sigma).options()
    if len(stated) == 1 and stated[0].is_dir() and not truth:
        if out is not None and out.resolve().parent == stated[0].resolve():
            raise GpvoError("lies where a method would", where=out, cure="write the scores to a folder beside these")
        with progress("folders", 1):
            methods = score_folder(stated[0], options)
        if out is not None:
            write_board(methods, out)
        document = {"schema": 1, "methods": list(methods.values())}
        answer(json_, document, lambda: _print_board(methods, truth_sigma is None))
        return
    if out is not None:
        raise GpvoError("-o has no effect on files", cure="give a folder of methods, or print --json")
    if len(stated) != len(truth):
        what = f"{counted(len(stated), 'file')} of stated motions and {counted(len(truth), 'truth')}"
        raise GpvoError(what, cure="give one --truth per file")
    with progress("files", 1):
        found = score_files(list(zip(stated, truth)), options)
    answer(json_, found, lambda: _print(found, truth_sigma is None))


_EXACT = "The truth is taken as exact: an honest covariance seems overconfident if it is not. Give --truth-sigma."
_LEGEND = "E: energy score, lower is better. NEES: per motion, then over 1 s, 10 m and 100 m; 1 is right."


def _print_board(methods: dict[str, dict[str, Any]], exact: bool) -> None:
    from gpvo.evaluation.score import board, on_other_axes, with_fewer_motions

    head = ("method", "E [mm]", "[mrad]", "NLL", "NEES", "1 s", "10 m", "100 m", "easy", "hard")
    rows = zip(*board(methods).values())  # NEES and shares to two digits: the table fits 80 columns
    show(head, ([row[0], *map(cell, row[1:4]), *(cell(v, 2) for v in row[4:])] for row in rows))
    say(_LEGEND)
    say("easy, hard: share within 1 sigma (0.68 is right) of the motions that the method calls easiest and hardest.")
    if exact:
        say(_EXACT)
    for method, axes in on_other_axes(methods).items():
        say(f"{method}: NLL and NEES are of {', '.join(axes)} alone: not comparable with those of others.")
    for method, (sequence, own, most) in with_fewer_motions(methods).items():
        say(f"{method}: states {own} motions of {sequence}, others {most}: not comparable, as the rest is not scored.")


def _print(found: dict[str, Any], exact: bool) -> None:
    rows = []
    for s in found["sequences"]:
        energy = (1e3 * s["energy_translation_m"], 1e3 * s["energy_rotation_rad"])
        over = (s["nees_dof_over"][name] for name in ("1s", "10m", "100m"))
        numbers = (*energy, s["nll_per_dim"], s["nees_dof"], *over)
        rows.append([s["sequence"], str(s["motions"]), str(s["lost"]), *map(cell, numbers)])
    show(("sequence", "motions", "lost", "E [mm]", "[mrad]", "NLL", "NEES", "1 s", "10 m", "100 m"), rows)
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
