"""Training sets as one Parquet file: a row per motion, written and read sequence by sequence."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gpvo.dataset.build import TrainingSet
from gpvo.errors import SourceError
from gpvo.io.atomic import replacing
from gpvo.types import StereoCamera

SCHEMA = 1


def write_sets(path: str | Path, sets: Iterable[TrainingSet]) -> None:
    """One file of all sequences, in place of what was there; a row group per sequence, one at a time in memory."""
    path = Path(path)
    about, schemas = [], []
    with replacing(path) as whole, tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        for i, s in enumerate(sets):
            table = _table(i, s)
            pq.write_table(table, Path(folder) / str(i), row_group_size=max(len(s), 1))
            schemas.append(table.schema)
            about.append(
                {
                    "name": s.name,
                    "target": s.target,
                    "counts": dict(s.counts),
                    "camera": None if s.camera is None else asdict(s.camera),
                    "columns": list(s.columns),
                    "lost_xi": s.lost_xi.tolist(),
                    "lost_jump": s.lost_jump.tolist(),
                }
            )
        metadata = {"gpvo": json.dumps({"schema": SCHEMA, "sequences": about}, sort_keys=True)}
        schema = pa.unify_schemas(schemas).with_metadata(metadata)
        with pq.ParquetWriter(whole, schema, compression="zstd") as writer:
            for i in range(len(about)):
                table = pq.read_table(Path(folder) / str(i))
                n = table.num_rows
                columns = [table[f.name] if f.name in table.column_names else pa.nulls(n, f.type) for f in schema]
                writer.write_table(pa.Table.from_arrays(columns, schema=schema), row_group_size=max(n, 1))


def read_sets(path: str | Path) -> list[TrainingSet]:
    """All sequences of a file. Raises SourceError where it is not such a file."""
    return list(stream_sets(path))


def stream_sets(path: str | Path) -> Iterator[TrainingSet]:
    """The sequences one by one, so that only one is in memory. Raises SourceError where it is not such a file."""
    try:
        file = pq.ParquetFile(path)
        meta = json.loads((file.schema_arrow.metadata or {})[b"gpvo"])
        about = meta["sequences"]
        if meta["schema"] > SCHEMA or len(about) != file.num_row_groups:
            raise SourceError("was written by a newer gpvo", where=path, cure="update gpvo")
    except (OSError, KeyError, ValueError, pa.ArrowException) as problem:
        if isinstance(problem, SourceError):
            raise
        raise SourceError(f"is not a training set: {problem}", where=path) from None
    for i, entry in enumerate(about):
        yield set_of_table(entry, file.read_row_group(i))


def _table(i: int, s: TrainingSet) -> pa.Table:
    columns: dict[str, Any] = {"sequence": np.full(len(s), i, dtype=np.int64), "t_ns": s.t_ns, "dt_s": s.dt_s}
    columns |= {f"x.{name}": s.X[:, k] for k, name in enumerate(s.columns)}
    columns |= {f"y.{k}": s.Y[:, k] for k in range(s.Y.shape[1])}
    for kind, matrices in (("cov", s.covariances), ("vt", s.v_t)):
        for method, C in matrices.items():
            d = C.shape[-1]
            columns |= {f"{kind}.{method}.{a}.{b}": C[:, a, b] for a in range(d) for b in range(a, d)}
    return pa.table({k: pa.array(v) for k, v in columns.items()})


def set_of_table(entry: dict[str, Any], table: pa.Table) -> TrainingSet:
    """Rows of one sequence; ``entry``: what the file's metadata says of it."""

    def column(name: str) -> Any:
        return table[name].to_numpy(zero_copy_only=False)

    outputs = sum(name.startswith("y.") for name in table.column_names)
    return TrainingSet(
        name=entry["name"],
        columns=tuple(entry["columns"]),
        X=np.stack([column(f"x.{c}").astype(np.float64) for c in entry["columns"]], axis=1),
        Y=np.stack([column(f"y.{k}") for k in range(outputs)], axis=1),
        t_ns=column("t_ns"),
        dt_s=column("dt_s"),
        covariances=_matrices(table, "cov", 6),
        v_t=_matrices(table, "vt", 3),
        counts=entry["counts"],
        camera=None if entry["camera"] is None else StereoCamera(**entry["camera"]),
        target=entry["target"],
        lost_xi=np.array(entry.get("lost_xi", []), dtype=np.float64).reshape(-1, 6),
        lost_jump=np.array(entry.get("lost_jump", []), dtype=np.float64).reshape(-1, 6),
    )


def _matrices(table: pa.Table, kind: str, d: int) -> dict[str, Any]:
    methods = dict.fromkeys(n.split(".")[1] for n in table.column_names if n.startswith(f"{kind}."))
    out = {}
    for method in methods:
        if table[f"{kind}.{method}.0.0"].null_count == table.num_rows:
            continue
        C = np.empty((table.num_rows, d, d))
        for a in range(d):
            for b in range(a, d):
                C[:, a, b] = C[:, b, a] = table[f"{kind}.{method}.{a}.{b}"].to_numpy(zero_copy_only=False)
        out[method] = C
    return out
