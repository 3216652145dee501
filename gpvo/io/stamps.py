"""Stamps: nanoseconds from text without rounding, matching of two cameras, order in a sequence; lines of text files."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.files import at_once
from gpvo.io.source import SourceReport
from gpvo.types import StereoFrame, TrackFrame

Stamps = NDArray[np.int64]
"""Nanoseconds (N,)."""

GAP_FACTOR = 1.75
BACK_NS = 1_000_000_000  # messages overtake each other on the way to the bag, but not by so much
PAIR_TOLERANCE_S = 0.002  # between the stamps of left and right
_WINDOW = 51
_MANY_STAMPS = 20  # of which some fraction begins with zero
_DATE = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(\.\d+)?Z?")
_MAX_BYTES = 2_000_000_000
_MAX_CHARACTERS = 1_000_000
# How files that are no text begin, read as if they were.
_PACKED = {"\x1f\ufffd": "gzip", "(\ufffd/\ufffd": "Zstandard", "\ufffd7zXZ": "xz", "PK\x03\x04": "zip"}
_PACKED |= {"BZh91AY&SY": "bzip2", "PAR1\x15": "Parquet"}
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
END_OF_ROS_NS = 2**31 * 10**9  # the stamps of ROS count seconds in 31 bits, from 1970 to January 2038
_UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# Below which size a number is a time of the unit. Between the first two, seconds would be of after 2262 and
# milliseconds of before 1973: such numbers are nanoseconds that count from zero.
_LIMITS = ((9.2e9, "s"), (1e11, "ns"), (1e14, "ms"), (1e17, "us"), (np.inf, "ns"))
# Usual intervals of any odometry [ns]; beyond them the stamps are in another unit.
_SHORTEST_NS, _LONGEST_NS = 1e5, 2e10
# The same where the stamps, read as nanoseconds, are of the size of today's microseconds: of frames 2 s apart, and no
# camera's after 28 hours up time.
_SHORTEST_AS_US_NS = 2e6


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbers from 1 and text of the lines of a file, without blanks around them; empty ones are left out.

    Raises SourceError where the file cannot be read, is larger than 2 GB, or has a line of more than a million
    characters.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError("is larger than 2 GB: too large for a log", where=path)
        with open(path, encoding="utf-8-sig", errors="replace", opener=at_once) as file:
            for number, line in enumerate(iter(partial(file.readline, _MAX_CHARACTERS + 1), ""), 1):
                if "\0" in line or (number == 1 and line.startswith(tuple(_PACKED))):
                    raise _not_text(line, number, path)
                if len(line) > _MAX_CHARACTERS:
                    raise SourceError(f"line {number} is longer than a million characters", where=path)
                if text := line.strip().removeprefix("\ufeff"):
                    yield number, text
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from None


def cure_of_end(path: Path, number: int) -> str | None:
    """What to do about a line that is too short, if it is the file's last; None for any other."""
    is_last = all(n <= number for n, _ in text_lines(path))
    return "the file breaks off in this line: remove it" if is_last else None


def _not_text(line: str, number: int, path: Path) -> SourceError:
    """What to raise where a line holds NUL, or the first begins as packed files do. Of text in UTF-16 the first line
    does; file systems fill up with NUL what was not on the disk yet when power was lost."""
    packed = next((name for sign, name in _PACKED.items() if number == 1 and line.startswith(sign)), None)
    if packed is not None:
        return SourceError(f"is a file of {packed}, no text", where=path, cure="unpack it, or write it as CSV")
    if number == 1:
        return SourceError("is no text file, or one in UTF-16", where=path, cure="give it as UTF-8 text")
    what = f"line {number} holds NUL bytes, as where power was lost while it was written"
    return SourceError(what, where=path, cure=f"keep the lines before it: head -n {number - 1} {path.name} > NEW")


