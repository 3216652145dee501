"""Taking records in: what cannot be is ``lost``, by name, and leaves no trace in what is remembered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np

from gpvo.types import Array, Status, VoRecord

LONGEST_STEP_S = 60.0
"""A record that comes later than this after the one before is believed when the next one confirms its clock."""
_LONGEST_STEP_NS = round(LONGEST_STEP_S * 1e9)
_FARTHEST_M = 1e5  # No motion between two frames is longer.
_NOT_RIGID = 1e-3  # Deviation of R^T R from the identity.
_EYE = np.eye(4)
_EYE.setflags(write=False)
T = TypeVar("T")


class Doubt(Generic[T]):
    """Holds what looks odd beside all before, a jump of a clock or of a reading, until ``enough`` in a row agree."""

    def __init__(self, enough: int = 2) -> None:
        self._enough, self._count = enough, 0
        self._last: T | None = None

    def is_settled_by(self, odd: T, agrees: Callable[[T, T], bool]) -> bool:
        """Whether the next odd one is to be believed; ``agrees`` says whether it goes with the odd one before it."""
        self._count = self._count + 1 if self._last is not None and agrees(self._last, odd) else 1
        self._last = odd
        if self._count < self._enough:
            return False
        self.clear()
        return True

    def clear(self) -> None:
        """What came now is not odd."""
        self._count, self._last = 0, None


class Intake:
    """Judges the stamps and the motion of one record after the other, in the order of their arrival.

    A record whose stamp repeats, goes back or jumps ahead is ``lost``, and the next one is judged by the record before
    it; where that next one follows the odd one, the clock itself was set, and is believed. A motion that is not finite
    and rigid is replaced by none.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._doubt: Doubt[int] = Doubt()

    def step(self, record: VoRecord) -> VoRecord:
        """The record, ``lost`` with the reason where it cannot be. Call once per record."""
        problem = self._clock(record)
        if not _is_motion(record.T_prev_cur):
            record = replace(record, T_prev_cur=_EYE)
            problem = problem or "the motion is not finite and rigid"
        return record.with_status(Status.LOST, problem) if problem else record

    def _clock(self, record: VoRecord) -> str:
        t_ns, last_ns = record.t_ns, self._last_ns
        if (
            last_ns is not None
            and record.status is not Status.START
            and not (follows(last_ns, t_ns) or self._doubt.is_settled_by(t_ns, follows))
        ):
            step_s = (t_ns - last_ns) * 1e-9
            return "the stamp repeats" if step_s == 0 else f"the stamp jumps by {step_s:+.3g} s"
        self._last_ns = t_ns
        self._doubt.clear()
        if record.usable and record.t_prev_ns >= t_ns:
            return "the motion ends no later than it begins"
        return ""


def follows(before_ns: int, t_ns: int) -> bool:
    """Whether a stamp comes after the one before, and not too long after."""
    return 0 < t_ns - before_ns <= _LONGEST_STEP_NS


def _is_motion(T: Array) -> bool:
    """Whether T is a rigid transform (4, 4) of a credible length."""
    # Comparisons with NaN are false.
    if T.shape != (4, 4) or not np.abs(T).max() < _FARTHEST_M:
        return False
    R = T[:3, :3]
    return bool(np.abs(R.T @ R - _EYE[:3, :3]).max() < _NOT_RIGID)
