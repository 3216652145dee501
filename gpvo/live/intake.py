"""Messages as they come in, from a transport or a recording: how a stamp continues those before, what waits, and when
each arrived.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from math import inf
from pathlib import Path
from statistics import median
from typing import Any

from gpvo.errors import SourceError
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPE, POSE_TYPES, open_bag, raw_messages, topics_of
from gpvo.io.stamps import END_OF_ROS_NS
from gpvo.io.stated import GAP_STEPS
from gpvo.stats.series import Doubt

BACK_S = 1.0
"""A stamp further back than this is no late message but another clock, if the next ones agree."""
AHEAD_S = 10.0
"""The same of a stamp ahead of the last: after so long a silence nothing of before holds."""
CONFIRM = 3
"""Messages in a row by which what looked wrong is believed."""
_WINDOW = 51
_LONGEST_WAIT_S, _TIMEOUT_S = 0.1, 0.2


@dataclass(frozen=True)
class Arrival:
    """One message: its topic, itself (the attributes of the ROS type) and when it came, on a clock that only grows."""

    topic: str
    message: Any
    received_ns: int


class Sequence(Enum):
    """How a stamp continues those before it."""

    FIRST = "first"
    NEXT = "next"
    GAP = "gap"
    RESTART = "restart"
    REPEATED = "repeated"
    LATE = "late"
    CLOCK = "clock"

    @property
    def dropped(self) -> bool:
        """Whether the message is not used."""
        return self in (Sequence.REPEATED, Sequence.LATE, Sequence.CLOCK)


class StampWatch:
    """Judges stamps [ns] as they come.

    A jump of the clock, back by more than a second or ahead by more than ten, is believed when three messages in a row
    agree on it: one corrupt stamp costs one message, a source that starts again three. Three gaps in a row are a lower
    rate.
    """

    def __init__(self) -> None:
        self._last: int | None = None
        self._doubt: Doubt[int] = Doubt(CONFIRM)
        self._steps: deque[int] = deque(maxlen=_WINDOW)
        self._gaps: list[int] = []

    def see(self, t_ns: int) -> Sequence:
        """What the next stamp is. One that no ROS message can hold is of another clock."""
        if not 0 <= t_ns < END_OF_ROS_NS:
            return Sequence.CLOCK
        if self._last is None:
            self._last = t_ns
            return Sequence.FIRST
        step = t_ns - self._last
        if -BACK_S * 1e9 <= step <= AHEAD_S * 1e9:
            self._doubt.clear()
            if step <= 0:
                return Sequence.LATE if step else Sequence.REPEATED
            return self._advance(t_ns, step)
        if not self._doubt.is_settled_by(t_ns, lambda before_ns, now_ns: 0 < now_ns - before_ns <= AHEAD_S * 1e9):
            return Sequence.CLOCK
        self._last = t_ns
        self._steps.clear()
        return Sequence.RESTART

    def _advance(self, t_ns: int, step: int) -> Sequence:
        usual = median(self._steps) if len(self._steps) >= 3 else inf
        self._last = t_ns
        if step <= GAP_STEPS * usual:
            self._gaps.clear()
            self._steps.append(step)
            return Sequence.NEXT
        self._gaps.append(step)
        if len(self._gaps) >= CONFIRM:
            # Not gaps: this is the rate now.
            self._steps = deque(self._gaps, maxlen=_WINDOW)
            self._gaps.clear()
        return Sequence.GAP


class Mailbox:
    """Raw messages between a transport's threads and the engine's; of a full lane (topic) the oldest is dropped.

    ``dropped``: how many, by topic, since it was opened. ``put`` never waits.
    """

    def __init__(self, depth: int = 10) -> None:
        self._lanes: dict[str, deque[tuple[int, str, bytes]]] = {}
        self._depth = depth
        self._ready = threading.Condition()
        self._is_open = True
        self.dropped: Counter[str] = Counter()

    def close(self) -> None:
        """From here on, what comes is ignored, and not counted as dropped."""
        self._is_open = False

    def open(self, keep: Container[str] = ()) -> None:
        """Forget what came while it was closed, but for the lanes ``keep``."""
        with self._ready:
            for topic in [] if self._is_open else [t for t in self._lanes if t not in keep]:
                self._lanes[topic].clear()
            self._is_open = True

    def put(self, topic: str, data: bytes, depth: int | None = None) -> None:
        """Add a message that has just arrived."""
        with self._ready:
            lane = self._lanes.setdefault(topic, deque())
            if len(lane) >= (depth or self._depth):
                lane.popleft()
                self.dropped[topic] += self._is_open
            lane.append((time.monotonic_ns(), topic, data))
            self._ready.notify()

    def get(self, timeout_s: float) -> tuple[int, str, bytes] | None:
        """The oldest message of all lanes: arrival [ns], topic, bytes; None where none came in time."""
        with self._ready:
            if not any(self._lanes.values()):
                self._ready.wait(timeout_s)
            lanes = [lane for lane in self._lanes.values() if lane]
            return min(lanes, key=lambda lane: lane[0][0]).popleft() if lanes else None


def arrivals(
    mailbox: Mailbox, decode: Callable[[str, bytes], Any], stop: threading.Event, counts: Counter[str]
) -> Iterator[Arrival | None]:
    """Decoded messages until ``stop``; None where nothing came for 0.2 s. What cannot be decoded is counted."""
    while not stop.is_set():
        raw = mailbox.get(_TIMEOUT_S)
        if raw is None:
            yield None
            continue
        received_ns, topic, data = raw
        if (message := _decoded(decode, topic, data, counts)) is not None:
            yield Arrival(topic, message, received_ns)


def _decoded(decode: Callable[[str, bytes], Any], which: str, data: bytes, counts: Counter[str]) -> Any:
    try:
        return decode(which, data)
    except Exception:  # whatever a decoder of foreign bytes raises: index, struct, unicode, assertion
        counts["undecodable"] += 1
        return None


def replay(
    path: Path, topics: Iterable[str], stop: threading.Event, counts: Counter[str] | None = None, *, fast: bool = False
) -> Iterator[Arrival]:
    """Messages of the named topics until ``stop``; they arrive when they were recorded. What cannot be decoded is
    counted.

    Raises SourceError where the bag cannot be read or lacks a topic.
    """
    wanted = set(topics)
    start, first, counts = time.monotonic_ns(), None, Counter() if counts is None else counts
    with open_bag(path) as reader:
        absent = sorted(wanted - set(reader.topics))
        if absent:
            found = ", ".join(sorted(reader.topics))
            raise SourceError(f"has no topic {', '.join(absent)} (there are: {found})", where=path)
        for connection, recorded_ns, raw in raw_messages(reader, wanted):
            first = recorded_ns if first is None else first
            due_ns = recorded_ns if fast else start + recorded_ns - first
            while not fast and not stop.is_set() and (ahead_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
                time.sleep(min(ahead_s, _LONGEST_WAIT_S))
            if stop.is_set():
                return
            message = _decoded(lambda kind, data: reader.deserialize(data, kind), connection.msgtype, raw, counts)
            if message is not None:
                yield Arrival(connection.topic, message, due_ns)


def odometry_topic(path: Path) -> str:
    """The only odometry of a bag. SourceError where there is none, or a choice."""
    with open_bag(path) as reader:
        found = list(topics_of(reader, (ODOMETRY_TYPE,))) or list(topics_of(reader, (POSE_TYPE,)))
        poses = list(topics_of(reader, POSE_TYPES))
    if len(found) != 1:
        listed = ", ".join(found or poses) or "none"
        raise SourceError(f"which odometry? (topics with poses: {listed})", where=path, cure="name it with --odometry")
    return found[0]
