"""Many of a kind, kept as columns instead of as objects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from gpvo.types.sensors import field_names

_AT_ONCE = 1000
_Item = TypeVar("_Item")
_Rows = TypeVar("_Rows", bound="Columns[Any]")


class Columns(Sequence[_Item], ABC):
    """Rows that are kept as ``columns`` by the names of their fields, (N, ...): a fraction of what objects take.
    Each is made when it is asked for."""

    columns: Mapping[str, NDArray[Any]]

    @classmethod
    def join(cls: type[_Rows], parts: Iterable[_Rows], count: int | None = None) -> _Rows:
        """One after the other; of mappings by method or stage, with those of all, NaN where a part has none. Where
        their ``count`` of rows is known, one part is in memory at a time."""
        if count is None:
            count = sum(map(len, parts := list(parts)))
        joined, end = {name: dict[str, NDArray[Any]]() for name in field_names(cls)}, 0
        for part in parts:
            start, end = end, end + len(part)
            for field_name, columns in joined.items():
                for name, column in getattr(part, field_name).items():
                    if name not in columns:
                        shape, fill = (count, *column.shape[1:]), np.nan if column.dtype.kind == "f" else 0
                        columns[name] = np.full(shape, fill, column.dtype)
                    columns[name][start:end] = column
        return cls(**joined)

    @abstractmethod
    def made(self, k: int) -> _Item:
        """Row k."""

    def __len__(self) -> int:
        return len(self.columns["t_ns"])

    @overload
    def __getitem__(self, k: int) -> _Item: ...

    @overload
    def __getitem__(self, k: slice) -> list[_Item]: ...

    def __getitem__(self, k: int | slice) -> _Item | list[_Item]:
        return [self.made(i) for i in range(*k.indices(len(self)))] if isinstance(k, slice) else self.made(k)


def batches(items: Iterable[_Item]) -> Iterator[list[_Item]]:
    """Items as they come, a thousand at a time; one empty list where there are none."""
    coming = iter(items)
    yield list(islice(coming, _AT_ONCE))
    while some := list(islice(coming, _AT_ONCE)):
        yield some
