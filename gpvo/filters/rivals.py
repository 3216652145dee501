"""Two timelines, of which one takes a clock to have been set: which of them do the motions speak for?"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from gpvo.filters.measurement import Gate, Innovation
from gpvo.filters.propagation import Nominal
from gpvo.types import Array

if TYPE_CHECKING:
    from gpvo.filters.timeline import Timeline

RARELY_SET = 14.0
"""Minus twice the log of one in a thousand: so seldom a clock is set where stamps jump."""
_MOST_OF_ONE = 10.0  # that one motion may say, which may be a slip
_ENOUGH, _OPEN_S, _MOST = 5, 10.0, 1000  # motions that tell; how long, and for how many records, both are followed


@dataclass(frozen=True)
class Step:
    """What one record did: ``outcome`` is ``used``, ``rejected``, ``lost``, ``start``, ``no_reference``,
    ``not_finite`` or ``no_covariance``; ``innovation`` is None where there was no measurement. ``nominal`` and
    ``covariance`` (B, 15, 15): the filter's after it."""

    t_ns: int
    outcome: str
    innovation: Innovation | None
    nominal: Nominal
    covariance: Array


@dataclass
class Rival:
    """A timeline that takes a clock to have been set ahead by ``set_ns``; its steps since; and by how much the motions
    speak for it (B,): the likelihood ratio's log, twice.

    ``alone`` counts motions that passed here, while there none passed but across missing samples.
    """

    line: Timeline
    set_ns: int
    since_ns: int
    guesses: tuple[int, int]
    steps: list[Step] = field(default_factory=list)
    favour: Array | float = 0.0
    alone: int = 0
    heard: int = 0

    def hear(self, its: list[Step], main: Timeline, steps: list[Step]) -> None:
        """Weigh what a record was here, and in the main timeline."""
        self.steps += its
        self.heard += 1
        before, self.guesses = self.guesses, (self.line.guesses, main.guesses)
        sound = [
            None if now > was or not done else done[0].innovation
            for now, was, done in zip(self.guesses, before, (its, steps), strict=True)
        ]
        here, there = sound
        if there is not None and there.passed.all():
            self.alone = -_ENOUGH
        elif here is not None:
            self.alone += bool(here.passed.all())
        if here is not None and there is not None:
            # What is only less sure is not likelier, nor what is only luckier; and one motion alone may be a slip.
            gain = np.minimum(there.nis - here.nis, there.surprise - here.surprise)
            self.favour = self.favour + np.clip(gain, -_MOST_OF_ONE, _MOST_OF_ONE)

    def has_won(self, gate: Gate) -> bool:
        """Whether motions say so, or go on saying so to this one alone."""
        alone = self.alone > _ENOUGH and self._age_s > gate.recover_after_s
        return alone or bool(np.min(self.favour) > RARELY_SET)

    def is_open(self) -> bool:
        """Whether it may still turn out to be right."""
        return bool(np.max(self.favour) > -RARELY_SET) and self._age_s < _OPEN_S and self.heard < _MOST

    @property
    def _age_s(self) -> float:
        return (self.line.t_ns - self.since_ns) * 1e-9
