"""Whatever bytes a file holds, reading it works or is refused in one line: never another exception."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io import open_source, read_run
from gpvo.io.foreign import read_foreign
from gpvo.io.run import write_run
from gpvo.types import Mounting, Status, StereoCamera, TruthLog, VoLog, VoRecord


def _run(root: Path) -> Path:
    poses = se3.exp(np.random.default_rng(0).normal(size=(30, 6)))
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    C = {"triangulation": np.eye(6)}
    records += [VoRecord(k * 10, k * 10 - 10, Status.OK, poses[k], covariances=C) for k in range(1, 30)]
    camera = StereoCamera(400.0, 400.0, 320.0, 240.0, 0.1, 640, 480)
    truth = TruthLog(np.arange(30) * 10, poses)
    write_run(root / "run", VoLog(records, camera), truth=truth, mounting=Mounting(T_body_cam=np.eye(4)))
    return root / "run"


def _euroc(root: Path) -> Path:
    from sequences import write_euroc

    return write_euroc(root / "euroc", 4)


def _tracks(root: Path) -> Path:
    from test_tracks_source import arrays, save

    return save(root / "tracks.npz", arrays())


def _bag(root: Path) -> Path:
    from bag_maker import stereo_bag

    return stereo_bag(True, 4).write(root / "stereo.bag")


def _csv(root: Path) -> Path:
    lines = ["t,x,y,z,qx,qy,qz,qw", *(f"{k}.5,{k},0,0,0,0,0,1" for k in range(20))]
    (root / "log.csv").write_text("\n".join(lines))
    return root / "log.csv"


def _draw_all(path: Path) -> None:
    for _ in open_source(path):
        pass


@pytest.mark.parametrize(
    ("make", "read"),
    [(_run, read_run), (_euroc, _draw_all), (_tracks, _draw_all), (_bag, _draw_all), (_csv, read_foreign)],
    ids=["run", "euroc", "tracks", "bag", "csv"],
)
def test_damage_is_refused_or_harmless(tmp_path, make, read):
    path = make(tmp_path)
    files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
    rng = np.random.default_rng(7)
    for _ in range(40):
        file = files[rng.integers(len(files))]
        raw = file.read_bytes()
        damaged = np.frombuffer(raw, dtype=np.uint8).copy()
        at = rng.integers(len(damaged), size=rng.choice([1, 3, 20]))
        damaged[at] = rng.integers(256, size=len(at))
        file.write_bytes(damaged.tobytes())
        message = ""
        try:
            read(path)
        except GpvoError as error:
            message = str(error)
        assert "\n" not in message
        file.write_bytes(raw)
