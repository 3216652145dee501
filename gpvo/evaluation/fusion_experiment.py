"""What a filter gains, measured: simulated flights without pictures, VO, a model from some, the policies on the others.

    python -m gpvo.evaluation.fusion_experiment tunnel-bursts --train 12 --test 50 -o experiment

Every fourth test flight has two seconds of darkness and one second of frozen pictures besides. Train and test seeds
differ, and with them path, world and sensors. Prints every run, paired intervals, and by how much VO's error rose.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import build_run
from gpvo.dataset.errors import motion_errors
from gpvo.evaluation.fusion import constants_of, flight_of
from gpvo.filters.policies import LEARNED, LearnedPolicy
from gpvo.filters.run import FuseOptions
from gpvo.filters.study import Study, fit_scalars, make_policies, study, table
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.runner import run as run_vo
from gpvo.sim.points import simulate_points

Array = NDArray[np.float64]

FIRST_TRAIN_SEED, FIRST_TEST_SEED = 1000, 0
_DARK_S, _FROZEN_S = (20.0, 22.0), (40.0, 41.0)


@dataclass(frozen=True)
class Rise:
    """VO's error in bad episodes against the rest: ``share`` of the motions, ratio of standard deviations (6,) per axis
    and of median absolute values, which a few failures do not move."""

    share: float
    standard_deviation: Array
    median: Array

    def __str__(self) -> str:
        sd, median = (" ".join(f"{v:.1f}" for v in values) for values in (self.standard_deviation, self.median))
        share = f"{100 * self.share:.0f} % of the motions are bad"
        return f"{share}: error x ({sd}) in standard deviation, x ({median}) in median"


def make_runs(scenario: str, seeds: Sequence[int], folder: Path, *, accidents: bool, jobs: int) -> list[Run]:
    """Simulate and run VO where the folder does not hold the run yet."""
    tasks = [(scenario, seed, folder, accidents and seed % 4 == 3) for seed in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return [read_run(path) for path in pool.map(_make_run, tasks)]


def _make_run(task: tuple[str, int, Path, bool]) -> Path:
    scenario, seed, folder, accident = task
    out = folder / f"{scenario}-{seed:04d}{'-accidents' if accident else ''}"
    if not (out / "run.json").is_file():
        events = {"dark": _DARK_S, "frozen": _FROZEN_S} if accident else {}
        tracks = simulate_points(scenario, seed, **events).save(folder / f"{out.name}.npz")
        run_vo(open_source(tracks), out)
        tracks.unlink()
    return out


def rise(runs: Sequence[Run], bad_rms_factor: float = 2.5) -> Rise:
    """Bad motions are those whose reprojection error is so many times the run's median."""
    calm, bad = [], []
    for run in runs:
        if run.truth is None:
            continue
        errors = motion_errors(run.log, run.truth)
        rms = np.array([run.log.records[i].reproj_rms_px for i in errors.index])
        is_bad = rms > bad_rms_factor * np.median(rms)
        calm.append(errors.xi[~is_bad])
        bad.append(errors.xi[is_bad])
    a, b = np.concatenate(calm), np.concatenate(bad)
    if not len(b):
        return Rise(0.0, np.ones(6), np.ones(6))
    medians = np.median(np.abs(b), axis=0) / np.median(np.abs(a), axis=0)
    return Rise(len(b) / (len(a) + len(b)), b.std(axis=0) / a.std(axis=0), medians)


def experiment(training: Sequence[Run], test: Sequence[Run], *, hindsight: bool = True) -> Study:
    """Train on some runs, tune the constants on them, filter the others under every policy.

    ``learned_white`` is the learned covariance taken as independent from motion to motion: what the parts are worth.
    """
    options = FuseOptions(history_s=0.0)
    model = train_sets([build_run(r) for r in training], TrainConfig(), judge=False)
    predictor = model.predictor()
    constants = constants_of(training)
    constants = replace(constants, best=fit_scalars([flight_of(r) for r in training], constants, options))
    flights = [flight_of(r, predictor) for r in test]
    if hindsight:
        constants = replace(constants, hindsight=fit_scalars(flights, constants, options))
    names = ("constant", "constant_best", "constant_hindsight", "triangulation", "pointing_matching", LEARNED)
    policies = make_policies(constants, names=names, learned=True)
    policies["learned_white"] = LearnedPolicy("learned_white", use_parts=False)
    return study(flights, {k: v for k, v in policies.items() if v is not None}, options, constants=constants)


def report(result: Study, risen: Rise) -> str:
    """The table of every run, the paired comparisons and the rise beside them."""
    lines = [table(result), "", str(risen)]
    lines += [str(result.compare(LEARNED, other)) for other in result.scores if other != LEARNED]
    if result.constants:
        lines.append(
            f"scalars (translation, rotation): best {result.constants.best}, hindsight {result.constants.hindsight}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", help="points-only scenario, such as tunnel-bursts")
    parser.add_argument("--train", type=int, default=12, help="training flights")
    parser.add_argument("--test", type=int, default=50, help="test flights")
    parser.add_argument("-o", "--out", type=Path, default=Path("experiment"), help="folder for the runs")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes for VO")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    train_seeds = range(FIRST_TRAIN_SEED, FIRST_TRAIN_SEED + given.train)
    test_seeds = range(FIRST_TEST_SEED, FIRST_TEST_SEED + given.test)
    training = make_runs(given.scenario, train_seeds, given.out, accidents=False, jobs=given.jobs)
    test = make_runs(given.scenario, test_seeds, given.out, accidents=True, jobs=given.jobs)
    print(report(experiment(training, test), rise([r for r in test if "accidents" not in r.name])))


if __name__ == "__main__":
    main()
