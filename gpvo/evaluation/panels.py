"""What is drawn of a run, on the page and in figures: plain numbers for each panel, thinned to what a screen can show.

A panel is ``{"title", "x": label, "y": label, "lines", "bands", "shades"}`` with optional ``log`` ("x", "y" or "xy"),
``equal`` axes, ``limit`` (low, high) of y, ``level``, a reference line, and ``along``, what is told of each point of a
path. NaN is None, a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby, pairwise
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.statements import Statement
from gpvo.geometry.covariance import half_axes, variances
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.stats import consistency
from gpvo.stats.series import allan_deviation, autocorrelation
from gpvo.types import Array, Status

Panel = dict[str, Any]

AXES = ("x", "y", "z", "rot x", "rot y", "rot z")
_COLOURS = {
    "constant": "#888888", "triangulation": "#1f77b4", "pointing_matching": "#ff7f0e", "spherical": "#8c564b",
    "triangulation_scaled": "#17becf", "pointing_matching_scaled": "#bcbd22", "learned": "#2ca02c", "base": "#e377c2",
    "imported": "#d62728", "imported_scaled": "#c49c94", "twin": "#3f51b5", "constant_best": "#393b79",
    "constant_hindsight": "#e7969c",
}  # fmt: skip


def colour(method: str) -> str:
    """One colour per method, the same in every figure."""
    return _COLOURS.get(method, "#9467bd")


MAX_POINTS = 500
_BLACK, _RED, _GREEN = "#1b1b1b", "#d62728", "#2ca02c"
SIX = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b")
_LEVELS: Array = np.linspace(0.02, 0.98, 49)
_HALF_WIDTHS: Array = np.array([NormalDist().inv_cdf(0.5 + p / 2) for p in _LEVELS])
_NEES_WINDOW_S = 0.5
_SHADES = {Status.DEGRADED: "#ffbf00", Status.LOST: _RED}


def level(T_world_first: Array) -> tuple[Array, tuple[str, str, str]]:
    """Axes to draw in, the third upwards, and their names. A camera's world (y down, as KITTI's) is turned."""
    down = T_world_first[:3, :3] @ np.array([0.0, 1.0, 0.0])
    if abs(down[2]) < 0.7 and abs(down[1]) > 0.7:
        return R_FLU_OPTICAL, ("forward z", "left -x", "up -y")
    return np.eye(3), ("x", "y", "z")


def views(e: Evaluation) -> list[Panel]:
    """Top and side view of truth and estimate, with 3-sigma ellipses."""
    to_plane, names = level(e.T_world_first)
    origin = e.T_world_first[:3, 3]
    p, q = (e.T_est[:, :3, 3] - origin) @ to_plane.T, (e.T_true[e.covered][:, :3, 3] - origin) @ to_plane.T
    bounds = np.zeros((0, 6, 6)) if e.shown_bounds is None else e.shown_bounds
    keep, panels = spread(len(p)), []
    told = {name: _rounded(values[keep]) for name, values in _along(e).items()}
    for i, j in ((0, 1), (0, 2)):
        lines = []
        for k in np.unique(np.linspace(0, max(len(bounds) - 1, 0), 12).astype(int))[1:]:
            R = to_plane @ e.T_est[k, :3, :3]
            outline = ring((R @ bounds[k, :3, :3] @ R.T)[np.ix_([i, j], [i, j])]) + p[k, [i, j]]
            # Whole ellipses lie inside the plot, unless they are far larger than the path.
            far = bool(np.ptp(outline, axis=0).max() > 2 * np.ptp(p, axis=0).max())
            lines.append({**line(outline[:, 0], outline[:, 1], "", _GREEN, 0.8), "aside": far})
        if len(q):
            lines.append(line(*_thin(q[:, i], q[:, j]), "truth", _BLACK, 1.6))
        lines.append(line(*_thin(p[:, i], p[:, j]), "visual odometry", _RED))
        along = {"x": _rounded(p[keep, i]), "y": _rounded(p[keep, j]), "told": told}
        panels.append(panel("", f"{names[i]} [m]", f"{names[j]} [m]", lines, equal=True, along=along))
    return panels


def _along(e: Evaluation) -> dict[str, Array]:
    """What the pointer shows of each pose of the path, with units: (N,) each."""
    out = {"time [s]": e.t_s}
    if e.covered.any():
        off = np.linalg.norm(e.T_est[:, :3, 3] - e.T_true[:, :3, 3], axis=1)
        out["off by [m]"] = np.where(e.covered, off, np.nan)
    if e.shown_bounds is not None:
        out["stated sigma [m]"] = np.sqrt(np.trace(e.shown_bounds[:, :3, :3], axis1=1, axis2=2))
    return out


def errors(e: Evaluation) -> list[Panel]:
    """The error of each motion and what is stated of it, axis by axis."""
    statement, index, panels = e.shown, e.errors.index, []
    if not len(index):
        return []
    t, keep = e.t_s[index], spread(len(index))
    for k, axis in enumerate(AXES):
        error, bands = 1e3 * e.errors.xi[:, k], []
        reach = max(1.3 * float(np.quantile(np.abs(error), 0.995)), 1e-6)
        if statement is not None:
            own = 0.0 if e.truth_noise is None else e.truth_noise[:, k, k]
            mean, bound = 1e3 * statement.mean[index, k], 3e3 * np.sqrt(statement.covariance[index, k, k] + own)
            low, high = (mean - bound)[keep], (mean + bound)[keep]
            bands = [{"x": _rounded(t[keep]), "low": _rounded(low), "high": _rounded(high), "colour": _GREEN}]
            # Nine tenths of the bound are always in the plot; its peaks unless the error would be a flat line.
            edge = np.abs(np.concatenate([low, high]))
            edge = edge[np.isfinite(edge)]
            if len(edge):
                reach = max(reach, 1.15 * float(np.quantile(edge, 0.9)), min(1.05 * float(edge.max()), 4.0 * reach))
        lines = [line(*_thin(t, error), "", _BLACK, 1.0)]
        unit = "mm" if k < 3 else "mrad"
        panels.append(panel(axis, "time [s]", f"{axis} [{unit}]", lines, bands=bands, limit=[-reach, reach]))
    return panels


def stated(e: Evaluation) -> list[Panel]:
    """What each method states of every motion, translation and rotation."""
    keep, panels = spread(len(e.t_s)), []
    for name, block in (("translation [mm]", slice(0, 3)), ("rotation [mrad]", slice(3, 6))):
        lines = []
        for s in (s for s in e.statements if s.errors is not None):
            sigma = np.sqrt(variances(s.covariance)[:, block].mean(axis=1))
            lines.append(_of_method(e, s, e.t_s[keep], 1e3 * sigma[keep]))
        if lines:
            panels.append(panel("", "time [s]", name, lines, log="y"))
    return panels


def reliability(e: Evaluation) -> list[Panel]:
    """Share of errors inside the stated central interval, all axes together, against its probability."""
    if not len(e.errors.index):
        return []
    lines = []
    for s, error, C, _ in _stated_errors(e):
        z = np.abs(error) / np.sqrt(variances(C))
        lines.append(_of_method(e, s, _LEVELS, np.array([(z <= width).mean() for width in _HALF_WIDTHS])))
    lines.append({**line(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "", _BLACK, 1.0), "dash": True})
    return [panel("Reliability", "stated probability", "share of errors inside", lines, limit=[0.0, 1.0])]


def nees(e: Evaluation) -> list[Panel]:
    """Joint NEES per degree of freedom over time, averaged over half a second around each motion."""
    if not len(e.errors.index):
        return []
    lines = []
    for s, error, C, t in _stated_errors(e):
        values = consistency.nees(error, C) / error.shape[1]
        ones = np.ones(min(len(values), max(1, round(_NEES_WINDOW_S / max(float(np.median(e.errors.dt_s)), 1e-3)))))
        # Divide by what lies under the window, or both ends would seem more honest than they are.
        smooth = np.convolve(values, ones, mode="same") / np.convolve(np.ones(len(values)), ones, mode="same")
        lines.append(_of_method(e, s, *_thin(t, np.maximum(smooth, 1e-3))))
    return [panel("NEES over time", "time [s]", "NEES / dof", lines, log="y", level=1.0)]


def _stated_errors(e: Evaluation) -> Iterator[tuple[Statement, Array, Array, Array]]:
    """Of each method that speaks of all axes of at least two motions with truth: itself, the errors about its mean on
    the d axes that count (K, d), the covariances (K, d, d), with the truth's noise, and the times [s] of these
    motions."""
    for s in e.statements:
        known = np.isfinite(s.covariance[e.errors.index]).all(axis=(1, 2))
        if s.errors is not None and known.sum() >= 2:
            axes, index = np.array(e.consistency[s.method].axes), e.errors.index[known]
            error = (e.errors.xi[known] - s.mean[index])[:, axes]
            C = s.covariance[index] if e.truth_noise is None else s.covariance[index] + e.truth_noise[known]
            yield s, error, consistency.marginal(C, axes), e.t_s[index]


def memory(e: Evaluation) -> list[Panel]:
    """Autocorrelation and Allan deviation of the error, axis by axis."""
    if len(e.errors.index) < 4:
        return []
    dt, rho, allan = float(np.median(e.errors.dt_s)), [], []
    for k, axis in enumerate(AXES):
        values = autocorrelation(e.errors.xi[:, k], min(60, len(e.errors.xi) // 2))
        rho.append(line(np.array([dt * lag for lag in range(len(values))]), values, axis, SIX[k], 1.0))
        allan.append(line(*allan_deviation(e.errors.xi[:, k] / dt, dt), axis, SIX[k], 1.0))
    return [
        panel("Autocorrelation", "lag [s]", "autocorrelation", rho, level=0.0),
        panel("Allan deviation", "averaging time [s]", "deviation [m/s, rad/s]", allan, log="xy"),
    ]


def inputs(e: Evaluation) -> list[Panel]:
    """Points, disparity and image over time, with the frames that were degraded or lost."""
    log = e.run.log
    t, shades = e.t_s, _shades(e)
    wanted = {
        "points": {"n_stereo": "matched in stereo", "n_tracked": "followed", "n_inliers": "inliers"},
        "disparity [px]": {"disparity_p10_px": "10 %", "disparity_p50_px": "median", "disparity_p90_px": "90 %"},
        "image, 0 to 1": {"brightness": "brightness", "contrast": "contrast", "noise_level": "noise"},
    }
    panels = []
    for label, names in wanted.items():
        columns = {names[n]: np.where(c < 0, np.nan, c) for n in names for c in [log.column(n).astype(np.float64)]}
        known = [(n, c) for n, c in columns.items() if np.isfinite(c).any()]
        lines = [line(*_thin(t, c), n, SIX[k]) for k, (n, c) in enumerate(known)]
        if lines:
            panels.append(panel("", "time [s]", label, lines, shades=shades))
    return panels


def _shades(e: Evaluation) -> list[dict[str, Any]]:
    """Stretches of time that were degraded or lost, each frame from the one before on; one where no screen shows them
    apart: each panel of a long run would hold thousands."""
    t_s, out = [round(float(t), 3) for t in e.t_s], []
    last: dict[str, dict[str, Any]] = {}
    statuses = e.run.log.statuses
    for tint, group in groupby(range(1, len(t_s)), lambda k: _SHADES.get(statuses[k])):
        frames = list(group)
        if tint is None:
            continue
        begin, end = t_s[frames[0] - 1], t_s[frames[-1]]
        if tint in last and begin - last[tint]["to"] < (t_s[-1] - t_s[0]) / MAX_POINTS:
            last[tint]["to"] = end
        else:
            last[tint] = {"from": begin, "to": end, "colour": tint}
            out.append(last[tint])
    return out


def panel(title: str, x: str, y: str, lines: list[dict[str, Any]], **more: Any) -> Panel:
    """A panel, see the module's text."""
    return {"title": title, "x": x, "y": y, "lines": lines, **more}


