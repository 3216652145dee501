"""Small Parquet tables: read with their sizes and checksums checked first; written with NumPy and the standard library,
so that odometry can record without a Parquet library.

Format: Apache Parquet 2.10, its footer and page headers in Thrift's compact protocol (the ids of fields are those of
``parquet.thrift``). Every column is optional, plainly encoded, in gzip pages with a CRC-32 each, one per joined table.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.files import Own, replacing

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_INTEGERS = ("t_ns", "t_prev_ns", "n_detected", "n_stereo", "n_tracked", "n_inliers")
KIND_OF = {
    **dict.fromkeys(_INTEGERS, "int64"),
    **dict.fromkeys(("status", "reason"), "string"),
    **dict.fromkeys(("is_reference", "is_inlier"), "bool"),
    **dict.fromkeys(("u_px", "v_px", "d_px"), "float32"),
    "track": "int32",
}
"""Kinds of the columns that are not float64, by name."""
_TYPE = {"bool": 0, "int32": 1, "int64": 2, "float32": 4, "float64": 5, "string": 6}
_MAGIC, _GZIP, _PLAIN, _RLE, _OPTIONAL, _UTF8 = b"PAR1", 2, 0, 3, 1, 0
_LEVEL = 1  # of gzip: covariances hardly shrink further
MAX_COLUMNS = 4096
MAX_BYTES = 8_000_000_000
_BLOCK_ROWS, _SPOOL_BYTES = 2_000, 4_000_000
_FEW_ROWS = 1_000  # for few rows, threads cost more than they save
_MOST_GROUPS = 1000  # of rows: what a file says of each column of each takes 1 kB to write and to read
_PLAIN_BYTES, _MAX_RATIO = 200_000_000, 200
_LARGEST = np.float64(1e100)  # No number of a run is larger: products of two or three stay finite.
# Of Thrift: by ids that rise by less than 16, numbers, texts, structures, as bytes where they are encoded, and lists of
# these.
_Struct = dict[int, Any]
_BYTE = [bytes([k]) for k in range(256)]


@dataclass(frozen=True)
class RowGroup:
    """Where the columns of a written file lie: ``names``, and (C, 3) ``offset``, stored and plain ``size`` in bytes."""

    path: Path
    rows: int
    names: tuple[str, ...]
    place: NDArray[np.int64]


def write_table(path: Path, columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> RowGroup:
    """Write columns of one length in place of what was there, or not at all. None and NaN become null.

    Raises OutputError, naming ``path``, as :func:`gpvo.files.replacing`.
    """
    return write_blocks(path, [columns], metadata)


def write_blocks(
    path: Path, blocks: Iterable[Mapping[str, Any]], metadata: Mapping[str, str] | None = None, own: Own | None = None
) -> RowGroup:
    """The same file of the rows of all blocks, one of which is in memory at a time, or a single column of all; a column
    that a block lacks is null there."""
    rows, end, place, parts = 0, len(_MAGIC), [], dict[str, list[tuple[int, int, int, int]]]()
    # A page begins with which of its values there are, and so is known only at the end. Nameless, the room for the
    # blocks goes with the process, however it ends.
    with (
        replacing(path, own) as temporary,
        temporary.open("wb") as file,
        SpooledTemporaryFile(_SPOOL_BYTES, dir=str(path.parent)) as spool,
    ):
        for block in blocks:
            count = 0
            for name, values in block.items():
                present, data = _encoded(values, KIND_OF.get(name, "float64"))
                count = len(present)
                parts.setdefault(name, []).append((rows, count, spool.tell(), len(data)))
                spool.write(data + present.tobytes())
            rows += count
        file.write(_MAGIC)
        for name, pieces in parts.items():
            there, known = np.zeros(rows, dtype=bool), bytearray()
            for first, count, offset, size in pieces:
                spool.seek(offset)
                known += spool.read(size)
                there[first : first + count] = np.frombuffer(spool.read(count), dtype=bool)
            page, plain = _packed(there, known, KIND_OF.get(name, "float64"))
            place.append((end, len(page), plain))
            end += file.write(page)
        group = RowGroup(path, rows, tuple(parts), np.array(place, dtype=np.int64).reshape(-1, 3))
        file.write(_footer([group], metadata))
    return group


def join_tables(parts: Sequence[RowGroup], target: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Join tables of a growing set of columns into one file, a few parts at a time in memory."""
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    joined, end, at_once = [], len(_MAGIC), -(-len(parts) // _MOST_GROUPS)
    with replacing(target) as temporary, temporary.open("wb") as file:
        file.write(_MAGIC)
        for k in range(0, len(parts), at_once or 1):
            some, rows = [(p, p.path.read_bytes(), dict(zip(p.names, p.place))) for p in parts[k : k + at_once]], []
            for name in names:
                pages = [_stored_page(stored, place.get(name), part.rows, name) for part, stored, place in some]
                size = file.write(b"".join(page for page, _ in pages))
                rows.append((end, size, sum(plain for _, plain in pages)))
                end += size
            count = sum(part.rows for part, _, _ in some)
            joined.append(RowGroup(target, count, names, np.array(rows, dtype=np.int64)))
        file.write(_footer(joined, metadata))


def _stored_page(stored: bytes, place: NDArray[np.int64] | None, rows: int, name: str) -> tuple[bytes, int]:
    """A column's page in a stored table, of nulls where it has none, and its size before compression."""
    if place is None:
        kind = KIND_OF.get(name, "float64")
        return _packed(*_encoded([None] * rows, kind), kind)
    offset, size, plain = place.tolist()
    return stored[offset : offset + size], plain


def _packed(present: NDArray[np.bool_], data: bytes | bytearray, kind: str) -> tuple[bytes, int]:
    """The page, with its header, of the values that there are, as :func:`_encoded` gives them; and its size before
    compression."""
    if kind == "bool":
        data = np.packbits(np.frombuffer(data, dtype=bool), bitorder="little").tobytes()
    levels = _varint(((len(present) + 7) // 8) << 1 | 1) + np.packbits(present, bitorder="little").tobytes()
    plain = struct.pack("<I", len(levels)) + levels + data
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, 31)
    packed = packer.compress(plain) + packer.flush()
    crc = zlib.crc32(packed)
    of_page = {1: len(present), 2: _PLAIN, 3: _RLE, 4: _RLE}
    header = _thrift({1: 0, 2: len(plain), 3: len(packed), 4: crc - (crc >> 31 << 32), 5: of_page})[1]
    return header + packed, len(header) + len(plain)


def _encoded(values: Any, kind: str) -> tuple[NDArray[np.bool_], bytes]:
    """Which values there are, and these in plain encoding, but for a byte of each boolean."""
    if kind.startswith("float"):
        numbers = np.asarray(values, dtype=f"<f{kind[5:].replace('64', '8').replace('32', '4')}")
        present = ~np.isnan(numbers)
        return present, numbers[present].tobytes()
    present = np.array([v is not None for v in values], dtype=bool)
    there = [v for v in values if v is not None]
    if kind == "string":
        texts = [str(v).encode() for v in there]
        return present, b"".join(struct.pack("<I", len(t)) + t for t in texts)
    if kind == "bool":
        return present, np.asarray(there, dtype=bool).tobytes()
    return present, np.asarray(there, dtype="<i8" if kind == "int64" else "<i4").tobytes()


def _footer(groups: Sequence[RowGroup], metadata: Mapping[str, str] | None) -> bytes:
    names = groups[0].names
    schema = [_thrift({4: "schema", 5: len(names)})[1], *map(_described, names)]
    told = [{1: key, 2: text} for key, text in (metadata or {}).items()]
    rows = _Long(sum(g.rows for g in groups))
    body = _thrift({1: 2, 2: schema, 3: rows, 4: [_group(g) for g in groups], 5: told, 6: "gpvo"})[1]
    return body + struct.pack("<I", len(body)) + _MAGIC


@cache
def _described(name: str) -> bytes:
    """What the schema says of a column."""
    kind = KIND_OF.get(name, "float64")
    return _thrift({1: _TYPE[kind], 3: _OPTIONAL, 4: name} | ({6: _UTF8} if kind == "string" else {}))[1]


@cache
def _encoding(name: str) -> bytes:
    """What a group says of a column wherever it lies: the first four fields."""
    return _fields({1: _TYPE[KIND_OF.get(name, "float64")], 2: [_PLAIN, _RLE], 3: [name], 4: _GZIP})


def _group(group: RowGroup) -> _Struct:
    columns, rows = list[bytes](), _Long(group.rows)
    for name, place in zip(group.names, group.place.tolist()):
        offset, size, plain = map(_Long, place)
        about = _encoding(name) + _fields({5: rows, 6: plain, 7: size, 9: offset}, before=4) + b"\x00"
        columns.append(_fields({2: offset, 3: about}) + b"\x00")
    return {1: columns, 2: _Long(group.place[:, 2].sum()), 3: _Long(group.rows)}


class _Long(int):
    """A number of 64 bits, which Thrift tells from one of 32."""


def _thrift(value: Any) -> tuple[int, bytes]:
    """Thrift's number for the type of a value, and the value in its compact protocol."""
    if isinstance(value, int):
        return 6 if isinstance(value, _Long) else 5, _varint(value << 1 ^ value >> 63)  # zigzag
    if isinstance(value, bytes):
        return 12, value
    if isinstance(value, dict):
        return 12, _fields(value) + b"\x00"
    if isinstance(value, str):
        text = value.encode()
        return 8, _varint(len(text)) + text
    kinds, entries = zip(*map(_thrift, value)) if value else ((12,), ())
    head = bytes([len(value) << 4 | kinds[0]]) if len(value) < 15 else bytes([0xF0 | kinds[0]]) + _varint(len(value))
    return 9, head + b"".join(entries)


def _fields(values: _Struct, before: int = 0) -> bytes:
    """Fields of a structure, that follow the one with this id."""
    out = []
    for number, held in values.items():
        kind, data = _thrift(held)
        out.append(_BYTE[(number - before) << 4 | kind] + data)
        before = number
    return b"".join(out)


def _varint(value: int) -> bytes:
    if value <= 0x7F:
        return _BYTE[value]
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def read_columns(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Columns as arrays (nulls of numbers as NaN) and the file's metadata.

    Raises SourceError where the file is missing, damaged or implausibly large.
    """
    with _opened(path) as file:
        metadata = {k.decode(): v.decode(errors="replace") for k, v in (file.schema_arrow.metadata or {}).items()}
        return _columns(file.read(use_threads=file.metadata.num_rows > _FEW_ROWS)), metadata


def read_blocks(path: Path) -> Iterator[dict[str, NDArray[Any]]]:
    """The same columns, at most ``_BLOCK_ROWS`` rows at a time; at least one block, which may be empty."""
    import pyarrow as pa

    with _opened(path) as file:
        left = file.metadata.num_rows
        if not left:
            yield _columns(file.read())
        for block in file.iter_batches(_BLOCK_ROWS, use_threads=left > _FEW_ROWS):
            left -= block.num_rows
            yield _columns(pa.Table.from_batches([block]))
        if left:
            raise ValueError("it does not hold as many rows as it states")


def count_rows(path: Path) -> int:
    """Rows of a table, of which none is read. SourceError as :func:`read_columns`."""
    with _opened(path) as file:
        return int(file.metadata.num_rows)


@contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    """The file, its sizes checked; what goes wrong with it, in one line."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Buffered ahead, what is read block by block would be in memory as a whole all the same.
        with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            shape = file.metadata
            if shape.num_columns > MAX_COLUMNS:
                raise SourceError(f"has {shape.num_columns} columns: too many for a run", where=path)
            cells, stated = shape.num_rows * shape.num_columns, range(shape.num_row_groups)
            if max(8 * cells, sum(shape.row_group(i).total_byte_size for i in stated)) > MAX_BYTES:
                cure = f"it has {shape.num_rows} rows: run the sequence in parts"
                raise SourceError("unpacks to more than 8 GB", where=path, cure=cure)
            names = file.schema_arrow.names
            if len(set(names)) < len(names):
                raise ValueError("two columns have the same name")
            # What a page's run lengths stand for is in no size that the file states.
            packed = path.stat().st_size
            if 8 * cells > _PLAIN_BYTES + _MAX_RATIO * packed:
                raise SourceError(f"unpacks {packed} bytes to {cells} numbers: too large for a run", where=path)
            yield file
    except FileNotFoundError:
        raise SourceError("is missing", where=path) from None
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SourceError(f"is damaged: {reason}", where=path, cure="run the sequence again") from None
    finally:
        pa.default_memory_pool().release_unused()  # kept, it would be twice what a run takes


def _columns(table: pa.Table) -> dict[str, NDArray[Any]]:
    return {name: _to_numpy(name, column) for name, column in zip(table.column_names, table.itercolumns())}


def placed_columns(path: Path) -> RowGroup:
    """Where the columns of a written table lie. Raises SourceError as :func:`read_columns`."""
    with _opened(path) as file:
        group = file.metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    place = [(c.data_page_offset, c.total_compressed_size, c.total_uncompressed_size) for c in columns]
    names = tuple(c.path_in_schema for c in columns)
    return RowGroup(path, group.num_rows, names, np.array(place, dtype=np.int64).reshape(-1, 3))


def _to_numpy(name: str, column: pa.ChunkedArray) -> NDArray[Any]:
    import pyarrow as pa

    wanted, kind = KIND_OF.get(name, "float64"), column.type
    is_number = pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)
    if wanted != "string" and not is_number and not (wanted == "bool" and pa.types.is_boolean(kind)):
        raise ValueError(f"the column '{name}' holds {kind}, not {wanted}")
    if not is_number and (pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_dictionary(kind)):
        return np.array(column.to_pylist(), dtype=object)
    values = numbers_of(column)
    large = np.abs(values) > _LARGEST if values.dtype.kind == "f" else None
    if large is not None and large.any() and np.isfinite(values[large]).any():
        raise ValueError(f"the column '{name}' holds a number beyond {_LARGEST:g}")
    return values


def numbers_of(column: pa.ChunkedArray) -> NDArray[Any]:
    """A column of numbers or booleans as ``column.to_numpy()`` gives it, NaN for null, or None if they are not numbers;
    but that loads pandas where it is installed, which takes half a second."""
    array = column.combine_chunks()
    kind, end = np.dtype(array.type.to_pandas_dtype()), array.offset + len(array)
    if kind.hasobject or not end:
        return np.array(array.to_pylist(), kind)

    def bits(buffer: pa.Buffer) -> NDArray[np.bool_]:
        return np.unpackbits(np.frombuffer(buffer, np.uint8), count=end, bitorder="little").view(bool)

    is_bool, (known, data) = kind.kind == "b", array.buffers()
    values: NDArray[Any] = bits(data) if is_bool else np.frombuffer(data, kind, end)
    if array.null_count:
        values = values.astype(kind if kind.kind == "f" else object if is_bool else np.float64)
        values[~bits(known)] = None if is_bool else np.nan
    return values[array.offset :]
