"""The scoreboard of honesty: covariances that anybody states of their motions, judged by files alone.

Each sequence is a file of stated motions (:mod:`gpvo.io.stated`) and its truth. Rules: sequences, not frames, carry the
intervals; the truth's noise is declared and counted in; a lost motion is charged as the statement that nothing moved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpvo.dataset.build import leave_out
from gpvo.dataset.doubtful import false_motions, in_waits
from gpvo.errors import SourceError
from gpvo.evaluation.evaluate import EvaluateOptions, Evaluation, distinct, evaluate_run
from gpvo.evaluation.statements import corrected
from gpvo.files import columns_of, write_csv, write_json
from gpvo.geometry import se3
from gpvo.io.foreign import read_foreign
from gpvo.io.run_read import Run
from gpvo.io.stated import read_stated, to_records, write_stated
from gpvo.io.trajectory import check_overlap, read_tum, write_tum
from gpvo.online.features import AXES
from gpvo.online.predictor import Predictor
from gpvo.stats.series import sequence_bootstrap
from gpvo.types import IMPORTED, Array, Mounting, Status, StoredRecords, TruthLog, VoLog, VoRecord

if TYPE_CHECKING:
    from gpvo.learning.config import TrainConfig
    from gpvo.learning.train import TrainedModel

POOLED = ("energy_translation_m", "energy_rotation_rad", "nll_per_dim", "nees_dof", "correlation_gain_nats")
"""Scores that are averaged over the sequences, with an interval by whole sequences."""

_WHOLE = 0.95


def score(files: Sequence[tuple[Path, Path]], options: EvaluateOptions | None = None) -> dict[str, Any]:
    """Scores of pairs (stated, truth), per ``sequences`` and ``pooled`` with 95 % intervals over the sequences.

    Raises SourceError where a file is malformed, or states nothing while its truth lasts.
    """
    scores = [score_sequence(stated, truth, options) for stated, truth in files]
    pooled = {name: sequence_bootstrap(np.array([s[name] for s in scores])).document() for name in POOLED}
    return {
        "schema": 1,
        "sequences": scores,
        "pooled": {**pooled, **{name: sum(s[name] for s in scores) for name in ("motions", "lost")}},
    }


def score_sequence(stated: Path, truth: Path, options: EvaluateOptions | None = None) -> dict[str, Any]:
    """Scores of one file of stated motions against TUM poses of the same camera: means over the motions.

    ``nees_dof_over`` {"1s", "1m", "10m", "100m"}: None where none fits. ``axes``: names of those that NLL and NEES are
    of, see :func:`gpvo.stats.consistency.seen_axes`.
    """
    log, poses = _read(stated), read_tum(truth)
    of_poses = TruthLog(poses.t_ns, poses.T_world_body)
    check_overlap(of_poses, log.t_ns, truth)
    options = options or EvaluateOptions()
    # The judge declares the truth's noise. An estimate would depend on the method that is judged.
    options = replace(options, truth_sigma=options.truth_sigma or (0.0, 0.0))
    run = Run(stated, stated.stem, log, of_poses, None, Mounting(), [])
    evaluation = evaluate_run(run, options=options)
    c, usable = evaluation.consistency.get(IMPORTED), int(log.usable.sum())
    if c is None or c.nll_per_dim is None or c.one_second is None:
        what = f"states {usable} of {len(log) - 1} motions, of which fewer than two have truth"
        raise SourceError(what, where=stated, cure="see --truth")
    charged_m, charged_rad = _charged(log, evaluation)
    joint = c.nees_dof["joint"]
    over = {"1s": c.one_second, **{f"{h.span:g}m": h for h in c.horizons}}
    return {
        "sequence": stated.stem,
        "motions": usable,
        "lost": int(log.lost.sum()),
        "axes": tuple(AXES[k] for k in c.axes),
        "energy_translation_m": _mean_with(c.energy["translation_m"] or 0.0, c.count, charged_m),
        "energy_rotation_rad": _mean_with(c.energy["rotation_rad"] or 0.0, c.count, charged_rad),
        "nll_per_dim": c.nll_per_dim,
        "nees_dof": np.nan if joint is None else joint.mean,
        "nees_dof_over": {n: h.nees_dof_truth_noise if h.count else None for n, h in over.items()},
        "nees_dof_by_difficulty": tuple(c.by_difficulty["nees_dof"] or ()),
        "coverage_by_difficulty": tuple(c.by_difficulty["coverage"] or ()),
        "correlation_gain_nats": c.correlation_gain_nats or 0.0,
        "ate_rmse_m": evaluation.trajectory.ate_rmse_m,
    }


def _read(stated: Path) -> VoLog:
    """A file of stated motions; or a CSV with a header, its covariances those of motions in the axes of the frame."""
    if stated.suffix.lower() != ".csv":
        return read_stated(stated)
    log = read_foreign(stated, "csv", covariance_of="motion", covariance_axes="body")
    if log.covariance is None:
        raise SourceError("states no covariances", where=stated, cure="add columns cov_00, cov_01, ... of the motions")
    pairs = zip(to_records(log)[0], log.covariance, strict=True)
    return VoLog(StoredRecords.of(_owned_up(record, C, stated) for record, C in pairs))


def _owned_up(record: VoRecord, covariance: Array, where: Path) -> VoRecord:
    """A motion without a covariance is lost: what a method does not state, it cannot be spared for."""
    if not record.usable or IMPORTED in record.covariances:
        return record
    if np.isfinite(covariance).all():
        when = f"{record.t_ns * 1e-9:.9f} s"
        cure = "write nan for a motion that is lost"
        raise SourceError(f"the covariance at {when} is not positive definite", where=where, cure=cure)
    return replace(record, status=Status.LOST, reason="no covariance")


def score_folder(folder: Path, options: EvaluateOptions | None = None) -> dict[str, dict[str, Any]]:
    """Scores of every ``METHOD/SEQUENCE.txt`` (or ``.csv``) of a folder against its ``truth/SEQUENCE.txt``, by method,
    the likeliest first.

    Raises SourceError where there is no truth, or a method leaves a sequence out: then the means could not be compared.
    """
    truths = sorted((folder / "truth").glob("*.txt"))
    if not truths:
        cure = "gpvo evaluate RUN --stated makes such folders"
        raise SourceError("holds no truth/SEQUENCE.txt", where=folder, cure=cure)
    found = {}
    # A name that begins with a dot is some other tool's.
    for method in sorted(p for p in folder.glob("[!.]*") if p.is_dir() and p.name != "truth"):
        pairs = [(_of_sequence(method, truth), truth) for truth in truths]
        found[method.name] = {"method": method.name, **score(pairs, options)}
    if not found:
        raise SourceError("holds no method beside truth", where=folder, cure="a method's files are METHOD/SEQUENCE.txt")
    return dict(sorted(found.items(), key=lambda item: item[1]["pooled"]["nll_per_dim"]["mean"]))


def _of_sequence(method: Path, truth: Path) -> Path:
    for path in (method / truth.name, method / f"{truth.stem}.csv"):
        if path.is_file():
            return path
    cure = "each method must state all sequences"
    raise SourceError(f"states nothing for the sequence {truth.stem}", where=method, cure=cure)


def write_board(found: Mapping[str, Mapping[str, Any]], folder: Path) -> None:
    """``METHOD.json`` each, and ``board.csv`` with a line per method."""
    for method, scores in found.items():
        write_json(folder / f"{method}.json", dict(scores), (b'"nees_dof_over"', "scores of a method"))
    write_csv(folder / "board.csv", board(found))


def board(found: Mapping[str, Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Columns of the table of methods, to three digits: means over the sequences."""
    rows = []
    for method, scores in found.items():
        pooled, sequences = scores["pooled"], scores["sequences"]
        row: dict[str, Any] = {
            "energy [mm]": 1e3 * pooled["energy_translation_m"]["mean"],
            "energy [mrad]": 1e3 * pooled["energy_rotation_rad"]["mean"],
            "NLL": pooled["nll_per_dim"]["mean"],
            "NEES": pooled["nees_dof"]["mean"],
        }
        for span in ("1s", "10m", "100m"):
            known = [v for s in sequences if (v := s["nees_dof_over"][span]) is not None]
            row[f"NEES {span}"] = float(np.mean(known)) if known else None
        covered = np.mean([s["coverage_by_difficulty"] for s in sequences], axis=0)
        row |= {"easy": covered[0], "hard": covered[-1]}
        digits = {name: None if value is None else float(f"{value:.3g}") for name, value in row.items()}
        rows.append({"method": method, **digits})
    return columns_of(rows)


