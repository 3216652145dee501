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

from gpvo.errors import GpvoError
from gpvo.evaluation import panels
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.forecast import Forecast
from gpvo.evaluation.fusion import Trace, nis_band, nis_over_runs
from gpvo.evaluation.panels import Drawing, Panel, colour, line
from gpvo.files import Own, refuse_foreign, replacing

PLOT = (b"atplotlib", "plot")
_SIGNATURE = {"jpg": {"comment": b"Matplotlib"}, "tif": {"tiffinfo": {305: "Matplotlib"}}}
"""Matplotlib says in most formats that it drew them; in these it has to be told. A picture without it is somebody's."""
_SIGNATURE |= {"jpeg": _SIGNATURE["jpg"], "tiff": _SIGNATURE["tif"]}


def picture(e: Evaluation, of: Drawing) -> Figure:
    """Panels of a run column by column, under their title."""
    figure = figure_of(of.of(e), of.size, columns=of.columns, shared=of.shared)
    figure.suptitle(f"{e.run.name}: {of.title.format(method=e.shown_method)}")
    return figure


def figure_of(
    drawn: Sequence[Panel], size: tuple[float, float], *, columns: int = 1, shared: bool = False, **options: Any
) -> Figure:
    """Panels column by column. ``shared``: one axis of time for each column; ``options``: of ``Figure.subplots``."""
    figure, rows = Figure(figsize=size, layout="constrained"), max(-(-len(drawn) // columns), 1)
    grid = figure.subplots(rows, columns, sharex="col" if shared else False, squeeze=False, **options)
    for k, panel in enumerate(drawn):
        _draw(grid[k % rows, k // rows], panel)
    for ax in grid[:-1].flat if shared else ():
        ax.set_xlabel("")
    return figure


def _draw(ax: Axes, panel: Panel) -> None:
    for shade in panel.get("shades", ()):
        ax.axvspan(shade["from"], shade["to"], color=shade["colour"], alpha=0.25, lw=0)
    for band in panel.get("bands", ()):
        x, low, high = (np.array(band[key], dtype=np.float64) for key in ("x", "low", "high"))
        ax.fill_between(x, low, high, color=band["colour"], alpha=0.2, lw=0)
    for told in panel["lines"]:
        x, y = (np.array(told[key], dtype=np.float64) for key in "xy")
        style: dict[str, Any] = (
            {"ls": "", "marker": "."} if told.get("dots") else {"ls": "--" if told.get("dash") else "-"}
        )
        drawn = Line2D(x, y, color=told["colour"], lw=told["width"], label=told["name"], **style)
        # As an artist a vast ellipse does not stretch the axes and hide the path.
        ax.add_artist(drawn) if told.get("aside") else ax.add_line(drawn)
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
    if names := ax.get_legend_handles_labels()[1]:
        many = len(names) > 4 and not panel.get("equal")  # they would cover curves
        beside: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)} if many else {}
        ax.legend(framealpha=0.8, edgecolor="none", fontsize=8, **beside)
    ax.grid(alpha=0.3)


FIGURES: dict[str, Callable[[Evaluation], Figure]] = {
    d.name: partial(picture, of=d) for drawings in panels.GROUPS.values() for d in drawings if d.name
}


def save_all(e: Evaluation, folder: Path, name: str | None = None) -> list[Path]:
    """Every figure of a run as ``<name>_<figure>.png`` and ``.pdf``; ``name``: by default the run's."""
    out = []
    for figure, draw in FIGURES.items():
        drawn, path = draw(e), folder / f"{name or e.run.name}_{figure}.png"
        save(drawn, path, dpi=110)
        save(drawn, path.with_suffix(".pdf"), metadata={"CreationDate": None})
        out.append(path)
    return out


def forecast(f: Forecast, title: str) -> Figure:
    """Of a planned path: top view with 3-sigma ellipses and sigma over the distance, one above the other."""
    to_plane, names = panels.level(f.plan.T_world_cam[0])
    p = f.plan.T_world_cam[:, :3, 3] @ to_plane.T
    C = to_plane @ f.position_covariance @ to_plane.T
    lines, far = [line(p[:, 0], p[:, 1], "plan", "black", 1.2)], np.concatenate([[False], f.in_domain < 0.5])
    if far.any():
        lines.append({**line(p[far, 0], p[far, 1], "outside the training domain", "#d62728"), "dots": True})
    name = "3-sigma bound of the position"
    for k in np.unique(np.linspace(1, len(p) - 1, 12).astype(int)):
        x, y = (panels.ring(C[k, :2, :2]) + p[k, :2]).T
        lines.append({**line(x, y, name, colour("learned"), 0.8), "aside": True})  # a vast one must not hide the path
        name = ""
    along = [line(f.plan.distance_m, f.position_sigma_m[:, j], "xyz"[j], panels.SIX[j], 1.0) for j in range(3)]
    along.append(line(f.plan.distance_m, f.sigma_m, "all three", "black", 1.4))
    drawn = (
        panels.panel(title, f"{names[0]} [m]", f"{names[1]} [m]", lines, equal=True),
        panels.panel("", "distance [m]", "sigma of the position [m]", along),
    )
    return figure_of(drawn, (8, 8), height_ratios=(2, 1))


def require_picture(path: Path) -> None:
    """Raise GpvoError where the name's ending is no format that can be drawn, or the file there is no such drawing."""
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise GpvoError("does not have the suffix of an image", where=path, cure=f"choose from {', '.join(known)}")
    refuse_foreign(path, *PLOT)


def fusion(traces: Sequence[Trace]) -> Figure:
    """Of filters, one colour per policy: the first run's path from above, its errors, and all runs' innovations."""
    first = [t for t in traces if t.run == traces[0].run]
    paths, errors = [], []
    to_plane, names = panels.level(first[0].T_world_first if first else np.eye(4))
    if first and first[0].truth is not None:
        x, y, _ = to_plane @ first[0].truth.T
        paths.append(line(x, y, "truth", "black", 2.0))
    for t in first:
        x, y, _ = to_plane @ t.position.T
        paths.append(line(x, y, t.policy, colour(t.policy), 1.0))
        errors.append(line(t.t_s, t.error_m, t.policy, colour(t.policy), 1.0))
        errors.append({**line(t.t_s, 3 * t.sigma_m, "", colour(t.policy), 0.7), "dash": True})
    about = "error, and three sigma of the filter's own (dashed)"
    drawn = (
        panels.panel(first[0].run if first else "", f"{names[0]} [m]", f"{names[1]} [m]", paths, equal=True),
        panels.panel(about, "time [s]", "position error [m]", errors),
        _innovations(traces),
    )
    return figure_of(drawn, (11, 9))


def _innovations(traces: Sequence[Trace]) -> Panel:
    """Mean NIS over runs at each step, which should stay inside the chi-square band."""
    runs, lines, bands = len({t.run for t in traces}), [], []
    for policy in dict.fromkeys(t.policy for t in traces):
        rows = [t for t in traces if t.policy == policy]
        mean, _ = nis_over_runs(rows)
        lines.append(line(rows[0].t_s[: len(mean)], mean, policy, colour(policy), 0.8))
    if runs:
        low, high = nis_band(runs)
        reach = [0.0, max(t.t_s[-1] for t in traces)]
        bands.append({"x": reach, "low": [low, low], "high": [high, high], "colour": "grey"})
    title = f"innovations, mean over {runs} run{'s' * (runs != 1)}, with the 95 % chi-square band"
    return panels.panel(title, "time [s]", "NIS / 6", lines, bands=bands, log="y")


def save(figure: Figure, path: Path, own: Own | None = PLOT, **options: Any) -> None:
    """Write to an image file, whole or not at all; what is not of its ``own`` kind is not replaced. ``options``: of
    Matplotlib's ``savefig``."""
    kind = path.suffix[1:].lower()
    if kind in _SIGNATURE:
        options["pil_kwargs"] = _SIGNATURE[kind]
    with replacing(path, own) as temporary:
        figure.savefig(temporary, format=kind, **options)
