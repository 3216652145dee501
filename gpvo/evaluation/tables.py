"""Everything of an evaluation as plain files: for evo, for plots of one's own, and for papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.evaluation.evaluate import Evaluation, document
from gpvo.io.atomic import write_text
from gpvo.io.tables import write_csv
from gpvo.io.trajectory import write_tum
from gpvo.online.features import AXES


def write_tables(e: Evaluation, folder: Path, name: str) -> list[Path]:
    """``NAME_est.tum`` and ``NAME_truth.tum`` (evo: ``evo_ape tum NAME_truth.tum NAME_est.tum``), ``NAME_motions.csv``
    (each motion's error and every method's sigma), and ``NAME_methods.csv`` and ``.tex`` (scores)."""
    folder.mkdir(parents=True, exist_ok=True)
    log, known = e.run.log, e.covered
    paths = [
        folder / f"{name}_{kind}" for kind in ("est.tum", "truth.tum", "motions.csv", "methods.csv", "methods.tex")
    ]
    write_tum(paths[0], log.t_ns[known], e.T_est[known])
    write_tum(paths[1], log.t_ns[known], e.T_true[known])
    rows = e.errors.index
    columns: dict[str, Any] = {"t_s": log.t_ns[rows] * 1e-9, "dt_s": e.errors.dt_s}
    columns |= {f"error_{a}": e.errors.xi[:, i] for i, a in enumerate(AXES)}
    for s in e.statements:
        sigma = np.sqrt(np.diagonal(s.covariance[rows], axis1=1, axis2=2))
        columns |= {f"{s.method}_sigma_{a}": sigma[:, i] for i, a in enumerate(AXES[: s.dof])}
    write_csv(paths[2], columns)
    scores = _scores(document([e])["runs"][0]["methods"])
    write_csv(paths[3], scores)
    write_text(paths[4], latex(scores))
    return paths


def _scores(methods: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Columns of the methods that were scored."""
    out: dict[str, list[Any]] = {}
    for method, m in methods.items():
        if m["nll_per_dim"] is None:
            continue
        over = {f"nees_{h['length_m']:g}m": h["nees_dof_truth_noise"] for h in m["horizons"]}
        row = {"method": method, "nees": m["nees_dof"]["joint"], "nees_median": m["nees_dof_median"]["joint"]}
        row |= {"nees_1s": m["one_second"]["nees_dof_truth_noise"], **over, "nll": m["nll_per_dim"]}
        row |= {f"within_{k}_sigma": share for k, share in m["coverage"].items()}
        row |= {f"energy_{unit}": m["energy"][unit] for unit in ("translation_m", "rotation_rad")}
        for key, value in row.items():
            out.setdefault(key, []).append(value)
    return out


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
