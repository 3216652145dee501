"""What a filter gains, measured: simulated flights, VO, a model from some, the policies on the others.

    python -m bench.fusion_experiment tunnel-bursts --train 12 --test 50 -o experiment

Training and test seeds differ, and with them path, world and sensors. Prints every run, paired intervals, and by how
much VO's error rose; writes the same as Markdown, JSON and a figure. Flights that the folder holds are not flown again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from gpvo.dataset.build import build_run
from gpvo.evaluation.flights import constants_of, flight_of
from gpvo.evaluation.fusion import FusionReport, Trace, document, trace_of
from gpvo.evaluation.plots import save
from gpvo.files import markdown_table, write_json, write_text
from gpvo.filters.policies import LEARNED, POLICIES, LearnedPolicy
from gpvo.filters.run import Flight, FusedRun, FuseOptions
from gpvo.filters.study import Study, fit_scalars, make_policies, study
from gpvo.io.run import Run
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model
from gpvo.learning.train import train_sets
from gpvo.online.predictor import Predictor
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.experiment_flights import (
    FIRST_TEST_SEED,
    Campaign,
    Rise,
    check_numbers,
    experiment_parser,
    rise,
    training_runs,
    unseen_runs,
    with_accidents,
)

LEARNED_WHITE = "learned_white"
_POINTS_S, _PICTURES_S = 60.0, 25.0
_HONEST = (0.7, 1.5)
_COLUMNS = (
    ("ATE m", "ate_rmse_m", 4),
    ("final m", "final_error_m", 4),
    ("NEES position", "nees_position", 2),
    ("NEES attitude", "nees_attitude", 2),
    ("NIS", "nis_dof", 2),
    ("rejected", "rejected", 1),
)


@dataclass(frozen=True)
class Outcome:
    """The study of the test flights, its traces, and by how much VO's error rose in their episodes."""

    title: str
    report: FusionReport
    rise: Rise

    @property
    def study(self) -> Study:
        """Scores of every run under every policy."""
        return self.report.study


def experiment(
    title: str, training: Sequence[Run], test: Sequence[Run], model: Path, *, hindsight: bool = True
) -> Outcome:
    """Tune the constants on the training runs and filter the others under every policy.

    ``learned_white`` is the learned covariance taken as independent from motion to motion: what the parts are worth.
    """
    options = FuseOptions(history_s=0.0)
    constants = constants_of(training)
    constants = replace(constants, best=fit_scalars([flight_of(r) for r in training], constants, options))
    predictor = Predictor.load(model).require_motions(model)
    flights = [flight_of(r, predictor) for r in test]
    if hindsight:
        constants = replace(constants, hindsight=fit_scalars(flights, constants, options))
    able = make_policies(constants, names=POLICIES, learned=True)
    policies = {name: policy for name, policy in able.items() if policy is not None}
    policies[LEARNED_WHITE] = LearnedPolicy(LEARNED_WHITE, use_parts=False)
    traces: list[Trace] = []

    def keep(flight: Flight, fused: FusedRun) -> None:
        traces.append(trace_of(flight, fused))

    result = study(flights, policies, options, constants=constants, on_run=keep)
    calm = [r for r in test if not with_accidents(r)]
    return Outcome(title, FusionReport(result, tuple(traces), ()), rise(calm))


def markdown(outcome: Outcome) -> str:
    """Means, paired comparisons, the rise, and every run."""
    result, names = outcome.study, list(outcome.study.scores)
    parts = [f"# {outcome.title}", "", f"{len(result.runs)} flights that no model and no constant has seen.", ""]
    parts += markdown_table(["policy", *(c[0] for c in _COLUMNS), "diverged"], [_mean_row(result, n) for n in names])
    parts += ["", f"VO in the episodes: {outcome.rise}.", ""]
    parts += [f"* {result.compare(LEARNED, other)}" for other in names if other != LEARNED]
    if result.constants:
        parts += ["", f"Factors on the constant's variances (translation, rotation): best {result.constants.best}, "]
        parts[-1] += f"hindsight {result.constants.hindsight}."
    parts += ["", "## Every run: ATE [m], and the learned policy's NEES per degree of freedom", ""]
    return "\n".join(parts + markdown_table(["run", *names, "position", "attitude"], _run_rows(result))) + "\n"


