"""Small files that would fill the memory or the time: refused by their header, in one line that names them."""

from __future__ import annotations

import json
import os
import resource
import signal
import struct
import subprocess
import threading
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from bag_maker import stereo_bag
from gpvo.cameras.imagesize import image_size
from gpvo.cameras.kalibr import calibration_text
from gpvo.cameras.models import PinholeRadtan
from gpvo.cameras.readers import read_stereo_yaml
from gpvo.cameras.rectify import Rectifier, read_mask
from gpvo.cameras.rig import StereoRig
from gpvo.cli.describe import describe
from gpvo.errors import CalibrationError, GpvoError, OutputError, SourceError
from gpvo.files import read_json, read_toml, write_text
from gpvo.geometry.se3 import from_rt
from gpvo.io import open_source
from gpvo.io.folder import FolderSource
from gpvo.io.foreign import read_foreign
from gpvo.io.images import read_grey8
from gpvo.io.parquet import count_rows, join_tables, read_blocks, read_columns, write_table
from gpvo.io.run_read import _read_beside
from gpvo.io.run_table import imu_from
from gpvo.io.tracks import TracksSource
from gpvo.io.trajectory import read_tum
from gpvo.online.predictor import Predictor

ENCODINGS = (".png", ".jpg", ".bmp", ".tif", ".pgm", ".ppm", ".webp")


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("text", [
    "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
    + "".join(f"{y}: &{y} [{','.join(['*' + x] * 10)}]\n" for x, y in zip("abcdefgh", "bcdefghi")) + "T: *i\n",
    "".join(f"k{i}: 1\n" for i in range(350_000)),
    "resolution: [.inf, 480]\n", "image_width: null\nimage_height: 3\n", f"T: [{'9' * 400}, 0, 0]\n",
    "x: " + "[" * 5000,
], ids=["aliases", "many keys", "infinite", "null", "400 digits", "deep"])  # fmt: skip
def test_yaml_bombs_are_refused_at_once(text: str, tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    rest = "R: [1,0,0,0,1,0,0,0,1]\nK1: [300,0,1,0,300,1,0,0,1]\nK2: [300,0,1,0,300,1,0,0,1]\nD1: [0,0,0,0,0]\n"
    rest += "D2: [0,0,0,0,0]\n" + ("" if "T: [9" in text else "T: [-0.1,0,0]\n")
    path.write_text(text + rest if any(key in text for key in ("image_width", "resolution", "T: [9")) else text)
    start = time.monotonic()
    with pytest.raises(CalibrationError, match=r"camchain\.yaml") as refusal:
        read_stereo_yaml(path)
    assert "\n" not in str(refusal.value)
    assert ("the alias" in str(refusal.value)) == ("*a" in text)
    assert time.monotonic() - start < 10.0


@pytest.mark.parametrize("suffix", ENCODINGS)
def test_the_size_is_read_from_the_header(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"image{suffix}"
    colour = np.random.default_rng(0).integers(0, 255, (37, 53, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), colour if suffix != ".pgm" else colour[:, :, 0])
    assert image_size(path.read_bytes()) == (53, 37)
    assert read_grey8(path).shape == (37, 53)
    for cut in range(40):
        image_size(path.read_bytes()[:cut])  # raises nothing


def _claiming(suffix: str, tmp_path: Path) -> Path:
    """A file whose header claims 16384 x 16384."""
    path = tmp_path / f"left{suffix}"
    cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    raw = bytearray(path.read_bytes())
    if suffix == ".png":
        raw[16:24] = struct.pack(">II", 16384, 16384)
        raw[29:33] = struct.pack(">I", zlib.crc32(raw[12:29]))
    elif suffix == ".bmp":
        raw[18:26] = struct.pack("<ii", 16384, 16384)
    elif suffix == ".jpg":
        at = raw.index(b"\xff\xc0")
        raw[at + 5 : at + 9] = struct.pack(">HH", 16384, 16384)
    else:
        raw = bytearray(raw.replace(b"64 48", b"16384 16384"))
    path.write_bytes(raw)
    return path


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".pgm"])
def test_an_image_that_claims_a_quarter_of_a_gigapixel_is_not_decoded(suffix: str, tmp_path: Path) -> None:
    before = _peak_mb()
    assert read_grey8(_claiming(suffix, tmp_path)) is None
    assert _peak_mb() - before < 200


def test_a_chunk_that_claims_gigabytes_is_not_made_room_for(tmp_path: Path) -> None:
    path = tmp_path / "left.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8))
    raw = bytearray(path.read_bytes())
    at = raw.index(b"IEND") - 4
    raw[at : at + 4] = b"\x7f\xff\xff\xff"
    raw[at + 4 : at + 8] = b"IDAT"
    path.write_bytes(raw)
    before = _peak_mb()
    assert read_grey8(path) is None
    assert _peak_mb() - before < 200


