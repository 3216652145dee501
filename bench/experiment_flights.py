"""Simulated flights for the fusion experiment, with or without pictures, and by how much VO's error rose in them.

Every fourth test flight has accidents: two seconds of darkness, frozen pictures and bursts of image noise.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gpvo.dataset.errors import motion_errors
from gpvo.errors import GpvoError
from gpvo.files import read_json, write_json
from gpvo.io import open_source
from gpvo.io.run import Run, read_run
from gpvo.parallel import map_jobs
from gpvo.runner import run as run_vo
from gpvo.sim.points import simulate_points
from gpvo.sim.scenario import load_scenario, points_scenario
from gpvo.sim.sequence import simulate
from gpvo.types import Array
from numpy.typing import NDArray

FIRST_TRAIN_SEED, FIRST_TEST_SEED = 1000, 0
_DARK_S, _FROZEN_S, _FROZEN_SHARE = 2.0, 1.0, 0.05
_EPISODES, _ACCIDENTS = "episodes.json", "-accidents"


@dataclass(frozen=True)
class Campaign:
    """Flights of one scenario, ``duration_s`` long, in ``folder``. ``pictures``: drawn; else landmark tracks.

    ``keep_tracks``: the runs keep what odometry saw, so that twins can be made of them.
    """

    scenario: str
    folder: Path
    duration_s: float
    pictures: bool = False
    keep_tracks: bool = False

    def run_path(self, seed: int, accidents: bool) -> Path:
        """Where the run of a flight lies."""
        kind = ("pictures" if self.pictures else "points") + ("-tracks" if self.keep_tracks else "")
        return self.folder / f"{self.scenario}-{kind}-{seed:04d}{_ACCIDENTS if accidents else ''}"


def experiment_parser(about: str | None, train: int, test: int, test_seed: int, out: str) -> argparse.ArgumentParser:
    """The command line that experiments share, with these defaults."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=train, help="training flights of each scenario")
    parser.add_argument("--test", type=int, default=test, help="test flights of each scenario")
    parser.add_argument("--test-seed", type=int, default=test_seed, help="seed of the first test flight")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes that fly")
    parser.add_argument("-o", "--out", type=Path, default=Path(out), help="folder for runs and results")
    return parser


def check_numbers(given: argparse.Namespace) -> None:
    """Raise GpvoError for too few flights, and where a test flight is a training flight."""
    if given.train < 2 or given.test < 2:
        raise GpvoError("too few flights to learn or to judge", cure="--train and --test of 2 at least")
    after = FIRST_TRAIN_SEED + given.train
    if given.test_seed < after and given.test_seed + given.test > FIRST_TRAIN_SEED:
        raise GpvoError("test flights are among the training flights", cure=f"--test-seed {after}")


def training_runs(campaign: Campaign, count: int, jobs: int = 1) -> list[Run]:
    """So many flights without accidents; path, world and sensors are never those of a test flight."""
    return flights(campaign, range(FIRST_TRAIN_SEED, FIRST_TRAIN_SEED + count), jobs)


def unseen_runs(campaign: Campaign, count: int, jobs: int = 1, first_seed: int = FIRST_TEST_SEED) -> list[Run]:
    """So many flights, every fourth with accidents."""
    return _make(campaign, [(first_seed + i, i % 4 == 3) for i in range(count)], jobs)


def flights(campaign: Campaign, seeds: Iterable[int], jobs: int = 1) -> list[Run]:
    """Flights of any seeds without accidents."""
    return _make(campaign, [(seed, False) for seed in seeds], jobs)


def with_accidents(run: Run) -> bool:
    """Whether this is a flight in which pictures were missing or frozen, which no episode accounts for."""
    return run.path.name.endswith(_ACCIDENTS)


def _make(campaign: Campaign, flights: Sequence[tuple[int, bool]], jobs: int) -> list[Run]:
    """Simulate and run VO where the folder does not hold the run yet."""
    campaign.folder.mkdir(parents=True, exist_ok=True)
    return [read_run(path) for path in map_jobs(_make_one, [(campaign, *f) for f in flights], jobs=jobs)]


