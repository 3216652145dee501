"""``gpvo doctor``: recordings and live topics, examined by :mod:`gpvo.live.doctor`."""

from __future__ import annotations

import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from gpvo.errors import GpvoError, SourceError
from gpvo.io.bag_reader import POSE_TYPES, is_bag, messages, open_bag, topics_of
from gpvo.live.doctor import examine
from gpvo.live.intake import Mailbox, arrivals
from gpvo.live.job import WIRES, open_wire
from gpvo.live.outputs import decode
from gpvo.live.stated import Finding, Stated

_DEPTH = 10_000


def examine_bag(path: Path, topic: str | None = None) -> dict[str, list[Finding]]:
    """Findings of a topic, or of every topic that holds poses.

    Raises
    ------
    SourceError
        Where the path is no bag, or has no such topic.
    """
    if not path.exists() or not is_bag(path):
        raise SourceError("is not a bag", where=path, cure=f"for a running topic add --{', --'.join(WIRES)}")
    with open_bag(path) as reader:
        found = list(topics_of(reader, POSE_TYPES))
        if not found or (topic is not None and topic not in found):
            raise SourceError(f"has no poses on '{topic or ''}' (poses on: {', '.join(found) or 'none'})", where=path)
        wanted = found if topic is None else [topic]
        return {t: examine(Stated.of((m for _, m in messages(reader, [t])), path)) for t in wanted}


def examine_topic(
    wire: str, topic: str, msgtype: str, seconds: float, address: str | None = None, domain: int = 0
) -> list[Finding]:
    """Findings about what a running system publishes within ``seconds``. GpvoError if nothing is received."""
    link, mailbox, stop = open_wire(wire, address, domain), Mailbox(_DEPTH), threading.Event()
    kept: list[Any] = []
    try:
        link.subscribe(topic, msgtype, lambda name, data: mailbox.put(name, data))
        end_s = time.monotonic() + seconds
        for arrival in arrivals(mailbox, lambda _, data: decode(link, data, msgtype), stop, Counter()):
            kept += [] if arrival is None else [arrival.message]
            if time.monotonic() > end_s:
                break
    finally:
        link.close()
    if not kept:
        raise GpvoError(f"nothing received on '{topic}' in {seconds:g} s", cure="is it published, and of that type?")
    return examine(Stated.of(kept))