def _tiff_of(tags: list[tuple[int, int, int]]) -> bytes:
    """A TIFF of (tag, kind, value), without strips."""
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + bytes(4)


def test_the_size_of_a_tiff_is_what_the_decoder_takes() -> None:
    size = [(256, 4, 64), (257, 4, 48)]
    assert image_size(_tiff_of(size)) == (64, 48)
    for other in ([(256, 4, 15000), *size], [*size, (257, 4, 15000)], [(256, 16, 64), (257, 16, 64)]):
        assert image_size(_tiff_of(other)) is None


@pytest.mark.parametrize("marker", [0x01, 0xD0, 0xD7, 0xD8, 0x00])
def test_the_size_of_a_jpeg_is_what_the_decoder_takes(marker: int) -> None:
    """A decoder steps over a marker without a length, and then over a comment that holds another frame's header."""
    whole = cv2.imencode(".jpg", np.zeros((2000, 3000), np.uint8))[1].tobytes()
    odd = b"\xff\xd8\xff" + bytes([marker])
    comments = bytearray(b"\xff\xfe" + struct.pack(">H", 65000) + bytes(64998) + b"\xff\xfe\x07\xd0" + bytes(1998))
    at = 4 + 0xFFFE - len(odd)
    comments[at : at + 9] = b"\xff\xc0\x00\x11\x08" + struct.pack(">HH", 48, 64)
    assert image_size(odd + bytes(comments) + whole[2:]) == (None if marker == 0 else (3000, 2000))


def test_a_sequence_of_such_images_is_refused_by_its_calibration(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    (tmp_path / "right").mkdir()
    bomb = _claiming(".png", tmp_path)
    for side in ("left", "right"):
        (tmp_path / side / "1400000000000000000.png").write_bytes(bomb.read_bytes())
    bomb.unlink()
    block = (
        "camera_model: pinhole\n  intrinsics: [300, 300, 320, 240]\n  distortion_model: none\n  resolution: [640, 480]"
    )
    pose = "  T_cn_cnm1: [[1,0,0,-0.1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
    (tmp_path / "camchain.yaml").write_text(f"cam0:\n  {block}\ncam1:\n  {block}\n{pose}\n")
    with pytest.raises(CalibrationError, match=r"1400000000000000000\.png.*16384x16384.*640x480"):
        FolderSource(tmp_path)
    huge = (
        (tmp_path / "camchain.yaml").read_text().replace("640, 480", "16384, 16384").replace("320, 240", "8192, 8192")
    )
    (tmp_path / "camchain.yaml").write_text(huge)
    with pytest.raises(CalibrationError, match="resolution 16384x16384"):
        FolderSource(tmp_path)


def _tracks(path: Path, **changed: object) -> Path:
    n, m = 3, 12
    data = {"t_s": np.arange(n) * 0.1, "frame": np.repeat(np.arange(n), 4), "track": np.arange(m),
            "uv_left": np.full((m, 2), 100.0), "uv_right": np.full((m, 2), 90.0), "fx": 300.0, "fy": 300.0, "cx": 320.0,
            "cy": 240.0, "baseline_m": 0.1, "width": 640, "height": 480,
            "T_world_cam": np.tile(np.eye(4), (n, 1, 1))}  # fmt: skip
    np.savez_compressed(path, **{**data, **changed})
    return path


def test_an_array_that_nobody_needs_is_not_unpacked(tmp_path: Path) -> None:
    path = _tracks(tmp_path / "t.npz", other=np.zeros(20_000_000))
    before = _peak_mb()
    assert len(TracksSource(path)) == 3
    assert _peak_mb() - before < 100


@pytest.mark.parametrize("changed", [
    {"width": np.array([640, 480])}, {"width": np.nan}, {"height": "480"},
    {"sigma_translation_m": "much", "sigma_rotation_rad": 0.1}, {"t_s": np.arange(3) + 1e12}, {"t_s": np.zeros(0)},
    {"track": np.full(12, 1e300)}, {"uv_left": np.full((12, 2), 1e200)}, {"fx": "x"}, {"baseline_m": -0.1},
    {"imu_t_ns": np.full(3, 2**63, np.uint64), "imu_gyro_radps": np.zeros((3, 3)), "imu_acc_mps2": np.zeros((3, 3))},
    {"imu_t_ns": np.array(["x"] * 3), "imu_gyro_radps": np.zeros((3, 3)), "imu_acc_mps2": np.zeros((3, 3))},
    {"frame": np.zeros(0), "track": np.zeros(0), "uv_left": np.zeros((0, 2)), "uv_right": np.zeros((0, 2))},
], ids=str)  # fmt: skip
def test_tracks_that_cannot_be_are_refused(changed: dict, tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    with pytest.raises(GpvoError, match=r"t\.npz: ") as refusal:
        list(TracksSource(_tracks(tmp_path / "t.npz", **changed)))
    assert "\n" not in str(refusal.value)
    assert not recwarn.list


@pytest.mark.parametrize("head", [
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }", b"{'descr': '<f8', 'fortran_order'",
    b"(((((", b"{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
], ids=["huge", "cut", "brackets", "objects", "negative"])  # fmt: skip
def test_damaged_array_headers_are_refused(head: bytes, tmp_path: Path) -> None:
    path = _tracks(tmp_path / "t.npz")
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    body = head.ljust(117) + b"\n"
    parts["t_s.npy"] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(body)) + body + bytes(24)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    with pytest.raises(SourceError, match=r"t\.npz: not readable") as refusal:
        TracksSource(path)
    assert ("does not fit its" in str(refusal.value)) == (b"(1000000000000,)" in head or b"'|O'" in head)


def test_an_array_that_is_needed_is_not_unpacked_beyond_all_tracks(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"t\.npz: unpacks .* too large for tracks"):
        TracksSource(_tracks(tmp_path / "t.npz", uv_left=np.zeros((4_000_000, 2))))


def test_a_table_of_run_lengths_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "imu.parquet"
    pq.write_table(pa.table({f"c{i}": np.zeros(3_000_000) for i in range(12)}), path)
    with pytest.raises(SourceError, match=r"imu\.parquet: unpacks"):
        read_columns(path)


def test_text_in_the_place_of_numbers_is_refused(tmp_path: Path) -> None:
    columns = {f"{k}_{a}_{u}": ["x", "y"] for k, u in (("gyro", "radps"), ("acc", "mps2")) for a in "xyz"}
    pq.write_table(pa.table({"t_ns": [1, 2], **columns}), tmp_path / "imu.parquet")
    with pytest.raises(SourceError, match=r"imu\.parquet.*holds string"):
        _read_beside(tmp_path / "imu.parquet", imu_from)


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "truth.parquet"
    pq.write_table(pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["p_x_m", "p_x_m"]), path)
    for read in (read_columns, lambda p: list(read_blocks(p))):
        with pytest.raises(SourceError, match=r"truth\.parquet: .*two columns have the same name"):
            read(path)


