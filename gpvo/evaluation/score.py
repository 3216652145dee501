"""The scoreboard of honesty: covariances that anybody states of their motions, judged by files alone.

Each sequence is a file of stated motions (:mod:`gpvo.io.stated`) and its truth. Rules: sequences, not frames, carry the
intervals; the truth's noise is declared and counted in; a lost motion is charged as the statement that nothing moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.errors import SourceError
from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, evaluate_run
from gpvo.geometry import se3
from gpvo.io.run_read import Run
from gpvo.io.stated import read_stated, write_stated
from gpvo.io.trajectory import read_tum, write_tum
from gpvo.stats.bootstrap import sequence_bootstrap
from gpvo.types import IMPORTED, Array, Mounting, Status, TruthLog, VoLog

POOLED = ("energy_translation_m", "energy_rotation_rad", "nll_per_dim", "nees_dof", "correlation_gain_nats")
"""Scores that are averaged over the sequences, with an interval by whole sequences."""


@dataclass(frozen=True)
class SequenceScore:
    """Of one sequence. Means over its motions; ``nees_dof_over`` {"1s", "1m", "10m", "100m"} None where none fits."""

    sequence: str
    motions: int
    lost: int
    energy_translation_m: float
    energy_rotation_rad: float
    nll_per_dim: float
    nees_dof: float
    nees_dof_over: dict[str, float | None]
    nees_dof_by_difficulty: tuple[float, ...]
    coverage_by_difficulty: tuple[float, ...]
    correlation_gain_nats: float
    ate_rmse_m: float


def score(files: Sequence[tuple[Path, Path]], options: EvaluateOptions | None = None) -> dict[str, Any]:
    """Scores of pairs (stated, truth), per ``sequences`` and ``pooled`` with 95 % intervals over the sequences.

    Raises
    ------
    SourceError
        Where a file is malformed, or states nothing while its truth lasts.
    """
    scores = [score_sequence(stated, truth, options) for stated, truth in files]
    pooled = {name: sequence_bootstrap(np.array([getattr(s, name) for s in scores])).document() for name in POOLED}
    return {
        "schema": 1,
        "sequences": [asdict(s) for s in scores],
        "pooled": {**pooled, "motions": sum(s.motions for s in scores), "lost": sum(s.lost for s in scores)},
    }


def score_sequence(stated: Path, truth: Path, options: EvaluateOptions | None = None) -> SequenceScore:
    """Scores of one file of stated motions against TUM poses of the same camera."""
    log, poses = read_stated(stated), read_tum(truth)
    options = options or EvaluateOptions()
    # The judge declares the truth's noise. An estimate would depend on the method that is judged.
    options = replace(options, truth_sigma=options.truth_sigma or (0.0, 0.0))
    run = Run(stated, stated.stem, log, TruthLog(poses.t_ns, poses.T_world_body), None, Mounting(), [])
    evaluation = evaluate_run(run, options=options)
    c = evaluation.consistency.get(IMPORTED)
    if c is None or c.energy_rotation_rad is None or c.nll_per_dim is None or c.one_second is None:
        raise SourceError("states fewer than two motions with truth", where=stated)
    usable, lost = int(log.usable.sum()), sum(r.status is Status.LOST for r in log)
    charged_m, charged_rad = _charged(log, evaluation)
    joint = c.nees_dof["joint"]
    over = {"1s": c.one_second, **{f"{h.span:g}m": h for h in c.horizons}}
    return SequenceScore(
        sequence=stated.stem,
        motions=usable,
        lost=lost,
        energy_translation_m=_mean_with(c.energy_translation_m, c.count, charged_m),
        energy_rotation_rad=_mean_with(c.energy_rotation_rad, c.count, charged_rad),
        nll_per_dim=c.nll_per_dim,
        nees_dof=np.nan if joint is None else joint.mean,
        nees_dof_over={n: h.nees_dof_truth_noise if h.count else None for n, h in over.items()},
        nees_dof_by_difficulty=c.nees_dof_by_difficulty,
        coverage_by_difficulty=c.coverage_by_difficulty,
        correlation_gain_nats=c.correlation_gain_nats,
        ate_rmse_m=evaluation.trajectory.ate_rmse_m,
    )


def _mean_with(mean: float, count: int, charged: Array) -> float:
    """Mean over the stated motions and the charged ones."""
    return float((mean * count + charged.sum()) / (count + len(charged)))


def _charged(log: VoLog, e: Evaluation) -> tuple[Array, Array]:
    """Energy scores of lost motions, translation [m] and rotation [rad]: the length of the true motion, which is what
    the certainty that nothing moved would score."""
    start = log.parent
    ends = [k for k, r in enumerate(log) if r.status is Status.LOST and e.covered[k] and e.covered[start[k]]]
    moved = se3.log(se3.inverse(e.T_true[start[ends]]) @ e.T_true[ends]).reshape(-1, 6)
    return np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)


def write_statements(evaluation: Evaluation, folder: Path, name: str) -> list[Path]:
    """What each method states of a run's motions, a file per method ``METHOD/RUN.txt``, and the ``truth/RUN.txt``."""
    log, name = evaluation.run.log, f"{name}.txt"
    truth = folder / "truth" / name
    truth.parent.mkdir(parents=True, exist_ok=True)
    write_tum(truth, log.t_ns[evaluation.covered], evaluation.T_true[evaluation.covered])
    written = [truth]
    for statement in evaluation.statements:
        if statement.dof != 6:
            continue
        T, C = corrected(log, statement.mean), np.where(log.usable[:, None, None], statement.covariance, np.nan)
        path = folder / statement.method / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_stated(path, log, T, C)
        written.append(path)
    return written


def corrected(log: VoLog, mean: Array) -> Array:
    """(N, 4, 4) poses of the log with the predicted ``mean`` (N, 6) taken off each motion."""
    T, parent = log.T_prev_cur @ se3.exp(-mean), log.parent
    out = np.empty_like(T)
    for k in range(len(T)):
        out[k] = T[k] if parent[k] < 0 else out[parent[k]] @ T[k]
    return out