def _make_one(campaign: Campaign, seed: int, accidents: bool) -> Path:
    out = campaign.run_path(seed, accidents)
    # The episodes are written last, so that a run which has them is whole.
    if not (out / _EPISODES).is_file():
        sequence = out.with_name(f"{out.name}.sequence{'' if campaign.pictures else '.npz'}")
        fly = _fly_pictures if campaign.pictures else _fly_points
        episodes = fly(campaign, seed, accidents, sequence)
        run_vo(open_source(sequence), out, keep_tracks=campaign.keep_tracks)
        write_json(out / _EPISODES, {"schema": 1, "episodes": episodes})
        if campaign.pictures:
            shutil.rmtree(sequence)
        else:
            sequence.unlink()
    return out


def _fly_points(campaign: Campaign, seed: int, accidents: bool, path: Path) -> list[dict[str, Any]]:
    D = campaign.duration_s
    scenario = points_scenario(load_scenario(campaign.scenario, {"duration_s": D}))
    happens: dict[str, Any] = {}
    if accidents:
        happens = {"dark": (D / 3, D / 3 + _DARK_S), "frozen": (2 * D / 3, 2 * D / 3 + _FROZEN_S)}
        happens |= {} if scenario.episodes_share else {"episodes_share": 0.2, "causes": ("image_noise",)}
    flight = simulate_points(scenario, seed, **happens)
    flight.save(path)
    return [{"begin_s": e.begin_s, "end_s": e.end_s, "cause": e.cause} for e in flight.episodes]


def _fly_pictures(campaign: Campaign, seed: int, accidents: bool, path: Path) -> list[dict[str, Any]]:
    D = campaign.duration_s
    happens: dict[str, Any] = {"duration_s": D}
    if accidents:
        begin = float(int(D / 3))
        happens |= {"dark": [begin, begin + _DARK_S], "frozen": _FROZEN_SHARE}
        if not load_scenario(campaign.scenario).episodes_share:
            happens |= {"episodes_share": 0.2, "causes": ["image_noise"]}
    simulate(load_scenario(campaign.scenario, happens), seed, path, threads=1)
    return list(read_json(path / _EPISODES)["episodes"])


@dataclass(frozen=True)
class Rise:
    """VO's error inside the episodes against outside them: ``share`` of the motions inside, and ratios (6,) per axis of
    standard deviations and of median absolute values, which a few failures do not move."""

    share: float
    standard_deviation: Array
    median: Array

    def __str__(self) -> str:
        sd, median = (" ".join(f"{v:.1f}" for v in values) for values in (self.standard_deviation, self.median))
        if not self.share:
            return "no bad episodes"
        return f"{100 * self.share:.0f} % of the motions in episodes: error's deviation x ({sd}), median x ({median})"


def rise(runs: Sequence[Run]) -> Rise:
    """By the episodes that the simulator wrote down, over all runs together; lost frames have no error to count."""
    calm, bad = [np.empty((0, 6))], [np.empty((0, 6))]
    for run in runs:
        if run.truth is None:
            raise GpvoError("has no ground truth to measure errors by", where=run.path)
        errors = motion_errors(run.log, run.truth)
        inside = in_episodes(run, run.log.t_ns[errors.index])
        calm.append(errors.xi[~inside])
        bad.append(errors.xi[inside])
    a, b = np.concatenate(calm), np.concatenate(bad)
    if not len(b) or not len(a):
        return Rise(0.0, np.ones(6), np.ones(6))
    medians = np.median(np.abs(b), axis=0) / np.median(np.abs(a), axis=0)
    return Rise(len(b) / (len(a) + len(b)), b.std(axis=0) / a.std(axis=0), medians)


def in_episodes(run: Run, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which motions that end at ``t_ns`` (n,) lie in an episode in which VO still sees something."""
    t_s = (t_ns - run.log.records[0].t_ns) * 1e-9
    inside = np.zeros(len(t_ns), bool)
    for episode in read_json(Path(run.path) / _EPISODES)["episodes"]:
        if episode["cause"] != "blackout":
            inside |= (t_s >= episode["begin_s"]) & (t_s < episode["end_s"])
    return inside