def test_a_line_without_end_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text("1 " * 5_000_000)
    for kind in (None, "tum", "csv"):
        tracemalloc.start()
        with pytest.raises(SourceError, match=r"log\.txt: line 1 is longer than a million"):
            read_foreign(path, kind)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 8_000_000


@pytest.mark.parametrize("rate_hz", [1e-300, 1e300, -1.0, 0.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate_hz: float, tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    with pytest.raises(SourceError, match=r"poses\.txt: a rate of"):
        read_foreign(tmp_path / "poses.txt", "kitti", rate_hz=rate_hz)


def test_a_position_beyond_the_earth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "plan.txt").write_text("0 0 0 0 0 0 0 1\n1 -1e308 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match=r"plan\.txt: line 2 .*1e\+308"):
        read_foreign(tmp_path / "plan.txt", "tum")


def test_json_numbers_beyond_all_floats_are_refused(tmp_path: Path) -> None:
    for text in (
        '{"schema": 1e999}',
        '{"schema": 1%s}' % ("0" * 400),
        '{"schema": NaN}',
        json.dumps({"schema": 1})[:-1],
    ):
        (tmp_path / "run.json").write_text(text)
        with pytest.raises(SourceError, match=r"run\.json: is damaged"):
            read_json(tmp_path / "run.json")


def test_metadata_that_take_long_to_read_are_refused(tmp_path: Path) -> None:
    bag = stereo_bag(ros1=False, n=2).write(tmp_path / "bag")
    with (bag / "metadata.yaml").open("a") as metadata:
        metadata.writelines(f"  k{i}: [1, 2]\n" for i in range(100_000))
    with pytest.raises(SourceError, match=r"metadata\.yaml: has \d+ bytes") as refusal:
        open_source(bag)
    assert "\n" not in str(refusal.value)


def test_lengths_that_are_none_in_an_mcap_are_refused(tmp_path: Path) -> None:
    """Of each record in turn, and of what a chunk unpacks to."""
    path = next(stereo_bag(ros1=False, n=2).write(tmp_path / "bag", mcap=True).glob("*.mcap"))
    raw, at, refusals = path.read_bytes(), 8, []
    before = _peak_mb()
    while at + 9 < len(raw):
        (length,) = struct.unpack_from("<Q", raw, at + 1)
        for place in (at + 1, at + 9 + 16) if length >= 24 else (at + 1,):
            bad = bytearray(raw)
            bad[place : place + 8] = struct.pack("<Q", 2**62)
            path.write_bytes(bad)
            try:
                list(open_source(path))
            except GpvoError as refusal:
                refusals.append(str(refusal))
        at += 9 + length
    assert len(refusals) > 5
    assert all(path.name in told and "\n" not in told for told in refusals)
    assert _peak_mb() - before < 500


@contextmanager
def _within_seconds(seconds: float) -> Iterator[None]:
    """What waits for longer fails."""

    def late(*_: object) -> None:
        raise AssertionError("it waits")  # no OSError, which readers catch

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_pipe_without_an_end_is_left_at_its_bound(tmp_path: Path) -> None:
    """Its size is 0 to whoever asks before reading."""
    os.mkfifo(tmp_path / "pipe")
    end = os.open(tmp_path / "pipe", os.O_RDWR)  # both ends, so that neither waits for the other

    def write() -> None:
        with suppress(OSError):
            while True:
                os.write(end, bytes(1 << 16))

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    with pytest.raises(SourceError, match="larger than 50 MB"):
        read_json(tmp_path / "pipe")
    with pytest.raises(GpvoError, match="too large for settings"):
        read_toml(tmp_path / "pipe")
    with pytest.raises(CalibrationError, match="too large for a calibration"):
        calibration_text(tmp_path / "pipe")
    os.set_blocking(end, False)
    with suppress(BlockingIOError):
        while True:
            os.read(end, 1 << 16)
    writer.join(10.0)
    os.close(end)


READERS = {
    "json": read_json,
    "toml": read_toml,
    "calibration": calibration_text,
    "log": read_foreign,
    "poses": read_tum,
    "model": Predictor.load,
    "tracks": lambda path: open_source(path, "tracks"),
    "sequence": open_source,
    "info": describe,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_file_is_refused_at_once(reader: str, kind: str, tmp_path: Path) -> None:
    """A pipe that nobody writes to would be waited for, and a device may have no end."""
    path = tmp_path / "it.txt"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    before = _peak_mb()
    with _within_seconds(20.0):
        if kind == "pipe" and reader in ("toml", "calibration"):
            assert not READERS[reader](path), "as of an empty file"
        else:
            with pytest.raises(GpvoError, match=r"it\.txt: ") as refused:
                READERS[reader](path)
            assert kind == "pipe" or "device" in str(refused.value)
    assert _peak_mb() - before < 20


def test_a_pipe_that_somebody_writes_to_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    writer = subprocess.Popen(
        ["sh", "-c", f"(sleep 0.3; echo '[run]'; sleep 0.3; echo 'window = 3') > {tmp_path}/pipe"]
    )
    end = os.open(tmp_path / "pipe", os.O_RDONLY)  # waits for the writer
    assert read_toml(tmp_path / "pipe") == {"run": {"window": 3}}
    os.close(end)
    writer.wait(10.0)


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="pipe: cannot be written: .*not a file"):
        write_text(tmp_path / "pipe", "text")
    assert [p.is_fifo() for p in tmp_path.iterdir()] == [True]


def test_a_table_is_bounded_by_its_size_and_not_by_its_rows(tmp_path: Path) -> None:
    """Ten hours of tracks have a hundred million rows."""
    track = np.random.default_rng(0).integers(0, 2, 100_000)
    part = write_table(tmp_path / "part.parquet", {"track": track})
    join_tables([part] * 600, tmp_path / "tracks.parquet")
    assert count_rows(tmp_path / "tracks.parquet") == 60_000_000


def test_a_disk_that_fails_while_a_file_is_read_is_told_with_its_name(tmp_path: Path) -> None:
    if not Path("/proc/self/mem").exists():
        pytest.skip("no file here that opens and cannot be read")
    (tmp_path / "image.tif").symlink_to("/proc/self/mem")
    with pytest.raises(SourceError, match=r"image\.tif: cannot be read: Input/output error"):
        describe(tmp_path / "image.tif")


def test_a_damaged_mask_is_refused_and_nothing_else_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mask.pgm"
    cv2.imwrite(str(path), np.full((48, 64), 255, np.uint8))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CalibrationError, match=r"mask\.pgm: not readable as an image"):
        read_mask(path)
    assert capfd.readouterr() == ("", "")


def test_a_large_rectified_image_is_mapped_in_little_memory_and_a_larger_one_refused() -> None:
    lens = PinholeRadtan(300.0, 300.0, 319.5, 239.5, 640, 480, (0.1, 0.0, 0.0, 0.0, 0.0))
    rig = StereoRig(lens, lens, from_rt(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    tracemalloc.start()
    assert Rectifier(rig, size=(3000, 3000), hfov_deg=60.0).camera.width == 3000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 500_000_000
    with pytest.raises(CalibrationError, match="rectified size 16384x16384 is not possible"):
        Rectifier(rig, size=(16384, 16384))
