"""Training sets as one Parquet file: a row per motion, written and read sequence by sequence; of a file larger than
memory piece by piece, or in blocks that fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.errors import CalibrationError, SourceError
from gpvo.files import make_folder, parse_json, replacing
from gpvo.geometry.covariance import LARGEST, are_semidefinite, from_upper, upper
from gpvo.io.parquet import numbers_of
from gpvo.types import Array, StereoCamera

SCHEMA = 1
_OF_TRUTH = "truth"
_STATED = ("name", "target", "counts", "camera", "odometry", "columns", "lost_xi", "lost_jump")  # beside the rows


def write_sets(path: str | Path, sets: Iterable[TrainingSet]) -> None:
    """One file of all sequences, in place of what was there; a row group per sequence, one at a time in memory."""
    about, schemas = [], []
    with replacing(Path(path)) as whole, _pieces(whole) as folder:
        for i, s in enumerate(sets):
            table = _table(i, s)
            pq.write_table(table, folder / str(i), row_group_size=max(len(s), 1))
            schemas.append(table.schema)
            about.append({name: getattr(s, name) for name in _STATED})
        document = {"schema": SCHEMA, "sequences": about}
        metadata = {
            "gpvo": json.dumps(document, sort_keys=True, default=lambda v: getattr(v, "tolist", lambda: vars(v))())
        }
        schema = pa.unify_schemas(schemas).with_metadata(metadata)
        with pq.ParquetWriter(whole, schema, compression="zstd") as writer:
            for i in range(len(about)):
                table = pq.ParquetFile(folder / str(i)).read()  # read_table would load pandas
                n = table.num_rows
                columns = [table[f.name] if f.name in table.column_names else pa.nulls(n, f.type) for f in schema]
                writer.write_table(pa.Table.from_arrays(columns, schema=schema), row_group_size=max(n, 1))


@contextmanager
def _pieces(whole: Path) -> Iterator[Path]:
    """An empty folder beside a file that is being written, in place of one that a killed process left."""
    folder = whole.with_name(f"{whole.name}s")
    try:
        if folder.is_symlink():
            folder.unlink()
        shutil.rmtree(folder, ignore_errors=True)
        yield make_folder(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def read_sets(path: str | Path) -> list[TrainingSet]:
    """All sequences of a file. Raises SourceError where it is not such a file."""
    stored = StoredSets(path)
    return [stored.whole(i) for i in range(len(stored.lengths))]


def _table(i: int, s: TrainingSet) -> pa.Table:
    columns: dict[str, Any] = {"sequence": np.full(len(s), i, dtype=np.int64), "t_ns": s.t_ns, "dt_s": s.dt_s}
    columns |= {f"x.{name}": s.X[:, k] for k, name in enumerate(s.columns)}
    columns |= {f"y.{k}": s.Y[:, k] for k in range(s.Y.shape[1])}
    if s.told is not None:
        columns |= {f"told.{k}": s.told[:, k] for k in range(s.told.shape[1])}
    noise = {} if s.truth_noise is None else {_OF_TRUTH: s.truth_noise}
    for kind, matrices in (("cov", s.covariances), ("vt", s.v_t), ("noise", noise)):
        for method, C in matrices.items():
            columns |= zip(_elements(kind, method, C.shape[-1]), upper(C).T, strict=True)
    return pa.table({k: _array(np.ascontiguousarray(v)) for k, v in columns.items()})


def _array(values: NDArray[Any]) -> pa.Array:
    """``pa.array(values)``, which would load pandas, for numbers."""
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values)])


def _elements(kind: str, method: str, d: int) -> list[str]:
    """Columns of the elements of symmetric matrices (d, d), in the order of :func:`gpvo.geometry.covariance.upper`."""
    return [f"{kind}.{method}.{a}.{b}" for a, b in zip(*np.triu_indices(d), strict=True)]


@contextmanager
def _guarded(path: Path) -> Iterator[None]:
    try:
        yield
    # pyarrow raises NotImplementedError for types that NumPy lacks.
    except (ArithmeticError, AttributeError, CalibrationError, LookupError, NotImplementedError, OSError,
            RecursionError, TypeError, ValueError, pa.ArrowException) as problem:  # fmt: skip
        cure = "give run folders, or the .rows.parquet beside a model"
        raise SourceError(f"is not a training set: {problem}", where=path, cure=cure) from None


def _require_sound(s: TrainingSet) -> None:
    """Raise ValueError for what no run gives: names that are none, numbers that nothing can be learned from."""
    if not all(isinstance(text, str) for text in (s.name, s.target, *s.columns)):
        raise ValueError("a name in it is no text")
    taken = s.counts.keys() & {"name", "rows"}
    if taken or not all(isinstance(n, int) for n in (s.counts["lost"], *s.counts.values())):
        raise ValueError(f"the counts of '{s.name}' are none")
    if s.t_ns.dtype != np.int64 or (s.t_ns[1:] < s.t_ns[:-1]).any() or not (s.dt_s > 0).all():
        raise ValueError(f"the stamps of '{s.name}' do not increase")
    told = [] if s.told is None else [s.told]
    if (s.told is None) != (s.truth_noise is None):
        raise ValueError(f"'{s.name}' holds half of what a noisy truth tells")
    if s.truth_noise is not None and not are_semidefinite(s.truth_noise).all():
        raise ValueError(f"the noise of the truth of '{s.name}' is none")
    errors = (s.Y, s.lost_xi, s.lost_jump, s.dt_s, *told)
    if s.Y.shape[1] not in (3, 6) or not all((np.abs(e) < LARGEST).all() for e in errors) or np.isinf(s.X).any():
        raise ValueError(f"'{s.name}' holds numbers that are no errors or features")


def _set_of_table(entry: dict[str, Any], table: pa.Table) -> TrainingSet:
    """Rows of one sequence; ``entry``: what the file's metadata says of it."""

    def column(name: str) -> Any:
        return numbers_of(table[name])

    def matrices(kind: str, d: int) -> dict[str, Array]:
        methods = dict.fromkeys(n.split(".")[1] for n in table.column_names if n.startswith(f"{kind}."))
        elements = {method: _elements(kind, method, d) for method in methods}
        return {
            method: from_upper(np.column_stack([column(name) for name in names]), d)
            for method, names in elements.items()
            if table[names[0]].null_count < table.num_rows
        }

    def errors(kind: str) -> Array | None:
        names = [n for n in (f"{kind}.{k}" for k in range(6)) if n in table.column_names]
        known = names and table[names[0]].null_count < table.num_rows
        return np.stack([column(n) for n in names], axis=1) if known else None

    Y = errors("y")
    if Y is None:
        raise ValueError(f"'{entry['name']}' holds no errors")
    made = TrainingSet(
        name=entry["name"],
        columns=tuple(entry["columns"]),
        X=np.stack([column(f"x.{c}").astype(np.float64) for c in entry["columns"]], axis=1),
        Y=Y,
        t_ns=column("t_ns"),
        dt_s=column("dt_s"),
        covariances=matrices("cov", 6),
        v_t=matrices("vt", 3),
        counts=entry["counts"],
        camera=None if entry["camera"] is None else StereoCamera(**entry["camera"]),
        target=entry["target"],
        lost_xi=np.array(entry.get("lost_xi", []), dtype=np.float64).reshape(-1, 6),
        odometry=dict(entry.get("odometry", {})),
        lost_jump=np.array(entry.get("lost_jump", []), dtype=np.float64).reshape(-1, 6),
        told=errors("told"),
        truth_noise=matrices("noise", 6).get(_OF_TRUTH),
    )
    _require_sound(made)
    return made