def text_to_ns(text: str, unit: str = "s") -> int:
    """A decimal number of ``unit`` (of :data:`UNITS_NS`) to whole nanoseconds without passing through a float.

    Raises ValueError where the text is no finite number, or more than 292 years from 1970.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text}' is not a number") from None
    factor = UNITS_NS[unit]
    if not value.is_finite() or value.copy_abs() > Decimal(9_200_000_000_000_000_000) / factor:
        raise ValueError(f"'{text}' is not a stamp in {_UNIT_NAMES[unit]}")
    return int((value * factor).to_integral_value())


def date_to_ns(text: str) -> int | None:
    """A date in UTC such as ``2011-09-26 13:02:25.964389445``, to nanoseconds since 1970; None for other text.

    Raises ValueError for a day or time that is none.
    """
    found = _DATE.fullmatch(text)
    whole = None if found is None else datetime.fromisoformat(f"{found[1]}T{found[2]}+00:00")
    return None if found is None or whole is None else text_to_ns(f"{whole.timestamp():.0f}{found[3] or ''}")


def likely_unit(text: str) -> str | None:
    """The unit (of :data:`UNITS_NS`) that makes a number a time of 1973 to 2262; for smaller ones seconds, or where
    these would be too many nanoseconds.

    None where the text is no number.
    """
    try:
        size = abs(float(text))
    except ValueError:
        return None
    return next((unit for limit, unit in _LIMITS if size < limit), None)


def is_number(text: str) -> bool:
    """Whether a field is a number, NaN included."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def cure_of_number(text: str) -> str | None:
    """What to do about a field that is no number; None where it does not show what it is."""
    if "," in text and is_number(text.replace(",", ".")):
        return "write numbers with a decimal point"
    is_date = re.match(r"\d{4}-\d\d-\d\d|\d\d?:\d\d:", text) is not None
    return "dates are not read: write seconds or nanoseconds since 1970" if is_date else None


def cure_of_seconds(text: str) -> str | None:
    """What to do about a stamp of a TUM file that is not in seconds; None where it is in no other unit either."""
    unit = likely_unit(text)
    return None if unit is None or unit == "s" else f"these look like {_UNIT_NAMES[unit]}, and {cure_of_unit(unit)}"


def cure_of_unit(unit: str) -> str:
    """What to do about a TUM file whose stamps are in ``unit`` (of :data:`UNITS_NS`)."""
    header = f"t_{unit} p_x p_y p_z q_x q_y q_z q_w"
    return (
        f"TUM has seconds: divide them by {UNITS_NS['s'] // UNITS_NS[unit]:,},"
        f" or give gpvo import the file with '{header}' as its first line"
    )


def integer_ns(text: str) -> int:
    """A whole number of nanoseconds.

    Raises ValueError where the text is something else, or not of the years 0 to 2262.
    """
    # Some exporters write stamps like 1.4036365e+18; those digits are lost for good.
    if not text.lstrip("-").isdigit():
        raise ValueError(f"'{text}' is not a whole number of nanoseconds")
    return text_to_ns(text, "ns")


def ns_to_seconds_text(t_ns: int) -> str:
    """Nanoseconds as decimal seconds with nine digits."""
    sign, t = ("-", -int(t_ns)) if t_ns < 0 else ("", int(t_ns))
    return f"{sign}{t // 1_000_000_000}.{t % 1_000_000_000:09d}"


def check_padding(texts: Sequence[str], where: object) -> None:
    """Refuse decimal seconds whose fractions are whole nanoseconds (or others) without their leading zeros: none begins
    with one, they differ in length, and as whole numbers they make the intervals at least twice as even.

    Raises SourceError.
    """
    parts = [text.partition(".")[::2] for text in texts]
    lengths = {len(fraction) for _, fraction in parts if fraction.strip("0")}
    if len(texts) < _MANY_STAMPS or len(lengths) < 2 or any(f[:1] == "0" < f.rstrip("0") for _, f in parts):
        return
    if not all(re.fullmatch(r"\d{1,12}", whole) and re.fullmatch(r"\d{0,9}", f) for whole, f in parts):
        return
    read = np.array([[float(f"0.{f}"), int(f or 0) * 10.0 ** -max(lengths)] for _, f in parts])
    t_s = np.array([[int(whole) - int(parts[0][0])] for whole, _ in parts]) + read
    spread_s = np.diff(np.sort(t_s, axis=0), axis=0).std(axis=0)
    if spread_s[1] < 0.5 * spread_s[0]:
        odd = next(text for text, (_, f) in zip(texts, parts) if f.strip("0") and len(f) < max(lengths))
        what = f"the fractions of the stamps, such as {odd}, lack their leading zeros"
        raise SourceError(what, where=where, cure=f"write seconds and nanoseconds as %d.%0{max(lengths)}d")


