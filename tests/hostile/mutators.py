"""Ways to damage a file: bit by bit, number by number, or whole and with a content that cannot be."""

from __future__ import annotations

import copy
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

EXTREME = tuple(
    word.encode()
    for word in (
        *["1e308", "-1e308", "1e999", "nan", ".inf", "-1", "0", "2147483648", "null", "[]", "{}", "1e-320", "true"],
        "9" * 400,
    )
)
VALUES = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e160, 0.0, -1.0, 1e-320, 1e12)
_NUMBER = re.compile(rb"-?\d+\.?\d*(e[-+]?\d+)?")
Rng = np.random.Generator


# -- bytes --


def flip(raw: bytes, rng: Rng, other: bytes) -> bytes:
    out = bytearray(raw)
    for at in rng.integers(0, max(len(out), 1), rng.integers(1, 17)):
        if out:
            out[at] ^= 1 << int(rng.integers(8))
    return bytes(out)


def truncate(raw: bytes, rng: Rng, other: bytes) -> bytes:
    return raw[: int(rng.integers(0, max(len(raw), 1)))]


def splice(raw: bytes, rng: Rng, other: bytes) -> bytes:
    at, begin, n = (int(rng.integers(0, max(len(v), 1))) for v in (raw, other, other))
    return raw[:at] + other[begin : begin + min(n, 4096)] + raw[at + int(rng.integers(0, 4096)) :]


def numbers(raw: bytes, rng: Rng, other: bytes) -> bytes:
    found = _numbers_in(raw)
    if not found:
        return flip(raw, rng, other)
    start, end = found[int(rng.integers(len(found)))]
    return raw[:start] + EXTREME[int(rng.integers(len(EXTREME)))] + raw[end:]


@cache
def _numbers_in(raw: bytes) -> list[tuple[int, int]]:
    """Where the numbers of a seed lie, of which there are few."""
    return [hit.span() for hit in _NUMBER.finditer(raw)]


def swap(raw: bytes, rng: Rng, other: bytes) -> bytes:
    separator = (b"\n", b",", b" ", b":")[int(rng.integers(4))]
    fields = raw.split(separator)
    a, b = (int(k) for k in rng.integers(0, len(fields), 2))
    fields[a], fields[b] = fields[b], fields[a]
    return separator.join(fields)


def bomb(raw: bytes, rng: Rng, other: bytes) -> bytes:
    at, n = int(rng.integers(0, max(len(raw), 1))), int(rng.integers(1, 64))
    return raw[:at] + raw[at : at + n] * int(rng.integers(10, 20_000)) + raw[at:]


ANY_BYTES = (flip, truncate, splice, numbers, swap, bomb)


# -- arrays: files that are whole, with a content that cannot be --


def odd_array(array: np.ndarray, rng: Rng) -> np.ndarray:
    """Another array: some or all of its values extreme, or of another shape or type."""
    choice = int(rng.integers(6))
    if choice == 0:
        return np.asarray(array[:-1] if array.ndim else [array, array])
    if choice == 1:
        return np.asarray(array).astype(("f4", "i8", "U3", "?", "f8", "i4")[int(rng.integers(6))])
    if choice == 2:
        return np.atleast_1d(array).reshape(-1, 1)
    out = np.array(array, dtype=np.float64)
    value = VALUES[int(rng.integers(len(VALUES)))]
    if choice == 3 or not out.size:
        out[...] = value
    else:
        out.reshape(-1)[int(rng.integers(out.size))] = value
    return out


def odd_tracks(path: Path, rng: Rng) -> None:
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    name = sorted(data)[int(rng.integers(len(data)))]
    data[name] = odd_array(data[name], rng)
    np.savez_compressed(path, **data)


def odd_kept(path: Path, rng: Rng) -> None:
    """A file of a run that broke off: its tables, its source, or the state of what made it."""
    if path.suffix == ".parquet":
        odd_table(path, rng)
    elif path.name != "state.npz":
        odd_tracks(path, rng)
    else:
        with np.load(path) as file:
            tree, data = json.loads(file["tree"].tobytes()), odd_array(file["data"], rng)
        if rng.random() < 0.8:
            with np.load(path) as file:
                data = file["data"]
            odd_tree(tree["state"], rng)
        np.savez(path, tree=np.frombuffer(json.dumps(tree).encode(), np.uint8), data=data)


def odd_tree(tree: Any, rng: Rng) -> None:
    """One node of a document becomes another of its nodes, or a value that cannot be."""
    places: list[tuple[Any, Any]] = []
    left = [tree]
    while left:
        node = left.pop()
        keys = node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        places += [(node, key) for key in keys]
        left += [node[key] for key in keys]
    (holder, key), (other, at) = (places[int(k)] for k in rng.integers(0, len(places), 2))
    odd = (None, -1, 0, [], {}, "x", [1.0], 1e300, True, 2**40, float("nan"))
    holder[key] = copy.deepcopy(other[at]) if rng.random() < 0.4 else odd[int(rng.integers(len(odd)))]


def odd_model(path: Path, rng: Rng) -> None:
    from gpvo.errors import ModelError
    from gpvo.online import modelfile

    arrays, header = _loaded(path.read_bytes())
    arrays, header, names = dict(arrays), dict(header), sorted(n for n in arrays if not n.startswith("thesis."))
    if rng.random() < 0.3:
        key = sorted(header)[int(rng.integers(len(header)))]
        header[key] = (None, -1, 0, [], {}, "x", [1.0], [[]], {"x": {}}, 1e300, True)[int(rng.integers(11))]
    else:
        name = names[int(rng.integers(len(names)))]
        arrays[name] = odd_array(arrays[name], rng)
    try:
        modelfile.save(path, arrays, header)
    except ModelError:
        path.write_bytes(flip(path.read_bytes(), rng, b""))


@cache
def _loaded(raw: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """A seed's arrays and header, neither of which may be changed."""
    from gpvo.online import modelfile

    return modelfile.parse(raw, Path("model.gpvo"))


def odd_table(path: Path, rng: Rng) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read(use_threads=False)
    at = int(rng.integers(table.num_columns))
    name = table.column_names[at]
    if rng.random() < 0.2:
        table = table.remove_column(at)
    elif rng.random() < 0.2:
        table = table.set_column(at, name, pa.array(["x"] * table.num_rows))
    else:
        values = table[name].to_pylist()
        if values and isinstance(values[0], (int, float)) and not isinstance(values[0], bool):
            k = int(rng.integers(len(values)))
            value = VALUES[int(rng.integers(len(VALUES)))]
            whole = isinstance(values[0], int)
            most = 2 ** (table[name].type.bit_width - 2)
            values[k] = int(rng.integers(-most, most)) if whole else value
            table = table.set_column(at, name, pa.array(values, table[name].type))
    pq.write_table(table, path)
