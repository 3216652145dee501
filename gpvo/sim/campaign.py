"""Many seeds of a scenario: on the cores of this machine, or on a dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpvo.errors import GpvoError, MissingExtraError
from gpvo.sim.scenario import Scenario, points_scenario


@dataclass(frozen=True)
class Flight:
    """One task's outcome. ``error``: one line where it failed, else empty."""

    seed: int
    path: Path
    frames: int = 0
    distance_m: float = 0.0
    redone: bool = True
    error: str = ""


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

    Raises
    ------
    GpvoError
        For an unknown backend.
    MissingExtraError
        For ``dask`` without the extra.
    """
    suffix = ".npz" if points else ""
    tasks = [(scenario, seed, out / f"seed_{seed}{suffix}", points) for seed in seeds]
    out.mkdir(parents=True, exist_ok=True)
    if backend == "joblib":
        from joblib import Parallel, delayed

        return list(Parallel(n_jobs=jobs)(delayed(fly_one)(*task) for task in tasks))
    if backend != "dask":
        raise GpvoError(f"unknown backend '{backend}'", cure="choose joblib or dask")
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError("distributed", "dask") from error
    options: dict[str, Any] = {"address": scheduler} if scheduler else {"n_workers": jobs, "threads_per_worker": 1}
    with Client(**options) as client:
        return list(client.gather([client.submit(fly_one, *task, pure=False) for task in tasks]))


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

    info = simulate(scenario, seed, out, threads=threads, on_frame=on_frame)
    return Flight(seed, out, info.frames, info.distance_m, info.redone)


def fly_points(scenario: Scenario, seed: int, out: Path) -> Flight:
    """One flight without images, written as ``.npz``; an existing file of that name is written anew."""
    import numpy as np

    from gpvo.sim.points import simulate_points

    flight = simulate_points(points_scenario(scenario), seed)
    flight.save(out)
    steps = np.linalg.norm(np.diff(flight.motion.position_m, axis=0), axis=1)
    return Flight(seed, out, len(flight.t_s), float(steps.sum()))
