"""The flights of a plan, and the first two stages: simulation and odometry. Images go when odometry has seen them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gpvo import __version__, runner
from gpvo.errors import GpvoError, OutputError
from gpvo.files import digest_of_file
from gpvo.io import open_source
from gpvo.io.run import is_finished
from gpvo.io.trajectory import read_euroc_csv, read_tum, write_tum
from gpvo.reproduce.experiments import FLIGHTS, FlightSet, Mode, Plan, sigma_pairs
from gpvo.reproduce.stages import Store, Workers, digest_of
from gpvo.sim.scenario import Scenario, load_scenario
from gpvo.sim.scenario import fly as simulate
from gpvo.vo.config import make_config


@dataclass(frozen=True)
class Flight:
    """One flight to simulate. ``key``: digest of everything that decides it."""

    set_name: str
    mode: Mode
    seed: int
    scenario: Scenario
    key: str
    presets: tuple[str, ...]

    @property
    def name(self) -> str:
        """Short, and unique within one folder."""
        return f"{self.set_name}-{self.mode}-{self.seed}-{self.key}"


def flights_of(plan: Plan, name: str, mode: Mode, store: Store) -> list[Flight]:
    """The flights of a set, in order; cuts pieces of recordings where it flies them."""
    chosen = FLIGHTS[name]
    if chosen.points_only and mode != "points":
        return []
    first, count = chosen.first_seed, plan.training[mode]
    seeds = range(first, first + count) if chosen.is_training else plan.test_seeds(mode)
    return [_flight(plan, chosen, mode, seed, k, store) for k, seed in enumerate(seeds)]


def _flight(plan: Plan, chosen: FlightSet, mode: Mode, seed: int, k: int, store: Store) -> Flight:
    duration = plan.duration_s * (chosen.longer if plan.stretch else 1.0)
    overrides: dict[str, Any] = {**chosen.overrides, "duration_s": duration, "rate_hz": plan.rate_hz}
    recordings = plan.recordings(chosen.recorded) if chosen.recorded else []
    content = ""
    if recordings:
        piece = _cut(recordings[seed % len(recordings)], seed, duration, store)
        overrides["trajectory"], content = str(piece.resolve()), digest_of_file(piece)
    elif chosen.recorded:
        # Without recordings there is no path for a vehicle of that name: a quadrotor wanders.
        overrides["vehicle"] = "quadrotor"
    if mode == "images":
        overrides = {k: v for k, v in overrides.items() if not k.startswith("points.")}
    scenario = load_scenario(chosen.scenarios[k % len(chosen.scenarios)], overrides)
    decided = scenario.model_dump(mode="json") | {"trajectory": content}
    key = digest_of(decided, seed, mode, __version__)
    return Flight(chosen.name, mode, seed, scenario, key, ("fast", "thesis") if chosen.thesis_preset else ("fast",))


def _cut(recording: Path, seed: int, duration_s: float, store: Store) -> Path:
    """A piece of a recorded path, which may hold many flights: at least ``duration_s`` (all there is, if it is shorter)
    from a place that follows from the seed."""
    target = store.folder("paths") / f"{recording.stem}-{digest_of(digest_of_file(recording), seed, duration_s)}.txt"
    if target.is_file():
        return target
    path = read_euroc_csv(recording) if recording.suffix.lower() == ".csv" else read_tum(recording)
    clock = (path.t_ns - path.t_ns[0]) * 1e-9
    begin = np.random.default_rng([seed, 4]).uniform(0.0, max(clock[-1] - duration_s, 0.0))
    keep = (clock >= begin - 1e-9) & (clock <= begin + duration_s + 0.5)
    write_tum(target, path.t_ns[keep], path.T_world_body[keep])
    return target


@dataclass(frozen=True)
class Flown:
    """What came of a flight: its run folders by preset, or one line of ``error``."""

    flight: Flight
    runs: dict[str, Path]
    error: str = ""


def fly(flight: Flight, store: Store) -> Flown:
    """Simulate and run odometry, as far as not done yet; a path that no vehicle can fly comes back as ``error``.

    Raises OutputError where a folder cannot be written: the disk is full, or workers of a killed reproduction live on.
    """
    pairs = {preset: sigma_pairs(flight.set_name, preset) for preset in flight.presets}
    runs = {p: store.folder("runs") / f"{flight.name}-{p}-{digest_of(pairs[p])[:4]}" for p in flight.presets}
    missing = {preset: path for preset, path in runs.items() if not is_finished(path)}
    sequence = store.folder("flights") / (flight.name + (".npz" if flight.mode == "points" else ""))
    try:
        if missing:
            simulate(flight.scenario, flight.seed, sequence, points=flight.mode == "points")
    except OutputError:
        raise
    except GpvoError as error:
        return Flown(flight, {}, str(error))
    for preset, path in missing.items():
        runner.run(open_source(sequence), path, make_config(preset, sigma_pairs_px=pairs[preset]))
    if sequence.is_dir():
        shutil.rmtree(sequence, ignore_errors=True)
    sequence.unlink(missing_ok=True)
    return Flown(flight, runs)


@dataclass(frozen=True)
class Flights:
    """All flights that were made. ``failed``: one line per flight that could not be flown."""

    flown: dict[tuple[str, Mode], list[Flown]] = field(default_factory=dict)

    def runs(self, name: str, mode: Mode, preset: str) -> tuple[Path, ...]:
        """Run folders of a set, in the order of its seeds."""
        return tuple(f.runs[preset] for f in self.flown.get((name, mode), []) if preset in f.runs)

    @property
    def failed(self) -> list[str]:
        """What could not be flown, and why."""
        return [f"{f.flight.name}: {f.error}" for group in self.flown.values() for f in group if f.error]


def fly_all(plan: Plan, store: Store, workers: Workers) -> Flights:
    """Stages one and two, for every set of flights in every mode."""
    wanted: dict[tuple[str, Mode], list[Flight]] = {
        (name, mode): flights_of(plan, name, mode, store) for mode in plan.modes for name in plan.flight_sets
    }
    listed = [f for group in wanted.values() for f in group]
    # The long ones first, so that no core waits for a last long one.
    listed.sort(key=lambda f: (f.mode != "images", -f.scenario.duration_s))
    flown = workers.map("flights", fly, listed, store)
    by_key = {f.flight.name: f for f in flown}
    return Flights({where: [by_key[f.name] for f in group] for where, group in wanted.items()})
