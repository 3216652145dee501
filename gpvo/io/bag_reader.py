"""ROS 1 bags, ROS 2 bags (sqlite3) and MCAP through one reader, with their failures as one line.

Bags that would fill the memory or never end are refused: chunks unpack to a bound, and databases hold tables alone.
"""

from __future__ import annotations

import bz2
import re
import sqlite3
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from gpvo.errors import GpvoError, SourceError
from gpvo.files import TooLarge
from gpvo.io.stamps import BACK_NS

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
IMU_TYPE = "sensor_msgs/msg/Imu"
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_TYPES = (ODOMETRY_TYPE, "geometry_msgs/msg/PoseStamped", POSE_TYPE, "geometry_msgs/msg/TransformStamped")
TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_STATIC = "/tf_static"
TF_TOPICS = ("/tf", TF_STATIC)
SENSOR_TYPES = (*IMAGE_TYPES, IMU_TYPE, *POSE_TYPES)
_NOT_YET = (".bag.active", ".db3.zstd", ".mcap.zstd")
_PACKED = re.compile(r"compression_mode[\"']?:\s*[\"']?file\b", re.IGNORECASE)
_PAUSE_S = 10.0  # between the bags of one recording
_MAX_METADATA_BYTES = 500_000  # a topic takes some 600, a file of a split bag 230; a megabyte is read in ten seconds
MAX_CHUNK_BYTES = 1 << 28
"""No recorder makes chunks of more than a few megabytes, or of one message where that is larger."""
_STEP_BYTES = 1 << 22
_ZSTD = b"\x28\xb5\x2f\xfd"
# What SQLite itself writes of a table or an index; views, triggers and virtual tables run code of the file's.
_ALLOWED = ("CREATE TABLE %", "CREATE INDEX %", "CREATE UNIQUE INDEX %")


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag, a ROS 2 storage file, a ROS 2 bag folder, or a folder of these."""
    return bool(_parts(path))


def _parts(path: Path) -> list[Path]:
    """The bags that a path stands for: itself, or those in a folder, of a split recording or of several recorders."""
    if not path.is_dir() or _is_whole(path):
        return [path] if _is_whole(path) or path.name.lower().endswith(_NOT_YET) else []
    inside = sorted(p for p in path.iterdir() if not p.name.startswith("."))
    bags = [p for p in inside if _is_whole(p)]
    packed = [p for p in inside if p.name.lower().endswith(_NOT_YET) and p.with_suffix("") not in bags]
    # 'rosbag reindex' keeps the bag of before as NAME.orig.bag.
    return packed or [p for p in bags if not (p.stem.endswith(".orig") and p.with_name(p.name[:-9] + ".bag") in bags)]


def _is_whole(path: Path) -> bool:
    if not path.is_dir():
        return path.suffix.lower() in (".bag", ".db3", ".mcap") and path.is_file()
    metadata = path / "metadata.yaml"
    if not metadata.is_file() or not any(f for end in ("db3", "mcap") for f in path.glob(f"*.{end}*")):
        return False
    with metadata.open(errors="replace") as file:
        return not _PACKED.search(file.read(_MAX_METADATA_BYTES))


def _check_parts(path: Path, parts: list[Path]) -> None:
    """Raise SourceError where a path is no bag, where a part is unfinished or packed, and for parts of ROS 1 and 2."""
    if not path.exists():
        raise SourceError("no such file or folder", where=path, cure="give a bag of ROS 1 or ROS 2")
    if not parts:
        raise SourceError("is not a bag", where=path, cure="give a .bag, .db3 or .mcap file, or a ROS 2 bag's folder")
    for part in parts:
        if part.name.lower().endswith(".active"):
            cure = f"end the recorder; else 'rosbag reindex {part.name}', then rename it to {part.stem}"
            raise SourceError("is still recorded, or the recorder was killed", where=part, cure=cure)
        if part.suffix.lower() == ".zstd":
            cure = f"unpack it beside: 'zstd -d {part.parent / '*.zstd'}', then give the same folder"
            raise SourceError("is compressed as a whole file", where=part, cure=cure)
        metadata = part / "metadata.yaml"
        if metadata.is_file() and (size := metadata.stat().st_size) > _MAX_METADATA_BYTES:
            reason = f"has {size} bytes, at most {_MAX_METADATA_BYTES} are read"
            raise SourceError(reason, where=metadata, cure="name one .mcap or .db3 file inside the folder")
        require_tables(part)
    if len({part.is_file() and part.suffix.lower() == ".bag" for part in parts}) > 1:
        raise SourceError("holds bags of ROS 1 and of ROS 2", where=path, cure="name one of them")


def _check_one_recording(path: Path, reader: Any) -> None:
    """Raise SourceError for bags with a pause between them, or that hold one sensor at one time."""
    readers = sorted((r for r in reader.readers if r.message_count), key=lambda r: r.start_time)
    cure = "name one of them, or a folder that holds the bags of one recording alone"
    for k, after in enumerate(readers[1:], 1):
        pause_s = (after.start_time - max(r.end_time for r in readers[:k])) * 1e-9
        if pause_s > _PAUSE_S:
            text = f"holds several recordings: {after.path.name} begins {pause_s:.0f} s after those before end"
            raise SourceError(text, where=path, cure=cure)
        for before in readers[:k]:
            twice = set(topics_of(before, SENSOR_TYPES)) & set(topics_of(after, SENSOR_TYPES))
            if twice and before.end_time - after.start_time > BACK_NS:
                text = f"{before.path.name} and {after.path.name} both hold '{min(twice)}' at one time"
                raise SourceError(text, where=path, cure=cure)


class _AnyCase(type(Path())):  # type: ignore[misc]
    """A path by whose suffix rosbags tells the kind of a bag, also where it is in capitals, or of a folder."""

    @property
    def suffix(self) -> str:
        return "" if self.is_dir() else str(super().suffix).lower()


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """An open ``rosbags`` reader of a bag, or of all the bags in a folder together, as :func:`is_bag` has it.

    Raises SourceError where the bag cannot be read, at opening or later inside the block; one line in any case.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    bound_chunks()
    try:
        parts = _parts(path)
        _check_parts(path, parts)
        # Bags of ROS 2 before Jazzy hold no message definitions: those of Humble serve.
        typestore = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([_AnyCase(part) for part in parts], default_typestore=typestore) as reader:
            _check_one_recording(path, reader)
            yield reader
    except (GpvoError, GeneratorExit, KeyboardInterrupt):
        raise
    except TooLarge as error:
        raise SourceError(f"unreadable bag: {error}", where=path, cure="record or convert it again") from None
    # The readers below raise whatever their storage does: struct, sqlite3, zstd, Unicode, index, assertion and
    # memory errors, the last for a length that is no length.
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        cure = "if the recording was cut off, 'rosbag reindex', 'ros2 bag reindex' or 'mcap recover' may repair it"
        raise SourceError(f"unreadable bag: {reason or type(error).__name__}", where=path, cure=cure) from None


