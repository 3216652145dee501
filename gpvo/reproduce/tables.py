"""The result for people: tables as CSV and Markdown, the thesis' figures 4.1 to 4.9 with gpvo's flights (error of the
position and 3-sigma bound, axis by axis), and one self-contained page with both."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gpvo.evaluation.panels import line, panel
from gpvo.evaluation.plots import figure_of, save
from gpvo.evaluation.report import number
from gpvo.files import columns_of, markdown_table, templates
from gpvo.reproduce.bounds import Bounds
from gpvo.reproduce.models import Studies
from gpvo.reproduce.rows import Cell
from gpvo.reproduce.stages import Store
from gpvo.types import Array

_AXES = ("x: right", "y: down", "z: forward")
_GREEN = "#2ca02c"
MODES = {"images": "images", "points": "points only", "real": "real"}
_THESIS = ("rmse_m", "final_error_m", "predicted_final_error_m", "ratio", "residual_m", "residual_over_rmse")
_COLUMNS = (
    "key", "table", "title", "mode", "seeds", "way", "rmse_m", "final_error_m", "predicted_final_error_m", "ratio",
    "ratio_interval_low", "ratio_interval_high", "vector_residual_m", "vector_over_rmse", "magnitude_residual_m",
    "magnitude_over_rmse", "coverage_3_sigma",
)  # fmt: skip


def with_interval(value: float | None, interval: Sequence[float] | None) -> str:
    """A number, with its interval where there is one."""
    return number(value) if interval is None else f"{number(value)} [{number(interval[0])}, {number(interval[1])}]"


def as_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """A line per row and way, every digit, as columns."""
    lines = []
    for row in rows:
        thesis = row.get("thesis") or {}
        for way, found in row["ways"].items():
            low, high = found["ratio_interval"] or (None, None)
            known = {**row, **found, "way": way, "ratio_interval_low": low, "ratio_interval_high": high}
            printed = {f"thesis_{name}": thesis.get(name) for name in _THESIS}
            lines.append({name: known[name] for name in _COLUMNS} | printed)
    return columns_of(lines)


TABLES = {"rows": "Tables 4.1 to 4.6", "sensitivity": "Sensitivity to sigma_p and sigma_m", "real": "Real data"}
REMARKS = {"errata": "Errata", "out_of_scope": "Out of scope", "failed": "Not flown"}


def present(document: Mapping[str, Any], titles: Mapping[str, str]) -> list[tuple[str, Sequence[Any]]]:
    """Titles and entries of those lists of the document that hold any."""
    return [(title, document[key]) for key, title in titles.items() if document[key]]


def as_markdown(document: Mapping[str, Any]) -> str:
    """All tables of the document."""
    parts = ["# The thesis' experiments, reproduced", "", *(f"* {line}" for line in document["notes"])]

    def add(title: str, lines: Iterable[str]) -> None:
        parts.extend(["", f"## {title}", "", *lines])

    for title, rows in present(document, TABLES):
        add(title, markdown_table(HEADS, [line for row in rows for line in cells(row)]))
    told = [
        (t["key"], MODES[t["mode"]], t["target"], number(t["value"]), verdict(t["met"])) for t in document["targets"]
    ]
    add("What is asked of the full model", markdown_table(("row", "flights", "target", "value", "met"), told))
    if document["claims"]:
        head = ("claim", "verdict", "evidence")
        add("The thesis' claims", markdown_table(head, [[c[name] for name in head] for c in document["claims"]]))
    for title, lines in present(document, REMARKS):
        add(title, (f"* {line}" for line in lines))
    return "\n".join(parts) + "\n"


def as_page(document: Mapping[str, Any], folder: Path) -> str:
    """All tables and figures of the document as HTML; images are read from ``folder``."""
    environment = templates("gpvo.reproduce", "gpvo.evaluation")  # the style sheet is that of the other pages
    environment.filters["number"] = number

    def embedded(file: str) -> str:
        return "data:image/png;base64," + base64.b64encode((folder / file).read_bytes()).decode("ascii")

    return environment.get_template("reproduce.html").render(
        result=document,
        groups=[(title, [line for row in rows for line in cells(row)]) for title, rows in present(document, TABLES)],
        heads=HEADS,
        modes=MODES,
        verdict=verdict,
        pictures=[{**f, "data": embedded(f["file"])} for f in document["figures"]],
        lists=present(document, REMARKS),
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


def draw(cells: Sequence[Cell], studied: Studies | None, store: Store, out: Path) -> list[dict[str, str]]:
    """Every figure as a file in ``out``, and what it shows: of each row the first flight."""
    drawn: list[dict[str, str]] = []

    def keep(name: str, title: str, figure: Figure) -> None:
        save(figure, out / "figures" / f"{name}.png", own=None, dpi=100, metadata={"Software": None})
        drawn.append({"file": f"figures/{name}.png", "title": title})

    simulated: dict[tuple[str, str], list[Cell]] = {}
    real: dict[str, list[Cell]] = {}
    for c in cells:
        e = c.experiment
        if c.mode == "real":
            real.setdefault(e.key, []).append(c)
        # The last figure shows the pairs of sigmas side by side.
        elif e.table == "sensitivity" and e.flights == "tunnel" and c.way == "recipe":
            simulated.setdefault((c.mode, "4.9"), []).append(c)
        elif e.table != "sensitivity" and e.figure:
            simulated.setdefault((c.mode, e.figure), []).append(c)
    for (mode, figure), group in sorted(simulated.items(), key=lambda item: item[0]):
        what = "tunnel, clean: sensitivity to sigma_p, sigma_m" if figure == "4.9" else group[0].experiment.title
        title = f"Figure {figure}, {what} ({MODES[mode]}, first seed)"
        keep(f"{figure}-{mode}", title, bounds_figure(title, {_column(c): c.load(store)[0] for c in group}))
    for key, group in real.items():
        title = f"Real: {group[0].experiment.title} (first sequence)"
        keep(key, title, bounds_figure(title, {c.way: c.load(store)[0] for c in group}))
    if studied is not None and len(next(iter(studied.curve.values()))) > 1:
        keep("learning-curve", f"Learning curve ({MODES[studied.mode]})", curve_figure(studied.curve))
    return drawn


def _column(c: Cell) -> str:
    p, m = c.experiment.sigma_px
    return f"recipe, sigma_p {p}, sigma_m {m}" if c.experiment.table == "sensitivity" else c.way


def bounds_figure(title: str, columns: Mapping[str, Bounds]) -> Figure:
    """One flight: a column per way, a row per axis of the first camera, error in black and mean +- 3 sigma in green.

    Ways share the scale of an axis; a bound far beyond all errors is cut, and its reach printed.
    """
    drawn = []
    for name, b in columns.items():
        for i, axis in enumerate(_AXES):
            mean, reach, limit = b.mean_m[:, i], 3 * b.sigma_m[:, i], _limit(list(columns.values()), i)
            band = {"x": b.t_s, "low": mean - reach, "high": mean + reach, "colour": _GREEN}
            lines = [line(b.t_s, mean, "", _GREEN, 0.8), line(b.t_s, b.error_m[:, i], "", "black", 1.1)]
            told = [name] * (i == 0) + [f"bound up to ±{reach.max():.2g} m"] * bool(reach.max() > limit)
            drawn.append(panel(", ".join(told), "time [s]", f"{axis} [m]", lines, bands=[band], limit=[-limit, limit]))
    figure = figure_of(drawn, (3.6 * len(columns) + 0.6, 6.6), columns=len(columns), shared=True)
    figure.suptitle(title, fontsize=11)
    return figure


def _limit(bounds: list[Bounds], axis: int) -> float:
    """Room for every error, and for bounds up to four times as far."""
    error = max(float(np.abs(b.error_m[:, axis]).max()) for b in bounds)
    reach = max(float((np.abs(b.mean_m[:, axis]) + 3 * b.sigma_m[:, axis]).max()) for b in bounds)
    return max(1.15 * min(max(error, reach), 4 * error), 1e-6)


def curve_figure(curves: Mapping[str, Mapping[int, Array]]) -> Figure:
    """Learning curves: NLL per axis of every flight (n,), by kind of training and number of flights."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.subplots()
    for (name, by_count), colour in zip(curves.items(), ("#1f77b4", "#d62728", _GREEN), strict=False):
        mean = np.array([v.mean() for v in by_count.values()])
        reach = np.array([1.96 * v.std(ddof=1) / np.sqrt(len(v)) if len(v) > 1 else 0.0 for v in by_count.values()])
        ax.plot(list(by_count), mean, marker="o", color=colour, label=name)
        ax.fill_between(list(by_count), mean - reach, mean + reach, color=colour, alpha=0.15, lw=0)
    ax.set_xscale("log", base=2)
    ticks = sorted({n for by_count in curves.values() for n in by_count})
    ax.set_xticks(ticks, [str(k) for k in ticks])
    ax.minorticks_off()
    ax.set(xlabel="training flights", ylabel="NLL per axis [nats], lower is better", title="Learning curve")
    ax.legend(frameon=False)
    ax.grid(alpha=0.3)
    return figure