def line(x: Array, y: Array, name: str, tint: str, width: float = 1.3) -> dict[str, Any]:
    """A line of a panel, in the legend where it has a name. It may be given more: ``dash``, ``dots`` in place of a line
    (in figures alone), and ``aside``, whether it does not stretch the axes."""
    return {"x": _rounded(x), "y": _rounded(y), "name": name, "colour": tint, "width": width}


def _of_method(e: Evaluation, s: Statement, x: Array, y: Array) -> dict[str, Any]:
    """A method's line; the method that the page is about stands out."""
    return line(x, y, s.method, colour(s.method), 2.4 if s.method == e.shown_method else 1.2)


def ring(C: Array) -> Array:
    """(49, 2) points of the 3-sigma ellipse of a (2, 2) covariance."""
    angle = np.linspace(0, 2 * np.pi, 49)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) @ half_axes(C)


def spread(n: int, most: int = MAX_POINTS) -> NDArray[np.int64]:
    """At most so many of n indices, evenly spread."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64)) if n else np.empty(0, np.int64)


def _thin(x: Array, y: Array) -> tuple[Array, Array]:
    """Lowest and highest y of each stretch, so that no peak is lost."""
    n = len(x)
    if n <= MAX_POINTS:
        return x, y
    edges = np.linspace(0, n, MAX_POINTS // 2 + 1).astype(int)
    filled = np.where(np.isfinite(y), y, 0.0)
    keep = sorted({a + int(pick(filled[a:b])) for a, b in pairwise(edges) for pick in (np.argmin, np.argmax)})
    return x[keep], y[keep]


def _rounded(values: Array) -> list[float | None]:
    """Five digits are more than a screen shows."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in np.asarray(values, dtype=np.float64).tolist()]


