"""Pictures of one run, and of a forecast: data in, matplotlib ``Figure`` out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from gpvo.evaluation import curves
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.forecast import Forecast
from gpvo.geometry.frames import R_FLU_OPTICAL
from gpvo.io.atomic import replacing
from gpvo.stats.series import allan_deviation, autocorrelation
from gpvo.types import Array, Status

AXES = ("x", "y", "z", "rot x", "rot y", "rot z")
_COLOURS = {
    "constant": "#888888", "triangulation": "#1f77b4", "pointing_matching": "#ff7f0e", "spherical": "#8c564b",
    "triangulation_scaled": "#17becf", "pointing_matching_scaled": "#bcbd22", "learned": "#2ca02c", "base": "#e377c2",
    "imported": "#d62728", "imported_scaled": "#c49c94", "twin": "#3f51b5",
}  # fmt: skip


def colour(method: str) -> str:
    """One colour per method, the same in every picture."""
    return _COLOURS.get(method, "#9467bd")


def _legend(ax: Axes, columns: int = 1) -> None:
    """A legend, where there is something to tell apart."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(framealpha=0.8, edgecolor="none", fontsize=8, ncols=columns)


def trajectory(e: Evaluation) -> Figure:
    """Top and side view of estimate and truth, with 3-sigma ellipses of the best statement."""
    figure = Figure(figsize=(9, 7), layout="constrained")
    top, side = figure.subplots(2, 1, height_ratios=(2, 1))
    statement = curves.best_statement(e)
    bounds = None if statement is None else statement.pose_covariance(e.run.log)
    to_plane, names = level(e)
    p, q = e.T_est[:, :3, 3] @ to_plane.T, e.T_true[:, :3, 3] @ to_plane.T
    for axes, (i, j) in ((top, (0, 1)), (side, (0, 2))):
        axes.plot(q[e.covered, i], q[e.covered, j], color="black", lw=1.2, label="truth")
        axes.plot(p[:, i], p[:, j], color="#d62728", lw=1.2, label="visual odometry")
        if bounds is not None:
            for k in np.unique(np.linspace(0, len(p) - 1, 12).astype(int)):
                R = to_plane @ e.T_est[k, :3, :3]
                C = (R @ bounds[k, :3, :3] @ R.T)[np.ix_([i, j], [i, j])]
                # As an artist the ellipse does not stretch the axes: a vast bound must not hide the path.
                axes.add_artist(_ellipse(p[k, [i, j]], C))
        axes.margins(0.15)
        axes.set_xlabel(f"{names[i]} [m]")
        axes.set_ylabel(f"{names[j]} [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    top.legend(loc="best", frameon=False)
    top.set_title(f"{e.run.name}: top and side view, 3-sigma ellipses: {statement.method if statement else 'none'}")
    return figure


def level(e: Evaluation) -> tuple[Array, tuple[str, str, str]]:
    """Axes to draw in, so that the third points up."""
    return _level_of(e.T_true[e.covered][0] if e.covered.any() else e.T_est[0])


def _level_of(T_world_cam: Array) -> tuple[Array, tuple[str, str, str]]:
    """By the first pose. A camera's world (y down, as KITTI's) is turned."""
    down = T_world_cam[:3, :3] @ np.array([0.0, 1.0, 0.0])
    if abs(down[2]) < 0.7 and abs(down[1]) > 0.7:
        return R_FLU_OPTICAL, ("forward z", "left -x", "up -y")
    return np.eye(3), ("x", "y", "z")


def forecast(f: Forecast, title: str) -> Figure:
    """Of a planned path: top view with 3-sigma ellipses and sigma over the distance, one above the other."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    top, below = figure.subplots(2, 1, height_ratios=(2, 1))
    to_plane, names = _level_of(f.plan.T_world_cam[0])
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


def error_bounds(e: Evaluation) -> Figure:
    """Error of each motion against the 3-sigma bound, axis by axis."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    axes = figure.subplots(3, 2, sharex=True)
    statement = curves.best_statement(e)
    t = curves.error_times_s(e)
    for k in range(6):
        ax = axes[k % 3, k // 3]
        scale = 1e3
        error = e.errors.xi[:, k]
        if statement is not None:
            mean = statement.mean[e.errors.index, k]
            sigma = np.sqrt(statement.covariance[e.errors.index, k, k])
            ax.fill_between(t, scale * (mean - 3 * sigma), scale * (mean + 3 * sigma), color="#2ca02c", alpha=0.2, lw=0)
        ax.plot(t, scale * error, color="black", lw=0.7)
        limit = max(scale * 1.3 * float(np.quantile(np.abs(error), 0.995)), 1e-6) if len(error) else 1.0
        ax.set_ylim(-limit, limit)
        ax.set_ylabel(f"{AXES[k]} [{'mm' if k < 3 else 'mrad'}]")
        ax.grid(alpha=0.3)
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    figure.suptitle(f"{e.run.name}: error per motion and 3-sigma bound of {statement.method if statement else 'none'}")
    return figure


def reliability(e: Evaluation) -> Figure:
    """Share of errors inside the stated interval against its level: the diagonal is right, below is overconfident."""
    figure = Figure(figsize=(5.5, 5), layout="constrained")
    ax = figure.subplots()
    for s in curves.full_statements(e):
        ax.plot(curves.LEVELS, curves.reliability(e, s), label=s.method, color=colour(s.method))
    ax.plot([0, 1], [0, 1], color="black", lw=0.8, ls="--")
    ax.set(xlabel="stated probability", ylabel="share of errors inside", title=f"{e.run.name}: reliability")
    _legend(ax)
    ax.grid(alpha=0.3)
    return figure


def memory(e: Evaluation) -> Figure:
    """Autocorrelation and Allan deviation of the error: what is noise and what is bias."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    dt = float(np.median(e.errors.dt_s)) if len(e.errors.dt_s) else 1.0
    for k in range(6 if len(e.errors.dt_s) else 0):
        rho = autocorrelation(e.errors.xi[:, k], min(60, len(e.errors.xi) // 2))
        left.plot(np.arange(len(rho)) * dt, rho, label=AXES[k], lw=1)
        tau, deviation = allan_deviation(e.errors.xi[:, k] / dt, dt)
        right.loglog(tau, deviation, label=AXES[k], lw=1)
    left.axhline(0, color="black", lw=0.6)
    left.set(xlabel="lag [s]", ylabel="autocorrelation", title="a dip at the first lag: shared pixel noise")
    right.set(xlabel="averaging time [s]", ylabel="Allan deviation [m/s, rad/s]", title="flat or rising: bias")
    _legend(right, 2)
    for ax in (left, right):
        ax.grid(alpha=0.3)
    figure.suptitle(f"{e.run.name}: how the error remembers")
    return figure


def nees_over_time(e: Evaluation) -> Figure:
    """Joint NEES per degree of freedom, averaged over half a second, of every full method."""
    figure = Figure(figsize=(10, 3.5), layout="constrained")
    ax = figure.subplots()
    for s in curves.full_statements(e):
        ax.plot(*curves.nees_over_time(e, s), label=s.method, color=colour(s.method), lw=1)
    ax.axhline(1.0, color="black", lw=0.8, ls="--")
    ax.set(
        xlabel="time [s]", ylabel="NEES / dof", yscale="log", title=f"{e.run.name}: 1 is right, above is overconfident"
    )
    _legend(ax, 3)
    ax.grid(alpha=0.3)
    return figure


def inputs(e: Evaluation) -> Figure:
    """What odometry saw: points, disparity, image, and where it was degraded or lost."""
    figure = Figure(figsize=(10, 5.5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    log = e.run.log
    t = (log.t_ns - log.t_ns[0]) * 1e-9
    for name in ("n_stereo", "n_tracked", "n_inliers"):
        axes[0].plot(t, np.where(log.column(name) < 0, np.nan, log.column(name)), label=name, lw=1)
    for name in ("disparity_p10_px", "disparity_p50_px", "disparity_p90_px"):
        axes[1].plot(t, log.column(name), label=name, lw=1)
    for name in ("brightness", "contrast", "noise_level"):
        axes[2].plot(t, log.column(name), label=name, lw=1)
    for ax, label in zip(axes, ("points", "disparity [px]", "image, 0 to 1"), strict=True):
        for status, colour in ((Status.DEGRADED, "#ffbf00"), (Status.LOST, "#d62728")):
            bad = np.array([r.status is status for r in log])
            ax.fill_between(t, 0, 1, where=bad, transform=ax.get_xaxis_transform(), color=colour, alpha=0.25, lw=0)
        ax.set_ylabel(label)
        _legend(ax, 3)
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(f"{e.run.name}: what odometry saw; amber is degraded, red is lost")
    return figure


FIGURES: dict[str, Callable[[Evaluation], Figure]] = {
    "trajectory": trajectory,
    "errors": error_bounds,
    "reliability": reliability,
    "memory": memory,
    "nees": nees_over_time,
    "inputs": inputs,
}


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