def on_other_axes(found: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[str, ...]]:
    """Methods whose NLL and NEES are, in a sequence, of other axes than those of the method with the most there; and of
    which in the sequence with the fewest.

    As of a robot in a plane, whose height never differs from the truth's: such numbers do not compare.
    """
    axes = {m: {s["sequence"]: tuple(s["axes"]) for s in scores["sequences"]} for m, scores in found.items()}
    most: dict[str, tuple[str, ...]] = {}
    for judged in axes.values():
        for sequence, names in judged.items():
            most[sequence] = max(most.get(sequence, ()), names, key=len)
    other = {m: [names for s, names in judged.items() if names != most[s]] for m, judged in axes.items()}
    return {method: min(names, key=len) for method, names in other.items() if names}


def with_fewer_motions(found: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[str, int, int]]:
    """Methods that state less than 95 % of the motions, lost ones included, that another states of a sequence: the
    sequence of which they state the smallest share, how many there, and how many the other.

    They break off, begin late, or leave frames out. What a file says nothing of, it is not charged for.
    """
    count = {m: {s["sequence"]: s["motions"] + s["lost"] for s in scores["sequences"]} for m, scores in found.items()}
    out = {}
    for method, own in count.items():
        most = {name: max(of[name] for of in count.values() if name in of) for name in own}
        worst = min(own, key=lambda name: own[name] / most[name])
        if own[worst] < _WHOLE * most[worst]:
            out[method] = worst, own[worst], most[worst]
    return out


