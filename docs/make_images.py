"""The pictures of README and documentation: ``python docs/make_images.py`` (a minute or two; needs ``gpvo[sim]``).

Four simulated flights teach, a fifth is shown: where it went and how sure odometry says it is, the error of each motion
and its predicted bound, and what a filter makes of it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from failures import draw_all
from gpvo.dataset.build import build_run
from gpvo.evaluation.evaluate import Evaluation, evaluate_run
from gpvo.evaluation.fusion import FusionSettings, fuse_runs
from gpvo.filters.run import FusedRun
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from gpvo.runner import run
from gpvo.sim.points import simulate_points
from matplotlib.axes import Axes

TRAINING = (0, 1, 2, 3)
SHOWN = 44  # of the flights 40 to 48 the one whose filter gains as much as the median one
OUT = Path(__file__).parent / "images" / "overview.png"


def fly(seed: int, folder: Path) -> Run:
    """One flight of 40 s through the odometry."""
    tracks = simulate_points("tunnel-bursts", seed, duration_s=40.0, rate_hz=10.0).save(folder / f"{seed}.npz")
    run(open_source(tracks), folder / f"run{seed}")
    return read_run(folder / f"run{seed}")


def draw_error(ax: Axes, shown: Run, evaluation: Evaluation, predictor: Predictor) -> None:
    """Length of each motion's translation error, and three predicted sigmas."""
    predictor.reset(shown.log.camera)
    stated = {p.t_ns: p for p in map(predictor.step, shown.log) if p is not None}
    stamps = shown.log.t_ns[evaluation.errors.index]
    t = (stamps - shown.log.t_ns[0]) * 1e-9
    bound = 3 * np.array([np.sqrt(np.trace(stated[s].covariance[:3, :3])) for s in stamps])
    ax.fill_between(t, 0, 1e3 * bound, color="C2", alpha=0.3, lw=0, label="predicted 3 sigma")
    ax.plot(t, 1e3 * np.linalg.norm(evaluation.errors.xi[:, :3], axis=1), color="k", lw=0.8, label="error")
    ax.set(ylabel="error of a motion [mm]", yscale="log", ylim=(0.1, 3e3))
    ax.legend(ncols=2, frameon=False, loc="upper left")


def draw_filters(ax: Axes, shown: Run, fused: dict[str, FusedRun]) -> None:
    """Position error of the filter under each policy."""
    assert shown.truth is not None
    for policy, colour in (("constant", "0.55"), ("learned", "C2")):
        one = fused[policy]
        at = np.searchsorted(shown.truth.t_ns, one.t_ns)
        off = np.linalg.norm(one.T_world_cam[:, :3, 3] - shown.truth.T_world_cam[at, :3, 3], axis=1)
        ax.plot((one.t_ns - one.t_ns[0]) * 1e-9, 100 * off, color=colour, label=f"{policy} covariance")
    ax.set(ylabel="error of the filter [cm]", xlabel="time [s]", ylim=(0, None))
    ax.margins(y=0.25)
    ax.legend(ncols=2, frameon=False, loc="upper left")


def draw_path(ax: Axes, shown: Run, evaluation: Evaluation, fused: FusedRun) -> None:
    """Truth from above, the end to the right of the start, and the filtered position with 3-sigma circles, ten times
    enlarged."""
    true = evaluation.T_true[evaluation.covered][:, :2, 3]
    way = (true[-1] - true[0]) / np.linalg.norm(true[-1] - true[0])
    turn = np.array([[way[0], -way[1]], [way[1], way[0]]])
    x, y = ((true - true[0]) @ turn).T
    ax.plot(x, y, color="k", lw=1, label="truth")
    off = (fused.T_world_cam[:, :2, 3] - true[0]) @ turn
    ax.plot(*off.T, color="C2", lw=1, ls="--", label="filter")
    for k in range(0, len(off), 25):
        radius = 30 * float(np.sqrt(np.linalg.eigvalsh(fused.covariance[k, :2, :2]).max()))
        ax.add_patch(plt.Circle((off[k, 0], off[k, 1]), radius, color="C2", alpha=0.2, lw=0))
    ax.set(xlabel="x [m]", ylabel="y [m]")
    ax.margins(y=0.15)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("path from above, 3 sigma drawn 10 times as large", loc="left", fontsize="medium")
    ax.legend(ncols=1, frameon=False, loc="center left")


def main() -> None:
    """Simulate, learn, filter, draw."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        training = [fly(seed, folder) for seed in TRAINING]
        shown = fly(SHOWN, folder)
        model = folder / "tunnel.gpvo"
        save_model(train_sets([build_run(r) for r in training], TrainConfig(), judge=False), model)
        predictor = Predictor.load(model)
        fused: dict[str, FusedRun] = {}
        settings = FusionSettings(policies=("constant", "learned"), model=model)
        fuse_runs([folder / f"run{SHOWN}"], settings, on_run=lambda one: fused.setdefault(one.policy, one) and None)
        evaluation = evaluate_run(shown, predictor)
    fig, (top, middle, bottom) = plt.subplots(3, 1, figsize=(9.5, 6.2), dpi=100, height_ratios=(0.8, 1.2, 1.2))
    draw_path(top, shown, evaluation, fused["learned"])
    draw_error(middle, shown, evaluation, predictor)
    draw_filters(bottom, shown, fused)
    bottom.sharex(middle)
    fig.tight_layout()
    fig.savefig(OUT)
    draw_all()
    print(OUT.parent)


if __name__ == "__main__":
    main()
