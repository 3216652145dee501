"""Many seeds of a scenario: on the cores of this machine, or on a dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from gpvo.errors import GpvoError
from gpvo.geometry.se3 import path_length_m
from gpvo.parallel import map_jobs
from gpvo.sim.scenario import Flight, Scenario, points_scenario


def fly_campaign(
    scenario: Scenario,
    seeds: Sequence[int],
    out: Path,
    *,
    points: bool = False,
    jobs: int = 1,
    backend: str = "joblib",
    scheduler: str | None = None,
) -> list[Flight]:
    """Simulate every seed into ``out/seed_N`` (``out/seed_N.npz`` for points); one failure does not stop the others.

    Raises GpvoError for an unknown backend; MissingExtraError for ``dask`` without the extra.
    """
    if backend not in ("joblib", "dask"):
        raise GpvoError(f"unknown backend '{backend}'", cure="choose joblib or dask")
    suffix = ".npz" if points else ""
    tasks = [(scenario, seed, out / f"seed_{seed}{suffix}", points) for seed in seeds]
    out.mkdir(parents=True, exist_ok=True)
    where = "local" if backend == "joblib" else backend
    return map_jobs(fly_one, tasks, jobs=jobs, backend=where, scheduler=scheduler)


def fly_one(scenario: Scenario, seed: int, out: Path, points: bool = False) -> Flight:
    """One flight; what goes wrong with it comes back as its ``error``."""
    try:
        return fly(scenario, seed, out, points)
    except GpvoError as error:
        return Flight(seed, out, error=str(error))


def fly(
    scenario: Scenario, seed: int, out: Path, points: bool = False, threads: int = 1,
    on_frame: Callable[[], None] | None = None,
) -> Flight:  # fmt: skip
    """One flight with images, a folder, or without, an ``.npz``. Raises GpvoError where it goes wrong."""
    if points:
        return fly_points(scenario, seed, out)
    from gpvo.sim.sequence import simulate

    return simulate(scenario, seed, out, threads=threads, on_frame=on_frame)


def fly_points(scenario: Scenario, seed: int, out: Path) -> Flight:
    """One flight without images, written as ``.npz``; an existing file of that name is written anew."""
    from gpvo.sim.points import simulate_points

    flight = simulate_points(points_scenario(scenario), seed)
    flight.save(out)
    return Flight(seed, out, len(flight.t_s), float(path_length_m(flight.motion.position_m)[-1]))
