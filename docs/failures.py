"""Pictures of "What can go wrong", before and after, from the small flights of ``data/`` and the model of ``models/``.

``python docs/failures.py`` draws them alone; ``docs/make_images.py`` draws them too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from gpvo.dataset.errors import motion_errors
from gpvo.evaluation.evaluate import EvaluateOptions, evaluate_run
from gpvo.geometry import se3
from gpvo.io.run import Run, read_run
from gpvo.online.predictor import Predictor
from gpvo.types import TruthLog, VoLog
from matplotlib.axes import Axes

ROOT = Path(__file__).parents[1]
OUT = Path(__file__).parent / "images"
GOOD, BAD, SLIP = "C2", "C3", 70


def flight() -> Run:
    """The bundled flight that the bundled model has not seen."""
    return read_run(ROOT / "data" / "unseen")


def model() -> Predictor:
    """The bundled model."""
    return Predictor.load(ROOT / "models" / "tunnel.gpvo")


def _truth(run: Run) -> TruthLog:
    assert run.truth is not None
    return run.truth


def noisy_truth(before: Axes, after: Axes) -> None:
    """Stamps of the truth that jitter by 20 ms: taken as exact, then estimated and counted in."""
    run, rng = flight(), np.random.default_rng(0)
    truth = _truth(run)
    shake = np.zeros((len(truth.t_ns), 6))
    shake[:, 2] = 0.02 * rng.standard_normal(len(shake))
    run = replace(run, truth=replace(truth, T_world_cam=truth.T_world_cam @ se3.exp(shake)))
    for ax, options in ((before, EvaluateOptions(truth_sigma=(0.0, 0.0))), (after, EvaluateOptions())):
        c = evaluate_run(run, model(), options).consistency["learned"]
        spans = [
            c.nees_dof_truth_noise["joint"],
            c.horizons[0].nees_dof_truth_noise,
            c.horizons[1].nees_dof_truth_noise,
        ]
        ax.bar(["one motion", "1 m", "10 m"], [s or np.nan for s in spans], color=BAD if ax is before else GOOD)
        ax.axhline(1, color="k", lw=0.8)
        ax.set(yscale="log", ylim=(0.1, 300), ylabel="NEES of learned")


def turned_truth(before: Axes, after: Axes) -> None:
    """A camera that is mounted 1.5 degrees off what the truth says."""
    run = flight()
    truth = _truth(run)
    turn = se3.exp(np.array([0, 0, 0, 0.0, 0.026, 0.0]))
    run = replace(run, truth=replace(truth, T_world_cam=truth.T_world_cam @ turn))
    for ax, align in ((before, "none"), (after, "rotation")):
        e = evaluate_run(run, options=EvaluateOptions(align=align))
        off = np.linalg.norm(e.T_est[:, :3, 3] - e.T_true[:, :3, 3], axis=1)
        ax.plot((e.run.log.t_ns - e.run.log.t_ns[0]) * 1e-9, off, color=BAD if align == "none" else GOOD)
        ax.set(ylim=(0, 0.7), xlabel="time [s]", ylabel="position error [m]")


def slip(before: Axes, after: Axes) -> None:
    """A motion that is wrong by 0.8 m at full inliers, without and with the rule of what a vehicle can do."""
    run = flight()
    records = list(run.log)
    wrong = se3.exp(np.array([0.3, 0, 0.75, 0, 0, 0]))
    records[SLIP] = replace(records[SLIP], T_prev_cur=records[SLIP].T_prev_cur @ wrong)
    run = replace(run, log=VoLog(records, run.log.camera))
    errors, predicted = motion_errors(run.log, _truth(run)), model().replay(run.log)
    log = [run.log.records[k] for k in errors.index]
    t = np.array([r.t_ns - run.log.t_ns[0] for r in log]) * 1e-9
    length = np.linalg.norm(errors.xi[:, :3], axis=1)
    stated = (
        np.array([np.sqrt(np.trace(r.covariances["triangulation"][:3, :3])) for r in log]),
        np.array([np.linalg.norm(predicted[r.t_ns].sigma[:3]) for r in log]),
    )
    at = list(errors.index).index(SLIP)
    for ax, sigma, colour in zip((before, after), stated, (BAD, GOOD)):
        ax.fill_between(t, 1e-4, 3 * sigma, color=colour, alpha=0.3, lw=0, step="mid")
        ax.plot(t, np.maximum(length, 1e-4), color="k", lw=0.8)
        ax.plot(t[at], length[at], "o", color=colour)
        ax.set(yscale="log", ylim=(1e-4, 100), xlabel="time [s]", ylabel="error and 3 sigma [m]")


FAILURES: dict[str, tuple[Callable[[Axes, Axes], None], str, str]] = {
    "noisy_truth": (noisy_truth, "truth taken as exact", "its noise estimated and counted in"),
    "turned_truth": (turned_truth, "as it is", "--align rotation"),
    "slip": (slip, "triangulation: nothing is noticed", "learned: called lost, and covered"),
}


def draw_all() -> None:
    """A picture per failure."""
    for name, (draw, before, after) in FAILURES.items():
        fig, axes = plt.subplots(1, 2, figsize=(9.5, 2.8), dpi=100)
        draw(*axes)
        for ax, title in zip(axes, (before, after)):
            ax.set_title(title, fontsize=10)
            ax.spines[["top", "right"]].set_visible(False)
        fig.tight_layout()
        fig.savefig(OUT / f"wrong_{name}.png")
        plt.close(fig)


if __name__ == "__main__":
    draw_all()
