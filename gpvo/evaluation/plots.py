"""Figures: of one run, the panels that the page draws by itself; of a forecast; of what filters made of runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from gpvo.errors import GpvoError
from gpvo.evaluation import panels
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.forecast import Forecast
from gpvo.evaluation.fusion import Trace, nis_band, nis_over_runs
from gpvo.evaluation.panels import Drawing, Panel, colour
from gpvo.files import replacing
from gpvo.types import Array


def picture(e: Evaluation, of: Drawing) -> Figure:
    """Panels of a run column by column, under their title."""
    figure, drawn = Figure(figsize=of.size, layout="constrained"), of.of(e)
    rows = max(-(-len(drawn) // of.columns), 1)
    grid = figure.subplots(rows, of.columns, sharex="col" if of.shared else False, squeeze=False)
    for k, panel in enumerate(drawn):
        _draw(grid[k % rows, k // rows], panel)
    for ax in grid[:-1].flat if of.shared else ():
        ax.set_xlabel("")
    figure.suptitle(f"{e.run.name}: {of.title.format(method=e.shown_method)}")
    return figure


def _draw(ax: Axes, panel: Panel) -> None:
    for shade in panel.get("shades", ()):
        ax.axvspan(shade["from"], shade["to"], color=shade["colour"], alpha=0.25, lw=0)
    for band in panel.get("bands", ()):
        x, low, high = (np.array(band[key], dtype=np.float64) for key in ("x", "low", "high"))
        ax.fill_between(x, low, high, color=band["colour"], alpha=0.2, lw=0)
    for line in panel["lines"]:
        x, y = (np.array(line[key], dtype=np.float64) for key in "xy")
        drawn = Line2D(x, y, color=line["colour"], lw=line["width"], ls="--" if line.get("dash") else "-")
        drawn.set_label(line["name"])
        # As an artist a vast ellipse does not stretch the axes and hide the path.
        ax.add_artist(drawn) if line.get("aside") else ax.add_line(drawn)
    if panel.get("level") is not None:
        ax.axhline(panel["level"], color="black", lw=0.8, ls="--")
    scales = {f"{axis}scale": "log" for axis in panel.get("log", "")}
    ax.set(xlabel=panel["x"], ylabel=panel["y"], title=panel["title"], **scales)
    ax.autoscale_view()
    if panel.get("limit") is not None:
        ax.set_ylim(*panel["limit"])
    if panel.get("equal"):
        ax.set_aspect("equal", adjustable="datalim")
        ax.margins(0.15)
    _legend(ax)
    ax.grid(alpha=0.3)


def _legend(ax: Axes, columns: int = 1) -> None:
    """A legend, where there is something to tell apart."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(framealpha=0.8, edgecolor="none", fontsize=8, ncols=columns)


FIGURES: dict[str, Callable[[Evaluation], Figure]] = {
    d.name: partial(picture, of=d) for drawings in panels.GROUPS.values() for d in drawings if d.name
}


