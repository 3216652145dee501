"""Bags that would fill the memory or never end: refused in one line that names them."""

from __future__ import annotations

import bz2
import resource
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_maker import stereo_bag
from gpvo.errors import SourceError
from gpvo.files import TooLarge
from gpvo.io import bag_reader, open_source
from gpvo.io.bag_reader import open_bag, unpacked
from lz4.frame import LZ4FrameDecompressor
from lz4.frame import compress as lz4_compress
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2.storage_mcap import zstd
from rosbags.typesys import Stores, get_typestore


@pytest.mark.parametrize("new", [bz2.BZ2Decompressor, LZ4FrameDecompressor, zstd.ZstdDecompressor])
def test_a_chunk_unpacks_to_what_it_declares_and_no_further(new: Callable[[], Any]) -> None:
    pack = {bz2.BZ2Decompressor: bz2.compress, LZ4FrameDecompressor: lz4_compress}.get(new, zstd.compress)
    some, large = np.random.default_rng(0).bytes(9_000_000), pack(bytes(300_000_000))
    packed = pack(some)
    assert unpacked(packed, new=new) == unpacked(packed, len(some), new=new) == some
    assert unpacked(pack(b""), new=new) == b""
    with pytest.raises(EOFError):
        unpacked(packed[:-20], new=new)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for declared, most in ((1000, 1000), (1 << 62, 1 << 28)):
        with pytest.raises(TooLarge, match=f"more than {most} bytes"):
            unpacked(large, declared, new=new)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 700_000


def test_a_bag_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_reader, "MAX_CHUNK_BYTES", 1000)
    path = tmp_path / "flight.bag"
    writer = Ros1Writer(path)
    writer.set_compression(Ros1Writer.CompressionFormat.BZ2)
    with writer:
        one = writer.add_connection("/t", "std_msgs/msg/String", typestore=get_typestore(Stores.ROS1_NOETIC))
        writer.write(one, 1, struct.pack("<I", 2000) + bytes(2000))
    with (
        pytest.raises(SourceError, match=r"flight\.bag: unreadable bag: a chunk unpacks to more"),
        open_bag(path) as bag,
    ):
        list(bag.messages())


@pytest.mark.parametrize("sql", [
    "CREATE VIEW messages AS WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM r) SELECT i AS id FROM r",
    "CREATE TRIGGER t AFTER INSERT ON m BEGIN DELETE FROM m; END",
], ids=["view", "trigger"])  # fmt: skip
def test_a_database_that_runs_code_is_refused(sql: str, tmp_path: Path) -> None:
    bag = stereo_bag(ros1=False, n=2).write(tmp_path / "bag")
    (file,) = bag.glob("*.db3")
    with closing(sqlite3.connect(file)) as database:
        database.execute("ALTER TABLE messages RENAME TO m")
        database.execute(sql)
        database.commit()
    for path in (bag, file):
        with pytest.raises(SourceError, match=r"\.db3: holds more than tables"):
            open_source(path)
