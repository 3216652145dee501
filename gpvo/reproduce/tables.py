"""The result for people: tables as CSV and Markdown, and one self-contained page with the same numbers."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpvo.files import markdown_table

MODES = {"images": "images", "points": "points only", "real": "real"}
_THESIS = ("rmse_m", "final_error_m", "predicted_final_error_m", "ratio", "residual_m", "residual_over_rmse")
_OURS = (
    "rmse_m", "final_error_m", "predicted_final_error_m", "ratio", "ratio_interval", "vector_residual_m",
    "vector_over_rmse", "magnitude_residual_m", "magnitude_over_rmse", "coverage_3_sigma",
)  # fmt: skip


def number(value: float | None) -> str:
    """Three digits, as every table shows them; a dash for what could not be computed."""
    return "–" if value is None else f"{value:.3g}"


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A number, with its interval where there is one."""
    return number(value) if interval is None else f"{number(value)} [{number(interval[0])}, {number(interval[1])}]"


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """One line per row and way, every digit."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    ours = [c for name in _OURS for c in ((f"{name}_low", f"{name}_high") if name == "ratio_interval" else (name,))]
    writer.writerow(["key", "table", "title", "mode", "seeds", "way", *ours, *(f"thesis_{n}" for n in _THESIS)])
    for row in rows:
        thesis = row.get("thesis") or {}
        for way, found in row["ways"].items():
            values: list[Any] = []
            for name in _OURS:
                values += (found[name] or [None, None]) if name == "ratio_interval" else [found[name]]
            head = [row["key"], row["table"], row["title"], row["mode"], found["seeds"], way]
            writer.writerow([*head, *values, *(thesis.get(n) for n in _THESIS)])
    return stream.getvalue()


def sections(document: Mapping[str, Any]) -> list[tuple[str, Sequence[Mapping[str, Any]]]]:
    """Titles and rows of the tables that have any."""
    titles = {
        "rows": "Tables 4.1 to 4.6",
        "sensitivity": "Sensitivity to sigma_p and sigma_m",
        "real": "Real data",
    }
    return [(title, document[key]) for key, title in titles.items() if document[key]]


def lists(document: Mapping[str, Any]) -> list[tuple[str, Sequence[str]]]:
    """Titles and lines of the remarks that there are."""
    titles = {"errata": "Errata", "out_of_scope": "Out of scope", "failed": "Not flown"}
    return [(title, document[key]) for key, title in titles.items() if document[key]]


def as_markdown(document: Mapping[str, Any]) -> str:
    """All tables of the document."""
    parts = ["# The thesis' experiments, reproduced", ""]
    parts += [f"* {line}" for line in document["notes"]]
    for title, rows in sections(document):
        parts += ["", f"## {title}", "", *markdown_table(HEADS, [line for row in rows for line in cells(row)])]
    parts += ["", "## What is asked of the full model", ""]
    parts += markdown_table(
        ("row", "flights", "target", "value", "met"),
        [(t["key"], MODES[t["mode"]], t["target"], number(t["value"]), verdict(t["met"])) for t in document["targets"]],
    )
    if document["claims"]:
        parts += ["", "## The thesis' claims", ""]
        parts += markdown_table(
            ("claim", "verdict", "evidence"), [(c["claim"], c["verdict"], c["evidence"]) for c in document["claims"]]
        )
    for title, lines in lists(document):
        parts += ["", f"## {title}", "", *(f"* {line}" for line in lines)]
    return "\n".join(parts) + "\n"


def as_page(document: Mapping[str, Any], folder: Path) -> str:
    """All tables and figures of the document as HTML; images are read from ``folder``."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, select_autoescape

    # The style sheet is that of the other pages.
    loader = ChoiceLoader([PackageLoader("gpvo.reproduce"), PackageLoader("gpvo.evaluation")])
    environment = Environment(loader=loader, autoescape=select_autoescape(default=True), trim_blocks=True)
    environment.filters["number"] = number

    def embedded(file: str) -> str:
        return "data:image/png;base64," + base64.b64encode((folder / file).read_bytes()).decode("ascii")

    return environment.get_template("reproduce.html").render(
        result=document,
        groups=[(title, [line for row in rows for line in cells(row)]) for title, rows in sections(document)],
        heads=HEADS,
        modes=MODES,
        verdict=verdict,
        pictures=[{**f, "data": embedded(f["file"])} for f in document["figures"]],
        lists=lists(document),
    )


def verdict(met: bool | None) -> str:
    """In a word."""
    return {True: "yes", False: "no", None: "too few seeds"}[met]


HEADS = (
    "table", "experiment", "flights", "seeds", "way", "RMSE [m]", "final [m]", "predicted [m]", "predicted / actual",
    "vector / RMSE", "magnitude / RMSE", "thesis: RMSE, final, predicted [m]", "ratio", "residual / RMSE",
)  # fmt: skip


def cells(row: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The lines of one row: a line per way, the thesis beside the first."""
    out = []
    for k, (way, f) in enumerate(row["ways"].items()):
        t = row.get("thesis") if k == 0 else None
        first = (row["table"], row["title"], MODES[row["mode"]]) if k == 0 else ("", "", "")
        thesis = ("", "", "")
        if t is not None:
            three = ", ".join(number(t[n]) for n in ("rmse_m", "final_error_m", "predicted_final_error_m"))
            thesis = (three, number(t["ratio"]), number(t["residual_over_rmse"]))
        out.append(
            (
                *first, str(f["seeds"]), way, number(f["rmse_m"]), number(f["final_error_m"]),
                number(f["predicted_final_error_m"]), with_interval(f["ratio"], f["ratio_interval"]),
                number(f["vector_over_rmse"]), number(f["magnitude_over_rmse"]), *thesis,
            )
        )  # fmt: skip
    return out
