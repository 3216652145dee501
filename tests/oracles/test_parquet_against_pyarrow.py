"""Tables that gpvo writes itself are what pyarrow reads, to the bit."""

from __future__ import annotations

from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pyarrow.parquet as pq
import pytest
from gpvo.io.parquet import join_tables, read_columns, write_table
from hypothesis import given, settings

ROWS = st.integers(0, 70)
NUMBERS = {"t_ns": st.integers(-(2**63), 2**63 - 1), "track": st.integers(-(2**31), 2**31 - 1)}


@st.composite
def tables(draw: st.DrawFn) -> dict[str, list[object]]:
    n = draw(ROWS)

    def column(values: st.SearchStrategy[object]) -> list[object]:
        return draw(st.lists(st.none() | values, min_size=n, max_size=n))

    return {
        **{name: column(values) for name, values in NUMBERS.items()},
        "n_inliers": column(st.integers(0, 10**6)),
        "x": column(st.floats(allow_nan=False)),
        "u_px": column(st.floats(allow_nan=False, width=32)),
        "status": column(st.text(st.characters(codec="utf-8"), max_size=9)),
        "is_inlier": column(st.booleans()),
    }


@settings(max_examples=60, deadline=None)
@given(columns=tables())
def test_every_kind_of_column_with_nulls(columns, tmp_path_factory):
    path = tmp_path_factory.mktemp("t") / "a.parquet"
    write_table(path, columns, {"schema": "1", "of": "ü"})
    table = pq.read_table(path, page_checksum_verification=True)
    assert table.to_pydict() == columns
    assert table.schema.metadata == {b"schema": b"1", b"of": "ü".encode()}


@settings(max_examples=30, deadline=None)
@given(parts=st.lists(tables(), min_size=1, max_size=20), late=st.integers(0, 20))
def test_joined_parts_are_one_table(parts, late, tmp_path_factory):
    folder = tmp_path_factory.mktemp("t")
    for part in parts[:late]:
        del part["x"], part["status"]
    groups = [write_table(folder / f"{i}.parquet", part) for i, part in enumerate(parts)]
    join_tables(groups, folder / "all.parquet", {"schema": "1"})
    read = pq.read_table(folder / "all.parquet", page_checksum_verification=True).to_pydict()
    for name, values in read.items():
        expected = [v for part in parts for v in part.get(name, [None] * len(part["t_ns"]))]
        assert values == expected


def test_arrays_and_what_they_lack(tmp_path):
    columns = {"t_ns": np.arange(3), "x": np.array([1.5, np.nan, -0.0]), "is_inlier": np.array([True, False, True])}
    write_table(tmp_path / "a.parquet", columns)
    read, _ = read_columns(tmp_path / "a.parquet")
    for name, values in columns.items():
        np.testing.assert_array_equal(read[name], values)
    assert pq.read_table(tmp_path / "a.parquet")["x"].null_count == 1


@pytest.mark.parametrize("at", [0.3, 0.6])
def test_a_flipped_bit_is_noticed(tmp_path: Path, at: float):
    path = tmp_path / "a.parquet"
    write_table(path, {"x": np.random.default_rng(0).standard_normal(1000)})
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(Exception, match="damaged"):
        read_columns(path)
