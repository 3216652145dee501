"""Bags that would fill the memory or never end: chunks unpack to a bound, and databases hold tables alone."""

from __future__ import annotations

import bz2
import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from gpvo.errors import SourceError

MAX_CHUNK_BYTES = 1 << 28
"""No recorder makes chunks of more than a few megabytes, or of one message where that is larger."""
_STEP_BYTES = 1 << 22
# What SQLite itself writes of a table or an index; views, triggers and virtual tables run code of the file's.
_ALLOWED = ("CREATE TABLE %", "CREATE INDEX %", "CREATE UNIQUE INDEX %")


class ChunkTooLarge(Exception):
    """A chunk of a bag unpacks to more than is made room for."""


def bound_chunks() -> None:
    """Make the readers of ``rosbags`` stop unpacking a chunk at what it declares, and at 256 MB in any case."""
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap as mcap

    of: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": LZ4FrameDecompressor}
    if hasattr(mcap, "zstd"):
        of["zstd"] = mcap.zstd.ZstdDecompressor
    # Versions of rosbags that have no such table are left as they are.
    for table in (getattr(ros1, "decompressors", {}), getattr(mcap, "DECOMPRESSORS", {})):
        table.update({name: partial(unpacked, new=of[name]) for name in of.keys() & table.keys()})


def unpacked(data: bytes, declared: int = MAX_CHUNK_BYTES, *, new: Callable[[], Any]) -> bytes:
    """All that compressed bytes hold, by decompressors that ``new`` makes, one for each of the streams.

    Raises ChunkTooLarge beyond ``declared`` bytes or the bound, EOFError where a stream is cut off.
    """
    most, out = min(declared, MAX_CHUNK_BYTES), bytearray()
    while data:
        one = new()
        while not one.eof:
            part = one.decompress(data, _STEP_BYTES)
            data = b""  # the decompressor keeps the rest
            if not part and not one.eof:
                raise EOFError("a chunk is cut off")
            out += part
            if len(out) > most:
                raise ChunkTooLarge(f"a chunk unpacks to more than {most} bytes")
        data = one.unused_data or b""
    return bytes(out)


def require_tables(path: Path) -> None:
    """Raise SourceError where a bag (a file or folder) has a database of more than tables and their indices: a view
    may have no end. sqlite3.Error where one is damaged."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        if file.suffix.lower() != ".db3":
            continue
        database = sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)
        try:
            other = " AND ".join(["sql NOT LIKE ?"] * len(_ALLOWED))
            if database.execute(f"SELECT 1 FROM sqlite_master WHERE {other}", _ALLOWED).fetchone():
                raise SourceError("holds more than tables: no bag", where=file, cure="record or convert it again")
        finally:
            database.close()
