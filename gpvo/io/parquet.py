"""Small Parquet tables, read with their sizes and checksums checked first."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.parquet_write import KIND_OF, RowGroup

if TYPE_CHECKING:
    import pyarrow as pa

MAX_ROWS = 50_000_000
MAX_COLUMNS = 4096
MAX_BYTES = 8_000_000_000
_PLAIN_BYTES, _MAX_RATIO = 200_000_000, 200
_LARGEST = np.float64(1e100)  # No number of a run is larger: products of two or three stay finite.


def read_columns(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Columns as arrays (nulls of numbers as NaN) and the file's metadata.

    Raises
    ------
    SourceError
        Where the file is missing, damaged or implausibly large.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

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


def placed_columns(path: Path) -> RowGroup:
    """Where the columns of a written table lie. SourceError where it cannot be read."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        group = pq.read_metadata(path).row_group(0)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise SourceError(f"is damaged: {str(error).splitlines()[0]}", where=path) from None
    columns = [group.column(i) for i in range(group.num_columns)]
    place = [(c.data_page_offset, c.total_compressed_size, c.total_uncompressed_size) for c in columns]
    names = tuple(c.path_in_schema for c in columns)
    return RowGroup(path, group.num_rows, names, np.array(place, dtype=np.int64).reshape(-1, 3))


def _to_numpy(name: str, column: pa.ChunkedArray) -> NDArray[Any]:
    import pyarrow as pa

    wanted = KIND_OF.get(name, "float64")
    is_number = pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_null(column.type)
    if wanted != "string" and not is_number and not (wanted == "bool" and pa.types.is_boolean(column.type)):
        raise ValueError(f"the column '{name}' holds {column.type}, not {wanted}")
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type) or pa.types.is_dictionary(column.type):
        return np.array(column.to_pylist(), dtype=object)
    values = np.asarray(column.to_numpy())
    if values.dtype.kind == "f" and (np.isfinite(values) & (np.abs(values) > _LARGEST)).any():
        raise ValueError(f"the column '{name}' holds a number beyond {_LARGEST:g}")
    return values