F = TypeVar("F", StereoFrame, TrackFrame)


def in_order(frames: Iterable[F], report: SourceReport, usual_ns: float | None = None) -> Iterator[F]:
    """The frames whose stamps grow; repeated and out-of-order stamps are dropped and counted, long gaps counted.

    Looks one frame ahead, so that a single stamp far in the future is dropped instead of everything behind it.
    ``usual_ns``: the usual interval where it is known beforehand, else the median of the last ones.
    """
    last: F | None = None
    intervals: deque[int] = deque(maxlen=_WINDOW)
    for frame in _growing_frames(frames, report):
        if last is not None:
            interval, usual = frame.t_ns - last.t_ns, usual_ns
            if usual is None and len(intervals) >= 3:
                usual = float(np.median(intervals))
            if usual is not None and interval > GAP_FACTOR * usual:
                report.count("gaps", f"gap of {interval * 1e-9:.3f} s before {frame.t_ns} ns")
            intervals.append(interval)
        yield frame
        last = frame


def _growing_frames(frames: Iterable[F], report: SourceReport) -> Iterator[F]:
    last: int | None = None
    pending: F | None = None
    for frame in frames:
        if pending is None:
            pending = frame
        elif frame.t_ns == pending.t_ns:
            report.count("duplicate", f"stamp {frame.t_ns} ns twice")
        elif frame.t_ns < pending.t_ns:
            report.count("out_of_order", f"stamp {frame.t_ns} ns after {pending.t_ns} ns")
            if last is None or frame.t_ns > last:
                pending = frame
        else:
            yield pending
            last, pending = pending.t_ns, frame
    if pending is not None:
        yield pending


def growing(t_ns: Stamps) -> NDArray[np.bool_]:
    """(N,) whether each stamp is later than all before it.

    A single one that is ahead of the next, which continues those before, is itself the wrong one: as in `in_order`.
    """
    goes_on = np.concatenate([[True], t_ns[2:] > np.maximum.accumulate(t_ns)[:-2]])  # the next, without this one
    keep = np.ones(len(t_ns), dtype=bool)
    keep[:-1] = (t_ns[1:] >= t_ns[:-1]) | ~goes_on
    rest = t_ns[keep]
    keep[np.flatnonzero(keep)[1:]] = rest[1:] > np.maximum.accumulate(rest)[:-1]
    return keep


def astray(t_ns: Stamps) -> NDArray[np.bool_]:
    """(N,) whether a stamp alone is wrong: more than a second ahead of the next or behind the one before, where these
    two are in order."""
    out = np.zeros(len(t_ns), dtype=bool)
    if len(t_ns) < 3:
        return out
    before, now, after = t_ns[:-2], t_ns[1:-1], t_ns[2:]
    out[1:-1] = (before <= after) & ((now > after + BACK_NS) | (now < before - BACK_NS))
    out[0] = t_ns[0] > t_ns[1] + BACK_NS and not out[1]
    out[-1] = t_ns[-1] < t_ns[-2] - BACK_NS and not out[-2]
    return out


def usual_interval(t_ns: Iterable[int]) -> float | None:
    """Median interval of stamps [ns], whatever their order; None for fewer than three."""
    steps = steps_ns(t_ns)
    return float(np.median(steps)) if len(steps) > 1 else None


def check_interval(
    t_ns: Sequence[int] | Stamps, where: object, cure: Callable[[str], str], *, is_stated: bool = False
) -> None:
    """Refuse stamps whose usual interval no odometry has, because they are in another unit than they were read in.

    ``is_stated``: somebody said the unit, so that the size of the stamps is no reason to doubt it. Raises SourceError,
    naming the interval, the likely unit and what ``cure`` makes of that unit (of :data:`UNITS_NS`).
    """
    usual_ns = usual_interval(t_ns)
    if usual_ns is None:
        return
    is_like_us = not is_stated and likely_unit(str(max(t_ns))) == "us"
    if (_SHORTEST_AS_US_NS if is_like_us else _SHORTEST_NS) <= usual_ns <= _LONGEST_NS:
        return
    # Up to a second they are too short: read as nanoseconds. Else too long: read as seconds.
    limits = ((1e3, "ms"), (1e9, "us"), (3e12, "ms"), (1e15, "us"), (np.inf, "ns"))
    unit = next(name for limit, name in limits if usual_ns < limit)
    text = f"the stamps look like {_UNIT_NAMES[unit]}: as read, the usual interval is {usual_ns * 1e-9:.3g} s"
    raise SourceError(text, where=where, cure=cure(unit))


