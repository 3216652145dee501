"""Mutated inputs of every kind, read one after the other in a process with limits: ``campaign.py SEEDS FIRST COUNT``.

Each case is its number: the same number makes the same file. A line of JSON is printed for each case that does not end
as it has to: read, or refused by one line that names the file, in time and without much memory.
"""

from __future__ import annotations

import gc
import json
import resource
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace as Named
from typing import Any
from unittest.mock import patch

import numpy as np
from gpvo.types import StereoCamera
from mutators import ANY_BYTES, Rng, odd_kept, odd_model, odd_table, odd_tracks

SECONDS, MEGABYTES = 10, 1000


# -- readers --


def read_model(path: Path) -> None:
    from gpvo.cli.describe import describe
    from gpvo.geometry.covariance import is_positive_definite
    from gpvo.online.predictor import Predictor

    describe(path, None, {})
    predictor = Predictor.load(path)
    n = len(predictor.features)
    for x in (predictor.model.domain.centre, np.zeros(n), np.full(n, np.nan)):
        said = predictor.predict(x)
        assert is_positive_definite(said.covariance), "a covariance that is none"
        assert np.isfinite(said.mean).all(), "a mean that is none"


def read_run_folder(path: Path) -> None:
    from gpvo.geometry.covariance import are_covariances
    from gpvo.io.run import read_run

    run = read_run(path)
    assert np.isfinite(run.log.trajectory()).all(), "a trajectory that is none"
    told = list(flying_model().replay(run.log).values())
    assert are_covariances(np.array([p.covariance for p in told])).all(), "a covariance that is none"
    assert np.isfinite([p.mean for p in told]).all(), "a mean that is none"


CAMERA = StereoCamera(60.0, 60.0, 32.0, 24.0, 0.1, 64, 48)


@cache
def flying_model() -> Any:
    """The model that comes with gpvo."""
    from gpvo.online.predictor import Predictor

    return Predictor.load(Path(__file__).parents[2] / "models" / "tunnel.gpvo")


def read_source(path: Path) -> None:
    from gpvo.io import open_source

    for _ in zip(range(3), open_source(path)):
        pass


def read_yaml(path: Path) -> None:
    from gpvo.cameras.readers import read_stereo_yaml

    read_stereo_yaml(path)


def read_log(path: Path) -> None:
    from gpvo.io.foreign import read_foreign
    from gpvo.io.stated import to_records

    log = read_foreign(path, None, rate_hz=10.0)
    assert all(np.isfinite(r.T_prev_cur).all() for r in to_records(log)[0]), "a motion that is none"


def read_planned_path(path: Path) -> None:
    from gpvo.evaluation.forecast import read_plan

    assert np.isfinite(read_plan(path, 0.1).motions).all(), "a motion that is none"


def read_settings(path: Path) -> None:
    from gpvo.files import read_toml

    read_toml(path)


def read_image(path: Path) -> None:
    from gpvo.io.images import read_grey8

    read_grey8(path)


def read_bag(path: Path) -> None:
    from gpvo.io.bag_messages import read_poses
    from gpvo.io.bag_reader import POSE_TYPES, open_bag, topics_of
    from gpvo.live.doctor import examine_bag

    with open_bag(path) as reader:
        topics = list(topics_of(reader, POSE_TYPES))
    for topic in topics:
        if len(read_poses(path, topic, lambda _: None)[0]) >= 10:
            examine_bag(path, topic)


def read_seen(path: Path) -> None:
    """A run with what odometry saw, as ``gpvo twin`` takes it."""
    from gpvo.twin.replicate import estimate

    structure = estimate(path).structure
    assert np.isfinite(structure.T_world_cam).all(), "a pose that is none"


def read_calibration_state(path: Path) -> None:
    from gpvo.geometry.covariance import is_positive_definite
    from gpvo.vo.rig_findings import findings, read_state

    state = read_state(path, CAMERA)
    assert is_positive_definite(state.covariance), "a covariance that is none"
    findings(state, CAMERA)


def read_gap_or_tolerance(path: Path) -> None:
    from gpvo.twin.gap import read_gap
    from gpvo.twin.replicate import read_tolerance

    if path.suffix == ".toml":
        read_tolerance(str(path))
    else:
        assert np.isfinite(read_gap(str(path)).factors(8)).all(), "a factor that is none"


def read_options(path: Path) -> None:
    """The options of a command, as ``--config`` takes them."""
    from gpvo.cli.common import options_of_file

    for name, needed in NEEDED.items():
        command = commands()[name]
        command.make_context(name, [*options_of_file(path, name, commands()), *needed])


@cache
def commands() -> dict[str, Any]:
    from gpvo.cli import app
    from typer.main import get_group

    return dict(get_group(app).commands)


NEEDED = {"run": ["x", "-o", "y"], "live": ["--model", "x"], "evaluate": ["x"]}


def read_stated_motions(path: Path) -> None:
    from gpvo.evaluation.score import score_sequence

    score = score_sequence(path / "stated.txt", path / "truth.txt")
    assert np.isfinite([score["nll_per_dim"], score["energy_rotation_rad"]]).all(), "a score that is none"


def read_live_state(path: Path) -> None:
    """A live session that goes on from it, with three poses of somebody's odometry."""
    from gpvo.geometry.covariance import is_positive_definite
    from gpvo.live.engine import Engine
    from gpvo.live.intake import Arrival
    from gpvo.live.stages import PoseStage

    live = Engine(PoseStage("/odom"), flying_model(), [], state=path)
    for k in range(3):
        for said in live.take(Arrival("/odom", _pose_message(k), k * 10**8)):
            assert np.isfinite(said.T_odom_body).all(), "a pose that is none"
            assert is_positive_definite(said.pose_covariance), "a covariance that is none"
    assert not live.counts["failed"], "a state that cannot be gone on with"