def _mean_with(mean: float, count: int, charged: Array) -> float:
    return float((mean * count + charged.sum()) / (count + len(charged)))


def _charged(log: VoLog, e: Evaluation) -> tuple[Array, Array]:
    """Energy scores of lost motions, translation [m] and rotation [rad]: the length of the true motion, which is what
    the certainty that nothing moved would score."""
    start = log.parent
    ends = np.flatnonzero(log.lost & e.covered & e.covered[start])
    moved = se3.log(se3.inverse(e.T_true[start[ends]]) @ e.T_true[ends]).reshape(-1, 6)
    return np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)


def write_left_out(trained: TrainedModel, runs: Sequence[Run], config: TrainConfig, folder: Path) -> None:
    """What each method, fitted to the other runs, or to those of other parts where they are many, states of every run:
    the training's table, as files.

    ``trained`` from the same ``runs``, in their order, with its folds kept in ``config.keep``.
    """
    from gpvo.learning.train import MOST_FOLDS, fold_model  # loads torch, which judging does without

    assert config.keep is not None
    names = distinct([run.name for run in runs])
    options = EvaluateOptions(align=config.align, time_offset_s=config.time_offset_s)
    for held_out, others in leave_out(list(zip(trained.sets, names, runs, strict=True)), MOST_FOLDS):
        sets, learned_from = ([s for s, *_ in part] for part in (held_out, others))
        predictor = Predictor.load(fold_model(sets, learned_from, config, config.keep))
        for _, name, run in held_out:
            write_statements(evaluate_run(run, predictor, options), folder, name, waits=config.waits)


def write_statements(evaluation: Evaluation, folder: Path, name: str, waits: str = "drop") -> int:
    """What each method states of a run's motions, a file per method ``METHOD/RUN.txt``, and the ``truth/RUN.txt``; how
    many methods there are.

    Truth that wanders while the vehicle stands, or jumps, is left out of its file, except with ``waits`` "keep".
    """
    log, name, known = evaluation.run.log, f"{name}.txt", evaluation.covered
    if waits == "drop" and evaluation.unscored and evaluation.run.truth is not None:
        waiting = false_motions(log, evaluation.run.truth)
        for first, last in waiting:
            known = known & ~((log.t_ns > first) & (log.t_ns < last))
        # A motion over the whole wait still has truth at both ends.
        known = known & ~(in_waits(log, waiting) & known[log.parent])
    write_tum(folder / "truth" / name, log.t_ns[known], evaluation.T_true[known])
    count = 0
    for statement in (s for s in evaluation.statements if s.dof == 6):
        T, C = corrected(log, statement.mean), np.where(log.usable[:, None, None], statement.covariance, np.nan)
        write_stated(folder / statement.method / name, log, T, C)
        count += 1
    return count
