"""Training sets larger than memory: what is kept, and that the size of the pieces does not matter."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gpvo.dataset.table import BLOCK_ROWS, StoredSets, kept_rows, read_sets, write_sets
from gpvo.errors import GpvoError, SourceError
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model, train_stored
from gpvo.learning.train import train_sets
from gpvo.types import StereoCamera, field_names
from small_model import training_sets

QUICK = TrainConfig(features="velocity,n_inliers")


@pytest.fixture(scope="module")
def stored_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("rows") / "rows.parquet"
    write_sets(path, training_sets(range(4), n=1500))
    return path


def test_what_is_kept():
    assert [k.sum() for k in kept_rows([100, 5000, 3000], 20_000)] == [100, 5000, 3000]
    kept = kept_rows([100, 50_000, 9000], 10_000)
    assert kept[0].all()
    assert abs(int(kept[1].sum()) - int(kept[2].sum())) <= 2 * BLOCK_ROWS
    assert sum(int(k.sum()) for k in kept) <= 10_000 + 2 * BLOCK_ROWS
    # Many short runs stay within the limit too.
    assert sum(int(k.sum()) for k in kept_rows([1000] * 1000, 100_000)) <= 100_000
    # In blocks, over the whole length.
    begins = np.flatnonzero(np.diff(np.concatenate([[0], kept[1].astype(int)])) == 1)
    assert len(begins) <= -(-int(kept[1].sum()) // BLOCK_ROWS)
    assert kept[1][0]
    assert kept[1][-1]


def test_pieces_of_any_size_are_the_same_rows(stored_file):
    stored, whole = StoredSets(stored_file), read_sets(stored_file)
    assert len(stored) == sum(map(len, whole))
    pieces = list(stored.chunks(2, 97))
    assert max(map(len, pieces)) <= 97
    np.testing.assert_array_equal(np.concatenate([p.X for p in pieces]), whole[2].X)
    for a, b in zip(stored.thinned(4400, 61), stored.thinned(4400, 8192), strict=True):
        assert len(a) <= 1100
        assert a.digest() == b.digest()


def test_what_fits_into_memory_is_trained_as_ever(tmp_path):
    write_sets(tmp_path / "few.parquet", training_sets(range(3), n=100))
    few = replace(QUICK, features="velocity")
    here = train_sets(read_sets(tmp_path / "few.parquet"), few, judge=False)
    there = train_stored(tmp_path / "few.parquet", few, judge=False, chunk_rows=17)
    assert here.arrays.keys() == there.arrays.keys()
    for name, values in here.arrays.items():
        np.testing.assert_array_equal(values, there.arrays[name], err_msg=name)


@pytest.mark.slow
def test_same_bytes_again(stored_file, tmp_path):
    config = replace(QUICK, max_rows=2048)
    for name in ("a", "b"):
        trained = train_stored(stored_file, config, judge=False, chunk_rows=500)
        rows = trained.header["rows"]
        assert rows == {"given": len(StoredSets(stored_file)), "in_memory": 2048}
        save_model(trained, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_what_a_killed_process_left_is_taken_over(stored_file, tmp_path):
    path, left = tmp_path / "rows.parquet", tmp_path / ".rows.parquet.parts"
    left.mkdir()
    for file in (left / "0", left / "7", tmp_path / ".rows.parquet.part"):
        file.write_bytes(b"half of it")
    write_sets(path, read_sets(stored_file))
    assert path.read_bytes() == stored_file.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_is_no_training_set(tmp_path):
    (tmp_path / "x.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(SourceError, match=r"not a training set: .* \(give run folders"):
        StoredSets(tmp_path / "x.parquet")
    with pytest.raises(GpvoError):
        train_stored(tmp_path / "none.parquet", QUICK)


def _column(name, value):
    def change(meta, table):
        at = table.column_names.index(name)
        return meta, table.set_column(at, name, pa.array([value] * table.num_rows))

    return change


def _about(**changed):
    def change(meta, table):
        first = {k: v for k, v in (meta["sequences"][0] | changed).items() if v is not None}
        return {**meta, "sequences": [first, *meta["sequences"][1:]]}, table

    return change


DAMAGED = {
    "a list": lambda meta, table: ([meta], table),
    "no sequence": lambda meta, table: ({**meta, "sequences": 3}, table),
    "a feature without its column": _about(columns=["v_x_mps", "x"]),
    "a feature that is a list": _about(columns=[["v_x_mps"]]),
    "no name": _about(name=None),
    "a name that is a number": _about(name=7),
    "counts of text": _about(counts={"lost": "3"}),
    "no counts": _about(counts={}),
    "half a camera": _about(camera={"fx_px": 300.0}),
    "an impossible camera": _about(camera=dict.fromkeys(field_names(StereoCamera), 1e100)),
    "errors of five axes": _about(lost_xi=[1.0] * 5),
    "an infinite error": _column("y.0", np.inf),
    "an error beyond all squares": _column("y.1", 1e200),
    "an unknown error": _column("y.2", np.nan),
    "an infinite feature": _column("x.v_x_mps", -np.inf),
    "a motion of no time": _column("dt_s", 0.0),
    "one column less": lambda meta, table: (meta, table.drop_columns(["y.5"])),
    "stamps that are text": _column("t_ns", "x"),
    "stamps that are structures": _column("t_ns", {"a": 1.0}),
    "no rows": lambda meta, table: (meta, table.slice(0, 0)),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_file_of_rows_that_cannot_be_is_refused_in_one_line(case, tmp_path):
    path = tmp_path / "rows.parquet"
    write_sets(path, training_sets(range(1), n=40))
    table = pq.ParquetFile(path).read()
    meta, table = DAMAGED[case](json.loads(table.schema.metadata[b"gpvo"]), table)
    pq.write_table(table.replace_schema_metadata({"gpvo": json.dumps(meta)}), path)
    for read in (read_sets, lambda p: StoredSets(p).thinned(1000)):
        with pytest.raises(SourceError, match=r"rows\.parquet: is not a training set: ") as refusal:
            read(path)
        assert "\n" not in str(refusal.value)
