"""Evaluations as plain values and files: for scripts, evo, plots of your own and papers."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.evaluation.consistency import HORIZONS_M, UNITS, Consistency, Horizon
from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.trajectory import nees_document
from gpvo.evaluation.verdict import verdict
from gpvo.files import columns_of, write_csv, write_text
from gpvo.geometry.covariance import variances
from gpvo.io.trajectory import write_tum
from gpvo.learning.methods import METHODS
from gpvo.online.features import AXES
from gpvo.stats.series import sequence_bootstrap
from gpvo.types import Array, Status


def document(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """The result for scripts; what could not be computed is None. SI units; the names are part of the interface.

    ``pooled``: for each method, ``nll_per_dim`` and ``nees_dof``, with the truth's noise, {``mean``, ``low``, ``high``}
    over the runs. For each run, besides its name, counts, path length, ATE and segments:

    * ``degraded``: frames of that status, by the odometry or a model. ``lost`` are counted apart.
    * ``truth_moves_at_rest``: motions that are not scored, because the vehicle stands still while the truth moves, or
      the truth jumps; they count only in ATE, final error and RPE.
    * ``odd_stretches``: motions, in words, in which odometry and truth differ far more than elsewhere; scored,
      unless they are jumps of the truth.
    * ``in_domain``: share of the measured motions in the model's training domain.
    * ``poses`` {``count``, ``position``, ``orientation``, ``joint``}: NEES of the pose covariances that a filter's log
      states (see :class:`gpvo.evaluation.trajectory.PoseConsistency`); None where it states none.
    * ``verdict`` {``colour``, ``headline``, ``lines``, ``judged``}: what the numbers amount to, in words; ``judged``:
      whether any covariance could be.
    * ``time_offset_s``: what was taken off the truth's clock, given or estimated. ``clocks_differ_by_s``: what seems to
      remain of it, None if it does not matter.
    * ``truth_sigma`` {``translation_m``, ``rotation_rad``}: noise of the truth per pose, root mean square over axes,
      as used: what ``--truth-sigma`` says, else what the source states (``truth_sigma_stated``) or the run shows
      (:func:`gpvo.dataset.truth_noise.estimate_truth_noise`), whichever is larger. ``truth_sigma_axes``: by axis, x y z
      [m], then [rad], over the run. ``truth_jitter_s``: the jitter of its stamps that these hold.
      ``truth_tells_from_m``: length of path from which odometry's errors outweigh it; 0: every motion; None: nowhere.
    * ``fixed_rotation`` {``angle_deg``, ``rotvec_rad``, ``error_change``, ``lever_m``, ``scale``, ``align_change``}:
      between truth and odometry, None if nothing of it matters; ``lever_m`` between their origins, 0 if that does not,
      and ``scale`` of the odometry's motions, 1 if that does not; ``error_change``: relative change of errors over a
      second without; ``align_change``: of what ``--align`` takes off, which fits no scale.
    * ``inverse_poses`` {``of``, ``error_change``, ``or_backwards``}: whose poses seem inverse; None: nobody's.
    * ``unlike`` {``scale``, ``motion``, ``turn``, ``path``}: how little odometry and truth resemble each other
      (:class:`gpvo.dataset.misread.Resemblance`), None where they do.
    * ``rpe`` {``frame``, ``1s``, ``10m``}: relative pose error over one frame, a second and ten metres of path, each
      {``translation_m``, ``rotation_rad``} with rmse, mean, median, std, min, max and the count of pairs. Pairs do not
      reach across a gap in the truth, nor over more than 2.5 times the span.

    For each method, besides NEES, coverage, NLL and CRPS:

    * ``axes``: those that count, named x y z rx ry rz; the rest never differ between odometry and truth.
    * ``nees_dof`` and ``nees_dof_interval``, by block, the latter the 95 % interval [low, high] by a bootstrap over
      blocks of time, are of what the method states alone; ``nees_dof_truth_noise`` and all other scores are with the
      truth's own noise added to it.
    * ``energy`` {``translation_m``, ``rotation_rad``}: energy score, the CRPS for vectors; it rewards sharpness and
      honesty together. ``correlation_gain_nats``: how much likelier the stated correlations make the errors.
      ``by_difficulty`` {``nees_dof``, ``coverage`` at one sigma}: in quartiles of rising stated uncertainty.
    * ``nll_per_dim`` treats every method as Gaussian; ``nll_stated_per_dim`` is that of the stated density, a Student-t
      for models that learned their tails, and ``nees_dof_median_stated`` the median NEES/dof that it implies.
    * ``one_second`` {``nees_dof``, ``nees_dof_truth_noise``, ``z2_truth_noise``, ``truth_drift_m``, ``count``}: of the
      motion over windows of a second, joint and (6,) by axis, and the truth's drift (3,) taken into account because its
      velocities contradict its positions; ``horizons`` are the same over lengths of path.
    * ``predicted_final_error_m``: root of the trace of the accumulated position covariance, by the method's parts;
      ``predicted_final_error_independent_m``: the same if all motions were independent.

    ``constant`` is for a motion of one frame: a motion that bridges lost frames has its covariance as many times over.
    ``gp_thesis`` needs a model file that holds it, as do all those written by this version.
    """
    runs = [run_document(e) for e in evaluations]
    return {"schema": 1, "runs": runs, "pooled": pooled(runs)}


def pooled(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over runs, by their documents, with 95 % intervals by whole runs, of the methods that speak of the motions
    of every run."""
    out: dict[str, Any] = {}
    runs = [d["methods"] for d in documents]
    for method in runs[0] if runs else ():
        scores = {
            "nll_per_dim": [r[method]["nll_per_dim"] for r in runs if method in r],
            "nees_dof": [r[method]["nees_dof_truth_noise"]["joint"] for r in runs if method in r],
        }
        if all(len(values) == len(runs) and None not in values for values in scores.values()):
            out[method] = {n: sequence_bootstrap(np.array(v, np.float64)).document() for n, v in scores.items()}
    return out


