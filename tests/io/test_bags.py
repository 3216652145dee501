"""ROS 1 bags, ROS 2 bags and MCAP: written by rosbags, read as sequences and as other people's odometry."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import sequences as seq
from bag_maker import BagMaker, stereo_bag
from gpvo.errors import CalibrationError, SourceError
from gpvo.geometry import covariance, se3
from gpvo.io import guess, open_source
from gpvo.io.bag_messages import decode_message, pair_streams, pose_of
from gpvo.io.bag_reader import stamp_ns
from gpvo.io.bags import has_word
from gpvo.io.foreign import read_foreign
from gpvo.io.source import SourceReport
from gpvo.io.stamps import match_nearest
from gpvo.io.stated import to_records
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer
from rosbags.rosbag2.storage_mcap import zstd

KINDS = {"ros1": (True, False, "a.bag"), "sqlite3": (False, False, "a"), "mcap": (False, True, "a")}


def _write(tmp_path, kind, maker_of=stereo_bag, **options):
    ros1, mcap, name = KINDS[kind]
    return maker_of(ros1, **options).write(tmp_path / name, mcap=mcap)


@pytest.mark.parametrize("kind", KINDS)
def test_stereo_bag(tmp_path, kind):
    path = _write(tmp_path, kind)
    assert guess(path) == "rosbag"
    source = open_source(path, truth_frame="cam")
    assert len(source) == 12
    assert seq.frames_of(source) == list(zip(seq.stamps(12), range(12), strict=True))
    assert str(source.report) == "12 frames"
    assert source.camera.baseline_m == pytest.approx(0.1)
    assert source.imu is not None
    np.testing.assert_array_equal(source.imu.acc_mps2[0], [0, 0, 9.81])
    assert len(source.imu.t_ns) == 60
    np.testing.assert_allclose(source.truth.T_world_cam, seq.true_poses(12), atol=1e-9)
    assert source.truth.sigma_rotation_rad == 8e-4


def _placed(tmp_path, *topics):
    """A bag whose transforms, one message for each topic, place its camera on base_link by (4, 4) each."""
    maker = stereo_bag(False)
    for k, (topic, T) in enumerate(topics):
        maker.tf(topic, seq.stamps(12)[k], (T, "base_link", "head"), (PLACE, "head", "cam"))
    return maker.write(tmp_path / f"{len(topics)}")


PLACE = se3.exp(np.array([0.1, 0.0, -0.05, -1.2, 1.2, -1.1]))
TILTED = se3.exp(np.array([0.2, 0.03, 0.1, 0.0, 0.4, 0.0]))


def test_the_body_is_the_frame_that_is_named_and_one_that_is_not_asked_for_is_told(tmp_path):
    path = _placed(tmp_path, ("/tf_static", TILTED), ("/tf", TILTED))
    mounting = open_source(path, base_frame="base_link").mounting
    np.testing.assert_allclose(mounting.T_body_cam, TILTED @ PLACE, atol=1e-12)
    np.testing.assert_allclose(open_source(path, base_frame="/head").mounting.T_body_cam, PLACE, atol=1e-12)
    plain = open_source(path)
    assert plain.mounting.T_body_cam is None
    assert "--base-frame base_link" in " ".join(plain.report.notes)
    assert not open_source(_write(tmp_path, "mcap")).report.notes[1:]
    with pytest.raises(SourceError, match="joins 'mast' to 'cam'"):
        open_source(path, base_frame="mast")


def test_a_body_that_the_camera_turns_on_is_refused(tmp_path):
    path = _placed(tmp_path, ("/tf_static", TILTED), ("/tf", TILTED @ TILTED))
    with pytest.raises(SourceError, match="from 'base_link' to 'cam' changes"):
        open_source(path, base_frame="base_link")


def test_transforms_that_nobody_asked_for_refuse_no_bag(tmp_path):
    path = _placed(tmp_path, ("/tf_static", TILTED), ("/tf_static", TILTED @ TILTED))
    assert "--base-frame" not in " ".join(open_source(path).report.notes)
    with pytest.raises(SourceError, match="changes"):
        open_source(path, base_frame="base_link")


def test_the_frame_of_the_images_is_no_body(tmp_path):
    with pytest.raises(SourceError, match="'cam' is the frame of the left images"):
        open_source(_placed(tmp_path, ("/tf_static", TILTED)), base_frame="cam")


def _with_imu(tmp_path, frame, *places):
    """A bag whose IMU names its frame, and whose transforms place ``imu_link`` on base_link by (4, 4) each."""
    maker = stereo_bag(False)
    maker.messages = [m for m in maker.messages if m[1] != "/imu0"]
    for k, T in enumerate(places):
        t_ns = seq.stamps(12)[k]
        maker.tf("/tf_static", t_ns, (T, "base_link", "imu_link"), (PLACE, "base_link", "cam"))
        maker.imu("/imu0", t_ns, frame=frame)
    return maker.write(tmp_path / f"{frame.strip('/')}{len(places)}")


def test_an_imu_of_which_no_calibration_says_where_it_sits_is_placed_by_static_transforms(tmp_path):
    source = open_source(_with_imu(tmp_path, "/imu_link", TILTED, TILTED))
    np.testing.assert_allclose(source.mounting.T_imu_cam, se3.inverse(TILTED) @ PLACE, atol=1e-12)
    assert "taken from /tf_static ('imu_link' to 'cam')" in " ".join(source.report.notes)
    chain = tmp_path / "of_both.yaml"
    chain.write_text(seq.camchain_yaml().replace("cam1:", f"  T_cam_imu: {se3.inverse(PLACE).tolist()}\ncam1:"))
    calibrated = open_source(source.path, calibration=chain)
    np.testing.assert_allclose(calibrated.mounting.T_imu_cam, PLACE, atol=1e-12)
    for frame, places in (("cam", [TILTED]), ("gyro", [TILTED]), ("imu_link", [TILTED, TILTED @ TILTED, TILTED])):
        unplaced = open_source(_with_imu(tmp_path, frame, *places))
        assert unplaced.mounting.T_imu_cam is None
        assert ("it changes" in " ".join(unplaced.report.notes)) == (len(places) == 3)


def test_single_storage_files(tmp_path):
    folder = _write(tmp_path, "mcap")
    assert len(seq.frames_of(open_source(next(folder.glob("*.mcap"))))) == 12
    folder = _write(tmp_path / "b", "sqlite3")
    assert len(seq.frames_of(open_source(next(folder.glob("*.db3"))))) == 12


def test_a_file_of_messages_that_are_compressed_one_by_one_needs_its_folder(tmp_path):
    maker, connections = stereo_bag(False), {}
    writer = Writer(tmp_path / "a", version=8)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        for t, topic, message in sorted(maker.messages, key=lambda m: m[0]):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=maker.store)
            writer.write(connections[topic], t, maker.store.serialize_cdr(message, kind))
    assert len(seq.frames_of(open_source(tmp_path / "a"))) == 12
    with pytest.raises(SourceError, match="compressed one by one.*folder"):
        open_source(next((tmp_path / "a").glob("*.db3")))


@pytest.mark.parametrize("kind", KINDS)
def test_suffixes_in_capitals_are_suffixes(tmp_path, kind):
    path = _write(tmp_path, kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    assert len(seq.frames_of(open_source(file.rename(tmp_path / f"A{file.suffix.upper()}")))) == 12


def _write_apart(folder, kind, name_of, slower=1):
    """The messages of one recording, each in the bag that ``name_of`` (share of the recording, topic) says."""
    ros1, mcap, _ = KINDS[kind]
    recorded = [(slower * (t - seq.START_NS) + seq.START_NS, *m) for t, *m in stereo_bag(ros1).messages]
    recorded = sorted(recorded, key=lambda m: m[0])
    makers = {}
    for k, message in enumerate(recorded):
        makers.setdefault(name_of(k / len(recorded), message[1]), BagMaker(ros1)).messages.append(message)
    folder.mkdir()
    for name, maker in makers.items():
        maker.write(folder / (f"{name}.bag" if ros1 else name), mcap=mcap)
    return folder


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name_of", [lambda share, topic: f"x_{int(3 * share)}", lambda share, topic: topic[1:4]])
def test_a_recording_in_several_bags_is_read_as_one(tmp_path, kind, name_of):
    one, parts = open_source(_write(tmp_path, kind)), _write_apart(tmp_path / "parts", kind, name_of)
    assert guess(parts) == "rosbag"
    assert seq.frames_of(open_source(parts)) == seq.frames_of(one)
    assert np.array_equal(open_source(parts).imu.t_ns, one.imu.t_ns)
    poses = [read_foreign(p, topic="/vicon/head/head").t_ns for p in (parts, one.path)]
    assert np.array_equal(*poses)
    (parts / "mav0" / "cam0").mkdir(parents=True)
    (parts / "mav0" / "cam0" / "data.csv").touch()
    assert guess(parts) == "euroc"


def test_bags_of_several_recordings_or_of_one_twice_are_refused(tmp_path):
    folder = _write_apart(tmp_path / "parts", "ros1", lambda share, topic: "a" if share < 0.2 else "c", slower=40)
    assert len(open_source(folder)) == 12
    again = _write_apart(tmp_path / "again", "ros1", lambda share, topic: "b" if share > 0.7 else "a", slower=40)
    shutil.copy(again / "b.bag", folder)
    with pytest.raises(SourceError, match=r"c\.bag and b\.bag both hold '/camera/left/image_raw' at one time"):
        open_source(folder)
    (folder / "c.bag").unlink()
    with pytest.raises(SourceError, match=r"several recordings: b\.bag begins 1\d s after those before end"):
        open_source(folder)
    (folder / "a.bag").unlink()
    shutil.copy(folder / "b.bag", folder / "b.orig.bag")
    assert len(open_source(folder)) < 6


def test_a_bag_that_is_still_recorded_or_compressed_as_a_file_is_refused_with_the_cure(tmp_path):
    folder = _write_apart(tmp_path / "parts", "ros1", lambda share, topic: f"x_{int(2 * share)}")
    active = (folder / "x_1.bag").rename(folder / "x_1.bag.active")
    for path in (folder, active):
        with pytest.raises(
            SourceError, match=r"x_1\.bag\.active: is still recorded.*'rosbag reindex x_1\.bag\.active'"
        ):
            open_source(path)
    packed = _write(tmp_path, "sqlite3")
    metadata = packed / "metadata.yaml"
    text = metadata.read_text().replace("a.db3", "a.db3.zstd").replace("compression_mode: ''", "compression_mode: FILE")
    metadata.write_text(text.replace("compression_format: ''", "compression_format: zstd"))
    (packed / "a.db3.zstd").write_bytes(zstd.compress((packed / "a.db3").read_bytes()))
    unpacked = (packed / "a.db3").read_bytes()
    (packed / "a.db3").unlink()
    for path in (packed, packed / "a.db3.zstd"):
        with pytest.raises(
            SourceError, match=r"is compressed as a whole file \(unpack it beside: 'zstd -d .*\*\.zstd'"
        ):
            open_source(path)
    (packed / "a.db3").write_bytes(unpacked)
    assert len(list(open_source(packed))) == 12


def test_missing_images_shift_nothing(tmp_path):
    path = _write(tmp_path, "ros1", skip={(2, "left"), (5, "right"), (6, "right"), (9, "left")})
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == [0, 1, 3, 4, 7, 8, 10, 11]
    assert source.report.missing == 4


def test_a_torn_image_costs_its_pair(tmp_path):
    path = _write(tmp_path, "sqlite3")
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database, database:
        left = "SELECT id FROM topics WHERE name='/camera/left/image_raw'"
        images = database.execute(f"SELECT id FROM messages WHERE topic_id IN ({left}) ORDER BY timestamp").fetchall()
        database.execute("UPDATE messages SET data=substr(data, 1, 30) WHERE id=?", images[5])
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert (source.report.unreadable, source.report.missing) == (1, 1)


def test_lone_camera_does_not_pile_up(tmp_path):
    path = _write(tmp_path, "ros1", n=60, skip={(k, "right") for k in range(10, 50)})
    source = open_source(path)
    assert [k for _, k in seq.frames_of(source)] == [*range(10), *range(50, 60)]
    assert source.report.missing == 40


def test_cameras_that_never_meet(tmp_path):
    path = _write(tmp_path, "ros1")
    with pytest.raises(SourceError, match=r"no pair within 0\.1 ms; the nearest are 0\.3 ms apart .*--pair-tolerance"):
        list(open_source(path, tolerance_s=1e-4))


def test_a_wide_tolerance_joins_no_neighbours_where_an_image_is_lost():
    """At 30 Hz with the right camera 5 ms behind; 40 ms are allowed."""
    maker, rng = BagMaker(ros1=False), np.random.default_rng(0)
    for k in range(300):
        for side, late_ns in (("left", 0), ("right", 5_000_000)):
            if rng.random() > 0.03:
                maker.image(side, seq.START_NS + k * 33_333_333 + late_ns, GREY, "mono8")
    stream = [(topic, message) for _, topic, message in sorted(maker.messages, key=lambda m: m[0])]
    pairs = list(pair_streams(stream, "left", 40_000_000, SourceReport(), "bag"))
    apart = [stamp_ns(right) - t_ns for t_ns, _, right in pairs]
    assert len(pairs) > 270
    assert set(apart) == {5_000_000}


@pytest.mark.parametrize("seed", range(20))
def test_a_wide_tolerance_joins_no_neighbours_at_the_start_or_where_both_cameras_lose_images(seed):
    """A fifth of the images of each camera lost; the right one is 5 ms behind, at 30 Hz."""
    rng, late_ns = np.random.default_rng(seed), {"left": 0, "right": 5_000_000}
    sides = [
        [seq.START_NS + k * 33_333_333 + late for k in range(40) if rng.random() > 0.2] for late in late_ns.values()
    ]
    listed = [[(t, str(t)) for t in side] for side in sides]
    by_file = match_nearest(*listed, 40_000_000, SourceReport(), "folder")
    assert {int(b) - int(a) for _, a, b in by_file} == {5_000_000}
    maker = BagMaker(ros1=False)
    for side, stamps in zip(late_ns, sides):
        for t in stamps:
            maker.image(side, t, GREY, "mono8")
    stream = [(topic, message) for _, topic, message in sorted(maker.messages, key=lambda m: m[0])]
    pairs = pair_streams(stream, "left", 40_000_000, SourceReport(), "bag")
    assert [stamp_ns(right) - t_ns for t_ns, _, right in pairs] == [5_000_000] * len(by_file)


GREY = np.random.default_rng(0).integers(20, 235, (24, 32), dtype=np.uint8)
# The same grey picture in every encoding.
ENCODED = {
    **dict.fromkeys(("mono8", "8UC1"), GREY),
    **{name: np.repeat(GREY[:, :, None], 3, axis=2) for name in ("rgb8", "bgr8", "8UC3")},
    **{name: np.repeat(GREY[:, :, None], 4, axis=2) for name in ("rgba8", "bgra8", "8UC4")},
    **{name: GREY.astype(np.uint16) << 8 for name in ("mono16", "16UC1")},
    **{name: np.repeat(GREY[:, :, None].astype(np.uint16) << 8, 3, axis=2) for name in ("rgb16", "bgr16", "16UC3")},
    **{name: np.repeat(GREY[:, :, None].astype(np.uint16) << 8, 4, axis=2) for name in ("rgba16", "bgra16", "16UC4")},
    **{name: np.stack([GREY, np.full_like(GREY, 128)], axis=2) for name in ("yuyv", "yuv422_yuy2")},
    **{name: np.stack([np.full_like(GREY, 128), GREY], axis=2) for name in ("uyvy", "yuv422")},
}


@pytest.mark.parametrize("encoding", ENCODED)
@pytest.mark.parametrize("padding", [0, 7])
def test_encodings(encoding, padding):
    rows = np.ascontiguousarray(ENCODED[encoding]).view(np.uint8).reshape(len(GREY), -1)
    maker = BagMaker(ros1=False)
    maker.image("/i", 0, np.pad(rows, ((0, 0), (0, padding))), encoding)
    [(_, _, message)] = maker.messages
    image = decode_message(replace(message, width=GREY.shape[1]))
    np.testing.assert_array_equal(image, GREY)
    for broken in ({"step": 3}, {"data": message.data[:-1]}, {"width": 0}, {"encoding": f"{encoding}?"}):
        assert decode_message(replace(message, **{"width": GREY.shape[1], **broken})) is None


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "nv24"])
def test_planes_of_brightness_come_before_those_of_colour(encoding):
    maker = BagMaker(ros1=False)
    maker.image("/i", 0, GREY, encoding)
    [(_, _, message)] = maker.messages
    colour = np.zeros(GREY.size * (2 if encoding == "nv24" else 1) // (1 if encoding == "nv24" else 2), dtype=np.uint8)
    np.testing.assert_array_equal(decode_message(replace(message, data=np.r_[message.data, colour])), GREY)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(("pattern", "red"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))])
def test_bayer_patterns(pattern, red, bits):
    """A red picture is as bright as red is, wherever the pattern puts it; image_transport compresses the mosaic."""
    mosaic = np.zeros((24, 32), dtype=f"u{bits // 8}")
    mosaic[red[0] :: 2, red[1] :: 2] = 200 << (bits - 8)
    maker = BagMaker(ros1=False)
    maker.image("/i", 0, mosaic, f"bayer_{pattern}{bits}")
    maker.compressed("/i/compressed", 0, mosaic, f"bayer_{pattern}{bits}; png compressed ")
    for _, _, message in maker.messages:
        np.testing.assert_allclose(decode_message(message)[4:-4, 4:-4], 0.299 * 200, atol=2)


@pytest.mark.parametrize("name", ["a#1", "a%20b", "a?"])
def test_a_database_that_rosbags_cannot_open_by_its_name(tmp_path, name):
    maker = stereo_bag(False, 3)
    path = maker.write(tmp_path / "plain").rename(tmp_path / name)
    with pytest.raises(SourceError, match=r"its path holds '.'.*rename"):
        open_source(path)


@pytest.mark.parametrize("mode", ["wal", "delete"])
def test_a_database_whose_recorder_was_killed_is_read_whole_or_not_at_all(tmp_path, mode):
    folder = _write(tmp_path, "sqlite3")
    live = next(folder.glob("*.db3"))
    with closing(sqlite3.connect(live, isolation_level=None)) as recorder:
        for line in (f"PRAGMA journal_mode={mode}", "PRAGMA cache_size=1", "BEGIN", "CREATE TABLE other (data BLOB)"):
            recorder.execute(line).fetchall()
        recorder.execute("UPDATE messages SET data=data, topic_id=topic_id")  # stays in the journal
        if mode == "wal":
            recorder.execute("COMMIT")
        killed = tmp_path / "killed"
        killed.mkdir()
        for file in folder.glob("*.db3*"):
            shutil.copy(file, killed)
    path = killed / live.name
    assert sorted(p.suffix for p in killed.iterdir())[1].startswith(".db3-")
    with pytest.raises(SourceError, match=f"{live.name}-{mode.replace('delete', 'journal')}.*SELECT count"):
        open_source(path)
    with closing(sqlite3.connect(path)) as cure:
        cure.execute("SELECT count(*) FROM messages").fetchall()
    assert len(seq.frames_of(open_source(path))) == 12


def test_a_bag_of_colour_images(tmp_path):
    maker = BagMaker(ros1=True)
    for k, t in enumerate(seq.stamps(3)):
        for side, tx in (("left", 0.0), ("right", -6.0)):
            maker.image(f"/{side}/image_raw", t, np.repeat(seq.grey(k)[:, :, None], 3, axis=2), "bgr8")
            maker.camera_info(f"/{side}/camera_info", t, tx)
    source = open_source(maker.write(tmp_path / "a.bag"))
    assert [k for _, k in seq.frames_of(source)] == [0, 1, 2]


def test_images_of_a_window_with_binned_pixels(tmp_path):
    """As if the calibration were of the images themselves."""
    cameras = []
    for corner in (None, (12, 8)):
        maker = BagMaker(ros1=False)
        for k, t in enumerate(seq.stamps(3)):
            for side, tx in (("left", 0.0), ("right", -6.0)):
                maker.image(f"/{side}/image_raw", t, seq.grey(k))
                maker.camera_info(f"/{side}/camera_info", t, tx, corner)
        cameras.append(open_source(maker.write(tmp_path / f"{corner is None}")).camera)
    assert cameras[0] == cameras[1]


def test_compressed_images_with_camchain_beside(tmp_path):
    maker = BagMaker(ros1=False)
    for k, t in enumerate(seq.stamps(3)):
        for camera in ("cam0", "cam1"):
            maker.compressed(f"/{camera}/image_raw/compressed", t, seq.grey(k))
    path = maker.write(tmp_path / "bag")
    with pytest.raises(CalibrationError, match="no calibration") as caught:
        open_source(path)
    assert "camchain.yaml" in str(caught.value)
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    assert [k for _, k in seq.frames_of(open_source(path))] == [0, 1, 2]


def test_of_two_heads_one_is_taken_and_not_a_camera_of_each(tmp_path):
    maker = BagMaker(True)
    for head in ("left", "right"):
        for side, tx in (("left", 0.0), ("right", -6.0)):
            for k, t in enumerate(seq.stamps(3)):
                maker.image(f"/{head}_head/{side}/image_raw", t, seq.grey(k))
                maker.camera_info(f"/{head}_head/{side}/camera_info", t, tx)
    topics = open_source(maker.write(tmp_path / "a.bag"))._topics
    assert (topics.left, topics.right) == ("/left_head/left/image_raw", "/left_head/right/image_raw")


def test_topics_by_name_and_by_choice(tmp_path):
    maker = BagMaker(ros1=True)
    for k, t in enumerate(seq.stamps(3)):
        for topic in ("front", "back", "down"):
            maker.image(f"/{topic}/image_raw", t, seq.grey(k))
    path = maker.write(tmp_path / "a.bag")
    (tmp_path / "camchain.yaml").write_text(seq.camchain_yaml())
    with pytest.raises(SourceError, match="--left-topic"):
        open_source(path)
    with pytest.raises(SourceError, match="no images on '/x'"):
        open_source(path, left_topic="/x", right_topic="/y")
    with pytest.raises(SourceError, match="same topic"):
        open_source(path, left_topic="/front/image_raw", right_topic="/front/image_raw")
    source = open_source(path, left_topic="/front/image_raw", right_topic="/back/image_raw")
    assert len(seq.frames_of(source)) == 3


def test_wrong_resolution_and_swapped(tmp_path):
    path = _write(tmp_path, "ros1", infos=False)
    chain = tmp_path / "camchain.yaml"
    chain.write_text(seq.camchain_yaml().replace("[64, 48]", "[128, 96]"))
    with pytest.raises(CalibrationError, match="64x48, the calibration is for 128x96"):
        open_source(path)
    chain.unlink()
    with pytest.raises(CalibrationError, match="no calibration"):
        open_source(path)
    both = stereo_bag(True).write(tmp_path / "both.bag")
    with pytest.raises(CalibrationError, match="left and right are swapped"):
        open_source(both, left_topic="/camera/right/image_raw", right_topic="/camera/left/image_raw")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["cut", "zero", "empty"])
def test_unreadable_bags_in_one_line(tmp_path, kind, how):
    path = _write(tmp_path, kind)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))
    raw = file.read_bytes()
    file.write_bytes({"cut": raw[: len(raw) // 2], "zero": bytes(len(raw)), "empty": b""}[how])
    with pytest.raises(SourceError) as caught:
        list(open_source(path))
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    assert "unreadable bag" in text or "empty" in text


@pytest.mark.parametrize("topic", ["/camera/left/image_raw", "/imu0", "/vicon/head/head"])
def test_a_topic_that_metadata_describes_otherwise_than_the_file_is_named(tmp_path, topic):
    path = _write(tmp_path, "mcap")
    before, name, after = (path / "metadata.yaml").read_text().partition(f"name: {topic}\n")
    zero = "{sec: 0, nsec: 0}"
    qos = f"history: 3, depth: 0, reliability: 2, durability: 2, liveliness: 1, deadline: {zero}, lifespan: {zero}"
    qos = f"[{{{qos}, liveliness_lease_duration: {zero}, avoid_ros_namespace_conventions: false}}]"
    after = after.replace("offered_qos_profiles: ''", f"offered_qos_profiles: {qos}", 1)
    (path / "metadata.yaml").write_text(before + name + after)
    with pytest.raises(SourceError, match=f"index does not fit the messages on '{topic}'.*inside"):
        open_source(path, truth_frame="cam")
    assert open_source(next(path.glob("*.mcap")), truth_frame="cam").truth is not None


def test_images_without_a_stamp_are_left_out_and_only_all_of_them_refused(tmp_path):
    maker = stereo_bag(True)
    unset = maker.type("builtin_interfaces/msg/Time")(0, 0)
    images = [m for m in sorted(maker.messages, key=lambda m: m[0]) if "image" in m[1]]
    for _, _, message in images[:2]:
        message.header.stamp = unset
    source = open_source(maker.write(tmp_path / "a.bag"))
    assert [k for _, k in seq.frames_of(source)] == list(range(1, 12))
    assert source.report.missing == 2
    for _, _, message in images:
        message.header.stamp = unset
    with pytest.raises(SourceError, match="carry no stamp"):
        open_source(maker.write(tmp_path / "b.bag"))


@pytest.mark.parametrize("where", [0, 3, 59])
def test_one_imu_stamp_far_ahead_costs_one_sample(tmp_path, where):
    maker = stereo_bag(True)
    imu = [m for m in sorted(maker.messages, key=lambda m: m[0]) if m[1] == "/imu0"]
    imu[where][2].header.stamp = maker.type("builtin_interfaces/msg/Time")(2_000_000_000, 0)
    source = open_source(maker.write(tmp_path / "a.bag"))
    assert len(source.imu.t_ns) >= 59
    assert np.array_equal(source.imu.t_ns[:58], [stamp_ns(m[2]) for i, m in enumerate(imu) if i != where][:58])


@pytest.mark.parametrize("name", ["direct/{}/image_raw", "correct_{}/image", "{}/image_unrectified"])
def test_a_word_that_ends_in_rect_makes_no_image_rectified(name):
    sides = [f"/{name.format(side)}" for side in ("left", "right")]
    assert not has_word("rect", *sides)
    assert not has_word("rect", sides[0], "/right/image_rect")
    assert has_word("rect", "/left/image_rect_color", "/rectified/right", "/infra2/image_rect_raw")


def test_bag_without_images(tmp_path):
    maker = BagMaker(ros1=True)
    maker.imu("/imu0", seq.START_NS)
    with pytest.raises(SourceError, match="no stereo pair"):
        open_source(maker.write(tmp_path / "a.bag"))


def test_truth_frame_and_overlap(tmp_path):
    path = _write(tmp_path, "ros1")
    with pytest.raises(CalibrationError, match="where the IMU sits"):
        open_source(path, truth_frame="imu")
    late = BagMaker(ros1=True)
    late.messages = stereo_bag(True).messages
    late.messages = [m for m in late.messages if "vicon" not in m[1]]
    for k, t in enumerate(seq.stamps(12)):
        late.transform("/mocap/pose", t + 10**12, seq.true_poses(12)[k])
    with pytest.raises(SourceError, match="does not overlap"):
        open_source(late.write(tmp_path / "late.bag"), truth_topic="/mocap/pose")


def test_markers_are_no_truth_unless_said_whose(tmp_path):
    maker = stereo_bag(True)
    # A marker that is turned by half, and lost for a moment.
    maker.messages = [m for m in maker.messages if "vicon" not in m[1]]
    T = seq.true_poses(12) @ np.diag([-1.0, -1.0, 1.0, 1.0])
    T[4, :3, 3] = np.nan
    for k, t in enumerate(seq.stamps(12)):
        maker.transform("/vicon/head/head", t, T[k])
    path = maker.write(tmp_path / "a.bag")
    source = open_source(path)
    assert source.truth is None
    assert len(seq.frames_of(source)) == 12
    assert any("'/vicon/head/head' not used as truth" in n and "--truth-frame" in n for n in source.report.notes)
    with pytest.raises(SourceError, match="message 5 .*--truth-topic none"):
        open_source(path, truth_frame="cam")
    source = open_source(path, truth_topic="none", truth_frame="cam")
    assert source.truth is None
    assert not source.report.notes
    for k, t in enumerate(seq.stamps(12)):
        maker.transform("/ground_truth", t, seq.true_poses(12)[k])
    source = open_source(maker.write(tmp_path / "b.bag"))
    np.testing.assert_allclose(source.truth.T_world_cam, seq.true_poses(12), atol=1e-9)


def _bag_with_imus(tmp_path, *streams):
    """A stereo bag whose IMU topics are (name, step [ns], function of time [s] to the arguments of the message)."""
    maker = stereo_bag(True)
    maker.messages = [m for m in maker.messages if "imu" not in m[1]]
    for topic, step_ns, sample in streams:
        for t in range(0, 500_000_000, step_ns):
            maker.imu(topic, seq.START_NS + t, **sample(t * 1e-9))
    return maker.write(tmp_path / "a.bag")


@pytest.mark.parametrize("known", [0.0, -1.0])
def test_gyro_and_accelerometer_on_topics_of_their_own(tmp_path, known):
    path = _bag_with_imus(
        tmp_path,
        ("/camera/accel/sample", 16_000_000, lambda t: {"gyro": (0, 0, 0), "acc": (t, 0, 9.81), "known": (known, 0)}),
        ("/camera/gyro/sample", 5_000_000, lambda t: {"gyro": (0, t, 0.1), "acc": (0, 0, 0), "known": (0, known)}),
    )
    source = open_source(path)
    t = (source.imu.t_ns - seq.START_NS) * 1e-9
    # The last sample of the accelerometer is of 496 ms.
    np.testing.assert_allclose(t, np.arange(100) * 5e-3, atol=1e-12)
    np.testing.assert_allclose(source.imu.gyro_radps[:, 1], t, atol=1e-9)
    np.testing.assert_allclose(source.imu.acc_mps2[:, 0], t, atol=1e-9)
    assert any("/camera/accel/sample" in n and "interpolated" in n for n in source.report.notes)
    source = open_source(path, imu_topic="/camera/accel/sample")
    assert source.imu is None
    assert any("not used as IMU" in n for n in source.report.notes)


def test_a_gyroscope_alone_has_no_accelerometer(tmp_path):
    streams = [("/camera/gyro/sample", 5_000_000, lambda t: {"acc": (0, 0, 0)})]
    source = open_source(_bag_with_imus(tmp_path, *streams))
    np.testing.assert_array_equal(source.imu.gyro_radps[0], [0.1, 0.2, 0.3])
    assert np.isnan(source.imu.acc_mps2).all()
    assert any("a gyroscope only" in n for n in source.report.notes)


def test_a_whole_imu_goes_before_halves_and_before_zeros(tmp_path):
    path = _bag_with_imus(
        tmp_path,
        ("/a/accel/sample", 5_000_000, lambda t: {"gyro": (0, 0, 0)}),
        ("/a/gyro/sample", 5_000_000, lambda t: {"acc": (0, 0, 0)}),
        ("/b/imu", 5_000_000, lambda t: {"gyro": (0, 0, 0)}),
        ("/c/imu", 5_000_000, lambda t: {"gyro": (0, 0, 0.7)}),
    )
    source = open_source(path)
    np.testing.assert_array_equal(source.imu.gyro_radps[0], [0, 0, 0.7])
    assert any("'/b/imu' not used as IMU" in n for n in source.report.notes)


def _odometry_bag(ros1: bool, twist: bool, zeros: int = 0) -> BagMaker:
    maker = BagMaker(ros1)
    C = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
    pose = C.copy()
    T = seq.true_poses(20)
    for k, t in enumerate(seq.stamps(20)):
        if k:
            A = se3.adjoint(se3.inverse(se3.inverse(T[k - 1]) @ T[k]))
            pose = A @ pose @ A.T + C
        B = np.zeros((6, 6))
        B[:3, :3] = B[3:, 3:] = T[k, :3, :3]
        maker.odometry("/odom", t, T[k], B @ pose @ B.T, C if twist and k >= zeros else np.zeros((6, 6)))
    return maker


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_of_others(tmp_path, kind):
    path = _write(tmp_path, kind, lambda ros1: _odometry_bag(ros1, twist=True))
    records, notes = to_records(read_foreign(path))
    assert len(records) == 20
    assert notes == ["the covariances of its velocities are used, those of its poses are not"]
    T = seq.true_poses(20)
    np.testing.assert_allclose(records[3].T_prev_cur, se3.inverse(T[2]) @ T[3], atol=1e-9)
    # Variance of velocity over the step of 50 ms.
    expected = np.array([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]) * 0.05**2
    np.testing.assert_allclose(np.diag(records[3].covariances["imported"]), expected, rtol=1e-9)
    assert not records[0].covariances


def test_covariances_of_poses_that_grow_in_other_axes_than_read_are_remarked(tmp_path):
    """The remark was made, and left behind."""
    C, T, maker = 1e-10 * np.eye(6), seq.true_poses(20), BagMaker(False)
    for k, t in enumerate(seq.stamps(20)):
        if k:
            added = np.diag([1e-4 if k < 4 else 1e-8, 1e-8, 1e-8, 1e-10, 1e-10, 1e-10])
            C = covariance.compound(se3.inverse(T[k - 1]) @ T[k], C, added)
        maker.pose_with_covariance("/pose", t, T[k], C)
    path = maker.write(tmp_path / "bag")
    assert not read_foreign(path, covariance_axes="body").notes
    assert "--covariance-axes body" in read_foreign(path).notes[0]


@pytest.mark.parametrize("axes", ["auto", "world", "body", "mixed"])
def test_covariances_of_poses_may_be_stated_in_other_axes_than_ros_has(tmp_path, axes):
    """OpenVINS' messages state the rotation's as its filter has it, in the axes of the body."""
    C, T, maker = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6]), seq.true_poses(20), BagMaker(False)
    for k, t in enumerate(seq.stamps(20)):
        B = np.eye(6)
        B[:3, :3] = np.eye(3) if axes == "body" else T[k, :3, :3]
        B[3:, 3:] = np.eye(3) if axes in ("body", "mixed") else T[k, :3, :3]
        maker.pose_with_covariance("/pose", t, T[k], B @ C @ B.T)
    log = read_foreign(maker.write(tmp_path / "bag"), covariance_axes=axes)
    np.testing.assert_allclose(log.covariance, np.tile(C, (20, 1, 1)), atol=1e-15)
    with pytest.raises(SourceError, match="in axes auto or world or body or mixed"):
        read_foreign(log.path, covariance_axes="camera")


def test_poses_of_other_frames_are_left_out_or_refused_and_so_are_those_without_a_stamp(tmp_path):
    T, C = seq.true_poses(40), np.eye(6) * 1e-4

    def bag(name, others):
        maker = BagMaker(False)
        for k, t in enumerate(seq.stamps(40)):
            maker.odometry("/odom", t, T[k], C, C)
            if k in others:
                maker.odometry("/odom", t + 10**7, T[k] @ seq.true_poses(40)[9], C, C, "camera")
        maker.messages[0][2].header.stamp.sec = maker.messages[0][2].header.stamp.nanosec = 0
        return maker.write(tmp_path / name)

    log = read_foreign(bag("few", {20, 30}))
    np.testing.assert_array_equal(log.t_ns, seq.stamps(40)[1:])
    np.testing.assert_allclose(log.trajectory.T_world_body, T[1:], atol=1e-9)
    assert any("left out: 1 of 42 messages on '/odom', without a stamp" in n for n in log.notes)
    assert any("left out: 2 of 41 messages on '/odom', of other frames" in n for n in log.notes)
    with pytest.raises(SourceError, match="mixed on '/odom': odom to camera, and odom to base_link"):
        read_foreign(bag("half", range(40)))


def _matrix(message) -> np.ndarray:
    p = pose_of(message)
    return se3.from_quaternion(p[:3], p[3:])


def _poses_with_covariance(ros1: bool) -> BagMaker:
    """The poses and covariances of an odometry that states no velocity."""
    maker = BagMaker(ros1)
    for t_ns, _, m in _odometry_bag(ros1, twist=False).messages:
        maker.pose_with_covariance("/pose", t_ns, _matrix(m), m.pose.covariance)
    return maker


@pytest.mark.parametrize("maker_of", [lambda ros1: _odometry_bag(ros1, twist=False), _poses_with_covariance])
def test_pose_covariance_gives_the_growth(tmp_path, maker_of):
    path = _write(tmp_path, "ros1", maker_of)
    records, notes = to_records(read_foreign(path))
    assert not notes
    expected = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
    for record in records[1:]:
        np.testing.assert_allclose(record.covariances["imported"], expected, atol=1e-12)


def test_a_covariance_that_begins_with_zeros_is_stated_from_there_on(tmp_path):
    maker = _odometry_bag(True, twist=True, zeros=3)
    records, notes = to_records(read_foreign(maker.write(tmp_path / "a.bag")))
    assert [bool(r.covariances) for r in records] == [False] * 3 + [True] * 17
    assert notes[-1] == "left out: 2 of 19 covariances, not positive definite"


def _stamped(tmp_path, stamps_s):
    """A bag of odometry that moves, with these stamps, recorded in this order."""
    maker = BagMaker(True)
    for k, t in enumerate(stamps_s):
        maker.odometry("/odom", round(t * 1e9), se3.exp(np.full(6, 0.01 * k)), np.eye(6), np.eye(6))
        maker.messages[-1] = ((k + 1) * 10**9, *maker.messages[-1][1:])
    return maker.write(tmp_path / "a.bag")


@pytest.mark.parametrize(
    ("stamps_s", "reason"),
    [
        ([0.0] * 20, "19 of 20 messages on '/odom' repeat a stamp with another pose .header.stamp must be"),
        ([*range(1, 11), *range(1, 11)], "go back by 9.000 s at message 11 .the clock was set"),
    ],
)
def test_a_clock_that_does_not_run_is_refused(tmp_path, stamps_s, reason):
    with pytest.raises(SourceError, match=reason):
        read_foreign(_stamped(tmp_path, stamps_s))


@pytest.mark.parametrize("wrong_s", [-40.0, 3600.0])
@pytest.mark.parametrize("where", [0, 1, 9, 18, 19])
def test_one_wrong_stamp_costs_one_pose_of_a_bag_and_is_named_in_a_file(tmp_path, wrong_s, where):
    stamps_s = [100 + 0.1 * k for k in range(where)] + [100 + wrong_s] + [100 + 0.1 * k for k in range(where + 1, 20)]
    is_order = (where, wrong_s) in ((0, -40.0), (19, 3600.0))  # then it is a pause
    log = read_foreign(_stamped(tmp_path, stamps_s))
    left = [s for k, s in enumerate(stamps_s) if is_order or k != where]
    np.testing.assert_allclose(log.t_ns * 1e-9, left)
    note = "left out: 1 of 20 messages on '/odom', stamped seconds off"
    assert (note in log.notes) is not is_order
    lines = tmp_path / "log.tum"
    lines.write_text("".join(f"{t:.9f} {k} 0 0 0 0 0 1\n" for k, t in enumerate(stamps_s)))
    if is_order:
        assert len(read_foreign(lines).t_ns) == 20
        return
    with pytest.raises(
        SourceError, match=rf"line {where + 1}: the stamp .* far from those around it \(remove the line"
    ):
        read_foreign(lines)


def test_messages_out_of_order_are_sorted_and_counted(tmp_path):
    stamps_s = [0.1 * k for k in range(20)]
    stamps_s[4:6] = stamps_s[5], stamps_s[4]
    stamps_s.append(stamps_s[-1])
    log = read_foreign(_stamped(tmp_path, stamps_s))
    np.testing.assert_allclose(log.t_ns, np.arange(20) * 1e8)
    assert log.notes == (
        "left out: 1 of 21 messages on '/odom', with a repeated stamp",
        "sorted by stamp: 1 of 21 messages on '/odom', which came out of order",
        "the covariances of its velocities are used, those of its poses are not",
    )


def test_poses_that_a_driver_publishes_twice_count_once(tmp_path):
    maker = _odometry_bag(True, twist=False)
    maker.messages[:] = [(t + j, *rest) for t, *rest in maker.messages for j in (0, 1)]
    log = read_foreign(maker.write(tmp_path / "a.bag"))
    assert len(log.t_ns) == 20
    assert log.notes == ("left out: 20 of 40 messages on '/odom', with a repeated stamp",)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_without_a_pose_are_left_out_as_the_lost_odometry_sends_them(tmp_path, kind):
    """RTAB-Map's, in ROS 1, has a quaternion of zeros; a ground truth with such messages is refused."""

    def maker_of(ros1: bool) -> BagMaker:
        maker = _odometry_bag(ros1, twist=True)
        for k, value in ((7, 0.0), (8, 0.0), (12, float("nan"))):
            q = maker.messages[k][2].pose.pose.orientation
            q.x = q.y = q.z = q.w = value
        return maker

    path = _write(tmp_path, kind, maker_of)
    log = read_foreign(path)
    assert log.notes[0] == "left out: 3 of 20 messages on '/odom', without a valid pose"
    T = seq.true_poses(20)
    np.testing.assert_allclose(to_records(log)[0][7].T_prev_cur, se3.inverse(T[6]) @ T[9], atol=1e-9)
    with pytest.raises(SourceError, match="message 8 on '/odom' holds no valid pose"):
        read_foreign(path, complete=True)


def test_which_topic(tmp_path):
    maker = _odometry_bag(True, twist=True)
    maker.odometry("/other", seq.START_NS, np.eye(4), np.eye(6), np.eye(6))
    path = maker.write(tmp_path / "a.bag")
    with pytest.raises(SourceError, match=r"which topic\? \(poses on: /odom, /other\)"):
        read_foreign(path)
    assert len(read_foreign(path, topic="/odom").t_ns) == 20
    with pytest.raises(SourceError, match="no poses on '/x'"):
        read_foreign(path, topic="/x")


def test_real_ground_robots(real_data):
    for name, count in (("rl_test1", 3952), ("rl_test2", 3060)):
        records, _ = to_records(read_foreign(real_data / "bags" / f"{name}.bag"))
        assert abs(len(records) - count) < 5
        assert all(r.covariances for r in records[1:])
