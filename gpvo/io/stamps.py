"""Stamps: nanoseconds from text without rounding, matching of two cameras, and order in a running sequence."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from decimal import Decimal, InvalidOperation
from typing import Protocol, TypeVar

import numpy as np

from gpvo.io.source import SourceReport

GAP_FACTOR = 1.75
_WINDOW = 51


def seconds_text_to_ns(text: str) -> int:
    """Decimal seconds as written, to whole nanoseconds without passing through a float.

    Raises
    ------
    ValueError
        Where the text is no finite number, or not of the years 0 to 2262.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text}' is not a number") from None
    if not value.is_finite() or abs(value) > 9_200_000_000:
        raise ValueError(f"'{text}' is not a stamp in seconds")
    return int((value * 1_000_000_000).to_integral_value())


def ns_to_seconds_text(t_ns: int) -> str:
    """Nanoseconds as decimal seconds with nine digits."""
    sign, t = ("-", -int(t_ns)) if t_ns < 0 else ("", int(t_ns))
    return f"{sign}{t // 1_000_000_000}.{t % 1_000_000_000:09d}"


class _Stamped(Protocol):
    @property
    def t_ns(self) -> int: ...


F = TypeVar("F", bound=_Stamped)


def in_order(frames: Iterable[F], report: SourceReport) -> Iterator[F]:
    """The frames whose stamps grow; repeated and out-of-order stamps are dropped and counted, long gaps counted.

    Looks one frame ahead, so that a single stamp far in the future is dropped instead of everything behind it.
    """
    last: int | None = None
    pending: F | None = None
    intervals: deque[int] = deque(maxlen=_WINDOW)
    for frame in frames:
        if pending is None:
            pending = frame
        elif frame.t_ns == pending.t_ns:
            report.duplicate += 1
            report.note(f"stamp {frame.t_ns} ns twice")
        elif frame.t_ns < pending.t_ns:
            report.out_of_order += 1
            report.note(f"stamp {frame.t_ns} ns after {pending.t_ns} ns")
            if last is None or frame.t_ns > last:
                pending = frame
        else:
            _watch_gap(last, pending.t_ns, intervals, report)
            yield pending
            last, pending = pending.t_ns, frame
    if pending is not None:
        _watch_gap(last, pending.t_ns, intervals, report)
        yield pending


def _watch_gap(last: int | None, t_ns: int, intervals: deque[int], report: SourceReport) -> None:
    if last is None:
        return
    interval = t_ns - last
    if len(intervals) >= 3 and interval > GAP_FACTOR * float(np.median(intervals)):
        report.gaps += 1
        report.note(f"gap of {interval * 1e-9:.3f} s before {t_ns} ns")
    intervals.append(interval)


def match_equal(
    left: list[tuple[int, str]], right: list[tuple[int, str]], report: SourceReport
) -> Iterator[tuple[int, str, str]]:
    """Pairs of (stamp, name) lists by equal stamp, in the order of the left list.

    Stamps that one camera alone has are counted as missing, repeated ones as duplicate; order is judged later, when
    the frames run.
    """
    by_stamp: dict[int, str] = {}
    for t_ns, name in right:
        if t_ns in by_stamp:
            report.duplicate += 1
            report.note(f"right stamp {t_ns} ns twice")
        else:
            by_stamp[t_ns] = name
    seen: set[int] = set()
    for t_ns, name in left:
        if t_ns in seen:
            report.duplicate += 1
            report.note(f"left stamp {t_ns} ns twice")
            continue
        seen.add(t_ns)
        if t_ns in by_stamp:
            yield t_ns, name, by_stamp[t_ns]
        else:
            report.missing += 1
            report.note(f"no right image for {t_ns} ns")
    for t_ns in by_stamp.keys() - seen:
        report.missing += 1
        report.note(f"no left image for {t_ns} ns")
