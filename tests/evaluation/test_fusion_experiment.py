"""The experiment that measures a filter's gain: its flights, the rise of VO's error, its tables; whole, if slow."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from bench.experiment_flights import Campaign, Rise, rise, training_runs, unseen_runs
from bench.fusion_experiment import Outcome, experiment, main, markdown, trained, write
from gpvo.errors import GpvoError
from gpvo.evaluation.fusion import FusionReport
from gpvo.files import read_json, write_json
from gpvo.filters.metrics import Scores
from gpvo.filters.study import Study
from gpvo.geometry import se3
from gpvo.io.run import Run, read_run, write_run
from gpvo.stats.series import Interval
from gpvo.types import Status, TruthLog, VoLog, VoRecord


def _run_with_episode(path: Path, factor: float, cause: str = "dust") -> Run:
    """A camera at rest, seen to move by noise that is ``factor`` times as large from 20 to 30 s."""
    rng = np.random.default_rng(3)
    t_ns = np.arange(0, 1001) * 50_000_000
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    for a, b in itertools.pairwise(t_ns):
        sigma = 1e-3 * (factor if 20e9 <= b < 30e9 else 1.0)
        records.append(VoRecord(int(b), int(a), Status.OK, se3.exp(sigma * rng.standard_normal(6))))
    write_run(path, VoLog(records), truth=TruthLog(t_ns, np.tile(np.eye(4), (len(t_ns), 1, 1))))
    write_json(path / "episodes.json", {"episodes": [{"begin_s": 20.0, "end_s": 30.0, "cause": cause}]})
    return read_run(path)


def test_the_rise_is_that_of_the_errors_inside_the_episodes(tmp_path: Path) -> None:
    found = rise([_run_with_episode(tmp_path / "a", 10.0), _run_with_episode(tmp_path / "b", 10.0)])
    assert found.share == pytest.approx(0.2, abs=0.005)
    np.testing.assert_allclose(found.standard_deviation, 10.0, rtol=0.2)
    np.testing.assert_allclose(found.median, 10.0, rtol=0.3)


def test_darkness_without_measurements_is_no_rise(tmp_path: Path) -> None:
    assert str(rise([_run_with_episode(tmp_path / "a", 1.0, "blackout")])) == "no bad episodes"


def test_flights_are_made_once_and_accidents_are_lost_frames(tmp_path: Path) -> None:
    campaign = Campaign("tunnel-clean", tmp_path, 8.0)
    runs = unseen_runs(campaign, 4)
    stamps = [p.stat().st_mtime_ns for p in sorted(tmp_path.glob("*/vo_log.parquet"))]
    assert sum(r.status is Status.LOST for r in runs[3].log) >= 35  # two seconds at 20 Hz
    assert not any(r.status is Status.LOST for run in runs[:3] for r in run.log)
    assert {e["cause"] for e in read_json(Path(runs[3].path) / "episodes.json")["episodes"]} <= {"image_noise"}
    assert len(list(tmp_path.iterdir())) == 4
    unseen_runs(campaign, 4)  # made once: nothing is written again
    assert [p.stat().st_mtime_ns for p in sorted(tmp_path.glob("*/vo_log.parquet"))] == stamps
    assert {r.path.name for r in training_runs(campaign, 1)}.isdisjoint(r.path.name for r in runs)


def _scores(ate: float) -> Scores:
    return Scores(1.0, Interval(1.0, 0.9, 1.1), 3, ate, ate, 0.1, 1.1, 0.9, False, 100)


def test_tables_hold_every_run_and_every_comparison(tmp_path: Path) -> None:
    study = Study(
        ("a", "b", "c", "d", "e"),
        {
            "constant_best": tuple(map(_scores, (0.04, 0.05, 0.06, 0.04, 0.06))),
            "learned": tuple(map(_scores, (0.02, 0.03, 0.01, 0.02, 0.02))),
        },
    )
    outcome = Outcome("flights", FusionReport(study, (), ()), Rise(0.2, np.full(6, 10.0), np.full(6, 9.0)))
    text = markdown(outcome)
    assert "gain 60.0 %" in text
    assert "| c | 0.0600 | 0.0100 | 1.10 | 0.90 |" in text
    assert "20 % of the motions" in text
    write(outcome, tmp_path / "result")
    document = json.loads((tmp_path / "result.json").read_text())
    assert document["rise"]["standard_deviation"] == [10.0] * 6
    assert document["comparisons"][0]["interval_m"][1] < 0
    assert (tmp_path / "result.png").stat().st_size > 5000
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".json", ".md", ".png"]


def test_too_few_flights_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="too few flights"):
        main(["tunnel-clean", "--train", "1", "-o", str(tmp_path)])


def test_a_test_flight_that_taught_is_refused(tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match="among the training flights"):
        main(["tunnel-clean", "--train", "2", "--test-seed", "1001", "-o", str(tmp_path)])


@pytest.mark.slow
def test_learned_covariance_beats_the_best_constant_where_vo_fails_for_seconds(tmp_path: Path) -> None:
    """A third of the full experiment, hence wide bounds; the full one found 40 % and NEES within [0.7, 1.5]."""
    campaign = Campaign("tunnel-bursts", tmp_path, 30.0)
    training, test = training_runs(campaign, 6), unseen_runs(campaign, 18)
    outcome = experiment("small", training, test, trained(training, tmp_path / "m.gpvo"), hindsight=False)
    assert (outcome.rise.standard_deviation > 6).all()
    study = outcome.study
    for other in ("constant", "constant_best", "pointing_matching", "triangulation"):
        assert study.mean("learned", "ate_rmse_m") < study.mean(other, "ate_rmse_m")
    assert study.compare("learned", "constant_best").gain_percent > 10
    for part in ("position", "attitude"):
        assert 0.4 < study.mean("learned", f"nees_{part}") < 2.5
    assert not any(np.nansum(study.column(name, "diverged")) for name in study.scores)
