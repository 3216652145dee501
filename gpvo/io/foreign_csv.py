"""CSV logs of other people's odometry: columns found by name, or mapped by the user."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.geometry.se3 import Array
from gpvo.io.run_table import COUNT_FIELDS, FLOAT_FIELDS
from gpvo.io.stamps import seconds_text_to_ns

_POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")
_COV = tuple(f"cov_{i}{j}" for i in range(6) for j in range(6))
# Everything that a column can be mapped to.
TARGETS = ("t_s", "t_ns", *_POSE, *_COV, *COUNT_FIELDS, *FLOAT_FIELDS)

_STAMP_NAMES = {"t", "time", "timestamp", "stamp", "t_s", "t_ns", "time_s", "time_ns", "sec", "secs"}
_OPENVINS = {
    **{f"p{a}{b}": f"cov_{i}{j}" for i, a in enumerate("xyz") for j, b in enumerate("xyz") if i <= j},
    **{f"q{a}{b}": f"cov_{i + 3}{j + 3}" for i, a in enumerate("rpy") for j, b in enumerate("rpy") if i <= j},
}
_MAX_BYTES = 2_000_000_000
_MAX_ROWS = 20_000_000


@dataclass(frozen=True)
class Table:
    """Columns of a CSV by target name; ``t_ns`` (N,) int64, the others (N,) float64; ``lines`` (N,) for messages."""

    t_ns: NDArray[np.int64]
    columns: dict[str, Array]
    lines: list[int]


def read_table(path: Path, mapping: Mapping[str, str]) -> Table:
    """Read a CSV with a header line (comma, semicolon, tab or blanks between).

    ``mapping`` gives column name -> target (one of :data:`TARGETS`) and goes before what the names suggest. A stamp is
    in nanoseconds where its target or name says so or it has 16 digits and more, else in seconds.

    Raises
    ------
    SourceError
        Naming file and line, or the column that is wanted.
    """
    lines = _lines(path)
    try:
        _, header = next(lines)
    except StopIteration:
        raise SourceError("is empty", where=path) from None
    targets = _targets(path, header, mapping)
    stamps: list[int] = []
    rows: list[list[float]] = []
    numbers: list[int] = []
    order = [name for name in targets if name not in ("t_s", "t_ns")]
    stamp = "t_ns" if "t_ns" in targets else "t_s"
    for number, fields in lines:
        if len(rows) >= _MAX_ROWS:
            raise SourceError(f"has more than {_MAX_ROWS} rows", where=path)
        if len(fields) < len(header):
            raise SourceError(f"line {number} holds {len(fields)} fields, the header {len(header)}", where=path)
        try:
            stamps.append(_stamp(fields[targets[stamp]], stamp))
            rows.append([float(fields[targets[name]] or "nan") for name in order])
        except ValueError as error:
            raise SourceError(f"line {number}: {error}", where=path) from None
        numbers.append(number)
    if not rows:
        raise SourceError("holds a header and no rows", where=path)
    data = np.array(rows, dtype=np.float64)
    return Table(np.array(stamps, dtype=np.int64), {n: data[:, i] for i, n in enumerate(order)}, numbers)


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and fields, the header first: the first line of names, or the last comment before the numbers."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError("is larger than 2 GB: no log", where=path)
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            comment: tuple[int, str] | None = None
            separator: str | None = None
            for number, line in enumerate(file, 1):
                text = line.strip()
                if text.startswith("#"):
                    comment = (number, text.lstrip("#").strip())
                if not text or text.startswith("#"):
                    continue
                if separator is None:
                    separator = next((s for s in (",", ";", "\t") if s in text), " ")
                    if is_number(_split(text, separator)[0]):
                        if comment is None:
                            raise SourceError("has no header line", where=path, cure="put the column names on top")
                        yield comment[0], _split(comment[1], separator)
                yield number, _split(text, separator)
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from None
    except csv.Error as error:
        raise SourceError(f"is no CSV: {error}", where=path) from None


def _split(text: str, separator: str) -> list[str]:
    if separator == " ":
        return text.split()
    return [f.strip() for f in next(csv.reader([text], delimiter=separator))]


def is_number(text: str) -> bool:
    """Whether a field is a number, NaN included."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _targets(path: Path, header: list[str], mapping: Mapping[str, str]) -> dict[str, int]:
    """Target name -> column index."""
    for column, target in mapping.items():
        if target not in TARGETS:
            raise SourceError(
                f"--map {column}={target}: there is no '{target}'",
                where=path,
                cure="targets are t_s or t_ns, p_x.., q_x..q_w, cov_00..cov_55, n_inliers and the other record fields",
            )
        if column not in header:
            raise SourceError(f"has no column '{column}' (there are: {', '.join(header)})", where=path)
    found: dict[str, int] = {mapping[c]: header.index(c) for c in mapping}
    for index, column in enumerate(header):
        guess = None if column in mapping else _suggest(column)
        if guess is not None and guess not in found and not (guess[:2] == "t_" and {"t_s", "t_ns"} & found.keys()):
            found[guess] = index
    absent = [p for p in _POSE if p not in found]
    if not {"t_s", "t_ns"} & found.keys():
        absent.insert(0, "t_s")
    if absent:
        raise SourceError(
            f"no column for {', '.join(absent)} (there are: {', '.join(header)})",
            where=path,
            cure="name it with --map COLUMN=" + absent[0],
        )
    return found


def _suggest(column: str) -> str | None:
    """What a column name means to most people."""
    unit = re.search(r"\[(.*?)\]", column)
    name = re.sub(r"\[.*?\]", "", column).strip().lower().replace(".", "_").lstrip("#%").strip("_")
    if name in TARGETS:
        return name
    if name in _STAMP_NAMES:
        return "t_ns" if name.endswith("_ns") or (unit and unit[1].strip() == "ns") else "t_s"
    if name in _OPENVINS:
        return _OPENVINS[name]
    if covariance := re.fullmatch(r"(?:field_)?pose_covariance_?(\d+)_?", name):
        k = int(covariance[1])
        return f"cov_{k // 6}{k % 6}" if k < 36 else None
    pose = re.fullmatch(
        r"(?:.*_)?(p|t|pos|position|translation|q|quat|orientation|rotation)(?:_rs_r|_rs)?_?([xyzw])", name
    )
    if pose is None:
        pose = re.fullmatch(r"()([xyz])", name)
    if pose is None or any(word in name for word in ("twist", "vel", "acc", "cov")):
        return None
    is_quaternion = pose[1][:1] in ("q", "o", "r")
    if pose[2] == "w" and not is_quaternion:
        return None
    return f"{'q' if is_quaternion else 'p'}_{pose[2]}"


def _stamp(text: str, target: str) -> int:
    if target == "t_ns":
        return int(text) if text.lstrip("-").isdigit() else round(float(text))
    if text.isdigit() and len(text) >= 16:
        return int(text)
    return seconds_text_to_ns(text)
