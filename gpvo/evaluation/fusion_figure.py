"""The picture of a fusion experiment: every run under every policy, and whether the learned one knew its error."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gpvo.filters.policies import LEARNED
from gpvo.filters.study import Study
from gpvo.io.atomic import replacing

_HONEST = (0.7, 1.5)


def plot_experiment(result: Study, title: str, path: Path) -> None:
    """Draw to an image file."""
    figure = experiment_figure(result, title)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, bbox_inches="tight", format=path.suffix[1:])


def experiment_figure(result: Study, title: str) -> Figure:
    """Left: position error of each run. Right: the learned policy's NEES of each run."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    figure.suptitle(title)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _errors(left, result)
    _consistency(right, result)
    return figure


def _errors(axes: Axes, result: Study) -> None:
    """One dot per run and policy; lines join the runs, so that pairs can be seen."""
    names = list(result.scores)
    ate = np.array([result.column(n, "ate_rmse_m") for n in names])  # (policies, runs)
    axes.plot(ate, color="grey", lw=0.4, alpha=0.5)
    for i, name in enumerate(names):
        colour = "tab:green" if name == LEARNED else "tab:blue"
        axes.plot(np.full(ate.shape[1], i), ate[i], "o", ms=3, color=colour, alpha=0.6)
        axes.plot([i - 0.3, i + 0.3], [np.nanmean(ate[i])] * 2, color="black", lw=2)
    axes.set_xticks(range(len(names)), names, rotation=20, ha="right", fontsize=8)
    axes.set(ylabel="ATE of each run [m]; bar: mean", yscale="log")


def _consistency(axes: Axes, result: Study) -> None:
    for part, marker in (("position", "o"), ("attitude", "^")):
        values = result.column(LEARNED, f"nees_{part}")
        axes.plot(values, marker, ms=4, label=f"{part}, mean {np.nanmean(values):.2f}")
    axes.axhspan(*_HONEST, color="grey", alpha=0.3)
    axes.set(xlabel="run", ylabel="NEES per degree of freedom, learned", yscale="log")
    axes.legend(fontsize=8)