class Drawing(NamedTuple):
    """Panels that stand together: in a group of the page, and as a figure of a ``name`` where it has one, under a
    ``title`` that may name the ``{method}`` whose bounds are shown. ``shared``: one axis of time for each column."""

    of: Callable[[Evaluation], list[Panel]]
    name: str = ""
    title: str = ""
    size: tuple[float, float] = (10, 4)
    columns: int = 1
    shared: bool = False


GROUPS: dict[tuple[str, str], tuple[Drawing, ...]] = {
    ("Top and side view", "Green: 3-sigma ellipses of {method}."): (
        Drawing(views, "trajectory", "top and side view, 3-sigma ellipses of {method}", (9, 9)),
    ),
    (
        "Error of each motion and its bound",
        "Line: error. Green: three standard deviations as stated by {method}, with the truth's noise.",
    ): (Drawing(errors, "errors", "error per motion and 3-sigma bound of {method}", (10, 7), 2, True),),
    ("What each method states", "The standard deviation of each motion, per axis."): (Drawing(stated),),
    (
        "Is it honest?",
        "Overconfident where the curve is below the diagonal, and where NEES (mean over 0.5 s) is above 1.",
    ): (
        Drawing(reliability, "reliability", "stated probability, and share inside", (7.5, 5)),
        Drawing(nees, "nees", "1 is right, above 1 is overconfident", (10, 3.5)),
    ),
    (
        "How errors are correlated in time",
        "A dip at the first lag shows shared pixel noise; a flat or rising Allan deviation shows a bias.",
    ): (Drawing(memory, "memory", "how errors are correlated in time", (10, 4), 2),),
    ("What odometry saw", "Amber: degraded frames. Red: lost frames."): (
        Drawing(inputs, "inputs", "what odometry saw; amber is degraded, red is lost", (10, 5.5), 1, True),
    ),
}
"""What is drawn of a run, in the order of the page: by title and note of a group."""
