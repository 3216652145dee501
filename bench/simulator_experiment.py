"""Is the simulator exact, and do its errors come from where they should? Flights with pictures, run through odometry.

``python -m bench.simulator_experiment -o DIR [--seeds 10] [--only clean,baseline,bursts,lunar]``

``clean``: perfect calibration, no image noise: the mean error of a motion, in percent of the motion, over seeds.
``baseline``: the same with a rig whose baseline is 1 % longer than its calibration says: the scale error.
``bursts``: by how much the standard deviation of the error rises inside the episodes. ``noise``: features, stated
sigma and drift with and without image noise. ``lunar``: two hundred metres over the moon.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gpvo import runner
from gpvo.dataset.errors import MotionErrors, motion_errors
from gpvo.files import write_json
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.sim.scenario import load_scenario
from gpvo.sim.sequence import simulate
from gpvo.stats.series import sequence_bootstrap
from gpvo.types import Array
from gpvo.vo.config import make_config

CLEAN: dict[str, Any] = {"scenario": "tunnel-clean", "duration_s": 9.0, "rate_hz": 10.0}


@dataclass(frozen=True)
class FlownRun:
    """A flight with pictures after odometry: its run, the errors of its motions, and where it was simulated."""

    run: Run
    errors: MotionErrors
    sequence: Path


def fly(scenario: str, seed: int, folder: Path, preset: str = "fast", **values: Any) -> FlownRun:
    """Simulate (unless it is there), run odometry, and compare with the truth. Dots in names are double underscores.

    The sigmas of pointing and matching are estimated from the residuals, so that noise shows in what is stated.
    """
    overrides = {name.replace("__", "."): value for name, value in values.items()}
    tag = "-".join([scenario, *(f"{k}={v}" for k, v in sorted(overrides.items())), str(seed)])
    sequence = simulate(load_scenario(scenario, overrides), seed, folder / "sequences" / tag).path
    out = folder / "runs" / f"{tag}-{preset}"
    runner.run(open_source(sequence), out, make_config(preset, sigma_p_px=None, sigma_m_px=None))
    run = read_run(out)
    assert run.truth is not None
    return FlownRun(run, motion_errors(run.log, run.truth), sequence)


def moving(errors: MotionErrors) -> Array:
    """(M,) bool: motions faster than a tenth of the flight's median speed; at rest there is no percentage."""
    length = np.linalg.norm(errors.T_true[:, :3, 3], axis=1)
    return length > 0.1 * np.median(length[length > 1e-4])


def scale_percent(errors: MotionErrors) -> float:
    """Error of the travelled length, along the true motion, in percent."""
    keep = moving(errors)
    t = errors.T_true[keep, :3, 3]
    along = (errors.T_est[keep, :3, 3] * t).sum(1) / np.linalg.norm(t, axis=1)
    return float(100 * (along.sum() / np.linalg.norm(t, axis=1).sum() - 1))


def mean_error_percent(errors: MotionErrors) -> float:
    """Length of the mean translation error over the mean motion, in percent: what does not average out."""
    keep = moving(errors)
    usual = np.linalg.norm(errors.T_true[keep, :3, 3], axis=1).mean()
    return float(100 * np.linalg.norm(errors.xi[keep, :3].mean(0)) / usual)


def drift_percent(flown: FlownRun) -> float:
    """Position error at the end over the path, first poses equal, in percent."""
    from gpvo.evaluation.evaluate import evaluate_run

    found = evaluate_run(flown.run).trajectory
    return 100 * found.final_error_m / found.path_length_m


def _interval(values: list[float]) -> dict[str, Any]:
    return {**sequence_bootstrap(np.array(values)).document(), "values": values}


def clean(folder: Path, seeds: int) -> dict[str, Any]:
    """Mean error and scale error of clean flights with a perfect calibration."""
    flown = [fly(seed=s, folder=folder, **CLEAN) for s in range(seeds)]
    return {
        "mean_error_percent": _interval([mean_error_percent(f.errors) for f in flown]),
        "scale_percent": _interval([scale_percent(f.errors) for f in flown]),
        "drift_percent": _interval([drift_percent(f) for f in flown]),
    }


def baseline(folder: Path, seeds: int) -> dict[str, Any]:
    """Scale error where the true baseline is 1 % longer than the written one."""
    off: dict[str, Any] = {"calibration_offset__baseline": 0.01}
    flown = [fly(seed=s, folder=folder, **CLEAN, **off) for s in range(min(seeds, 4))]
    return {"scale_percent": _interval([scale_percent(f.errors) for f in flown])}


