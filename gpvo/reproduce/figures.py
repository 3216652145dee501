"""The thesis' figures 4.1 to 4.9 with our flights: error of the position and 3-sigma bound, axis by axis."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from gpvo.io.atomic import replacing
from gpvo.reproduce.bounds import Bounds

_AXES = ("x: right", "y: down", "z: forward")
_GREEN = "#2ca02c"


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


def curve_figure(curves: Mapping[str, tuple[list[int], list[float], list[float], list[float]]]) -> Figure:
    """Learning curves: number of flights, mean NLL per axis, low, high."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.subplots()
    for (name, (n, mean, low, high)), colour in zip(curves.items(), ("#1f77b4", "#d62728", _GREEN), strict=False):
        ax.plot(n, mean, marker="o", color=colour, label=name)
        ax.fill_between(n, low, high, color=colour, alpha=0.15, lw=0)
    ax.set_xscale("log", base=2)
    ticks = sorted({k for n, *_ in curves.values() for k in n})
    ax.set_xticks(ticks, [str(k) for k in ticks])
    ax.minorticks_off()
    ax.set(xlabel="training flights", ylabel="NLL per axis [nats], lower is better", title="Learning curve")
    ax.legend(frameon=False)
    ax.grid(alpha=0.3)
    return figure


def save(figure: Figure, path: Path) -> None:
    """As PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=100, format="png", metadata={"Software": None})
