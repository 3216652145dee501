"""A recording as a live source: its messages at their own pace, or as fast as they can be taken."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from gpvo.errors import SourceError
from gpvo.io.bag_reader import ODOMETRY_TYPE, POSE_TYPES, open_bag, topics_of
from gpvo.live.intake import Arrival
from gpvo.live.outputs import POSE

_LONGEST_WAIT_S = 0.1


def replay(path: Path, topics: Iterable[str], stop: threading.Event, *, fast: bool = False) -> Iterator[Arrival]:
    """Messages of the named topics until ``stop``; they arrive when they were recorded.

    Raises
    ------
    SourceError
        Where the bag cannot be read or lacks a topic.
    """
    wanted = set(topics)
    start, first = time.monotonic_ns(), None
    with open_bag(path) as reader:
        absent = sorted(wanted - set(reader.topics))
        if absent:
            found = ", ".join(sorted(reader.topics))
            raise SourceError(f"has no topic {', '.join(absent)} (there are: {found})", where=path)
        connections = [c for c in reader.connections if c.topic in wanted]
        for connection, recorded_ns, raw in reader.messages(connections=connections):
            first = recorded_ns if first is None else first
            due_ns = recorded_ns if fast else start + recorded_ns - first
            while not fast and not stop.is_set() and (ahead_s := (due_ns - time.monotonic_ns()) * 1e-9) > 0:
                time.sleep(min(ahead_s, _LONGEST_WAIT_S))
            if stop.is_set():
                return
            yield Arrival(connection.topic, reader.deserialize(raw, connection.msgtype), due_ns)


def odometry_topic(path: Path) -> str:
    """The only odometry of a bag. SourceError where there is none, or a choice."""
    with open_bag(path) as reader:
        found = list(topics_of(reader, (ODOMETRY_TYPE,))) or list(topics_of(reader, (POSE,)))
        poses = list(topics_of(reader, POSE_TYPES))
    if len(found) != 1:
        listed = ", ".join(found or poses) or "none"
        raise SourceError(f"which odometry? (topics with poses: {listed})", where=path, cure="name it with --odometry")
    return found[0]
