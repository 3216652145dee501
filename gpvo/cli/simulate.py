"""``gpvo simulate``: sequences with exact truth, from nothing but a name and a seed."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpvo.cli.output import Json, answer, progress
from gpvo.errors import GpvoError
from gpvo.files import parse_toml, refuse_foreign

if TYPE_CHECKING:
    from gpvo.sim.scenario import Flight, Scenario

_SEED_LIMIT = 100_000


def simulate(
    scenario: Annotated[str | None, typer.Argument(help="Name of a scenario (see --list), or a TOML file.")] = None,
    out: Annotated[Path | None, "Folder to write; with --points, a .npz file."] = None,
    seed: Annotated[int | None, "Random seed; default 0, or the one in the TOML file.", {"min": 0}] = None,
    seeds: Annotated[str | None, "Several seeds, such as 0..9 or 1,4,7; each flight goes to OUT/seed_N."] = None,
    duration: Annotated[float | None, "Length of the flight [s]."] = None,
    rate: Annotated[float | None, "Frames per second."] = None,
    speed: Annotated[float | None, "Speed [m/s]."] = None,
    trajectory: Annotated[
        Path | None, "Path to fly, scaled to fit the world: TUM lines or EuRoC CSV, z up, or a run."
    ] = None,
    camera: Annotated[str | None, "pinhole, euroc, t265, a Kalibr, OpenCV, ROS or KITTI file, or a run."] = None,
    like: Annotated[
        Path | None, "Run folder with tracks: fly its path, with its camera, rate, depths, track count and noise."
    ] = None,
    points: Annotated[bool, "Landmark tracks instead of images: a thousand times faster."] = False,
    jobs: Annotated[int, "Flights to simulate in parallel with --seeds; -1 for one per core."] = 1,
    threads: Annotated[int, "Threads per flight; they do not change the result.", {"min": 1}] = 2,
    backend: Annotated[str, "local, or dask."] = "local",
    scheduler: Annotated[str | None, "Address of a dask scheduler."] = None,
    preview: Annotated[Path | None, "Write a contact sheet of the images (PNG)."] = None,
    list_: Annotated[bool, "List the scenarios."] = False,
    set_: Annotated[
        list[str] | None, "Setting of the scenario, with dots for tables; repeatable.", {"metavar": "KEY=VALUE"}
    ] = None,
    json_: Json = False,
) -> None:
    """Simulate stereo sequences with IMU and exact truth.

    Example: gpvo simulate tunnel-clean -o seq/ --seed 1 --duration 30
    """
    if list_:
        _show_list(json_)
        return
    if scenario is None:
        raise GpvoError("nothing to simulate", cure="gpvo simulate SCENARIO -o OUT, or gpvo simulate --list")
    if out is None and preview is None:
        raise GpvoError("nowhere to write", cure="give -o OUT, or --preview PNG for a look at the images")
    if preview is not None and preview.suffix.lower() != ".png":
        raise GpvoError("does not have the suffix of a PNG", where=preview, cure="end it in .png")
    if points and preview:
        raise GpvoError("--points draws no images to preview", cure="leave out one of --points, --preview")
    if preview is not None:
        from gpvo.sim.sequence import SHEET

        refuse_foreign(preview, *SHEET)  # before the work, not after it
    from gpvo.sim.scenario import fly_campaign, load_scenario, stated_seed, warn_of_unused

    given = {"duration_s": duration, "rate_hz": rate, "speed_mps": speed, "camera": camera,
             "trajectory": None if trajectory is None else str(trajectory)}  # fmt: skip
    overrides = (
        _like(like, points) | {k: v for k, v in given.items() if v is not None} | dict(map(_assignment, set_ or []))
    )
    chosen = load_scenario(scenario, overrides)
    if points:
        warn_of_unused(chosen)
    if seeds is not None and seed is not None:
        raise GpvoError("--seed and --seeds are mutually exclusive", cure="leave out one of them")
    # A contact sheet alone keeps no sequence.
    with nullcontext() if out is not None else TemporaryDirectory() as temporary:
        target = out or Path(temporary or "") / chosen.name
        if seeds is None:
            flights = [_one(chosen, stated_seed(scenario) if seed is None else seed, target, points, threads)]
        else:
            backend = "local" if backend == "joblib" else backend  # its name until 2026
            flights = fly_campaign(
                chosen, _seeds(seeds), target, points=points, jobs=jobs, backend=backend, scheduler=scheduler
            )
        _tell(chosen, flights, json_, preview)


def _like(run: Path | None, points: bool) -> dict[str, Any]:
    if run is None:
        return {}
    if not points:
        raise GpvoError("--like makes no images", cure="add --points: landmark tracks instead of images")
    from gpvo.sim.like import like

    return like(run)


def _one(scenario: Scenario, seed: int, out: Path, points: bool, threads: int) -> Flight:
    from gpvo.sim.scenario import fly

    if points:
        return fly(scenario, seed, out if out.suffix == ".npz" else out.with_name(out.name + ".npz"), points)
    with progress("frames", int(scenario.duration_s * scenario.rate_hz) + 1) as advance:
        return fly(scenario, seed, out, threads=threads, on_frame=advance)


def _tell(scenario: Scenario, flights: list[Flight], json_: bool, preview: Path | None) -> None:
    good = [f for f in flights if not f.error]
    if preview is not None and good:
        from gpvo.sim.sequence import contact_sheet

        contact_sheet(good[0].path, preview)
    lines = []
    for f in flights:
        what = f.error or f"{f.frames} frames, {f.distance_m:.1f} m" + ("" if f.redone else ", already there")
        lines.append(what if what.startswith(f"{f.path}: ") else f"{f.path}: {what}")
    document = {"schema": 1, "scenario": scenario.name, "flights": [vars(f) for f in flights]}
    answer(json_, document, lambda: print(*lines, sep="\n"))
    if len(good) < len(flights):
        raise GpvoError(f"{len(flights) - len(good)} of {len(flights)} flights failed", cure="see the lines above")


def _show_list(json_: bool) -> None:
    from gpvo.sim.scenario import load_scenario, names

    known = {name: load_scenario(name).about for name in names()}
    lines = (f"{name:16s}{about}" for name, about in known.items())
    answer(json_, {"schema": 1, "scenarios": known}, lambda: print(*lines, sep="\n"))


def _assignment(text: str) -> tuple[str, Any]:
    """``key=value`` with a TOML value; anything that is not TOML is text."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise GpvoError(f"--set '{text}' is not key=value", cure="such as --set noise_sigma=0.05")
    try:
        return key.strip(), parse_toml(f"v = {value}")["v"]
    except ValueError:
        return key.strip(), value.strip()


def _seeds(text: str) -> list[int]:
    """``0..9`` (both ends), ``3`` or ``1,4,7``."""
    out: list[int] = []
    try:
        for part in text.split(","):
            first, dots, last = part.partition("..")
            a, b = int(first), int(last if dots else first)
            if not 0 <= a <= b < a + _SEED_LIMIT:
                raise ValueError
            out += range(a, b + 1)
    except ValueError:
        raise GpvoError(f"--seeds '{text}' is not a list of seeds", cure="such as 0..9 or 1,4,7") from None
    return list(dict.fromkeys(out))