def run_document(e: Evaluation) -> dict[str, Any]:
    """One of the ``runs`` of :func:`document`."""
    t = e.trajectory
    counts = {s.value: e.run.log.statuses.count(s) for s in Status}
    suspected: dict[str, Any] = {"fixed_rotation": e.turned, "inverse_poses": e.inverse, "unlike": e.unlike}
    return {
        "run": e.run.name,
        "source": e.run.meta.get("source"),
        "frames": len(e.run.log),
        "lost": counts["lost"],
        "degraded": counts["degraded"],
        "truth_moves_at_rest": e.unscored,
        "odd_stretches": [str(s) for s in e.odd],
        "in_domain": e.in_domain,
        **{name: getattr(t, name) for name in ("path_length_m", "ate_rmse_m", "rmse_origin_m", "final_error_m")},
        "time_offset_s": e.time_offset_s,
        "clocks_differ_by_s": e.late_s,
        "truth_sigma": _by_kind(e.truth_sigma),
        "truth_sigma_axes": e.truth_sigma.tolist(),
        "truth_sigma_stated": _by_kind(e.truth_sigma_stated),
        "truth_jitter_s": e.truth_jitter_s,
        "truth_tells_from_m": e.tells_from_m,
        **{n: None if found is None else asdict(found) for n, found in suspected.items()},
        "rpe": {"frame": asdict(t.rpe_frame), "1s": asdict(t.rpe_second), "10m": asdict(t.rpe_10m)},
        "segments": [asdict(s) for s in t.segments],
        "poses": nees_document(e.poses),
        "verdict": asdict(verdict(e)),
        "methods": {
            m: _method_document(e.consistency.get(m) or Consistency(m))
            for m in dict.fromkeys((*METHODS, *e.consistency))
        },
    }


def _by_kind(sigma: Array) -> dict[str, float]:
    translation, rotation = np.sqrt((sigma.reshape(2, 3) ** 2).mean(axis=1))
    return {"translation_m": float(translation), "rotation_rad": float(rotation)}