def save_all(e: Evaluation, folder: Path, name: str | None = None) -> list[Path]:
    """Every figure of a run as ``<name>_<figure>.png`` and ``.pdf``; ``name``: by default the run's."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for figure, draw in FIGURES.items():
        drawn, path = draw(e), folder / f"{name or e.run.name}_{figure}.png"
        save(drawn, path, dpi=110)
        save(drawn, path.with_suffix(".pdf"), metadata={"CreationDate": None})
        out.append(path)
    return out


def forecast(f: Forecast, title: str) -> Figure:
    """Of a planned path: top view with 3-sigma ellipses and sigma over the distance, one above the other."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    top, below = figure.subplots(2, 1, height_ratios=(2, 1))
    to_plane, names = panels.level(f.plan.T_world_cam[0])
    p = f.plan.T_world_cam[:, :3, 3] @ to_plane.T
    C = to_plane @ f.position_covariance @ to_plane.T
    top.plot(p[:, 0], p[:, 1], color="black", lw=1.2, label="plan")
    far = np.concatenate([[False], f.in_domain < 0.5])
    if far.any():
        top.plot(p[far, 0], p[far, 1], ".", color="#d62728", ms=3, label="outside the training domain")
    for k in np.unique(np.linspace(1, len(p) - 1, 12).astype(int)):
        # As an artist the ellipse does not stretch the axes: a vast bound must not hide the path.
        top.add_artist(_ellipse(p[k, :2], C[k, :2, :2]))
    top.plot([], [], color=colour("learned"), lw=0.8, label="3-sigma bound of the position")
    top.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", title=title)
    top.set_aspect("equal", adjustable="datalim")
    top.margins(0.15)
    _legend(top)
    distance = f.plan.distance_m
    for j, axis in enumerate("xyz"):
        below.plot(distance, f.position_sigma_m[:, j], lw=1, label=axis)
    below.plot(distance, f.sigma_m, color="black", lw=1.4, label="all three")
    below.set(xlabel="distance [m]", ylabel="sigma of the position [m]")
    _legend(below, columns=4)
    for ax in (top, below):
        ax.grid(alpha=0.3)
    return figure


def _ellipse(centre: Array, C: Array) -> Ellipse:
    values, vectors = np.linalg.eigh(C)
    width, height = 2 * 3 * np.sqrt(np.maximum(values, 0))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec="#2ca02c", lw=0.8)


def require_picture(path: Path) -> None:
    """Raise GpvoError where the name's ending is no format that can be drawn."""
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise GpvoError("does not have the suffix of an image", where=path, cure=f"choose from {', '.join(known)}")


def plot_fusion(traces: Sequence[Trace], path: Path) -> None:
    """Draw the first run's path and errors and all runs' innovations to an image file, one colour per policy."""
    figure = Figure(figsize=(11, 9), layout="constrained")
    above, middle, below = figure.subplots(3, 1)
    first = [t for t in traces if t.run == traces[0].run]
    _fused_paths(above, first)
    _fused_errors(middle, first)
    _innovations(below, traces)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path, dpi=120, bbox_inches="tight")


def save(figure: Figure, path: Path, **options: Any) -> None:
    """Write to an image file, whole or not at all; ``options``: of matplotlib's ``savefig``."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:].lower(), **options)


def _fused_paths(axes: Axes, traces: Sequence[Trace]) -> None:
    if traces and traces[0].truth is not None:
        axes.plot(traces[0].truth[:, 0], traces[0].truth[:, 1], color="black", lw=2, label="truth")
    for trace in traces:
        axes.plot(trace.position[:, 0], trace.position[:, 1], lw=1, label=trace.policy)
    axes.set(xlabel="x [m]", ylabel="y [m]", title=traces[0].run if traces else "")
    axes.set_aspect("equal", "datalim")
    axes.legend(fontsize=8)


def _fused_errors(axes: Axes, traces: Sequence[Trace]) -> None:
    for trace in traces:
        (line,) = axes.plot(trace.t_s, trace.error_m, lw=1, label=trace.policy)
        axes.plot(trace.t_s, 3 * trace.sigma_m, color=line.get_color(), lw=0.7, ls="--")
    axes.set(
        xlabel="time [s]", ylabel="position error [m]", title="error, and three sigma of the filter's own (dashed)"
    )


def _innovations(axes: Axes, traces: Sequence[Trace]) -> None:
    """Mean NIS over runs at each step, which should stay inside the chi-square band."""
    runs = len({t.run for t in traces})
    for policy in dict.fromkeys(t.policy for t in traces):
        rows = [t for t in traces if t.policy == policy]
        mean, _ = nis_over_runs(rows)
        axes.plot(rows[0].t_s[: len(mean)], mean, lw=0.8, label=policy)
    if runs:
        axes.axhspan(*nis_band(runs), color="grey", alpha=0.3)
    axes.set_yscale("log")
    axes.set(
        xlabel="time [s]",
        ylabel="NIS / 6",
        title=f"innovations, mean over {runs} run(s), with the 95 % chi-square band",
    )
