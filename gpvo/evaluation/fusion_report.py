"""What ``gpvo fuse`` writes for machines: the JSON document, and a log of innovations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.evaluation.fusion import FusionReport, Trace
from gpvo.files import write_text
from gpvo.filters.gate import chi2_quantile
from gpvo.filters.metrics import Scores
from gpvo.filters.policies import LEARNED
from gpvo.filters.run import FusedRun
from gpvo.filters.study import Study
from gpvo.types import Array

_AXES = ("x_m", "y_m", "z_m", "rot_x_rad", "rot_y_rad", "rot_z_rad")


def write_log(path: Path, fused: FusedRun) -> None:
    """A line per record: what was done with it, NIS, innovation and its standard deviation per axis (camera frame)."""
    header = ["t_ns", "outcome", "nis", *(f"innovation_{a}" for a in _AXES), *(f"sigma_{a}" for a in _AXES)]
    lines = [",".join(header)]
    for step in fused.steps:
        values = [np.nan] * 13
        if step.innovation is not None:
            sigma = np.sqrt(np.diagonal(step.innovation.S[0]))
            values = [step.innovation.nis[0], *step.innovation.residual[0], *sigma]
        lines.append(",".join([str(step.t_ns), step.outcome, *(f"{v:.9g}" if np.isfinite(v) else "" for v in values)]))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GpvoError(f"cannot be written: {error.strerror}", where=path) from None
    write_text(path, "\n".join(lines) + "\n", "ascii")


def document(report: FusionReport) -> dict[str, Any]:
    """The machine-readable result of ``gpvo fuse``; a policy that could not run is null."""
    result = report.study
    names = list(result.scores)
    runs = [
        {"run": run, "policies": {name: _score(result.scores[name][i]) for name in names}}
        for i, run in enumerate(result.runs)
    ]
    others = [n for n in names if n != LEARNED] if LEARNED in names else []
    return {
        "schema": 1,
        "runs": runs,
        "mean": {name: _mean(result, name, report.traces) for name in names},
        "comparisons": [_comparison(result, LEARNED, other) for other in others],
        "constants": None if result.constants is None else asdict(result.constants),
        "warnings": list(report.warnings),
        "simulated_truth": list(report.simulated_truth),
    }


def _score(scores: Scores | None) -> dict[str, Any] | None:
    if scores is None:
        return None
    return {
        "ate_rmse_m": scores.ate_rmse_m,
        "final_error_m": scores.final_error_m,
        "drift_percent": scores.drift_percent,
        "nees_dof": scores.nees_dof,
        "nis_dof": scores.nis_dof,
        "nis_dof_interval": [scores.nis_interval.low, scores.nis_interval.high],
        "rejected": scores.rejected,
        "diverged": scores.diverged,
    }


def _mean(result: Study, name: str, traces: Sequence[Trace]) -> dict[str, Any] | None:
    if all(s is None for s in result.scores[name]):
        return None
    keys = ("ate_rmse_m", "final_error_m", "drift_percent", "nis_dof", "rejected")
    out: dict[str, Any] = {key: result.mean(name, key) for key in keys}
    nees = {part: result.mean(name, f"nees_{part}") for part in ("position", "attitude")}
    out["nis_in_band_percent"] = nis_in_band_percent([t for t in traces if t.policy == name])
    return {**out, "nees_dof": nees, "diverged": result.diverged(name)}


def _comparison(result: Study, policy: str, against: str) -> dict[str, Any] | None:
    compared = result.compare(policy, against)
    if not np.isfinite(compared.gain_percent):
        return None
    d = compared.difference_m
    return {
        "policy": policy,
        "against": against,
        "gain_percent": compared.gain_percent,
        "ate_difference_m": d.mean,
        "interval_m": [d.low, d.high],
    }


def nis_over_runs(traces: Sequence[Trace]) -> tuple[Array, NDArray[np.int64]]:
    """Mean NIS per degree of freedom over runs at each step of the shortest, and how many runs measured there."""
    length = min((len(t.t_s) for t in traces), default=0)
    nis = np.array([t.nis_dof[:length] for t in traces]).reshape(len(traces), length)
    known = np.isfinite(nis).sum(axis=0)
    return np.where(known > 0, np.nansum(nis, axis=0) / np.maximum(known, 1), np.nan), known


def nis_in_band_percent(traces: Sequence[Trace]) -> float:
    """Share of the steps whose mean NIS lies in the 95 % chi-square band of as many runs: 95 where all is right."""
    mean, known = nis_over_runs(traces)
    bands = {int(n): nis_band(int(n)) for n in np.unique(known) if n > 0}
    inside = [bands[int(n)][0] <= m <= bands[int(n)][1] for m, n in zip(mean, known, strict=True) if n > 0]
    return 100.0 * float(np.mean(inside)) if inside else float("nan")


def nis_band(runs: int, level: float = 0.95, dof: int = 6) -> tuple[float, float]:
    """Where the mean NIS per degree of freedom over so many runs should lie at each time step."""
    total = dof * runs
    return chi2_quantile((1 - level) / 2, total) / total, chi2_quantile((1 + level) / 2, total) / total