def _horizon(h: Horizon | None) -> dict[str, Any]:
    keys = ("nees_dof", "nees_dof_truth_noise", "z2_truth_noise", "truth_drift_m")
    return {k: getattr(h, k, None) for k in keys} | {"count": 0 if h is None else h.count}


def _method_document(c: Consistency) -> dict[str, Any]:
    """Scores of one method; the same entries of one that says nothing."""
    plain = {name: value for name, value in vars(c).items() if name not in ("method", "count")}
    return plain | {
        "axes": [AXES[k] for k in c.axes] or None,
        "nees_dof": {b: i and i.mean for b, i in c.nees_dof.items()},
        "nees_dof_interval": {b: i and [i.low, i.high] for b, i in c.nees_dof.items()},
        "one_second": _horizon(c.one_second),
        "horizons": [{"length_m": m, **_horizon(h)} for m, h in itertools.zip_longest(HORIZONS_M, c.horizons)],
    }


def write_tables(e: Evaluation, folder: Path, name: str) -> None:
    """``NAME_est.tum`` and ``NAME_truth.tum`` (evo: ``evo_ape tum NAME_truth.tum NAME_est.tum``), ``NAME_motions.csv``
    (each motion's error and every method's sigma), and ``NAME_methods.csv`` and ``.tex`` (scores)."""
    log, known = e.run.log, e.covered
    write_tum(folder / f"{name}_est.tum", log.t_ns[known], e.T_est[known])
    write_tum(folder / f"{name}_truth.tum", log.t_ns[known], e.T_true[known])
    rows = e.errors.index
    columns: dict[str, Any] = {"t_s": log.t_ns[rows] * 1e-9, "dt_s": e.errors.dt_s}
    columns |= {f"error_{a}": e.errors.xi[:, i] for i, a in enumerate(AXES)}
    for s in e.statements:
        sigma = np.sqrt(variances(s.covariance[rows]))
        columns |= {f"{s.method}_sigma_{a}": sigma[:, i] for i, a in enumerate(AXES[: s.dof])}
    write_csv(folder / f"{name}_motions.csv", columns)
    scores = _scores(run_document(e)["methods"])
    write_csv(folder / f"{name}_methods.csv", scores)
    write_text(folder / f"{name}_methods.tex", latex(scores), own=(rb"\A\\begin\{tabular\}", "table"))


def _scores(methods: Mapping[str, Any]) -> dict[str, list[Any]]:
    rows = []
    for method, m in methods.items():
        if m["nll_per_dim"] is None:
            continue
        over = {f"nees_{h['length_m']:g}m": h["nees_dof_truth_noise"] for h in m["horizons"]}
        row = {"method": method, "nees": m["nees_dof"]["joint"], "nees_median": m["nees_dof_median"]["joint"]}
        row |= {"nees_1s": m["one_second"]["nees_dof_truth_noise"], **over, "nll": m["nll_per_dim"]}
        row |= {f"within_{k}_sigma": share for k, share in m["coverage"].items()}
        row |= {f"energy_{unit}": m["energy"][unit] for unit in UNITS}
        rows.append(row)
    return columns_of(rows)


def latex(columns: Mapping[str, Sequence[Any]]) -> str:
    """Columns as a LaTeX table of booktabs, numbers to three digits."""

    def cell(value: Any) -> str:
        if isinstance(value, str):
            return value.replace("_", r"\_")
        return "--" if value is None or not np.isfinite(value) else f"{value:.3g}"

    rows = [" & ".join(map(cell, row)) + r" \\" for row in zip(*columns.values(), strict=True)]
    head = " & ".join(map(cell, columns)) + r" \\"
    body = [r"\toprule", head, r"\midrule", *rows, r"\bottomrule"]
    spec = "l" + "r" * (len(columns) - 1)
    return "\n".join([rf"\begin{{tabular}}{{{spec}}}", *body, r"\end{tabular}"]) + "\n"
