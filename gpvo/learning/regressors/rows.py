"""Training rows that may not fit into memory: read again and again, chunk by chunk, in the same order."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from gpvo.errors import GpvoError
from gpvo.types import Array

RawChunk = tuple[Array, Array, Array, Array]
"""Inputs (b, d), outputs (b, D), noise weights (b,), sample weights (b,), in the units of the data."""


class Rows(Protocol):
    """Rows that can be iterated more than once."""

    def __len__(self) -> int:
        """Number of rows."""
        ...

    def __iter__(self) -> Iterator[RawChunk]:
        """All rows, in order, in chunks."""
        ...


@dataclass(frozen=True)
class ArrayRows:
    """Rows held in memory."""

    X: Array
    Y: Array
    noise_weight: Array
    sample_weight: Array
    chunk_rows: int = 8192

    def __len__(self) -> int:
        return len(self.X)

    def __iter__(self) -> Iterator[RawChunk]:
        for i in range(0, len(self.X), self.chunk_rows):
            rows = slice(i, i + self.chunk_rows)
            yield self.X[rows], self.Y[rows], self.noise_weight[rows], self.sample_weight[rows]


@dataclass(frozen=True)
class ParquetRows:
    """Rows of a Parquet file; rows with a value that is not finite are skipped.

    ``inputs``, ``outputs``: column names. ``noise_weight``, ``sample_weight``: columns of weights, or None for ones.
    """

    path: str | os.PathLike[str]
    inputs: Sequence[str]
    outputs: Sequence[str]
    noise_weight: str | None = None
    sample_weight: str | None = None
    chunk_rows: int = 8192

    def __post_init__(self) -> None:
        import pyarrow.parquet as pq

        if not Path(self.path).is_file():
            raise GpvoError("there is no such file", where=self.path)
        missing = set(self._columns()) - set(pq.read_schema(self.path).names)
        if missing:
            raise GpvoError(f"lacks the columns {', '.join(sorted(missing))}", where=self.path)

    def _columns(self) -> list[str]:
        weights = [w for w in (self.noise_weight, self.sample_weight) if w is not None]
        return [*self.inputs, *self.outputs, *weights]

    def __len__(self) -> int:
        import pyarrow.parquet as pq

        return int(pq.read_metadata(self.path).num_rows)

    def __iter__(self) -> Iterator[RawChunk]:
        import pyarrow.parquet as pq

        d, D = len(self.inputs), len(self.outputs)
        with pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches(batch_size=self.chunk_rows, columns=self._columns(), use_threads=False):
                named = {
                    name: batch.column(name).to_numpy(zero_copy_only=False).astype(np.float64)
                    for name in self._columns()
                }
                values = np.stack([named[name] for name in self._columns()], axis=1)
                values = values[np.isfinite(values).all(axis=1)]
                ones = np.ones(len(values))
                noise = values[:, d + D] if self.noise_weight else ones
                sample = values[:, -1] if self.sample_weight else ones
                if len(values):
                    yield values[:, :d], values[:, d : d + D], noise, sample


def draw(rows: Rows, n: int, seed: int) -> RawChunk:
    """n random rows in their order (all of them if there are no more), in one pass."""
    total = len(rows)
    keep = np.ones(total, dtype=bool)
    if total > n:
        keep[:] = False
        keep[np.random.default_rng(seed).permutation(total)[:n]] = True
    parts: list[list[Array]] = [[], [], [], []]
    start = 0
    for chunk in rows:
        mine = keep[start : start + len(chunk[0])]
        start += len(chunk[0])
        for part, values in zip(parts, chunk, strict=True):
            part.append(values[mine])
    X, Y, noise, sample = (np.concatenate(part) for part in parts)
    return X, Y, noise, sample
