"""Pictures of "What can go wrong", before and after, from the small flights of ``data/`` and the model of ``models/``.

``python docs/failures.py`` draws them alone; ``docs/make_images.py`` draws them too.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from gpvo.cameras.rig import Tolerance
from gpvo.dataset.doubtful import odd_stretches, without_wandering_truth
from gpvo.dataset.errors import interpolate_truth, motion_errors
from gpvo.evaluation.evaluate import EvaluateOptions, evaluate_run
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.online.predictor import Predictor
from gpvo.runner import steps
from gpvo.sim.points import simulate_points
from gpvo.types import Status, TruthLog, VoLog
from gpvo.vo.config import make_config
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


def fly(
    scenario: str, seed: int, duration_s: float, *, self_calibration: bool = True, **known: Tolerance
) -> tuple[VoLog, TruthLog]:
    """A flight of landmarks alone, through odometry, with its truth."""
    with tempfile.TemporaryDirectory() as folder:
        flown = simulate_points(scenario, seed, duration_s=duration_s, **known)
        source = open_source(flown.save(Path(folder) / "flight.npz"))
        config = make_config(self_calibration=self_calibration)
        log = VoLog([step.record for step in steps(source, config)], source.camera)
    assert source.truth is not None
    return log, source.truth


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


def odd_stretch(before: Axes, after: Axes) -> None:
    """Tracks that had not settled: five motions of half their length; the share of the true motion that is seen."""
    run = flight()
    head = range(60, 66)
    records = [
        replace(r, T_prev_cur=se3.from_rt(r.T_prev_cur[:3, :3], 0.5 * r.T_prev_cur[:3, 3])) if k in head else r
        for k, r in enumerate(run.log)
    ]
    log = replace(run.log, records=records)
    e = motion_errors(log, _truth(run))
    length = np.linalg.norm(e.T_true[:, :3, 3], axis=1)
    share = np.linalg.norm(e.T_est[:, :3, 3], axis=1) / length
    for ax, kept in ((before, np.ones(len(share), bool)), (after, ~np.isin(e.index, named(log, _truth(run))))):
        show = kept & (length > 0.05)
        ax.plot(e.index[show], share[show], ".", color=BAD if ax is before else GOOD)
        ax.set(ylim=(0, 1.5), xlabel="motion", ylabel="share of the true motion")


def named(log: VoLog, truth: TruthLog) -> np.ndarray:
    """Motions in stretches that are called odd."""
    return np.concatenate([np.arange(s.first, s.last + 1) for s in odd_stretches(log, truth)] or [np.zeros(0, int)])


def traffic(before: Axes, after: Axes) -> None:
    """A street on which cars and lorries lead and overtake: error, and what geometry and the mixture state."""
    log, truth = fly("street-traffic", 2008, 40.0)
    e = motion_errors(log, truth)
    t = np.array([log.records[k].t_ns - log.t_ns[0] for k in e.index]) * 1e-9
    error = np.maximum(np.linalg.norm(e.xi[:, :3], axis=1), 1e-4)
    ok = np.array([log.records[k].status is Status.OK for k in e.index])
    sigma = [np.sqrt(np.trace(log.records[k].covariances["triangulation"][:3, :3])) for k in e.index]
    before.plot(t, error, ".", color=BAD, ms=3)
    after.fill_between(t, 1e-4, 3 * np.array(sigma), color=GOOD, alpha=0.3, lw=0, step="mid")
    after.plot(t[~ok], error[~ok], ".", color="0.5", ms=3, label="degraded")
    after.plot(t[ok], error[ok], ".", color=GOOD, ms=3, label="ok")
    after.legend(loc="lower right", fontsize=8)
    for ax in (before, after):
        ax.set(yscale="log", ylim=(1e-4, 100), xlabel="time [s]", ylabel="error of a motion [m]")


def drifted_calibration(before: Axes, after: Axes) -> None:
    """A right camera turned by 0.1 degrees since it was calibrated: without and with self-calibration."""
    turned = Tolerance(rotation_rad=0.0017)
    for ax, on in ((before, False), (after, True)):
        log, truth = fly("tunnel-clean", 0, 40.0, offset=turned, self_calibration=on)
        T_true, known = interpolate_truth(truth, log.t_ns)
        T_est = T_true[0] @ np.linalg.inv(log.trajectory()[0]) @ log.trajectory()
        off = np.linalg.norm(T_est[known, :3, 3] - T_true[known, :3, 3], axis=1)
        ax.plot((log.t_ns[known] - log.t_ns[0]) * 1e-9, off, color=GOOD if on else BAD)
        ax.set(ylim=(0, None), xlabel="time [s]", ylabel="position error [m]")
    after.set(ylim=before.get_ylim())


def wandering_wait(before: Axes, after: Axes) -> None:
    """A vehicle that stands for 2.8 s while its truth wanders by 0.2 m: all motions, and those that are scored."""
    log, truth = fly("tunnel-clean", 3, 8.0)
    s, T = (truth.t_ns - truth.t_ns[0]) * 1e-9, truth.T_world_cam.copy()
    rests = (s >= 0.3) & (s <= 2.8)
    T[rests, 1, 3] += 0.2 * np.sin(np.pi * (s[rests] - 0.3) / 1.25) ** 2
    wrong = replace(truth, T_world_cam=T)
    for ax, scored in ((before, log), (after, without_wandering_truth(log, wrong))):
        e = motion_errors(scored, wrong)
        t = np.array([log.records[k].t_ns - log.t_ns[0] for k in e.index]) * 1e-9
        error = np.maximum(np.linalg.norm(e.xi[:, :3], axis=1), 1e-5)
        ax.plot(t, error, ".", color=BAD if scored is log else GOOD)
        ax.set(yscale="log", xlim=(0, 8), ylim=(1e-5, 1), xlabel="time [s]", ylabel="error of a motion [m]")


FAILURES: dict[str, tuple[Callable[[Axes, Axes], None], str, str]] = {
    "noisy_truth": (noisy_truth, "truth taken as exact", "its noise estimated and counted in"),
    "turned_truth": (turned_truth, "as it is", "--align rotation"),
    "traffic": (traffic, "motions against the lorry, not the street", "degraded, and 3 sigma reach over"),
    "odd_stretch": (odd_stretch, "six motions of half their length", "named, and left out with --odd drop"),
    "drifted_calibration": (drifted_calibration, "--no-self-calibration", "calibration estimated in flight"),
    "wandering_wait": (wandering_wait, "--stationary keep", "the wait is left out, and counted"),
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
