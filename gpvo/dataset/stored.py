"""A training-set file larger than memory: its sequences piece by piece, or in blocks that fit."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gpvo.dataset.build import TrainingSet
from gpvo.dataset.table import SCHEMA, set_of_table
from gpvo.errors import SourceError
from gpvo.types import Array

CHUNK_ROWS = 8192
BLOCK_ROWS = 1024
"""Rows that are kept or left out together: long enough to show how errors add up over hundreds of frames."""

_BUFFER_BYTES = 1 << 20


class StoredSets:
    """The sequences of a file that :func:`gpvo.dataset.table.write_sets` wrote; never more than a chunk in memory.

    ``names``, ``lengths``: of the sequences. Raises SourceError where it is not such a file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            with self._open() as file:
                meta = json.loads((file.schema_arrow.metadata or {})[b"gpvo"])
                self._about: list[dict[str, Any]] = meta["sequences"]
                groups = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
                if meta["schema"] > SCHEMA or len(self._about) != len(groups):
                    raise SourceError("was written by a newer gpvo", where=path, cure="update gpvo")
        except (OSError, KeyError, ValueError, pa.ArrowException) as problem:
            if isinstance(problem, SourceError):
                raise
            raise SourceError(f"is not a training set: {problem}", where=path) from None
        self.names = [str(entry["name"]) for entry in self._about]
        self.lengths = groups

    def __len__(self) -> int:
        return sum(self.lengths)

    def _open(self) -> pq.ParquetFile:
        return pq.ParquetFile(self.path, buffer_size=_BUFFER_BYTES, pre_buffer=False)

    def chunks(self, i: int, chunk_rows: int = CHUNK_ROWS) -> Iterator[TrainingSet]:
        """Sequence i in order, piece by piece."""
        with self._open() as file:
            for batch in file.iter_batches(batch_size=chunk_rows, row_groups=[i], use_threads=False):
                yield set_of_table(self._about[i], pa.Table.from_batches([batch]))

    def thinned(self, max_rows: int, chunk_rows: int = CHUNK_ROWS) -> list[TrainingSet]:
        """At most ``max_rows`` rows (or one of each sequence), in blocks, evenly over each sequence, sequences alike.

        What is kept does not depend on ``chunk_rows``.
        """
        return [
            _join([c.rows(kept[start : start + len(c)]) for start, c in _numbered(self.chunks(i, chunk_rows))])
            for i, kept in enumerate(kept_rows(self.lengths, max_rows))
        ]


def kept_rows(lengths: Sequence[int], max_rows: int) -> list[Any]:
    """Per sequence (n_i,) bool: which rows are kept, short sequences whole and long ones to equal numbers of rows."""
    quota, left, room = {}, list(np.argsort(lengths, kind="stable")), max_rows
    while left:
        share = room // len(left)
        i = int(left.pop(0))
        quota[i] = min(lengths[i], max(share, 1))
        room = max(room - quota[i], 0)
    out = []
    for i, n in enumerate(lengths):
        keep = np.zeros(n, dtype=bool)
        blocks = -(-quota[i] // BLOCK_ROWS)
        size = -(-quota[i] // blocks) if blocks else 0
        for start in np.linspace(0, n - size, blocks).round().astype(int).tolist():
            keep[start : start + size] = True
        out.append(keep)
    return out


def _numbered(chunks: Iterator[TrainingSet]) -> Iterator[tuple[int, TrainingSet]]:
    start = 0
    for chunk in chunks:
        yield start, chunk
        start += len(chunk)


def _join(parts: Sequence[TrainingSet]) -> TrainingSet:
    """Pieces of one sequence below one another."""
    from dataclasses import replace

    def stack(values: list[Array]) -> Array:
        return np.concatenate(values)

    first = parts[0]
    return replace(
        first,
        X=stack([p.X for p in parts]),
        Y=stack([p.Y for p in parts]),
        t_ns=np.concatenate([p.t_ns for p in parts]),
        dt_s=stack([p.dt_s for p in parts]),
        covariances={m: stack([p.covariances[m] for p in parts]) for m in first.covariances},
        v_t={m: stack([p.v_t[m] for p in parts]) for m in first.v_t},
    )
