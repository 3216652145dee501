"""Speed and memory, as ratios within one run: ``python -m bench``."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

Rows = dict[str, dict[str, Any]]
"""Results by name, as ``bench.json`` holds them."""


def row(
    value: float, unit: str, peer: str | None = None, peer_value: float | None = None, *, smaller_wins: bool = False
) -> dict[str, Any]:
    """One result; ``ratio``: its value over that of the peer (or limit), or with ``smaller_wins`` the inverse."""
    ratio = None
    if peer_value is not None:
        ratio = peer_value / value if smaller_wins else value / peer_value
    return {"value": value, "unit": unit, "peer": peer, "peer_value": peer_value, "ratio": ratio}


def median_s(
    call: Callable[[int], object], repeats: int, *, warm_up: int = 0, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Median time [s] of ``call(k)`` for k = 0, 1, ..., of which the first ``warm_up`` do not count."""
    spent = []
    for k in range(warm_up + repeats):
        begin = clock()
        call(k)
        spent.append(clock() - begin)
    return float(np.median(spent[warm_up:]))
