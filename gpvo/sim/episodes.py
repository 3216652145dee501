"""Episodes in which seeing goes wrong: when, for how long, and by what cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Episode:
    """From ``begin_s`` to ``end_s``. The factors say what the cause does to pixel noise, number of tracks and outliers
    where no images are drawn: together they raise the standard deviation of VO's error about tenfold."""

    begin_s: float
    end_s: float
    cause: str
    sigma_factor: float = 1.0
    count_factor: float = 1.0
    outlier_factor: float = 1.0


# Factors on (pixel noise, number of tracks, outliers): error grows with noise and with the root of the number.
CAUSES: dict[str, tuple[float, float, float]] = {
    "darkness": (2.8, 0.22, 3.0),
    "dust": (2.6, 0.20, 4.0),
    "motion_blur": (3.6, 0.35, 3.0),
    "bare_wall": (2.3, 0.15, 2.0),
    "image_noise": (3.8, 0.40, 4.0),
}


def draw_episodes(
    duration_s: float,
    rng: np.random.Generator,
    share: float = 0.2,
    rest_s: float = 4.0,
    causes: Sequence[str] = tuple(CAUSES),
) -> tuple[Episode, ...]:
    """Episodes of 2 to 5 s that fill ``share`` of the flight, none during the rest at its start, none touching
    another, each with one of the ``causes``."""
    lengths: list[float] = []
    while sum(lengths) < share * duration_s - 1.0:
        lengths.append(min(rng.uniform(2.0, 5.0), max(share * duration_s - sum(lengths), 2.0)))
    free = duration_s - rest_s - sum(lengths) - 0.5 * len(lengths)
    if free <= 0:
        return ()
    gaps = rng.dirichlet(np.ones(len(lengths) + 1)) * free
    out, t = [], rest_s
    for gap, length in zip(gaps[:-1], lengths, strict=True):
        cause = str(rng.choice(list(causes)))
        t += gap
        out.append(Episode(t, t + length, cause, *CAUSES[cause]))
        t += length + 0.5
    return tuple(out)
