"""Plain files of an evaluation: evo reads the trajectories, and the tables hold the scores."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from gpvo.evaluation.document import document, latex, write_tables
from gpvo.evaluation.evaluate import evaluate_run
from gpvo.io.run import read_run

ROOT = Path(__file__).parents[2]


def test_evo_and_spreadsheets_read_them(tmp_path: Path) -> None:
    evo_metrics = pytest.importorskip("evo.core.metrics")
    from evo.tools import file_interface

    e = evaluate_run(read_run(ROOT / "data" / "unseen"))
    write_tables(e, tmp_path, "unseen")
    truth, estimate = (file_interface.read_tum_trajectory_file(tmp_path / f"unseen_{k}.tum") for k in ("truth", "est"))
    estimate.align(truth)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    assert ape.get_statistic(evo_metrics.StatisticsType.rmse) == pytest.approx(e.trajectory.ate_rmse_m, rel=1e-4)
    rows = list(csv.DictReader((tmp_path / "unseen_motions.csv").open()))
    assert len(rows) == len(e.errors.index)
    assert float(rows[7]["error_z"]) == e.errors.xi[7, 2]
    sigma = np.sqrt(e.run.log.covariance("triangulation")[e.errors.index[7], 2, 2])
    assert float(rows[7]["triangulation_sigma_z"]) == pytest.approx(sigma, rel=1e-12)
    scores = {r["method"]: r for r in csv.DictReader((tmp_path / "unseen_methods.csv").open())}
    m = document([e])["runs"][0]["methods"]["triangulation"]
    assert float(scores["triangulation"]["nll"]) == m["nll_per_dim"]
    assert float(scores["triangulation"]["nees_1s"]) == m["one_second"]["nees_dof_truth_noise"]


def test_latex_escapes_names_and_marks_what_is_unknown() -> None:
    text = latex({"method": ["a_b"], "nees": [1.23456], "nll": [None]})
    assert r"a\_b & 1.23 & -- \\" in text
    assert text.startswith(r"\begin{tabular}{lrr}")
