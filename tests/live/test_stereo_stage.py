"""Images by live messages give the records that the same images give from a bag."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sequences as seq
from bag_maker import BagMaker, stereo_bag
from gpvo import runner
from gpvo.cameras.models import PinholeRadtan
from gpvo.cameras.readers import read_kitti_calib
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.io.bag_reader import messages, open_bag
from gpvo.io.images import read_grey8
from gpvo.live import LiveSettings, WireSettings
from gpvo.live.engine import Engine
from gpvo.live.intake import Arrival, replay
from gpvo.live.job import make_stage, run_live, topics_in
from gpvo.live.stereo_stage import StereoSettings, StereoStage
from gpvo.types import StereoFrame, VoRecord
from gpvo.vo.config import make_config
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.rig_findings import read_state
from shim_bags import Kept, shim_predictor

LEFT, RIGHT = "/camera/left/image_raw", "/camera/right/image_raw"


def _equal(ours: list[VoRecord], theirs: list[VoRecord]) -> None:
    assert len(ours) == len(theirs) > 0
    for a, b in zip(ours, theirs, strict=True):
        a, b = replace(a, stage_ms={}), replace(b, stage_ms={})
        for name in VoRecord.__dataclass_fields__:
            np.testing.assert_equal(getattr(a, name), getattr(b, name), err_msg=name)


def _black_half(path: Path, shape: tuple[int, int]) -> Path:
    mask = np.full(shape, 255, np.uint8)
    mask[: shape[0] // 3] = 0
    cv2.imwrite(str(path), mask)
    return path


@pytest.mark.parametrize("settings", ["of its own", "as they are"])
def test_a_bag_with_imu_and_camera_info(settings: str, tmp_path: Path) -> None:
    bag = stereo_bag(ros1=True, n=8).write(tmp_path / "stereo.bag")
    chosen, seen = StereoSettings(), {}
    if settings == "of its own":
        with open_bag(bag) as reader:
            (_, image), *_ = messages(reader, [LEFT])
        mask = _black_half(tmp_path / "mask.png", (image.height, image.width))
        seen = {"hfov_deg": 50.0, "size": (image.width // 2, image.height // 2), "mask_left": mask}
        config = make_config("thesis", window=3, sigma_m_px=None)
        runner.run(open_source(bag, prefetch=False, **seen), tmp_path / "before", make_config())
        state = tmp_path / "before" / "calibration_state.json"
        chosen = StereoSettings(replace(config, self_calibration=True), state, **seen)
    source = open_source(bag, prefetch=False, **seen)
    known = None if chosen.calibration_state is None else read_state(chosen.calibration_state, source.camera)
    odometry = StereoOdometry(source.camera, chosen.config, source.mask, known)
    theirs = [s.record for s in runner.steps(source, chosen.config, odometry)]
    stage = StereoStage(LEFT, RIGHT, "/imu0", settings=chosen)
    topics = ["/imu0", *(f"/camera/{s}/{t}" for s in ("left", "right") for t in ("image_raw", "camera_info"))]
    taken = [t for a in replay(bag, topics, threading.Event(), fast=True) for t in stage.take(a)]
    taken += list(stage.flush())
    assert taken[0].begins
    assert not any(t.begins for t in taken[1:])
    _equal([t.record for t in taken], theirs)


@pytest.mark.parametrize("which", ["12 bits", "5 ms apart", "window", "zeros", "-1", "nan"])
def test_what_a_run_reads_is_read_live(which: str, tmp_path: Path) -> None:
    maker, seen = BagMaker(ros1=True), {"12 bits": {"bits": 12}, "5 ms apart": {"tolerance_s": 0.006}}.get(which, {})
    acc = {"-1": (1.0, 0.0, 0.0), "nan": (np.nan,) * 3}.get(which, (0.0, 0.0, 0.0))
    for k, t in enumerate(seq.stamps(8)):
        for side, late_ns, tx in (("left", 0, 0.0), ("right", 5_000_000 * (which == "5 ms apart"), -6.0)):
            image = seq.grey(k).astype(np.uint16) << 4 if which == "12 bits" else seq.grey(k)
            maker.image(f"/camera/{side}/image_raw", t + late_ns, image, "mono16" if which == "12 bits" else "mono8")
            corner = (12, 8) if which == "window" else None
            maker.camera_info(f"/camera/{side}/camera_info", t, tx, corner)
        maker.imu("/imu0", t, (0.1 * k, 0.2, 0.3), acc, known=(0.0, -1.0 if which == "-1" else 0.0))
    bag = maker.write(tmp_path / "stereo.bag")
    theirs = [s.record for s in runner.steps(open_source(bag, prefetch=False, **seen), make_config())]
    stage = StereoStage(LEFT, RIGHT, "/imu0", settings=StereoSettings(**seen))
    topics = ["/imu0", *(f"/camera/{s}/{t}" for s in ("left", "right") for t in ("image_raw", "camera_info"))]
    taken = [t for a in replay(bag, topics, threading.Event(), fast=True) for t in stage.take(a)]
    _equal([t.record for t in [*taken, *stage.flush()]], theirs)
    assert not stage.problems()


@pytest.mark.parametrize("when", ["first", "late"])
def test_an_imu_is_placed_by_static_transforms_as_in_a_bag(when: str, tmp_path: Path) -> None:
    maker, T = stereo_bag(ros1=False, n=8), se3.exp(np.array([0.1, 0.0, -0.05, -1.2, 1.2, -1.1]))
    maker.messages = [m for m in maker.messages if m[1] != "/imu0"]
    for t in seq.stamps(8):
        maker.imu("/imu0", t, frame="imu")
    maker.tf("/tf_static", seq.stamps(8)[4 if when == "late" else 0] - 1, (T, "imu", "cam"))
    bag = maker.write(tmp_path / "bag")
    source = open_source(bag, prefetch=False)
    theirs = [s.record for s in runner.steps(source, make_config())]
    stage = StereoStage(LEFT, RIGHT, "/imu0")
    settings = LiveSettings(tmp_path, stereo=(LEFT, RIGHT), imu="/imu0", replay=bag)
    assert {"/tf_static", "/imu0"} <= set(topics_in(stage, settings))
    arrivals = list(replay(bag, _present(bag, topics_in(stage, settings)), threading.Event(), fast=True))
    taken = [t for a in arrivals for t in stage.take(a)]
    taken += stage.flush()
    assert stage._odometry is not None
    np.testing.assert_allclose(stage._odometry._T_imu_cam, T, atol=1e-12)
    assert not stage.wants_place
    assert stage.counts["imu_placed"] == 1
    if when == "first":
        _equal([t.record for t in taken], theirs)
    assert stage._odometry._state.felt is not None


@pytest.mark.parametrize("which", ["apart", "gyroscope alone", "whole"])
def test_gyroscope_and_accelerometer_apart_are_joined_as_in_a_bag(which: str, tmp_path: Path) -> None:
    maker = stereo_bag(ros1=False, n=28)
    maker.messages = [m for m in maker.messages if "imu" not in m[1]]
    for k in range(-4, 280):
        t = seq.START_NS + k * 5_000_000
        maker.imu("/gyro/sample", t, (0.01 * k, 0.2, 0.3), (0.0, 0.1 * k, 9.8) if which == "whole" else (0, 0, 0))
        if which == "apart" and k % 3 == 0:
            maker.imu("/accel/sample", t + 1_000_000, (0, 0, 0), (0.1 * k, 0.0, 9.8))
    bag = maker.write(tmp_path / "bag")
    stage = StereoStage(LEFT, RIGHT, "/gyro/sample")
    settings = LiveSettings(tmp_path, stereo=(LEFT, RIGHT), imu="/gyro/sample", replay=bag)
    assert topics_in(stage, settings)["/accel/sample"] == "sensor_msgs/msg/Imu"
    records = [t.record for a in replay(bag, _present(bag, topics_in(stage, settings)), threading.Event(), fast=True)
               for t in stage.take(a)]  # fmt: skip
    records += [t.record for t in stage.flush()]
    log = [s.record for s in runner.steps(open_source(bag, prefetch=False), make_config())]
    assert len(records) == len(log) == 28
    if which == "gyroscope alone":  # for a second, an accelerometer might follow
        assert all(r.imu_gyro_mean_radps is not None for r in records[22:])
        assert all(np.isnan(r.imu_acc_mean_mps2).all() for r in records[22:])
        return
    for ours, run in list(zip(records, log))[1:]:
        for name in ("imu_gyro_mean_radps", "imu_acc_mean_mps2"):
            np.testing.assert_allclose(getattr(ours, name), getattr(run, name), atol=1e-12, err_msg=name)


def _present(bag: Path, topics: dict[str, str]) -> list[str]:
    with open_bag(bag) as reader:
        return [t for t in topics if t in reader.topics]


def test_an_imu_whose_clock_is_set_back_leaves_no_samples_of_before() -> None:
    early, late, stage, records = BagMaker(False), stereo_bag(False, n=50), StereoStage(LEFT, RIGHT, "/imu0"), []
    for k in range(40):  # before the cameras run, on a clock that is 1.5 s ahead
        early.imu("/imu0", seq.START_NS + 15 * 10**8 + k * 10**7, (9.0, 9.0, 9.0))
    for t, topic, message in [*early.messages, *sorted(late.messages, key=lambda m: m[0])]:
        records += [r.record for r in stage.take(Arrival(topic, message, t))]
    means = [r.imu_gyro_mean_radps for r in records if r.imu_gyro_mean_radps is not None]
    assert len(means) > 40
    np.testing.assert_allclose(means, np.tile([0.1, 0.2, 0.3], (len(means), 1)), atol=1e-12)


def test_an_imu_on_another_clock_is_called_out(tmp_path: Path) -> None:
    maker = stereo_bag(ros1=True, n=30)
    for _, topic, message in maker.messages:
        message.header.stamp.sec -= 1000 * (topic == "/imu0")
    bag = maker.write(tmp_path / "a.bag")
    assert any("IMU does not overlap the images in time" in note for note in open_source(bag).report.notes)
    stage = StereoStage(LEFT, RIGHT, "/imu0")
    for t, topic, message in sorted(maker.messages, key=lambda m: m[0]):
        list(stage.take(Arrival(topic, message, t)))
    assert "no sample of the IMU on '/imu0'" in stage.problems()[0]


def test_images_that_were_decompressed_are_not_compressed(tmp_path: Path) -> None:
    sides = ("/l/image_uncompressed", "/r/image_raw/compressed")
    settings = LiveSettings(tmp_path / "m.gpvo", stereo=sides)
    kinds = topics_in(make_stage(settings), settings)
    assert [kinds[t] for t in sides] == ["sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"]


def test_images_that_make_no_pair_or_cannot_be_read_are_called_out() -> None:
    lens = PinholeRadtan(60.0, 60.0, 31.5, 23.5, 64, 48)
    apart = StereoStage("/l", "/r")
    unread = StereoStage("/l", "/r", rig=StereoRig(lens, lens, se3.exp(np.array([-0.1, 0, 0, 0, 0, 0]))))
    maker = BagMaker(ros1=False)
    for topic, late_ns in (("/l", 0), ("/r", 4_000_000)):
        maker.image(topic, 10**18 + late_ns, np.zeros((48, 64), np.uint8), "h264")
    for t, topic, message in maker.messages:
        assert not list(apart.take(Arrival(topic, message, t)))
        message.header.stamp.nanosec = 0
        assert not list(unread.take(Arrival(topic, message, t)))
    assert "no pair within 2 ms; the nearest are 4 ms apart" in apart.problems()[0]
    assert unread.problems() == ["images of encoding 'h264' cannot be read"]


def test_images_that_cannot_be_read_are_called_out_beside_their_calibration() -> None:
    stage = StereoStage(LEFT, RIGHT)
    for t, topic, message in sorted(stereo_bag(ros1=False).messages, key=lambda m: m[0]):
        message = replace(message, encoding="h264") if topic in (LEFT, RIGHT) else message
        assert not list(stage.take(Arrival(topic, message, t)))
    assert stage.problems() == ["images of encoding 'h264' cannot be read"]


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


def test_a_calibration_without_a_size_takes_that_of_the_first_pair(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "calib.txt"
    row = "100 0 {0} {1} 0 100 {2} 0 0 0 1 0"
    path.write_text(f"P0: {row.format(80, 0, 60)}\nP1: {row.format(80, -10, 60)}\n")
    settings = LiveSettings(tmp_path / "m.gpvo", stereo=("/l", "/r"), calibration=path)
    stage, image = make_stage(settings), rng.integers(0, 255, (120, 160), np.uint8)
    assert set(topics_in(stage, settings)) == {"/l", "/r"}
    maker = BagMaker(ros1=False)
    for t in (0, 10**8):
        for topic in ("/l", "/r"):
            maker.image(topic, 10**18 + t, image)
    arrivals = [Arrival(topic, m, t) for t, topic, m in maker.messages]
    torn = replace(arrivals[0], message=replace(arrivals[0].message, encoding="?"))
    taken = [t.record for a in (torn, arrivals[1], *arrivals) for t in stage.take(a)]
    assert len(taken) == 2
    assert stage.camera is not None
    assert (stage.camera.width, stage.camera.height, stage.camera.baseline_m) == (160, 120, pytest.approx(0.1))
    small = make_stage(settings)
    maker.image("/l", 0, image[:30, :40])
    maker.image("/r", 0, image[:30, :40])
    left, right = (Arrival(topic, m, t) for t, topic, m in maker.messages[-2:])
    assert list(small.take(left)) == []
    with pytest.raises(GpvoError, match="far from the middle of the 40x30 images"):
        list(small.take(right))
    with pytest.raises(GpvoError, match=r"no\.txt"):
        make_stage(replace(settings, calibration=tmp_path / "no.txt"))


def test_settings_that_cannot_be_used_are_refused_at_the_start(tmp_path: Path, real_data: Path) -> None:
    folder = real_data / "kitti_2011_09_26_0001"
    rig = read_kitti_calib(folder / "calib.txt", left=0, right=1, size=(1242, 375))
    small = _black_half(tmp_path / "mask.png", (20, 30))
    with pytest.raises(GpvoError, match="mask is 30x20"):
        StereoStage("/l", "/r", rig=rig, settings=StereoSettings(mask_left=small))
    (tmp_path / "state.json").write_text("{}")
    with pytest.raises(GpvoError, match="is not a calibration state"):
        StereoStage("/l", "/r", rig=rig, settings=StereoSettings(calibration_state=tmp_path / "state.json"))
    with pytest.raises(GpvoError, match="no images to run on"):
        run_live(LiveSettings(tmp_path / "m.gpvo", odometry="/vio", replay=tmp_path, vo=StereoSettings(size=(9, 9))))


def test_a_folder_of_images_is_no_bag(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((9, 9), np.uint8))
    with pytest.raises(GpvoError, match=r"is not a bag \(give a \.bag, \.db3 or \.mcap file"), open_bag(tmp_path):
        pass


@pytest.mark.parametrize(("given", "said"), [
    ({"stereo": ("/l", "/l")}, "same topic '/l'"), ({"odometry": "/o", "imu": "/imu"}, "--imu would be ignored"),
    ({"odometry": "/o", "calibration": Path("c.yaml")}, "--calibration would be ignored .*--stereo"),
    ({"odometry": "/o", "wire": WireSettings(address="tcp/h:1", domain=3)}, "--address would be ignored .*--zenoh"),
    ({"odometry": "/o", "wire": WireSettings(domain=3)}, "--domain would be ignored"),
    ({"pose_topic": "/p"}, "--pose-topic would"),
    ({"replay": None, "wire": WireSettings(dds=True), "fast": True}, "--fast would be ignored"),
    ({"odometry": "/o", "depth": 50}, "--depth would be ignored .*recording"),
])  # fmt: skip
def test_options_that_nothing_would_read_are_refused(given: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(GpvoError, match=said):
        run_live(LiveSettings(**{"model": tmp_path / "m.gpvo", "replay": tmp_path, **given}))


@pytest.mark.parametrize("wrong", ["swapped", "size"])
def test_images_that_the_calibration_is_not_for_are_called_out_and_publish_nothing(wrong: str) -> None:
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (240, 360), dtype=np.uint8), (5, 5), 0)
    views = scene[:, :320], scene[:, 10:330]  # in the right image a point lies further left
    size = (320, 240) if wrong == "swapped" else (512, 512)
    lens = PinholeRadtan(0.625 * size[0], 0.625 * size[0], size[0] / 2, size[1] / 2, *size)
    stage, kept = StereoStage("/l", "/r", rig=StereoRig(lens, lens, se3.exp(np.array([-0.1, 0, 0, 0, 0, 0])))), Kept()
    maker, told = BagMaker(ros1=False), []
    for k in range(5):
        for topic, view in zip(("/r", "/l") if wrong == "swapped" else ("/l", "/r"), views, strict=True):
            maker.image(topic, 10**18 + k * 10**8, view)
    live = Engine(stage, shim_predictor(), [kept], tell=told.append)
    for t, topic, message in maker.messages:
        live.take(Arrival(topic, message, t))
    live.close()
    what = {"swapped": "images are swapped", "size": "images are 320x240, the calibration is for 512x512"}[wrong]
    assert sum(what in text for text in told) == 1
    assert what in kept.reports[-1].text
    assert kept.reports[-1].level == 1
    assert all(o.twist_body is None for o in kept.frames)
