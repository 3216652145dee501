"""Training sets larger than memory: what is kept, what streams, and that the size of the pieces does not matter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.dataset.stored import BLOCK_ROWS, StoredSets, kept_rows
from gpvo.dataset.table import read_sets, write_sets
from gpvo.errors import GpvoError, SourceError
from gpvo.learning.config import TrainConfig
from gpvo.learning.fit import fit_model
from gpvo.learning.store import save_model
from gpvo.learning.stream import train_stored, with_streamed_mean
from gpvo.learning.train import train_sets
from small_model import training_sets

QUICK = TrainConfig(features="velocity,n_inliers", noise_inducing=16, inducing=32, regressor="sparse")


def biased(sets, *, sideways: float = 0.0):
    """A mean worth learning: the odometry goes too far by a hundredth of what it is faster than usual.

    ``sideways``: of a noise that no sum of physical parts can tell, worse to the right than to the left.
    """
    out = []
    for s in sets:
        Y = s.Y * np.exp(sideways * s.select(["v_x_mps"]))
        Y[:, 2] += 0.01 * (s.select(["v_z_mps"])[:, 0] - 1.0)
        out.append(replace(s, Y=Y))
    return out


@pytest.fixture(scope="module")
def stored_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("rows") / "rows.parquet"
    write_sets(path, (s for s in biased(training_sets(range(4), n=1500))))
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
    assert (len(stored), stored.names) == (sum(map(len, whole)), [s.name for s in whole])
    pieces = list(stored.chunks(2, 97))
    assert max(map(len, pieces)) <= 97
    np.testing.assert_array_equal(np.concatenate([p.X for p in pieces]), whole[2].X)
    for a, b in zip(stored.thinned(4400, 61), stored.thinned(4400, 8192), strict=True):
        assert len(a) <= 1100
        assert a.digest() == b.digest()


def test_what_fits_into_memory_is_trained_as_ever(tmp_path):
    write_sets(tmp_path / "few.parquet", biased(training_sets(range(3), n=100)))
    few = replace(QUICK, features="velocity", inducing=16)
    here = train_sets(read_sets(tmp_path / "few.parquet"), few, judge=False)
    there = train_stored(tmp_path / "few.parquet", few, judge=False, chunk_rows=17)
    assert here.arrays.keys() == there.arrays.keys()
    for name, values in here.arrays.items():
        np.testing.assert_array_equal(values, there.arrays[name], err_msg=name)


@pytest.mark.slow
def test_streamed_mean_is_that_of_all_rows_whatever_the_pieces(stored_file):
    """Noise from 4,096 rows at most, the mean from 6,000: as a fit of all rows in memory says, in any pieces."""
    stored = StoredSets(stored_file)
    learned = fit_model(stored.thinned(4096), QUICK)
    assert learned.choices["use_mean"][2]
    probe = training_sets([77], n=300)[0]
    X, v = probe.select(learned.model.columns), probe.select(["v_z_mps"])[:, 0]
    low, high = (learned.model.domain.centre + learned.model.domain.scale * e
                 for e in (learned.model.domain.low, learned.model.domain.high))  # fmt: skip
    inside = ((low < X) & (high > X)).all(axis=1)
    truth = 0.01 * (v - 1.0)
    whole = fit_model(read_sets(stored_file), QUICK).model.estimate(X).mean[:, 2]
    sigma = float(np.median(learned.model.estimate(X).sigma[:, 2]))
    for regressor, chunk_rows in (("svgp", 6000), ("svgp", 257), ("sparse", 257)):
        config = replace(QUICK, regressor=regressor)
        found = with_streamed_mean(learned, stored, config, chunk_rows).model.estimate(X).mean[:, 2]
        assert np.abs(found - whole)[inside].max() < 0.25 * sigma, (regressor, chunk_rows)
        assert np.sqrt(np.mean((found - truth)[inside] ** 2)) < 0.15 * np.sqrt(np.mean(truth[inside] ** 2))


@pytest.mark.slow
def test_same_bytes_again(stored_file, tmp_path):
    config = replace(QUICK, max_rows=4096)
    for name in ("a", "b"):
        trained = train_stored(stored_file, config, judge=False, chunk_rows=500)
        rows = trained.header["rows"]
        assert rows == {"given": len(StoredSets(stored_file)), "in_memory": 4096}
        save_model(trained, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_what_is_no_training_set(tmp_path):
    (tmp_path / "x.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(SourceError, match="not a training set"):
        StoredSets(tmp_path / "x.parquet")
    with pytest.raises(GpvoError):
        train_stored(tmp_path / "none.parquet", QUICK)
