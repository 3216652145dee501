"""Is the learned covariance true in every scenario, per motion and over 1, 10 and 100 m? Simulated flights, a model.

    python -m bench.scenario_experiment --train 10 --test 12 -o scenarios

Per scenario: a model from the training flights, judged on flights whose seeds, and with them path, world, noise and
calibration, it has never seen; ``--together`` adds one model of all scenarios at the same rate, and ``--twins 8`` for
each test flight a model of so many twins of it alone, with the scenario's tolerance. A flight is the unit of every mean
and interval, as its calibration is one draw. Flights that the folder holds are not flown again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from gpvo.dataset.build import TrainingSet, build_run, predictions_of
from gpvo.dataset.errors import interpolate_truth, motion_errors
from gpvo.errors import GpvoError
from gpvo.evaluation.consistency import HORIZONS_M, consistency
from gpvo.evaluation.evaluate import judged
from gpvo.evaluation.statements import statements
from gpvo.files import markdown_table, write_json
from gpvo.io.run import Run, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from gpvo.parallel import map_jobs
from gpvo.sim.scenario import load_scenario, points_scenario
from gpvo.stats.series import Interval, sequence_bootstrap
from gpvo.twin.replicate import TwinSettings, make_twins

from bench.experiment_flights import Campaign, check_numbers, experiment_parser, flights, training_runs

DURATIONS_S: Mapping[str, float] = {
    "tunnel-clean": 125.0,
    "tunnel-noise": 125.0,
    "tunnel-bursts": 125.0,
    "lunar-straight": 130.0,
    "room-t265": 210.0,
}
"""The scenarios, and how long a flight is: far enough for 100 m, in training too: short flights do not show that."""

METHODS = ("constant", "triangulation_scaled", "learned")
NEES_COLUMNS = ("frame", *(f"{m:g} m" for m in HORIZONS_M))
FIRST_TEST_SEED = 2000


@dataclass(frozen=True)
class MethodScores:
    """Of one method over F flights: ``nees`` (F, 4) joint NEES per degree of freedom per motion and over 1, 10, 100 m,
    NaN where no window fits; ``median`` (F,) of the motions' NEES; ``nll`` (F,) per axis [nats]; ``final_m`` (F, 2)
    error of the last position, predicted 1 sigma and actual."""

    nees: np.ndarray
    median: np.ndarray
    nll: np.ndarray
    final_m: np.ndarray

    def interval(self, column: int) -> Interval:
        """Mean over flights of a column of ``nees``, with its bootstrap interval."""
        values = self.nees[:, column]
        return sequence_bootstrap(values[np.isfinite(values)])

    @property
    def final_ratio(self) -> float:
        """Predicted over actual final error, each as root mean square over the flights: a mean of ratios diverges."""
        predicted, actual = np.sqrt((self.final_m**2).mean(axis=0))
        return float(predicted / actual)


def score_flights(runs: Sequence[Run], predictor: Predictor, jobs: int = 1) -> dict[str, MethodScores]:
    """Every method of :data:`METHODS` that the runs and the model allow."""
    return _tabulated(map_jobs(_score_flight, [(run, predictor) for run in runs], jobs=jobs))


def score_by_twins(runs: Sequence[Run], settings: TwinSettings, jobs: int = 1) -> dict[str, MethodScores]:
    """Each flight by a model of its own twins alone: :data:`METHODS` as ``METHOD of twins``."""
    rows = map_jobs(_score_by_twins, [(run, settings) for run in runs], jobs=jobs)
    return {f"{m} of twins": scores for m, scores in _tabulated(rows).items()}


def _score_by_twins(run: Run, settings: TwinSettings) -> dict[str, list[float]]:
    with TemporaryDirectory(prefix="gpvo-twins-") as folder:
        sets = [build_run(read_run(p)) for p in make_twins(run.path, Path(folder), settings)]
    return _score_flight(run, train_sets(sets, TrainConfig(), judge=False).predictor())


def _tabulated(flights: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, MethodScores]:
    tables = {m: np.array([row[m] for row in flights], np.float64) for m in flights[0]}
    return {m: MethodScores(t[:, :-4], t[:, -4], t[:, -3], t[:, -2:]) for m, t in tables.items()}


def _score_flight(run: Run, predictor: Predictor) -> dict[str, list[float]]:
    """NEES per motion and by horizon, its median over the motions, NLL, and final error, by method."""
    if run.truth is None:
        raise GpvoError("has no ground truth to judge by", where=run.path)
    predictions = predictions_of(run, predictor)
    log = judged(run.log, predictions)
    T_true, known = interpolate_truth(run.truth, log.t_ns)
    errors = motion_errors(log, run.truth)
    T_est = log.trajectory()
    off = T_true[0] @ np.linalg.inv(T_est[0]) @ T_est[-1] - T_true[-1]
    actual_m = float(np.linalg.norm(off[:3, 3]))
    out = {}
    for statement in statements(log, predictions, predictor):
        c = consistency(statement, errors, log, T_true, known) if statement.method in METHODS else None
        joint, nll = (c.nees_dof["joint"], c.nll_per_dim) if c else (None, None)
        if c is not None and joint is not None and nll is not None:
            far = [h.nees_dof for h in c.horizons]
            median, final_m = float(c.nees_dof_median["joint"] or np.nan), float(c.predicted_final_error_m or np.nan)
            out[statement.method] = [joint.mean, *far, median, nll, final_m, actual_m]
    return out


@dataclass(frozen=True)
class ScenarioFlights:
    """Flights of one scenario: what a model may learn from, and what it is judged on."""

    name: str
    training: Sequence[TrainingSet]
    test: Sequence[Run]


def fly(name: str, folder: Path, train: int, test: int, *, test_seed: int = FIRST_TEST_SEED, jobs: int = 1,
        duration_s: float | None = None, pictures: bool = False,
        keep_tracks: bool = False) -> ScenarioFlights:  # fmt: skip
    """Simulate, as points or with pictures, run VO; training seeds begin at 1000, test seeds at ``test_seed``."""
    campaign = Campaign(name, folder, duration_s or DURATIONS_S[name], pictures)
    seen = training_runs(campaign, train, jobs)
    unseen = flights(replace(campaign, keep_tracks=keep_tracks), range(test_seed, test_seed + test), jobs)
    return ScenarioFlights(name, [build_run(r) for r in seen], unseen)


def judge(flown: ScenarioFlights, jobs: int = 1) -> dict[str, MethodScores]:
    """Train on the scenario's training flights and score the unseen ones."""
    return score_flights(flown.test, train_sets(flown.training, TrainConfig(), judge=False).predictor(), jobs)


