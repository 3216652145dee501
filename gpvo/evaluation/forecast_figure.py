"""Picture of a forecast: the path from above with 3-sigma ellipses, and sigma over the distance."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from gpvo.evaluation.forecast import Forecast
from gpvo.geometry.frames import R_FLU_OPTICAL
from gpvo.types import Array

_ELLIPSES = 12
_GREEN, _RED = "#2ca02c", "#d62728"


def draw(f: Forecast, title: str) -> Figure:
    """Top view and sigma over the distance, one above the other."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    top, below = figure.subplots(2, 1, height_ratios=(2, 1))
    to_plane, names = _level(f.plan.T_world_cam[0])
    p = f.plan.T_world_cam[:, :3, 3] @ to_plane.T
    C = to_plane @ f.position_covariance @ to_plane.T
    top.plot(p[:, 0], p[:, 1], color="black", lw=1.2, label="plan")
    far = np.concatenate([[False], f.in_domain < 0.5])
    if far.any():
        top.plot(p[far, 0], p[far, 1], ".", color=_RED, ms=3, label="outside the training domain")
    for k in np.unique(np.linspace(1, len(p) - 1, _ELLIPSES).astype(int)):
        # As an artist the ellipse does not stretch the axes: a vast bound must not hide the path.
        top.add_artist(_ellipse(p[k, :2], C[k, :2, :2]))
    top.plot([], [], color=_GREEN, lw=0.8, label="3-sigma bound of the position")
    top.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", title=title)
    top.set_aspect("equal", adjustable="datalim")
    top.margins(0.15)
    top.legend(framealpha=0.8, edgecolor="none", fontsize=8)
    distance = f.plan.distance_m
    for j, axis in enumerate("xyz"):
        below.plot(distance, f.position_sigma_m[:, j], lw=1, label=axis)
    below.plot(distance, f.sigma_m, color="black", lw=1.4, label="all three")
    below.set(xlabel="distance [m]", ylabel="sigma of the position [m]")
    below.legend(framealpha=0.8, edgecolor="none", fontsize=8, ncols=4)
    for ax in (top, below):
        ax.grid(alpha=0.3)
    return figure


def _level(T_world_cam: Array) -> tuple[Array, tuple[str, str]]:
    """The two level axes of the plan's world: x and y, or z and -x where it is a camera's world with y down."""
    down = T_world_cam[:3, :3] @ np.array([0.0, 1.0, 0.0])
    if abs(down[2]) < 0.7 and abs(down[1]) > 0.7:
        return R_FLU_OPTICAL, ("z", "-x")
    return np.eye(3), ("x", "y")


def _ellipse(centre: Array, C: Array) -> Ellipse:
    values, vectors = np.linalg.eigh(C)
    width, height = 2 * 3 * np.sqrt(np.maximum(values, 0))
    angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse((centre[0], centre[1]), width, height, angle=angle, fill=False, ec=_GREEN, lw=0.8)
