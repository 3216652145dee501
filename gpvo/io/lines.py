"""Lines of text files, none of them longer than a line can be."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gpvo.errors import SourceError

_MAX_BYTES = 2_000_000_000
_MAX_CHARACTERS = 1_000_000


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbers from 1 and text of the lines of a file, without blanks around them; empty ones are left out.

    Raises
    ------
    SourceError
        Where the file cannot be read, is larger than 2 GB, or has a line of more than a million characters.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError("is larger than 2 GB: no log", where=path)
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            number = 0
            while line := file.readline(_MAX_CHARACTERS + 1):
                number += 1
                if len(line) > _MAX_CHARACTERS:
                    raise SourceError(f"line {number} is longer than a million characters", where=path)
                if text := line.strip().removeprefix("\ufeff"):
                    yield number, text
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from None