def _mean_row(result: Study, name: str) -> list[str]:
    values = [f"{result.mean(name, key):.{digits}f}" for _, key, digits in _COLUMNS]
    return [name, *values, f"{result.diverged(name)}"]


def _run_rows(result: Study) -> list[list[str]]:
    columns = [result.column(n, "ate_rmse_m") for n in result.scores]
    nees = [result.column(LEARNED, f"nees_{part}") for part in ("position", "attitude")]
    return [
        [run, *(f"{c[i]:.4f}" for c in columns), *(f"{c[i]:.2f}" for c in nees)] for i, run in enumerate(result.runs)
    ]


def write(outcome: Outcome, stem: Path) -> None:
    """``stem.md``, ``stem.json`` and ``stem.png``."""
    write_text(stem.with_suffix(".md"), markdown(outcome))
    risen = outcome.rise
    extra = {"share": risen.share, "standard_deviation": risen.standard_deviation, "median": risen.median}
    write_json(stem.with_suffix(".json"), {**document(outcome.report), "title": outcome.title, "rise": extra})
    save(experiment_figure(outcome.study, outcome.title), stem.with_suffix(".png"), dpi=120, bbox_inches="tight")


def experiment_figure(result: Study, title: str) -> Figure:
    """Left: position error of each run. Right: the learned policy's NEES of each run."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    figure.suptitle(title)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    _errors_of_runs(left, result)
    _consistency(right, result)
    return figure


def _errors_of_runs(axes: Axes, result: Study) -> None:
    """One dot per run and policy; lines join the runs, so that pairs can be seen."""
    names = list(result.scores)
    ate = np.array([result.column(n, "ate_rmse_m") for n in names])  # (policies, runs)
    axes.plot(ate, color="grey", lw=0.4, alpha=0.5)
    for i, name in enumerate(names):
        colour = "tab:green" if name == LEARNED else "tab:blue"
        axes.plot(np.full(ate.shape[1], i), ate[i], "o", ms=3, color=colour, alpha=0.6)
        axes.plot([i - 0.3, i + 0.3], [np.nanmean(ate[i])] * 2, color="black", lw=2)
    axes.set_xticks(range(len(names)), names, rotation=20, ha="right", fontsize=8)
    axes.set(ylabel="ATE of each run [m]; bar: mean", yscale="log")


def _consistency(axes: Axes, result: Study) -> None:
    for part, marker in (("position", "o"), ("attitude", "^")):
        values = result.column(LEARNED, f"nees_{part}")
        axes.plot(values, marker, ms=4, label=f"{part}, mean {np.nanmean(values):.2f}")
    axes.axhspan(*_HONEST, color="grey", alpha=0.3)
    axes.set(xlabel="run", ylabel="NEES per degree of freedom, learned", yscale="log")
    axes.legend(fontsize=8)


def trained(training: Sequence[Run], path: Path) -> Path:
    """Train on the runs and keep the model beside them."""
    save_model(train_sets([build_run(r) for r in training], TrainConfig(), judge=False), path)
    return path


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of the experiment."""
    parser = experiment_parser(__doc__, 12, 50, FIRST_TEST_SEED, "experiment")
    parser.add_argument("scenario", help="such as tunnel-bursts, tunnel-clean, tunnel-noise")
    parser.add_argument("--pictures", action="store_true", help="draw the pictures: real VO, a hundred times slower")
    parser.add_argument("--duration", type=float, help=f"s; default {_POINTS_S:g}, with pictures {_PICTURES_S:g}")
    parser.add_argument("--model", type=Path, help="use this model, such as one trained on points, in place of a new")
    given = parser.parse_args(arguments)
    check_numbers(given)
    duration = given.duration or (_PICTURES_S if given.pictures else _POINTS_S)
    campaign = Campaign(given.scenario, given.out, duration, given.pictures)
    training = training_runs(campaign, given.train, given.jobs)
    test = unseen_runs(campaign, given.test, given.jobs, given.test_seed)
    kind = "pictures" if given.pictures else "points"
    stem = given.out / f"{given.scenario}-{kind}{'-other-model' if given.model else ''}"
    model = given.model or trained(training, stem.with_suffix(".gpvo"))
    title = f"{given.scenario}, {kind}, {given.train} training flights" + (f", model {given.model}" * bool(given.model))
    outcome = experiment(title, training, test, model)
    write(outcome, stem)
    print(markdown(outcome))


if __name__ == "__main__":
    main()