def markdown(results: Mapping[str, Mapping[str, MethodScores]]) -> str:
    """One row per scenario and method: NEES per degree of freedom with 95 % intervals over flights, median, NLL,
    predicted over actual final error."""
    head = ["scenario", "method", "flights", *(f"NEES, {c}" for c in NEES_COLUMNS), "median", "NLL", "final"]
    rows = []
    for scenario, methods in results.items():
        for method, s in methods.items():
            cells = [_cell(s, i) for i in range(len(NEES_COLUMNS))]
            ends = [f"{s.median.mean():.2f}", f"{s.nll.mean():.3f}", f"{s.final_ratio:.2f}"]
            rows.append([scenario, method, str(len(s.nll)), *cells, *ends])
    return "\n".join(markdown_table(head, rows))


def _cell(scores: MethodScores, column: int) -> str:
    if not np.isfinite(scores.nees[:, column]).any():
        return "-"
    i = scores.interval(column)
    return f"{i.mean:.2f} [{i.low:.2f}, {i.high:.2f}]"


def document(results: Mapping[str, Mapping[str, MethodScores]]) -> dict[str, Any]:
    """The same for machines, flight by flight."""
    return {
        "schema": 1,
        "columns": list(NEES_COLUMNS),
        "scenarios": {
            scenario: {
                m: {"nees_dof": s.nees, "nees_dof_median": s.median, "nll_per_dim": s.nll, "final_m": s.final_m}
                for m, s in methods.items()
            }
            for scenario, methods in results.items()
        },
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the experiment."""
    parser = experiment_parser(__doc__, 10, 12, FIRST_TEST_SEED, "scenarios")
    parser.add_argument("scenarios", nargs="*", default=list(DURATIONS_S), help="default: all")
    parser.add_argument("--duration", type=float, help="of a flight [s]; default: far enough for 100 m")
    parser.add_argument("--together", action="store_true", help="also one model of all scenarios of equal rate")
    parser.add_argument("--twins", type=int, default=0, help="also a model of so many twins of each test flight")
    parser.add_argument("--pictures", action="store_true", help="flights with pictures; default: as points")
    given = parser.parse_args(arguments)
    if unknown := [s for s in given.scenarios if s not in DURATIONS_S]:
        raise GpvoError(f"cannot judge {unknown}", cure=f"one of {', '.join(DURATIONS_S)}")
    check_numbers(given)
    results: dict[str, dict[str, MethodScores]] = {}
    flown = []
    for name in given.scenarios:
        flown.append(
            fly(name, given.out, given.train, given.test, test_seed=given.test_seed, jobs=given.jobs,
                duration_s=given.duration, pictures=given.pictures, keep_tracks=given.twins > 0)
        )  # fmt: skip
        results[name] = judge(flown[-1], given.jobs)
        if given.twins:
            tolerance = points_scenario(load_scenario(name)).tolerance
            results[name] |= score_by_twins(flown[-1].test, TwinSettings(given.twins, tolerance, name), given.jobs)
        print(markdown({name: results[name]}), flush=True)
    if given.together:
        results |= _together(flown, given.jobs)
    write_json(given.out / "scenarios.json", document(results))
    print(markdown(results))


def _together(flown: Sequence[ScenarioFlights], jobs: int) -> dict[str, dict[str, MethodScores]]:
    """One model of all scenarios that share the first one's rate, judged on each."""
    step = float(np.median(flown[0].training[0].dt_s))
    alike = [f for f in flown if abs(float(np.median(f.training[0].dt_s)) / step - 1) < 0.01]
    predictor = train_sets([s for f in alike for s in f.training], TrainConfig(), judge=False).predictor()
    return {f"{f.name}, model of all": score_flights(f.test, predictor, jobs) for f in alike}


if __name__ == "__main__":
    main()