def _pose_message(k: int) -> Any:
    position, stamp = Named(x=0.1 * k, y=0.0, z=0.0), Named(sec=1_700_000_000, nanosec=k * 10**8)
    pose = Named(position=position, orientation=Named(x=0.0, y=0.0, z=0.0, w=1.0))
    header, covariance = Named(stamp=stamp, frame_id="odom"), np.eye(6).ravel() * 1e-4 * (k + 1)
    return Named(header=header, child_frame_id="base_link", pose=Named(pose=pose, covariance=covariance))


def bytes_of(source: Any) -> list[object]:
    """What a source is known by here: a copy has times of its own, by which its run would begin anew."""
    return [Path(source.path).read_bytes()]


def read_broken_run(path: Path) -> None:
    """A run that broke off, gone on with from the state of its last chunk."""
    from gpvo import runner
    from gpvo.io import open_source
    from gpvo.io.run import read_run

    with patch.object(runner, "_content", bytes_of):
        runner.run(open_source(path / "source.npz"), path / "run", keep_tracks=True, overwrite=False, options={})
    assert np.isfinite(read_run(path / "run").log.trajectory()).all(), "a trajectory that is none"


READERS: dict[str, tuple[Callable[[Path], None], Callable[[Path, Rng], None] | None]] = {
    "model": (read_model, odd_model),
    "tracks": (read_source, odd_tracks),
    "run": (read_run_folder, odd_table),
    "sequence": (read_source, None),
    "calibration": (read_yaml, None),
    "log": (read_log, None),
    "plan": (read_planned_path, None),
    "settings": (read_settings, None),
    "image": (read_image, None),
    "bag": (read_bag, None),
    "recording": (read_source, None),
    "seen": (read_seen, odd_table),
    "calibration state": (read_calibration_state, None),
    "gap": (read_gap_or_tolerance, None),
    "options": (read_options, None),
    "stated": (read_stated_motions, None),
    "live state": (read_live_state, None),
    "broken run": (read_broken_run, odd_kept),
}

SLOW_KINDS = ("broken run", "bag", "recording", "seen")  # 20 to 90 ms a case; the others take 1 to 20
TURNS = [*READERS, *(kind for kind in READERS if kind not in SLOW_KINDS)]
"""The kinds of case, in the order in which they come."""


# -- cases --


@cache
def listed(folder: Path) -> tuple[list[Path], list[Path]]:
    """The seeds of a kind, and all their files."""
    return sorted(folder.iterdir()), [p for p in sorted(folder.rglob("*")) if p.is_file()]


def mutated(seeds: Path, number: int, work: Path) -> tuple[str, Path, Path]:
    """The kind of a case, what is to be read, and the file in it that was changed."""
    rng = np.random.default_rng(number)
    kind = TURNS[number % len(TURNS)]
    chosen, others = listed(seeds / kind)
    seed = chosen[int(rng.integers(len(chosen)))]
    target = work / seed.name
    if seed.is_dir():
        shutil.copytree(seed, target)
        files = sorted(p for p in target.rglob("*") if p.is_file())
        changed = files[int(rng.integers(len(files)))]
    else:
        shutil.copy(seed, target)
        changed = target
    odd = READERS[kind][1]
    if odd is not None and rng.random() < 0.5 and changed.suffix in (".npz", ".gpvo", ".parquet"):
        odd(changed, rng)
    else:
        mutate = ANY_BYTES[int(rng.integers(len(ANY_BYTES)))]
        other = others[int(rng.integers(len(others)))].read_bytes()
        changed.write_bytes(mutate(changed.read_bytes(), rng, other))
    return kind, target, changed


def _peak_mb() -> float:
    """Largest resident set of this process; ``ru_maxrss`` would begin with that of the one that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024


def problems(seeds: Path, first: int, count: int, work: Path) -> Iterator[dict[str, Any]]:
    """What went wrong, case by case, and which took more memory than any should. ``work`` is emptied for each."""
    from gpvo.errors import GpvoError

    def hang(*_: object) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    signal.signal(signal.SIGPROF, hang)
    most_mb = MEGABYTES + 300.0  # of Python and its libraries
    for number in range(first, first + count):
        if number == first + len(TURNS):  # all that is loaded stays: it is searched for garbage no more
            gc.collect()
            gc.freeze()
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        (work.parent / f"{work.name}.case").write_text(str(number))
        kind, target, changed = mutated(seeds, number, work)
        case = {"case": number, "kind": kind, "file": changed.name}
        started, told = time.monotonic(), ""
        signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: the machine may have other work
        try:
            with warnings.catch_warnings(record=True) as beside:
                warnings.simplefilter("always")
                READERS[kind][0](target)
        except GpvoError as refusal:
            told = str(refusal)
            if "\n" in told or target.name not in told:
                yield {**case, "problem": f"names no file: {told[:200]}"}
        except BaseException as error:
            yield {**case, "problem": f"{type(error).__name__}: {str(error)[:200]}", "s": time.monotonic() - started}
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        ours = [w for w in beside if "gpvo" in w.filename and issubclass(w.category, RuntimeWarning)]
        if ours:
            yield {**case, "problem": f"{ours[0].filename}:{ours[0].lineno}: {ours[0].message}"}
        peak_mb = _peak_mb()
        if peak_mb > most_mb:
            most_mb = 1.2 * peak_mb
            yield {**case, "problem": f"{peak_mb:.0f} MB {told[:200]}"}


def main() -> None:
    seeds, first, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    for problem in problems(seeds, first, count, seeds.parent / f"work-{first}"):
        print(json.dumps(problem), flush=True)


if __name__ == "__main__":
    main()