def tolerance_ns(seconds: float) -> int:
    """How far the stamps of a pair may be apart [ns]; SourceError unless they are 0 to 10 ``seconds``."""
    if not 0.0 <= seconds <= 10.0:
        raise SourceError(f"the stamps of a pair cannot differ by {seconds:g} s", cure="--pair-tolerance takes 0 to 10")
    return round(seconds * 1e9)


def match_nearest(
    left: list[tuple[int, str]], right: list[tuple[int, str]], tolerance_ns: int, report: SourceReport, where: object
) -> list[tuple[int, str, str]]:
    """(left stamp, left name, right name) of images each other's nearest and at most :func:`reach_ns` apart.

    In order of time. Images that stay alone are counted as missing, repeated stamps as duplicate. Raises SourceError
    where no image has a partner.
    """
    names = [_by_stamp(images, side, report) for images, side in ((left, "left"), (right, "right"))]
    t_left, t_right = (np.array(sorted(n), dtype=np.int64) for n in names)
    if len(t_left) == 0 or len(t_right) == 0:
        return []
    partner = _nearest(t_left, t_right)
    apart = np.abs(t_right[partner] - t_left)
    reach = reach_ns(tolerance_ns, t_left, t_right)
    paired = (apart <= reach) & (_nearest(t_right, t_left)[partner] == np.arange(len(t_left)))
    if not paired.any():
        raise no_pair(int(reach), int(apart.min()), where)
    for t in t_left[~paired]:
        report.count("missing", f"no right image for {t} ns")
    for t in np.delete(t_right, partner[paired]):
        report.count("missing", f"no left image for {t} ns")
    both = zip(t_left[paired].tolist(), t_right[partner[paired]].tolist(), strict=True)
    return [(a, names[0][a], names[1][b]) for a, b in both]


def reach_ns(tolerance_ns: int, left: Iterable[int], right: Iterable[int]) -> float:
    """How far the stamps of a pair may be apart: the tolerance, but no more than half the usual interval, as what is
    further off belongs to a neighbour whose partner was lost."""
    steps = steps_ns(left, right)
    return min(tolerance_ns, 0.5 * float(np.median(steps))) if len(steps) > 2 else tolerance_ns


def steps_ns(*cameras: Iterable[int]) -> Stamps:
    """Intervals (N,) between the stamps of each camera, whatever their order."""
    return np.concatenate([np.diff(np.unique(np.fromiter(t_ns, dtype=np.int64))) for t_ns in cameras])


def no_pair(tolerance_ns: int, nearest_ns: int, where: object) -> SourceError:
    """What to raise where both cameras have images and none of them belong together."""
    return SourceError(
        f"no pair within {tolerance_ns * 1e-6:g} ms; the nearest are {nearest_ns * 1e-6:.6g} ms apart",
        where=where,
        cure="put both cameras on one clock, or allow more with --pair-tolerance SECONDS",
    )


def _by_stamp(images: list[tuple[int, str]], side: str, report: SourceReport) -> dict[int, str]:
    """Name by stamp, the first of those that repeat."""
    names: dict[int, str] = {}
    for t_ns, name in images:
        if t_ns in names:
            report.count("duplicate", f"{side} stamp {t_ns} ns twice")
        else:
            names[t_ns] = name
    return names


def _nearest(t: Stamps, among: Stamps) -> NDArray[np.intp]:
    """Index of the nearest of the sorted stamps ``among``, for each of ``t``."""
    after = np.searchsorted(among, t).clip(max=len(among) - 1)
    before = (after - 1).clip(min=0)
    return np.where(np.abs(among[before] - t) <= np.abs(among[after] - t), before, after)
