"""Files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gpvo.errors import SourceError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; at the end of the block it takes its place.

    If the block fails, what was written is removed, and ``path`` is as it was. No two writers share a name.

    Raises
    ------
    SourceError
        Naming ``path``, where the block or the replacement raises OSError: no folder, no right, no space.
    """
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            reason = error.strerror or (str(error).splitlines() or ["the disk refuses"])[-1]
            raise SourceError(f"cannot be written: {reason}", where=path) from None
        raise


def write_text(path: Path, text: str, encoding: str = "utf-8") -> None:
    """Write a text file whole or not at all; lines end as in ``text``. Raises as :func:`replacing`."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding=encoding)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
