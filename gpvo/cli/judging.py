"""``gpvo doctor --truth``: the NEES of what a bag states, by the ways of ``gpvo import`` and ``gpvo evaluate``."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gpvo.cli.files import import_log
from gpvo.errors import GpvoError
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.evaluation.trajectory import nees_document
from gpvo.io.foreign import read_foreign
from gpvo.io.run import read_run
from gpvo.types import IMPORTED


def nees_of_bag(
    bag: Path, topic: str, truth: Path, truth_topic: str | None = None, align: str = "none"
) -> dict[str, Any]:
    """NEES per degree of freedom of the ``poses`` and of the ``motions`` that a topic states covariances of.

    Each is None, or by block of the error {``nees_dof``, ``interval``, ``median``} with the ``count``; ``problem`` is
    the reason where nothing could be judged. ``truth``: anything that ``gpvo import --truth`` reads, of the same body.
    """
    try:
        with TemporaryDirectory(prefix="gpvo-") as folder:
            given = read_foreign(truth, topic=truth_topic, complete=True)
            import_log(read_foreign(bag, topic=topic), given, Path(folder) / "run", frame="body", align=align)
            evaluation = evaluate_run(read_run(Path(folder) / "run"))
    except GpvoError as error:
        return {"poses": None, "motions": None, "problem": str(error)}
    motions = nees_document(evaluation.consistency.get(IMPORTED))
    problem = None if motions or evaluation.poses else "no covariance is stated that could be judged"
    return {"poses": nees_document(evaluation.poses), "motions": motions, "problem": problem}


def lines(found: dict[str, Any]) -> list[str]:
    """The same in words, one line for each."""
    if found["problem"]:
        return [f"NEES: not known: {found['problem']}"]
    out = []
    for what in ("poses", "motions"):
        if about := found[what]:
            by_block = {name: block for name, block in about.items() if name != "count"}
            joint = by_block.pop("joint")
            low, high = joint["interval"]
            each = ", ".join(f"{name} {block['nees_dof']:.3g}" for name, block in by_block.items())
            out.append(
                f"NEES per degree of freedom of {about['count']} {what}: {joint['nees_dof']:.3g}"
                f" [{low:.3g}, {high:.3g}], {each}: {_meaning(low, high)}"
            )
    return out


def _meaning(low: float, high: float) -> str:
    if low > 1.0:
        return "too sure"
    return "too timid" if high < 1.0 else "right, as far as this truth tells"
