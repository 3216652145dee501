"""Tables that gpvo writes itself are what pyarrow reads, to the bit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from gpvo.io.parquet import join_tables, numbers_of, read_columns, write_blocks, write_table
from hypothesis import given, settings

ROOT = Path(__file__).parents[2]
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
    write_blocks(folder / "blocks.parquet", iter(parts), {"schema": "1"})
    write_table(folder / "once.parquet", read, {"schema": "1"})
    assert (folder / "blocks.parquet").read_bytes() == (folder / "once.parquet").read_bytes()


def test_the_footer_of_a_long_run_stays_small(tmp_path):
    """A million frames in parts of 100 had 10,000 groups of rows, whose 117 columns took 1.6 GB to describe."""
    parts = [write_table(tmp_path / "a.parquet", {"t_ns": [1, 2], "x": [0.5, None]})]
    parts += 2500 * [write_table(tmp_path / "b.parquet", {"t_ns": [3], "status": ["ok"], "x": [2.5]})]
    join_tables(parts, tmp_path / "all.parquet")
    assert pq.read_metadata(tmp_path / "all.parquet").num_row_groups <= 1000
    read = pq.read_table(tmp_path / "all.parquet", page_checksum_verification=True).to_pydict()
    assert read["t_ns"] == [1, 2, *2500 * [3]]
    assert read["status"] == [None, None, *2500 * ["ok"]]
    assert read["x"] == [0.5, None, *2500 * [2.5]]


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


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_numbers_are_those_of_to_numpy(data):
    kind, values = data.draw(
        st.sampled_from(
            [
                (pa.null(), st.none()),
                (pa.bool_(), st.booleans()),
                (pa.int32(), st.integers(-(2**31), 2**31 - 1)),
                (pa.uint8(), st.integers(0, 255)),
                (pa.int64(), st.integers(-(2**63), 2**63 - 1)),
                (pa.float32(), st.floats(width=32)),
                (pa.float64(), st.floats()),
            ]
        )
    )
    some = values if data.draw(st.booleans()) else st.none() | values
    parts = data.draw(st.lists(st.lists(some, max_size=20), max_size=3))
    cuts = data.draw(st.lists(st.integers(0, 9), min_size=len(parts), max_size=len(parts)))
    column = pa.chunked_array([pa.array(p, kind).slice(c) for p, c in zip(parts, cuts, strict=True)], kind)
    found, expected = numbers_of(column), column.to_numpy()
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_no_table_loads_pandas(tmp_path):
    alone = "import sys, pyarrow; pyarrow.float64().to_pandas_dtype(); sys.exit('pandas' in sys.modules)"
    if subprocess.run([sys.executable, "-c", alone], timeout=120).returncode:
        pytest.skip("this version of PyArrow loads pandas to name a type")
    code = f"""
import sys
from gpvo.dataset.build import build_run
from gpvo.dataset.table import read_sets, write_sets
from gpvo.io.run import read_run
path = {str(tmp_path / "sets.parquet")!r}
write_sets(path, [build_run(read_run({str(ROOT / "data" / "tunnel-1")!r}))])
print(len(read_sets(path)), "pandas" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "1 False\n", done.stderr
