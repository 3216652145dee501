"""CSV logs of other people's odometry: columns found by name, or mapped by the user."""

from __future__ import annotations

import csv
import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError, counted
from gpvo.io.stamps import (
    UNITS_NS,
    check_interval,
    check_padding,
    cure_of_end,
    cure_of_number,
    integer_ns,
    is_number,
    likely_unit,
    text_lines,
    text_to_ns,
)
from gpvo.types import COUNT_FIELDS, FLOAT_FIELDS, Array

_POSE = ("p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w")
_COV = tuple(f"cov_{i}{j}" for i in range(6) for j in range(6))
_STAMPS = ("t_ns", "t_us", "t_ms", "t_s")
# Everything that a column can be mapped to.
TARGETS = (*_STAMPS, *_POSE, *_COV, *COUNT_FIELDS, *FLOAT_FIELDS)

_STAMP_NAMES = {
    *("t", "time", "timestamp", "stamp", "sec", "secs"),
    *(f"{name}_{unit}" for name in ("time", "timestamp", "stamp") for unit in (*UNITS_NS, "sec", "secs")),
}
# Its own files number the axes, and put the covariance of the rotation (Pr) before that of the translation (Pt); the
# rotation's is in the axes of the body (ov_eval/src/calc/ResultTrajectory.cpp, ``calculate_error``).
_OPENVINS = {
    **{f"pt{i + 1}{j + 1}": f"cov_{i}{j}" for i in range(3) for j in range(i, 3)},
    **{f"pr{i + 1}{j + 1}": f"cov_{i + 3}{j + 3}" for i in range(3) for j in range(i, 3)},
    **{f"p{a}{b}": f"cov_{i}{j}" for i, a in enumerate("xyz") for j, b in enumerate("xyz") if i <= j},
    **{f"q{a}{b}": f"cov_{i + 3}{j + 3}" for i, a in enumerate("rpy") for j, b in enumerate("rpy") if i <= j},
}
# The result files of VINS-Mono and VINS-Fusion have no header; those of the loop closure end with the quaternion.
_VINS = ("t_ns", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z", "v_x", "v_y", "v_z")
NO_HEADER = (
    "it has no header line: read as VINS-Fusion writes it, nanoseconds, position, quaternion with w first; a line of"
    " column names on top says otherwise"
)
POSITIONS_ALONE = (
    "positions alone, of a laser tracker or satellites, still give the ATE: write 0, 0, 0, 1 as q_x, q_y, q_z, q_w"
)
_ANGLES = (
    "attitudes are read as quaternions alone: scipy's Rotation.from_euler('xyz', [roll, pitch, yaw]).as_quat() makes"
    " them, x, y, z, w, of rotations about fixed axes (degrees=True if they are)"
)
_MAX_ROWS = 20_000_000
_EMPTY = {"", "na", "n/a", "#n/a", "<na>", "none", "null"}  # how an unknown number is written, beside NaN
_AXES = {f"{of}{axis}": i + 3 * (of == "r") for of in ("", "p", "t", "r") for i, axis in enumerate("xyz")}
_AXES |= {"roll": 3, "pitch": 4, "yaw": 5, "r": 3, "p": 4}
_AXIS = "roll|pitch|yaw|[prt]?[xyz]|r|p"
_COVARIANCE = re.compile(rf"(?:pose_|position_)?(?:cov|covariance)_({_AXIS})_?({_AXIS})")
_POSED = re.compile(
    r"(?:.*_)?(p|t|pos|pose|position|translation|q|quat|quaternion|ori|orientation|rot|rotation)(?:_[rwg][sib](?:_[rwg])?)?_?([xyzw])"
)
_NUMBERED = re.compile(
    r"(?:.*[_.])?(?:(?P<q>q(?:uat|uaternion)?_?\[?[0-3]\]?)|p(?:os|osition)?_?\[?[0-2]\]?)", re.IGNORECASE
)
_VELOCITY = re.compile(r"(?:.*_)?(?:v_?[xyz]|vel|velocity|twist)(?:_.*|[xyz])?")
_GEOGRAPHIC = {"lat", "latitude", "lon", "lng", "longitude"}
_VARIANCE = re.compile(rf"(?:pose_|position_)?(?:var|variance)_({_AXIS})")
_LENGTHS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048}
_METRES = {"": 1.0, "milli": 1e-3, "centi": 1e-2, "kilo": 1e3}
_LENGTHS_M |= {f"{k}met{end}": size for k, size in _METRES.items() for end in ("er", "ers", "re", "res")}
_ANGLES_RAD = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180}
# In brackets, or behind an underscore; of a variance, squared or not.
_UNIT = re.compile(rf"(?:[\[(] *|_)({'|'.join((*_LENGTHS_M, *_ANGLES_RAD))})(?:\^?2|²)?(?: *[\])])?$")
_BRACKETS = re.compile(r"[\[(](.*?)[\])]")
_STAMP_UNITS = {name: unit for unit in UNITS_NS for name in (unit, f"{unit}ec", f"{unit}ecs")}
_STAMP_UNITS |= {"µs": "us", "μs": "us"}  # the sign for micro, and the Greek letter
_SECONDS = {"": "s", "milli": "ms", "micro": "us", "nano": "ns"}
_STAMP_UNITS |= {f"{k}second{end}": unit for k, unit in _SECONDS.items() for end in ("", "s")}
# What tells how wrong a motion may be: an uncertainty, or what odometry counts and sees.
_TELLING = re.compile(
    r"cov|var|sigma|std|^p_?\d\d$|inlier|feature|tracked|match|landmark|keypoint|reproj|disparity|bright|contrast|sharp",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Table:
    """Columns of a CSV by target name; ``t_ns`` (N,) int64, the others (N,) float64; ``lines`` (N,) for messages;
    ``covariance_axes``, of :data:`gpvo.io.foreign.COVARIANCE_AXES`, as the names tell them."""

    t_ns: NDArray[np.int64]
    columns: dict[str, Array]
    lines: list[int]
    unused: tuple[str, ...] = ()  # columns that look like an uncertainty or a feature and were not understood
    notes: tuple[str, ...] = ()
    covariance_axes: str = "world"


def read_table(path: Path, mapping: Mapping[str, str]) -> Table:
    """Read a CSV with a header line (comma, semicolon, tab or blanks between), or as VINS-Fusion writes it, without.

    ``mapping`` gives column name -> target (one of :data:`TARGETS`) and goes before what the names suggest. A stamp is
    in the unit of its target or name; where only a guess says seconds, 16 digits and more are nanoseconds. ROS's
    nanoseconds beyond whole seconds are added where their column stands beside. Positions and covariances are in the
    unit of their column's name, else in m and rad. Raises SourceError, naming file and line, or the column that is
    wanted or whose unit is not known.
    """
    lines = _lines(path)
    first = next(lines, None)
    if first is None:
        raise SourceError("is empty", where=path)
    top, header = first
    targets = _targets(path, header, mapping)
    stamps: list[int] = []
    rows: list[list[float]] = []
    numbers: list[int] = []
    texts: list[str] = []
    order = [name for name in targets if name not in _STAMPS]
    stamp = next(s for s in _STAMPS if s in targets)
    is_stated = stamp in mapping.values()
    column = header[targets[stamp]]
    rest = _rest_of_seconds(header, column) if stamp == "t_s" else None
    for number, fields in lines:
        if len(rows) >= _MAX_ROWS:
            raise SourceError(f"has more than {_MAX_ROWS} rows", where=path)
        if len(fields) < len(header) or any(fields[len(header) :]):  # empty: VINS ends its lines with a comma
            too_long = "name every column, and write numbers with a decimal point"
            cure = too_long if len(fields) >= len(header) else cure_of_end(path, number) if rows else None
            what = f"line {number} holds {counted(len(fields), 'field')}, the header {len(header)}"
            raise SourceError(what, where=path, cure=cure)
        text = fields[targets[stamp]]
        try:
            stamps.append(_stamp(text, stamp[2:], is_stated) + (0 if rest is None else integer_ns(fields[rest])))
        except ValueError as error:
            unit = likely_unit(text)
            cure = cure_of_number(text) if unit is None or f"t_{unit}" == stamp else _unit_cure(column, unit)
            raise SourceError(f"line {number}: {error}", where=path, cure=cure) from None
        try:
            values = [fields[targets[name]] for name in order]
            rows.append([float("nan" if v.lower() in _EMPTY else v) for v in values])
        except ValueError:
            wrong = next(v for v in values if v.lower() not in _EMPTY and not is_number(v))
            what = f"line {number}: '{wrong}' is not a number"
            raise SourceError(what, where=path, cure=cure_of_number(wrong)) from None
        texts.append(text)
        numbers.append(number)
    if not rows:
        raise SourceError("holds a header and no rows", where=path)
    if stamp == "t_s" and rest is None:
        check_padding(texts, path)
    check_interval(stamps, path, lambda unit: _unit_cure(column, unit), is_stated=is_stated)
    data = np.array(rows, dtype=np.float64)
    unused = tuple(c for k, c in enumerate(header) if k not in targets.values() and _TELLING.search(c))
    named = {n: header[targets[n]] for n in order}
    to_si = {n: _to_si(column, n) or 1.0 for n, column in named.items()}  # of a unit unknown, --map says which
    columns = {n: data[:, i] * to_si[n] for i, n in enumerate(order)}
    axes = "mixed" if "cov_33" in targets and _plain(header[targets["cov_33"]]) in _OPENVINS else "world"
    notes = (*(() if top else (NO_HEADER,)), *_units_apart(named, to_si))
    return Table(np.array(stamps, dtype=np.int64), columns, numbers, unused, notes, axes)


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and fields, the header first: the first line of names, or the last comment before the numbers that
    names columns, else the last; 0 is the number of that which the layout of VINS-Fusion stands for."""
    try:
        comments: dict[int, str] = {}
        separator: str | None = None
        for number, text in text_lines(path):
            if text.startswith("#"):
                comments[number] = text.lstrip("#").strip()
                continue
            if separator is None:
                separator = next((s for s in (",", ";", "\t") if s in text), " ")
                if is_number((fields := _split(text, separator))[0]):
                    if not comments:
                        yield 0, _implied_header(path, text, separator)
                    else:
                        top, last = max(comments.items())
                        yield top, column_names([*comments.values()], len(fields)) or _split(last, separator)
            yield number, _split(text, separator)
    except csv.Error as error:
        raise SourceError(f"is not a CSV file: {error}", where=path) from None


def _implied_header(path: Path, text: str, separator: str) -> list[str]:
    """The names that VINS-Fusion's result files leave out. Raises SourceError, with the line to put on top, for another
    file's first line."""
    fields = _split(text, separator)
    if fields[-1] == "":  # VINS ends its lines with a comma.
        fields.pop()
    unit = likely_unit(fields[0]) or "s"
    if separator == "," and len(fields) in (8, 11) and unit == "ns" and all(map(is_number, fields)):
        return list(_VINS[: len(fields)])
    others = [f"column_{k}" for k in range(len(_POSE) + 2, len(fields) + 1)]
    names = separator.join((f"t_{unit}", *_POSE, *others))
    if len(words := text.split()) > 1 and all(re.fullmatch(r"[-+]?\d+,\d+\S*", word) for word in words):
        raise SourceError(f"'{words[0]}' is not a number", where=path, cure=cure_of_number(words[0]))
    cure = f"put the column names on top, in order, such as '{names}'; any other column may have any name"
    raise SourceError("has no header line", where=path, cure=cure)


def _split(text: str, separator: str) -> list[str]:
    if separator == " ":
        return text.split()
    return [f.strip() for f in next(csv.reader([text], delimiter=separator))]


def column_names(comments: list[str], count: int) -> list[str] | None:
    """The names of ``count`` columns, a stamp and a pose among them, in the last of the comments above them that holds
    such, with commas, other signs or blanks between; None where none does."""
    for comment in reversed(comments):
        text = comment.lstrip("# ")
        unspaced = re.sub(r"\s+(?=[\[(])", "", text)  # a unit belongs to the name before
        for words in (*(text.split(s) for s in (",", ";", "\t", None)), unspaced.split()):
            names = [word.strip() for word in words] if len(words) == count else []
            named = {_suggest(name) for name in names}
            if named & {*_STAMPS} and named >= {*_POSE}:
                return names
    return None


def is_tum(names: list[str]) -> bool:
    """Whether columns have the order and the units of TUM."""
    layout = ("t_s", *_POSE)
    if tuple(map(_suggest, names)) != layout:
        return False
    return all(_to_si(*pair) == 1.0 for pair in zip(names, layout))


def _targets(path: Path, header: list[str], mapping: Mapping[str, str]) -> dict[str, int]:
    """Target name -> column index."""
    for column, target in mapping.items():
        if target not in TARGETS:
            cure = "targets are t_s, t_ms, t_us, t_ns, p_x.., q_x..q_w, cov_00..cov_55, n_inliers and the like"
            raise SourceError(f"--map {column}={target}: unknown name '{target}'", where=path, cure=cure)
        if column not in header:
            raise SourceError(f"has no column '{column}' (there are: {', '.join(header)})", where=path)
        if target in _COV and re.search("std|deviation", column.lower()):
            text = f"--map {column}={target}: '{column}' is a standard deviation by its name, {target} a variance"
            raise SourceError(text, where=path, cure="square its numbers, and give it another name")
    found: dict[str, int] = {mapping[c]: header.index(c) for c in mapping}
    # The sensor's time, of the header of a ROS message, before that of recording.
    for index, column in sorted(enumerate(header), key=lambda c: "header" not in c[1].lower()):
        guess = None if column in mapping else _suggest(column)
        if guess is None or (guess in _STAMPS and found.keys() & _STAMPS):
            continue
        if guess not in _POSE or guess not in found:
            found.setdefault(guess, index)
        elif (other := header[found[guess]]) not in mapping and _is_plain(column) >= _is_plain(other):
            if _is_plain(column) == _is_plain(other):
                cure = f"say which with --map COLUMN={guess} and so on, for ground truth with --truth-map"
                raise SourceError(f"the columns '{other}' and '{column}' may both be {guess}", where=path, cure=cure)
            found[guess] = index
    absent = [p for p in _POSE if p not in found]
    if not found.keys() & _STAMPS:
        absent.insert(0, "t_s")
    if absent:
        text = f"no column for {', '.join(absent)} (there are: {', '.join(header)})"
        raise SourceError(text, where=path, cure=_cure_of_absent(absent, [c for c in header if c not in mapping]))
    for target, index in found.items():
        if header[index] not in mapping:
            _check_unit(path, header[index], target)
    return found


def _cure_of_absent(absent: list[str], columns: list[str]) -> str:
    """What to do about targets without a column, by the names of those that are not mapped."""
    target = "t_s (or t_ms, t_us, t_ns)" if absent[0] == "t_s" else absent[0]
    cure = f"name it with --map COLUMN={target}, for ground truth with --truth-map"
    plain, numbered = {_plain(c) for c in columns}, {c: m for c in columns if (m := _NUMBERED.fullmatch(c))}
    q, p = ([c for c, m in numbered.items() if bool(m["q"]) == of_q] for of_q in (True, False))
    q, p = q if len(q) == 4 and "q_x" in absent else [], p if len(p) == 3 and "p_x" in absent else []
    if {"roll", "pitch", "yaw"} <= {c.removesuffix("_deg").removesuffix("_rad") for c in plain}:
        return _ANGLES
    if q or p:
        names = zip([*q, *p], [*(("q_w", "q_x", "q_y", "q_z") if q else ()), *_POSE[:3]])
        given = "give " + " ".join(f"--map '{c}={name}'" for c, name in names)
        return f"numbers do not tell which is w: if the first, as in PX4's logs, {given}" if q else given
    if not plain.isdisjoint(_GEOGRAPHIC) and "p_x" in absent:
        return "convert latitude and longitude to metres, x to the east and y to the north of the start"
    if any(map(_VELOCITY.fullmatch, plain)) and {*_POSE[:3]} <= {*absent}:
        return f"velocities alone are not read: integrate them to poses, or, if there are positions, {cure}"
    return f"{cure}; {POSITIONS_ALONE}" if absent == list(_POSE[3:]) else cure


def _is_plain(column: str) -> bool:
    """Whether the name of a column of poses does not say whose: ``p_x`` goes before ``gt_p_x``."""
    return re.fullmatch(r"[a-z]*_?[xyzw]", column.strip().lower().replace(".", "_")) is not None


def _plain(column: str) -> str:
    """The name of a column in small letters with underscores, without its unit in brackets."""
    return re.sub(r"[./ ]+", "_", re.sub(r"[\[(].*?[\])]", "", column).strip().lower()).lstrip("#%").strip("_")


def _to_si(column: str, target: str) -> float | None:
    """What the numbers of a column are multiplied by to be metres or radians, of a covariance their squares or
    products, by the unit in its name; 1 where that states none, None where that in its brackets is none that is read.
    """
    known, axes = _units(target), target[4:] if target in _COV else ""
    unit = _UNIT.search(column.strip().lower()) or _UNIT.search(_plain(column))
    of_axes = [_ANGLES_RAD if axis in "345" else _LENGTHS_M for axis in axes] or [known]
    sizes = [of_axis[unit[1]] for of_axis in of_axes if unit[1] in of_axis] if unit else []
    size = float(np.prod(sizes)) if len(sizes) == len(of_axes) else 1.0
    stated, si = _BRACKETS.search(column), {name for name, of_si in known.items() if of_si == 1.0}
    is_read = size != 1.0 or not (stated and si) or si >= set(re.findall(r"[^\W\d_]+", stated[1].lower()))
    return size if is_read else None


def _units(target: str) -> dict[str, float]:
    """What numbers of a target may be in, by name, 1 for what they are read as; none where they have no unit."""
    if target in _STAMPS:
        return dict.fromkeys(_STAMP_UNITS, 1.0)
    if target in _COV:
        return _LENGTHS_M | _ANGLES_RAD
    return _LENGTHS_M if target in _POSE[:3] else {}


def _check_unit(path: Path, column: str, target: str) -> None:
    """Refuse a column in a unit that is not known: else it would be read as metres, or seconds.

    Raises SourceError, naming the column.
    """
    stated = _BRACKETS.search(column)
    if stated is None or _to_si(column, target) is not None:
        return
    if target in _STAMPS:
        cure = f"write seconds, or {_unit_cure(column, 's')}"
    else:
        short = ", ".join(name for name in _units(target) if len(name) < 5)
        si = "metres" if target in _POSE else "of metres and radians"
        cure = f"units are {short}; if it is {si}, --map {shlex.quote(f'{column}={target}')}, of truth --truth-map"
    what = f"the column '{column}' is in '{stated[1]}', which is no unit that is read"
    raise SourceError(what, where=path, cure=cure)


def _units_apart(named: Mapping[str, str], to_si: Mapping[str, float]) -> Iterator[str]:
    """A remark where positions state a unit that is converted, and covariances none; ``named``: columns by target."""
    odd = [column for target, column in named.items() if target[:2] == "p_" and to_si[target] != 1.0]
    if odd and any(target[:4] == "cov_" and not _UNIT.search(column) for target, column in named.items()):
        yield f"{odd[0]} is converted to metres, the covariances, which name no unit, are not"


def _rest_of_seconds(header: list[str], column: str) -> int | None:
    """Index of the column of nanoseconds beyond the whole seconds of another, as ROS has them; None without one."""
    base, is_seconds = re.subn(r"secs?$", "", _plain(column))
    wanted = {base + rest for rest in ("nsec", "nsecs", "nanosec", "nanosecs")} if is_seconds else {}
    return next((index for index, name in enumerate(header) if _plain(name) in wanted), None)


def _suggest(column: str) -> str | None:
    """What a column name means to most people."""
    unit, name = _BRACKETS.search(column), re.sub(r"^.*header_(?=stamp)", "", _plain(column))
    if name in TARGETS:
        return name
    name = _UNIT.sub("", name)
    if name in _STAMP_NAMES:
        said = unit[1].strip().lower() if unit else name.rpartition("_")[2]
        return f"t_{_STAMP_UNITS.get(said, 's')}"
    if name in _OPENVINS:
        return _OPENVINS[name]
    if named := _COVARIANCE.fullmatch(name) or _VARIANCE.fullmatch(name):
        i, j = (_AXES[named[k]] for k in (1, named.lastindex or 1))
        return f"cov_{min(i, j)}{max(i, j)}"
    # The 36 numbers of ROS, row by row; a number in brackets is no unit.
    flat = re.sub(r"\[(\d+)\]$", r"_at_\1", column.strip())
    if covariance := re.fullmatch(r"(?:(?:.*_)?pose_covariance_?(?:at_)?|cov(?:ariance)?_at_)(\d+)_?", _plain(flat)):
        k = int(covariance[1])
        return f"cov_{k // 6}{k % 6}" if k < 36 else None
    pose = _POSED.fullmatch(name) or re.fullmatch(r"()([xyz])", name)
    if pose is None or any(word in name for word in ("twist", "vel", "acc", "cov")):
        return None
    is_quaternion = pose[1][:1] in ("q", "o", "r")
    if pose[2] == "w" and not is_quaternion:
        return None
    return f"{'q' if is_quaternion else 'p'}_{pose[2]}"


def _unit_cure(column: str, unit: str) -> str:
    """How to say in which unit a column of stamps is, most likely ``unit``."""
    others = ", ".join(f"t_{u}" for u in UNITS_NS if u != unit)
    return f"name the unit: --map {shlex.quote(f'{column}=t_{unit}')} (or {others}), for ground truth with --truth-map"


def _stamp(text: str, unit: str, is_stated: bool) -> int:
    is_epoch_ns = unit == "s" and not is_stated and text.isdigit() and len(text) >= 16
    return text_to_ns(text, "ns" if is_epoch_ns else unit)
