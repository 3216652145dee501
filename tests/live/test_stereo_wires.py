"""Pictures of EuRoC's size at 20 Hz from one process, ``gpvo live --stereo`` in another, somebody else's reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from gpvo.cameras.rectify import Rectifier
from gpvo.cameras.rig import StereoRig
from gpvo.geometry import se3
from gpvo.online.predictor import Predictor
from gpvo.publish.odometry import Odometry, OdometryBuilder, messages
from gpvo.types import StereoFrame, VoLog
from gpvo.vo.odometry import StereoOdometry
from rendered_clip import write_pairs
from test_wires import WIRES, check
from wire_peers import ROOT, ends, live, place, reader, running

MODEL = ROOT / "models" / "tunnel.gpvo"
PAIRS = 24


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pairs(tmp_path_factory.mktemp("clip") / "clip.npz", PAIRS)


def offline(clip: Path, stamps: list[int]) -> list[Odometry]:
    """What the same pictures give without a wire."""
    with np.load(clip) as data:
        pairs, (f, cx, cy, b) = data["pairs"], (float(data[k]) for k in ("f", "cx", "cy", "baseline_m"))
    from gpvo.cameras.models import PinholeRadtan

    lens = PinholeRadtan(f, f, cx, cy, pairs.shape[3], pairs.shape[2])
    rectifier = Rectifier(StereoRig(lens, lens, se3.exp(np.array([-b, 0, 0, 0, 0, 0]))))
    odometry = StereoOdometry(rectifier.camera, mask=rectifier.mask)
    frames = [StereoFrame(t, *rectifier.apply(*pair)) for t, pair in zip(stamps, pairs, strict=True)]
    predictor = Predictor.load(MODEL)
    predictor.reset(rectifier.camera)
    log = VoLog([odometry.step(frame) for frame in frames], rectifier.camera)
    builder = OdometryBuilder(method="pointing_matching")
    predictions = predictor.replay(log)
    return [m for m in messages(log, lambda r: predictions.get(r.t_ns), builder) if m.twist_body is not None]


@pytest.mark.parametrize("wire", WIRES)
def test_every_pair_arrives_with_the_numbers_of_the_offline_path(wire: str, clip: Path, tmp_path: Path) -> None:
    stereo = ("--stereo", "/left/image_raw", "/right/image_raw", "--model", str(MODEL))
    with (
        place(wire) as at,
        live(at, *stereo) as process,
        reader(at, PAIRS - 1, tmp_path) as (_, rows),
    ):
        peer = ["-m", "bench.live_peers", "pictures", wire, at.address, str(PAIRS / 20), str(clip)]
        with running(*at.python, *peer, env=at.env) as camera:
            out, err = camera.communicate(timeout=60)
            assert out, err
        want = offline(clip, [stamp for stamp, _ in json.loads(out)])
        assert len(want) == PAIRS - 1
        got, counts = rows(), ends(process)
    assert counts["frames_start"] == 1, counts
    assert counts["next"] == PAIRS - 1, counts
    check(got, want)
