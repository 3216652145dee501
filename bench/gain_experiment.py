"""What does the Gaussian process gain over its own mean function? Real and simulated data sets, sequences left out.

``python -m bench.gain_experiment DATA -o DIR [--only drives,bursts] [--flights 8] [--duration 60]``

``DATA`` is the folder of real data that the tests read. Each set is trained and judged as ``gpvo train`` does it, each
sequence left out in turn; the table is the paired difference of ``learned`` less ``base`` by sequence. ``poses alone``:
the same flights as a log that holds nothing but the odometry's poses. What ``DIR/gain.json`` holds is not judged again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gpvo.cli.files import import_log
from gpvo.dataset.build import TrainingSet, build
from gpvo.files import markdown_table, read_json, write_json
from gpvo.io import open_source
from gpvo.io.foreign import read_foreign
from gpvo.io.run import Run, is_finished, read_run
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.runner import run as run_vo
from gpvo.types import VoLog, VoRecord

from bench.experiment_flights import Campaign, training_runs
from bench.shim_experiment import imported

TUNNELS = ("tunnel-clean", "tunnel-noise", "tunnel-bursts")


@dataclass(frozen=True)
class Place:
    """Where data comes from and runs go: ``data``, ``out``; ``flights`` of ``duration_s`` in a simulated set."""

    data: Path
    out: Path
    flights: int
    duration_s: float


Load = Callable[[Place], list[TrainingSet]]


def drives(place: Place) -> list[TrainingSet]:
    """Six KITTI drives as feature tracks."""
    runs = []
    for tracks in sorted((place.data / "tracks").glob("*.npz")):
        run = place.out / "drives" / tracks.stem
        if not is_finished(run):
            run_vo(open_source(tracks), run)
        runs.append(read_run(run))
    return [TrainConfig().rows_of(r) for r in runs]


def stereo_logs(place: Place) -> list[TrainingSet]:
    """Five logs of a SIFT and PnP odometry."""
    sets = []
    for log in sorted((place.data / "kitti_stereo_vo").glob("*_est.txt")):
        run = place.out / "stereo-logs" / log.stem
        if not is_finished(run):
            truth = read_foreign(log.with_name(log.name.replace("_est", "_gt")), complete=True)
            import_log(read_foreign(log), truth, run)
        sets.append(TrainConfig().rows_of(read_run(run)))
    return sets


def inertial_logs(system: str) -> Load:
    """Seven logs of a visual-inertial odometry."""

    def load(place: Place) -> list[TrainingSet]:
        logs = sorted((place.data / "euroc_vio_logs").glob(f"*/{system}.tum"))
        sets = [TrainConfig().rows_of(read_run(imported(p, place.out / "runs"))) for p in logs]
        return [replace(s, name=f"{p.parent.name}") for s, p in zip(sets, logs, strict=True)]

    return load


def flights(*scenarios: str, poses_alone: bool = False, images: bool = False) -> Load:
    """Simulated flights of one or more scenarios, the same number of each."""

    def load(place: Place) -> list[TrainingSet]:
        count, sets = max(place.flights // len(scenarios), 2), []
        for scenario in scenarios:
            seconds = place.duration_s * (0.4 if images else 1.0)
            runs = training_runs(Campaign(scenario, place.out / "flights", seconds, pictures=images), count)
            sets += [_poses_alone(r) if poses_alone else TrainConfig().rows_of(r) for r in runs]
        return sets

    return load


def _poses_alone(run: Run) -> TrainingSet:
    bare = [VoRecord(r.t_ns, r.t_prev_ns, r.status, r.T_prev_cur, reason=r.reason) for r in run.log]
    return build(VoLog(bare), run.truth, name=run.path.name)


SETS: dict[str, tuple[str, Load]] = {
    "drives": ("six drives (tracks)", drives),
    "stereo-logs": ("five logs of a stereo VO", stereo_logs),
    "vins-fusion": ("seven logs of VINS-Fusion", inertial_logs("vins-fusion")),
    "vins-mono": ("seven logs of VINS-Mono", inertial_logs("vins-mono")),
    "pls-vio": ("seven logs of PLS-VIO", inertial_logs("pls-vio")),
    "tunnels": ("three kinds of tunnel", flights(*TUNNELS)),
    "bursts": ("tunnel, bursts", flights("tunnel-bursts")),
    "moon": ("rover on the moon", flights("lunar-straight")),
    "hall": ("hall, fisheye camera", flights("room-t265")),
    "traffic": ("street with traffic", flights("street-traffic")),
    "images": ("tunnel, bursts, images", flights("tunnel-bursts", images=True)),
    "tunnels-poses": ("three kinds of tunnel, poses alone", flights(*TUNNELS, poses_alone=True)),
    "bursts-poses": ("tunnel, bursts, poses alone", flights("tunnel-bursts", poses_alone=True)),
    "moon-poses": ("rover on the moon, poses alone", flights("lunar-straight", poses_alone=True)),
}


def judge(name: str, place: Place) -> dict[str, Any]:
    """One set: title, sequences, chosen inputs, and the differences with their intervals [nats per axis]."""
    title, load = SETS[name]
    sets = load(place)
    trained = train_sets(sets, TrainConfig())
    return {"set": title, "sequences": len(sets), "inputs": trained.header["choices"]["inputs"],
            **trained.table["comparison"]["learned_less_base"]}  # fmt: skip


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """One line per set."""
    return "\n".join(markdown_table(list(rows[0]), [[str(v) for v in r.values()] for r in rows]))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", default=",".join(SETS))
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--duration", type=float, default=60.0, help="of a simulated flight [s]")
    given = parser.parse_args(arguments)
    place, kept = Place(given.data, given.out, given.flights, given.duration), given.out / "gain.json"
    rows = read_json(kept)["sets"] if kept.is_file() else {}
    for name in given.only.split(","):
        if name not in rows:
            rows[name] = judge(name, place)
            print(rows[name], file=sys.stderr, flush=True)
            write_json(kept, {"schema": 1, "sets": rows})
    print(markdown(list(rows.values())))


if __name__ == "__main__":
    main()
