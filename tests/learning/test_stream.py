"""Training sets larger than memory: what is keptand that the size of the pieces does not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.dataset.table import BLOCK_ROWS, StoredSets, kept_rows, read_sets, write_sets
from gpvo.errors import GpvoError, SourceError
from gpvo.learning.config import TrainConfig
from gpvo.learning.store import save_model, train_stored
from gpvo.learning.train import train_sets
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


def test_what_is_no_training_set(tmp_path):
    (tmp_path / "x.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(SourceError, match=r"not a training set: .* \(give run folders"):
        StoredSets(tmp_path / "x.parquet")
    with pytest.raises(GpvoError):
        train_stored(tmp_path / "none.parquet", QUICK)
