"""Images by live messages give the records that the same images give from a bag."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
from bag_maker import BagMaker, stereo_bag
from gpvo import runner
from gpvo.cameras.readers import read_kitti_calib
from gpvo.io import open_source
from gpvo.io.images import read_grey8
from gpvo.live.intake import Arrival, replay
from gpvo.live.stereo_stage import StereoStage
from gpvo.types import StereoFrame, VoRecord
from gpvo.vo.config import VoConfig
from gpvo.vo.odometry import StereoOdometry


def _equal(ours: list[VoRecord], theirs: list[VoRecord]) -> None:
    assert len(ours) == len(theirs) > 0
    for a, b in zip(ours, theirs, strict=True):
        a, b = replace(a, stage_ms={}), replace(b, stage_ms={})
        for name in VoRecord.__dataclass_fields__:
            np.testing.assert_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_a_bag_with_imu_and_camera_info(tmp_path: Path) -> None:
    bag = stereo_bag(ros1=True, n=8).write(tmp_path / "stereo.bag")
    source = open_source(bag, prefetch=False)
    theirs = [s.record for s in runner.steps(source, VoConfig())]
    stage = StereoStage("/camera/left/image_raw", "/camera/right/image_raw", "/imu0")
    topics = ["/imu0", *(f"/camera/{s}/{t}" for s in ("left", "right") for t in ("image_raw", "camera_info"))]
    taken = [t for a in replay(bag, topics, threading.Event(), fast=True) for t in stage.take(a)]
    taken += list(stage.flush())
    assert taken[0].begins
    assert not any(t.begins for t in taken[1:])
    _equal([t.record for t in taken], theirs)


def test_real_pictures_and_a_source_that_starts_again(real_data: Path) -> None:
    folder = real_data / "kitti_2011_09_26_0001"
    names = sorted(p.name for p in (folder / "image_0").glob("*.png"))[:6]
    pairs = [[read_grey8(folder / f"image_{k}" / name) for k in (0, 1)] for name in names]
    assert pairs[0][0] is not None
    rig = read_kitti_calib(folder / "calib.txt", left=0, right=1, size=pairs[0][0].shape[::-1])
    stage = StereoStage("/l", "/r", rig=rig)
    assert stage.camera is not None
    odometry = StereoOdometry(stage.camera)
    maker, theirs = BagMaker(ros1=False), []
    for k, (left, right) in enumerate(pairs):
        assert left is not None
        assert right is not None
        t = 10**18 + k * 10**8
        maker.image("/l", t, left)
        maker.image("/r", t + 10_000, right)
        theirs.append(odometry.step(StereoFrame(t, left, right)))
    arrivals = [Arrival(topic, m, t) for t, topic, m in maker.messages]
    ours = [t.record for a in arrivals for t in stage.take(a)]
    _equal(ours, theirs)
    torn = replace(arrivals[-1].message, data=arrivals[-1].message.data[:100])
    for message in (torn, replace(arrivals[-1].message, encoding="?")):
        assert list(stage.take(replace(arrivals[-2]))) == []
        assert list(stage.take(replace(arrivals[-1], message=message))) == []
    assert stage.counts["unreadable"] == 2