def topics_of(reader: Any, types: tuple[str, ...]) -> dict[str, str]:
    """Topics that hold messages of one of the types, with the type."""
    topics = sorted(reader.topics.items())
    return {name: info.msgtype for name, info in topics if info.msgtype in types and info.msgcount}


def raw_messages(reader: Any, topics: Container[str]) -> Iterator[tuple[Any, int, bytes]]:
    """(connection, time of recording [ns], bytes) of the named topics, in the order of recording.

    Raises SourceError at the end where a topic gave none of the messages that the bag counts: rosbags leaves out those
    whose QoS in metadata.yaml, as people edit it, is not that of the file beside.
    """
    connections = [c for c in reader.connections if c.topic in topics]
    silent = {(str(c.owner.path), c.topic) for c in connections if c.msgcount}
    for connection, recorded_ns, raw in reader.messages(connections=connections):
        silent.discard((str(connection.owner.path), connection.topic))
        if reader.is2 and raw[:4] == _ZSTD:
            text, cure = "its messages are compressed one by one, as metadata.yaml tells", "name the bag's folder"
            raise SourceError(text, where=connection.owner.path, cure=cure)
        yield connection, recorded_ns, raw
    if silent:
        where, topic = min(silent)
        text = f"its index does not fit the messages on '{topic}': none of those it counts is found"
        cure = "if metadata.yaml was edited, name the .mcap or .db3 file inside; else 'ros2 bag reindex'"
        raise SourceError(text, where=where, cure=cure)


def messages(
    reader: Any, topics: Container[str], torn: Callable[[str], None] | None = None
) -> Iterator[tuple[str, Any]]:
    """(topic, message) of :func:`raw_messages`; ``torn`` is told the topic of each that cannot be decoded."""
    for connection, _, raw in raw_messages(reader, topics):
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception:  # index, struct, unicode, assertion
            if torn is None:
                raise
            torn(connection.topic)
            continue
        yield connection.topic, message


def stamp_ns(message: Any) -> int:
    """``header.stamp`` in nanoseconds: the sensor's time, never that of recording."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def bound_chunks() -> None:
    """Make the readers of ``rosbags`` stop unpacking a chunk at what it declares, and at 256 MB in any case."""
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import storage_mcap as mcap

    of: dict[str, Callable[[], Any]] = {
        "bz2": bz2.BZ2Decompressor,
        "lz4": LZ4FrameDecompressor,
        "zstd": mcap.zstd.ZstdDecompressor,
    }
    for table in (ros1.decompressors, mcap.DECOMPRESSORS):
        table.update({name: partial(unpacked, new=of[name]) for name in of.keys() & table.keys()})


def unpacked(data: bytes, declared: int = MAX_CHUNK_BYTES, *, new: Callable[[], Any]) -> bytes:
    """All that compressed bytes hold, by decompressors that ``new`` makes, one for each of the streams.

    Raises TooLarge beyond ``declared`` bytes or the bound, EOFError where a stream is cut off.
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
                raise TooLarge(f"a chunk unpacks to more than {most} bytes")
        data = one.unused_data or b""
    return bytes(out)


def require_tables(path: Path) -> None:
    """Raise SourceError where a bag (a file or folder) has a database of more than tables and their indices: a view
    may have no end; and one whose last messages are in a journal beside it, which rosbags does not read. sqlite3.Error
    where one is damaged."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        if file.suffix.lower() != ".db3":
            continue
        if found := set(str(file)) & set("#%?"):  # rosbags opens databases by an address, in which these have a meaning
            raise SourceError(f"its path holds '{min(found)}'", where=file, cure="rename the file or folder")
        journals = (file.with_name(f"{file.name}-{kind}") for kind in ("wal", "journal"))
        if journal := next((p for p in journals if p.is_file() and p.stat().st_size), None):
            text = f"is not whole without {journal.name}: it is still recorded, or the recorder was killed"
            cure = f"end the recorder, then let SQLite join them: sqlite3 {file.name} 'SELECT count(*) FROM messages'"
            raise SourceError(text, where=file, cure=cure)
        database = sqlite3.connect(f"{file.resolve().as_uri()}?immutable=1", uri=True)
        try:
            other = " AND ".join(["sql NOT LIKE ?"] * len(_ALLOWED))
            if database.execute(f"SELECT 1 FROM sqlite_master WHERE {other}", _ALLOWED).fetchone():
                raise SourceError("holds more than tables: not a bag", where=file, cure="record or convert it again")
        finally:
            database.close()
