"""``gpvo twin``: runs simulated again from their own tracks, for those without ground truth."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from stat import S_ISDIR
from tempfile import TemporaryDirectory, gettempdir
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from gpvo.cli.common import refuse_idle
from gpvo.cli.output import Json, answer, note, print_json, progress, say, show, status
from gpvo.dataset.errors import require_attitude
from gpvo.errors import GpvoError, OutputError, counted
from gpvo.files import FolderLock
from gpvo.io.run import Run, read_run
from gpvo.online.features import AXES

if TYPE_CHECKING:
    from gpvo.twin.replicate import TwinSettings


@dataclass(frozen=True)
class TwinOptions:
    """How twins are made."""

    replicates: Annotated[int, "Twins per run.", {"min": 2, "max": 1000}] = 8
    tolerance: Annotated[
        str,
        "Tolerance of the calibration: none, t265, d455, zed2, oak-d, kitti, euroc, or a TOML file"
        " with baseline and focal (fractions) and rotation_rad. Each twin draws its own error.",
    ] = "none"
    gap: Annotated[
        str | None, "By how much real errors exceed those of twins: drives, or the JSON of 'gpvo twin --against'."
    ] = None

    def settings(self, seed: int) -> TwinSettings:
        """The flags, parsed. Raises GpvoError for an unknown tolerance or a file without a gap."""
        with status("starting"):
            from gpvo.twin.gap import read_gap
            from gpvo.twin.replicate import TwinSettings, read_tolerance

        name, sigma = read_tolerance(self.tolerance)
        return TwinSettings(self.replicates, sigma, name, seed, None if self.gap is None else read_gap(self.gap))

    def asked(self, ctx: typer.Context, twins: bool, seed: int, *others: str) -> TwinSettings | None:
        """:meth:`settings` with ``--twins``, else None.

        Raises GpvoError for one of these flags, or of the ``others``, that has no effect without it.
        """
        if twins:
            return self.settings(seed)
        refuse_idle(ctx, (*(f.name for f in fields(self)), *others), "without --twins", "add --twins")
        return None


TWINS = "For runs without ground truth, use twins: the runs simulated again from their tracks (gpvo run --keep-tracks)."
Twins = Annotated[bool, TWINS]
Seed = Annotated[
    int, "Random seed of the twins; not that of 'gpvo train', so a model is judged on other twins.", {"min": 0}
]


def twin(
    ctx: typer.Context,
    runs: Annotated[list[Path], "Run folders made with --keep-tracks."],
    out: Annotated[Path | None, "Folder for the twins."] = None,
    against: Annotated[bool, "Compare with the runs' ground truth: real errors over predicted ones."] = False,
    align: Annotated[str, "Fit between log and truth: a fixed rotation, transform (with lever arm) or none."] = "none",
    options: TwinOptions = TwinOptions(),
    seed: Annotated[int, "Random seed.", {"min": 0}] = 0,
    jobs: Annotated[int, "Twins to make in parallel; -1 for one per core."] = 1,
    json_: Json = False,
) -> None:
    """Simulate runs again, so that their errors are known.

    Each twin is a run folder with exact truth, made from the run's own tracks. Finished ones are kept where an
    interrupted command is started again.

    Example: gpvo twin runs/mine -o twins --tolerance d455
    """
    if not against:
        refuse_idle(ctx, ("align",), "without --against", "add --against")
    settings = options.settings(seed)
    if out is None and not against:
        raise GpvoError("no folder was given for the twins", cure="give a folder with -o, or compare with --against")
    real: list[Run] = []
    if against:  # before the work, not after it
        with status("starting"):
            from gpvo.dataset.build import aligned

        real = [aligned(read_run(path), align)[0] for path in runs]
    if without := [run.path for run in real if run.truth is None]:
        raise GpvoError("has no ground truth to compare twins with", where=without[0], cure="leave out --against")
    for run in real:
        assert run.truth is not None
        require_attitude(run.log, run.truth, run.path)
    with nullcontext(out) if out is not None else TemporaryDirectory(prefix="gpvo-twins-") as folder:
        made = make_all(runs, Path(folder), settings, jobs)
        if against:
            n = settings.replicates
            _print_ratios(real, [made[i : i + n] for i in range(0, len(made), n)], json_)
            return
    told = f"{out}: {len(made)} twins of {counted(len(runs), 'run')}"
    answer(json_, {"schema": 1, "twins": [str(p) for p in made]}, lambda: print(told))


def _print_ratios(runs: Sequence[Run], twins: Sequence[Sequence[Path]], json_: bool) -> None:
    from gpvo.evaluation.by_twins import SPANS, ratios
    from gpvo.twin.gap import pooled

    found = np.array([ratios(run, [read_run(t) for t in made]) for run, made in zip(runs, twins, strict=True)])
    names = [run.path.resolve().name for run in runs]
    mean, spread = pooled(found)
    if json_:
        of_all = {s: {"ratio": m, "spread": d} for s, m, d in zip(SPANS, mean, spread)}
        each = [{"run": n, "ratio": dict(zip(SPANS, r))} for n, r in zip(names, found)]
        print_json({"schema": 1, "axes": AXES, "runs": each, "pooled": of_all})
        return
    each_run = ((name, span, row) for name, of_run in zip(names, found) for span, row in zip(SPANS, of_run))
    rows = [[name, span, *(f"{v:.2f}" for v in row)] for name, span, row in each_run if np.isfinite(row).any()]
    for span, m, d in zip(SPANS, mean, spread):
        if np.isfinite(m).any():  # none of the runs is so long
            rows.append(["all (spread)", span, *(f"{v:.2f} ({w:.2f})" for v, w in zip(m, d))])
    show(("run", "over", *AXES), rows)
    print("real over predicted error, root mean square; the truth's own noise is taken into account")


def make_all(runs: Sequence[Path], out: Path, settings: TwinSettings, jobs: int = 1) -> list[Path]:
    """Twins of all runs, with a progress bar; runs with the same name get distinct names."""
    from gpvo.evaluation.evaluate import distinct
    from gpvo.twin.replicate import make_twins

    made: list[Path] = []
    names = distinct([run.resolve().name for run in runs])
    with progress("twins", settings.replicates * len(runs)) as advance:
        for run, name in zip(runs, names, strict=True):
            made += make_twins(run, out / name, settings, jobs=jobs, on_twin=advance)
    return made


@contextmanager
def twins_of(runs: Sequence[Path], settings: TwinSettings, jobs: int = 1) -> Iterator[list[Path]]:
    """Twins of all runs for as long as the context is open. A command that is killed leaves those that are finished,
    and goes on with them when it is started again: their folder is named by the runs and settings."""
    from gpvo.io.snapshot import digest_of

    key = digest_of([str(run.resolve()) for run in runs], asdict(settings))[:16]
    folder = Path(gettempdir()) / f"gpvo-twins-{key}"
    with ExitStack() as stack:
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            place = folder.lstat()
            if not S_ISDIR(place.st_mode) or (hasattr(os, "getuid") and place.st_uid != os.getuid()):
                raise OutputError("is somebody else's", where=folder)
            if not stack.enter_context(FolderLock(folder)).holds(folder):
                raise OutputError("cannot be locked", where=folder)
        except (OSError, OutputError):  # or the same command runs already
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="gpvo-twins-")))
        try:
            yield make_all(runs, folder, settings, jobs)
        except Exception:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        shutil.rmtree(folder, ignore_errors=True)


def say_simulated(about: Mapping[str, Any]) -> None:
    """The line above every table whose truth comes from twins."""
    name, twins, tolerance = about["of"], about["twins"], about["tolerance_name"]
    say(f"{name} has no ground truth: means over {twins} twins, whose truth is simulated (tolerance {tolerance})")


@contextmanager
def in_place_of_runs_without_truth(
    paths: list[Path], settings: TwinSettings | None, jobs: int = 1
) -> Iterator[list[Path]]:
    """Runs with truth, and twins of the others, for as long as the context is open; no twins without settings."""
    if settings is None:
        yield paths
        return
    without = []
    for path in paths:
        if (run := read_run(path)).truth is None:
            without.append(path)
        else:
            note(f"gpvo: {run.name} has ground truth: no twins are made of it")
    with twins_of(without, settings, jobs) as made:
        yield [p for p in paths if p not in without] + made
