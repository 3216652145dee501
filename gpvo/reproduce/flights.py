"""The first two stages: simulate a flight, run odometry over it. Pictures go when odometry has seen them."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from gpvo import runner
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.io.jsonfile import read_json
from gpvo.reproduce.experiments import sigma_pairs
from gpvo.reproduce.plan import Flight
from gpvo.reproduce.store import Store, digest_of
from gpvo.vo.config import make_config


@dataclass(frozen=True)
class Flown:
    """What came of a flight: its run folders by preset, or one line of ``error``."""

    flight: Flight
    runs: dict[str, Path]
    error: str = ""


def run_path(flight: Flight, preset: str, store: Store) -> Path:
    """Where the run of a flight lies."""
    return store.folder("runs") / f"{flight.name}-{preset}-{digest_of(sigma_pairs(flight.set_name, preset))[:4]}"


def fly(flight: Flight, store: Store) -> Flown:
    """Simulate and run odometry, as far as that is not done yet. What goes wrong comes back as ``error``."""
    runs = {preset: run_path(flight, preset, store) for preset in flight.presets}
    missing = {preset: path for preset, path in runs.items() if not is_complete(path)}
    sequence = store.folder("flights") / (flight.name + (".npz" if flight.mode == "points" else ""))
    try:
        if missing:
            _simulate(flight, sequence)
        for preset, path in missing.items():
            config = make_config(preset, sigma_pairs_px=sigma_pairs(flight.set_name, preset))
            runner.run(open_source(sequence), path, config)
    except GpvoError as error:
        # One path that no vehicle can fly does not stop the others.
        return Flown(flight, {}, str(error))
    _remove(sequence)
    return Flown(flight, runs)


def is_complete(run: Path) -> bool:
    """Whether a run folder holds a run that was finished."""
    return (run / "run.json").is_file() and bool(read_json(run / "run.json").get("complete"))


def _simulate(flight: Flight, sequence: Path) -> None:
    if flight.mode == "points":
        from gpvo.sim.campaign import fly_points

        if not sequence.is_file():
            fly_points(flight.scenario, flight.seed, sequence)
        return
    from gpvo.sim.sequence import simulate

    simulate(flight.scenario, flight.seed, sequence, threads=1)


def _remove(sequence: Path) -> None:
    if sequence.is_dir():
        shutil.rmtree(sequence, ignore_errors=True)
    sequence.unlink(missing_ok=True)
