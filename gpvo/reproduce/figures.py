"""The thesis' figures 4.1 to 4.9 with gpvo's flights: error of the position and 3-sigma bound, axis by axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gpvo.files import replacing
from gpvo.reproduce.bounds import Bounds
from gpvo.reproduce.models import Studies
from gpvo.reproduce.rows import Cell
from gpvo.reproduce.stages import Store
from gpvo.reproduce.tables import MODES
from gpvo.types import Array

_AXES = ("x: right", "y: down", "z: forward")
_GREEN = "#2ca02c"


def draw(cells: Sequence[Cell], studied: Studies | None, store: Store, out: Path) -> list[dict[str, str]]:
    """Every figure as a file in ``out``, and what it shows: of each row the first flight."""
    drawn: list[dict[str, str]] = []

    def keep(name: str, title: str, figure: Figure) -> None:
        path = out / "figures" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=100, format="png", metadata={"Software": None})
        drawn.append({"file": f"figures/{name}.png", "title": title})

    simulated: dict[tuple[str, str], list[Cell]] = {}
    real: dict[str, list[Cell]] = {}
    for c in cells:
        if c.mode == "real":
            real.setdefault(c.experiment.key, []).append(c)
        elif c.experiment.table == "sensitivity":
            # The last figure shows the pairs of sigmas side by side.
            if c.experiment.flights == "tunnel" and c.way == "recipe":
                simulated.setdefault((c.mode, "4.9"), []).append(c)
        elif c.experiment.figure:
            simulated.setdefault((c.mode, c.experiment.figure), []).append(c)
    for (mode, number), group in sorted(simulated.items(), key=lambda item: item[0]):
        what = "tunnel, clean: sensitivity to sigma_p, sigma_m" if number == "4.9" else group[0].experiment.title
        title = f"Figure {number}, {what} ({MODES[mode]}, first seed)"
        keep(f"{number}-{mode}", title, bounds_figure(title, {_column(c): c.load(store)[0] for c in group}))
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
    figure = Figure(figsize=(3.6 * len(columns) + 0.6, 6.6), layout="constrained")
    grid = figure.subplots(3, len(columns), sharex=True, squeeze=False)
    for i, axis in enumerate(_AXES):
        limit = _limit(list(columns.values()), i)
        for j, (name, b) in enumerate(columns.items()):
            ax = grid[i][j]
            reach = 3 * b.sigma_m[:, i]
            ax.fill_between(b.t_s, b.mean_m[:, i] - reach, b.mean_m[:, i] + reach, color=_GREEN, alpha=0.22, lw=0)
            ax.plot(b.t_s, b.mean_m[:, i], color=_GREEN, lw=0.8)
            ax.plot(b.t_s, b.error_m[:, i], color="black", lw=1.1)
            ax.set_ylim(-limit, limit)
            ax.grid(alpha=0.3)
            if reach.max() > limit:
                ax.text(0.03, 0.93, f"bound up to ±{reach.max():.2g} m", transform=ax.transAxes, fontsize=8, va="top")
            if i == 0:
                ax.set_title(name, fontsize=10)
            if j == 0:
                ax.set_ylabel(f"{axis} [m]")
            else:
                ax.tick_params(labelleft=False)
    for ax in grid[-1]:
        ax.set_xlabel("time [s]")
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
