"""The figure of ``gpvo fuse``: path, errors and innovations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.figure import Figure

from gpvo.errors import GpvoError
from gpvo.evaluation.fusion import Trace
from gpvo.evaluation.fusion_report import nis_band, nis_over_runs
from gpvo.files import replacing


def require_picture(path: Path) -> None:
    """Raise GpvoError where the name's ending is no format that can be drawn."""
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise GpvoError("does not have the suffix of an image", where=path, cure=f"choose from {', '.join(known)}")


def plot_fusion(traces: Sequence[Trace], path: str | Path) -> None:
    """Draw the first run's path and errors and all runs' innovations to an image file."""
    target = Path(path)
    require_picture(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    save(figure_of(traces), target)


def save(figure: Figure, path: Path) -> None:
    """Write to an image file, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, bbox_inches="tight", format=path.suffix[1:].lower())


def figure_of(traces: Sequence[Trace]) -> Figure:
    """The figure, one colour per policy."""
    figure = Figure(figsize=(11, 9), layout="constrained")
    above, middle, below = figure.subplots(3, 1)
    first = [t for t in traces if t.run == traces[0].run] if traces else []
    _paths(above, first)
    _errors(middle, first)
    _innovations(below, traces)
    return figure


def _paths(axes: Axes, traces: Sequence[Trace]) -> None:
    if traces and traces[0].truth is not None:
        axes.plot(traces[0].truth[:, 0], traces[0].truth[:, 1], color="black", lw=2, label="truth")
    for trace in traces:
        axes.plot(trace.position[:, 0], trace.position[:, 1], lw=1, label=trace.policy)
    axes.set(xlabel="x [m]", ylabel="y [m]", title=traces[0].run if traces else "")
    axes.set_aspect("equal", "datalim")
    axes.legend(fontsize=8)


def _errors(axes: Axes, traces: Sequence[Trace]) -> None:
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
