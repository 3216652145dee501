"""When to believe what looks odd beside all before it: a jump of a clock, or of a reading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

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
