"""Small Parquet tables: written under a temporary name with page checksums, read back with sizes checked first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.atomic import replacing

MAX_ROWS = 50_000_000
MAX_COLUMNS = 4096
MAX_BYTES = 8_000_000_000
_PLAIN_BYTES, _MAX_RATIO = 200_000_000, 200
_LARGEST = 1e100  # No number of a run is larger: products of two or three stay finite.
_INTEGERS = {"t_ns", "t_prev_ns", "n_detected", "n_stereo", "n_tracked", "n_inliers"}
_TYPES = {
    "status": pa.string(),
    "reason": pa.string(),
    "is_reference": pa.bool_(),
    "track": pa.int32(),
    "u_px": pa.float32(),
    "v_px": pa.float32(),
    "d_px": pa.float32(),
    "is_inlier": pa.bool_(),
}


def make_table(columns: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> pa.Table:
    """Columns as a table: integers, strings and booleans where their name says so, else float64."""
    fields, arrays = [], []
    for name, values in columns.items():
        kind = pa.int64() if name in _INTEGERS else _TYPES.get(name, pa.float64())
        arrays.append(pa.array(values, type=kind))
        fields.append(pa.field(name, kind))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=dict(metadata or {})))


def write_table(path: Path, table: pa.Table) -> None:
    """Write one table in place of what was there, or not at all."""
    with replacing(path) as temporary:
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)


def concatenate(parts: Sequence[Path], target: Path, metadata: Mapping[str, str] | None = None) -> None:
    """Join tables of a growing set of columns into one file, a part at a time in memory."""
    schema = pa.unify_schemas([pq.read_schema(p).remove_metadata() for p in parts])
    schema = schema.with_metadata(dict(metadata or {}))
    with (
        replacing(target) as temporary,
        pq.ParquetWriter(temporary, schema, compression="zstd", write_page_checksum=True) as writer,
    ):
        for part in parts:
            table = pq.read_table(part)
            n = table.num_rows
            columns = [table[f.name] if f.name in table.column_names else pa.nulls(n, f.type) for f in schema]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def read_columns(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Columns as arrays (nulls of numbers as NaN) and the file's metadata.

    Raises
    ------
    SourceError
        Where the file is missing, damaged or implausibly large.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            shape = file.metadata
            if shape.num_rows > MAX_ROWS or shape.num_columns > MAX_COLUMNS:
                raise SourceError(f"has {shape.num_rows} rows and {shape.num_columns} columns: no run's", where=path)
            if sum(shape.row_group(i).total_byte_size for i in range(shape.num_row_groups)) > MAX_BYTES:
                raise SourceError("unpacks to more than 8 GB", where=path)
            # What a page's run lengths stand for is in no size that the file states.
            cells, packed = shape.num_rows * shape.num_columns, path.stat().st_size
            if 8 * cells > _PLAIN_BYTES + _MAX_RATIO * packed:
                raise SourceError(f"unpacks {packed} bytes to {cells} numbers: no run's", where=path)
            table = file.read()
            metadata = {k.decode(): v.decode(errors="replace") for k, v in (table.schema.metadata or {}).items()}
            return {name: _to_numpy(name, table[name]) for name in table.column_names}, metadata
    except FileNotFoundError:
        raise SourceError("is missing", where=path) from None
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SourceError(f"is damaged: {reason}", where=path, cure="run the sequence again") from None


def _to_numpy(name: str, column: pa.ChunkedArray) -> NDArray[Any]:
    wanted = _TYPES.get(name, pa.float64())
    is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_null(column.type)
    if not pa.types.is_string(wanted) and not is_number and not (pa.types.is_boolean(wanted) and column.type == wanted):
        raise ValueError(f"the column '{name}' holds {column.type}, not {wanted}")
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type) or pa.types.is_dictionary(column.type):
        return np.array(column.to_pylist(), dtype=object)
    values = np.asarray(column.to_numpy())
    if values.dtype.kind == "f" and (np.isfinite(values) & (np.abs(values) > _LARGEST)).any():
        raise ValueError(f"the column '{name}' holds a number beyond {_LARGEST:g}")
    return values