def noise(folder: Path, seeds: int) -> dict[str, Any]:
    """Features, stated sigma and drift of the same flights, clean and with image noise."""
    out: dict[str, Any] = {}
    for preset in ("fast", "thesis"):
        for scenario in ("tunnel-clean", "tunnel-noise"):
            values = {**CLEAN, "scenario": scenario, "preset": preset}
            out[f"{scenario}, {preset}"] = _told([fly(seed=s, folder=folder, **values) for s in range(min(seeds, 4))])
    return out


def _told(flown: list[FlownRun]) -> dict[str, Any]:
    """What the logs say of themselves, beside the true error: medians over all frames."""
    logs = [f.run.log for f in flown]
    sigma = [np.sqrt(np.trace(r.covariances["pointing_matching"][:3, :3])) for log in logs for r in log if r.usable]
    columns = ("n_inliers", "reproj_rms_px", "residual_sigma_m_px", "noise_level")
    return {
        "drift_percent": _interval([drift_percent(f) for f in flown]),
        "rms_error_mm": 1e3 * float(np.sqrt(np.mean([(f.errors.xi[:, :3] ** 2).sum(1).mean() for f in flown]))),
        "stated_sigma_mm": 1e3 * float(np.median(sigma)),
        **{c: float(np.nanmedian(np.concatenate([log.column(c)[1:] for log in logs]))) for c in columns},
    }


def bursts(folder: Path, seeds: int) -> dict[str, Any]:
    """Rise of the error's standard deviation inside the episodes, by axis and by cause."""
    flown = [fly("tunnel-bursts", s, folder, duration_s=30.0, rate_hz=10.0) for s in range(min(seeds, 4))]
    inside, outside, lost = _episodes(flown)
    quiet = outside.std(0)
    everything = np.concatenate(list(inside.values()))
    far, near = ((xi[:, :3] ** 2).sum(1).mean() for xi in (everything, outside))
    return {
        "rise_by_axis": (everything.std(0) / quiet).tolist(),
        "rise_translation": float(np.sqrt(far / near)),
        "rise_by_cause": {c: float(np.sqrt(((x / quiet) ** 2).mean())) for c, x in sorted(inside.items())},
        "share_inside": len(everything) / (len(everything) + len(outside)),
        "lost_inside": lost,
    }


def _episodes(flown: list[FlownRun]) -> tuple[Mapping[str, Array], Array, int]:
    """Errors inside the episodes by cause and outside of all, and how many frames inside were lost."""
    inside: dict[str, list[Array]] = {}
    outside, lost = [], 0
    for f in flown:
        document = json.loads((f.sequence / "episodes.json").read_text(encoding="utf-8"))
        t = (f.run.log.t_ns[f.errors.index] - document["t_start_ns"]) * 1e-9
        t_all = (f.run.log.t_ns - document["t_start_ns"]) * 1e-9
        free = np.ones(len(t), bool)
        for e in document["episodes"]:
            # A motion counts if either of its frames does.
            within = (t >= e["begin_s"]) & (t - f.errors.dt_s < e["end_s"])
            inside.setdefault(e["cause"], []).append(f.errors.xi[within])
            free &= ~within
            lost += sum(not r.usable for r, s in zip(f.run.log, t_all, strict=True) if e["begin_s"] <= s < e["end_s"])
        outside.append(f.errors.xi[free])
    return {c: np.concatenate(x) for c, x in inside.items()}, np.concatenate(outside), lost


def lunar(folder: Path, seeds: int) -> dict[str, Any]:
    """Two hundred metres over the moon, with pictures."""
    flown = fly("lunar-straight", 0, folder)
    statuses = [r.status.value for r in flown.run.log]
    path = float(np.linalg.norm(flown.errors.T_true[:, :3, 3], axis=1).sum())
    return {
        "path_m": path,
        "drift_percent": drift_percent(flown),
        "statuses": {s: statuses.count(s) for s in set(statuses)},
    }


EXPERIMENTS = {f.__name__: f for f in (clean, baseline, noise, bursts, lunar)}


def main() -> None:
    """Run the experiments and write ``simulator.json``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--only", default=",".join(EXPERIMENTS))
    given = parser.parse_args()
    document: dict[str, Any] = {"schema": 1, "seeds": given.seeds}
    for name in given.only.split(","):
        document[name] = EXPERIMENTS[name](given.out, given.seeds)
        print(name, json.dumps(document[name], indent=1), flush=True)
        write_json(given.out / "simulator.json", document)


if __name__ == "__main__":
    main()
