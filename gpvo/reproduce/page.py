"""The result as one self-contained page: tables with the numbers of ``results.json``, figures inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpvo.reproduce import tables


def render(result: Mapping[str, Any], folder: Path) -> str:
    """The page as text; pictures are read from ``folder``."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, select_autoescape

    # The style sheet is that of the other pages.
    loader = ChoiceLoader([PackageLoader("gpvo.reproduce"), PackageLoader("gpvo.evaluation")])
    environment = Environment(loader=loader, autoescape=select_autoescape(default=True), trim_blocks=True)
    environment.filters["number"] = tables.number
    pictures = [{**f, "data": _embedded(folder / f["file"])} for f in result["figures"]]
    groups = [
        ("Tables 4.1 to 4.6", result["rows"]),
        ("Sensitivity to sigma_p and sigma_m", result["sensitivity"]),
        ("Real data", result["real"]),
    ]
    return environment.get_template("reproduce.html").render(
        result=result,
        groups=[(title, [line for row in rows for line in tables.cells(row)]) for title, rows in groups if rows],
        heads=tables.HEADS,
        modes=tables.MODES,
        verdict=tables.verdict,
        pictures=pictures,
    )


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")