CHUNK_ROWS = 8192
BLOCK_ROWS = 1024
"""Rows that are kept or left out together: long enough to show how errors add up over hundreds of frames."""

_BUFFER_BYTES = 1 << 20


class StoredSets:
    """The sequences of a file that :func:`gpvo.dataset.table.write_sets` wrote; never more than a chunk in memory.

    ``lengths``: of the sequences. Raises SourceError where it is not such a file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with _guarded(self.path), self._open() as file:
            meta = parse_json((file.schema_arrow.metadata or {})[b"gpvo"].decode())
            self._about: list[dict[str, Any]] = meta["sequences"]
            self.lengths = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
            if meta["schema"] > SCHEMA:
                raise SourceError("was written by a newer gpvo", where=path, cure="update gpvo")
            if len(self._about) != len(self.lengths) or 0 in self.lengths:
                raise ValueError(f"{len(self._about)} sequences in groups of {self.lengths} rows")

    def __len__(self) -> int:
        return sum(self.lengths)

    def _open(self) -> pq.ParquetFile:
        return pq.ParquetFile(self.path, buffer_size=_BUFFER_BYTES, pre_buffer=False)

    def whole(self, i: int) -> TrainingSet:
        """Sequence i."""
        with _guarded(self.path), self._open() as file:
            return _set_of_table(self._about[i], file.read_row_group(i))

    def chunks(self, i: int, chunk_rows: int = CHUNK_ROWS) -> Iterator[TrainingSet]:
        """Sequence i in order, piece by piece."""
        with _guarded(self.path), self._open() as file:
            for batch in file.iter_batches(batch_size=chunk_rows, row_groups=[i], use_threads=False):
                yield _set_of_table(self._about[i], pa.Table.from_batches([batch]))

    def thinned(self, max_rows: int, chunk_rows: int = CHUNK_ROWS) -> list[TrainingSet]:
        """At most ``max_rows`` rows (or one of each sequence), in blocks, evenly over each sequence, sequences alike.

        What is kept does not depend on ``chunk_rows``.
        """
        out = []
        for i, kept in enumerate(kept_rows(self.lengths, max_rows)):
            parts, start = [], 0
            for chunk in self.chunks(i, chunk_rows):
                parts.append(chunk.rows(kept[start : start + len(chunk)]))
                start += len(chunk)
            out.append(TrainingSet.over(parts, np.concatenate))
        return out


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
