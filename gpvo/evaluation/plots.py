"""Figures of one run: of the panels that the page draws by itself; and of a forecast."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from gpvo.evaluation import curves, panels
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.forecast import Forecast
from gpvo.evaluation.panels import Panel, colour
from gpvo.files import replacing
from gpvo.types import Array


def picture(
    e: Evaluation,
    of: Callable[[Evaluation], list[Panel]],
    title: str,
    *,
    size: tuple[float, float],
    columns: int = 1,
    shared: bool = False,
) -> Figure:
    """Panels of a run column by column, under a ``title`` that may name the ``{method}`` whose bounds are shown.

    ``shared``: one axis of time for each column.
    """
    figure, drawn = Figure(figsize=size, layout="constrained"), of(e)
    rows = max(-(-len(drawn) // columns), 1)
    grid = figure.subplots(rows, columns, sharex="col" if shared else False, squeeze=False)
    for k, panel in enumerate(drawn):
        _draw(grid[k % rows, k // rows], panel)
    for ax in grid[:-1].flat if shared else ():
        ax.set_xlabel("")
    statement = curves.best_statement(e)
    method = "no method" if statement is None else statement.method
    figure.suptitle(f"{e.run.name}: {title.format(method=method)}")
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
    "trajectory": partial(
        picture, of=panels.views, title="top and side view, 3-sigma ellipses of {method}", size=(9, 9)
    ),
    "errors": partial(
        picture, of=panels.errors, title="error per motion and 3-sigma bound of {method}", size=(10, 7), columns=2,
        shared=True,
    ),
    "reliability": partial(
        picture, of=panels.reliability, title="stated probability, and share inside", size=(5.5, 5)
    ),
    "memory": partial(picture, of=panels.memory, title="how the error remembers", size=(10, 4), columns=2),
    "nees": partial(picture, of=panels.nees, title="1 is right, above is overconfident", size=(10, 3.5)),
    "inputs": partial(
        picture, of=panels.inputs, title="what odometry saw; amber is degraded, red is lost", size=(10, 5.5),
        shared=True,
    ),
}  # fmt: skip


def save_all(e: Evaluation, folder: Path, name: str | None = None) -> list[Path]:
    """Every figure of a run as ``<name>_<figure>.png`` and ``.pdf``; ``name``: by default the run's."""
    folder.mkdir(parents=True, exist_ok=True)
    out = []
    for figure, draw in FIGURES.items():
        drawn, path = draw(e), folder / f"{name or e.run.name}_{figure}.png"
        with replacing(path) as temporary:
            drawn.savefig(temporary, dpi=110, format="png")
        with replacing(path.with_suffix(".pdf")) as temporary:
            drawn.savefig(temporary, format="pdf", metadata={"CreationDate": None})
        out.append(path)
    return out


def forecast(f: Forecast, title: str) -> Figure:
    """Of a planned path: top view with 3-sigma ellipses and sigma over the distance, one above the other."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    top, below = figure.subplots(2, 1, height_ratios=(2, 1))
    to_plane, names = panels.level_of(f.plan.T_world_cam[0])
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
