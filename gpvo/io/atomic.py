"""Files written whole or not at all, and by one writer at a time."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.errors import SourceError

try:
    import fcntl
except ImportError:  # Windows: two writers there are not told of one another.
    fcntl = None  # type: ignore[assignment]


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to; at the end of the block it takes its place.

    If the block fails, what was written is removed, and ``path`` is as it was. No two writers share a name. Raises
    SourceError, naming ``path``, where the block or the replacement raises OSError: no folder, no right, no space.
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


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays as a packed ``.npz`` whole or not at all, in a folder made on the way."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


class FolderLock:
    """Held from its making to :meth:`release`, or to the end of the process, however that comes.

    ``path``: the folder, or with ``create`` a file that stands for ``where``. Raises SourceError where another process,
    or another writer of this one, holds it.
    """

    def __init__(self, path: Path, *, create: bool = False, where: Path | None = None) -> None:
        self._handle = -1
        if fcntl is None:
            return
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT if create else os.O_RDONLY)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.release()
            cure = "wait for it, or choose another folder with -o"
            raise SourceError("is being written by another process", where=where or path, cure=cure) from None

    def release(self) -> None:
        """Let others write; a second time does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
        self._handle = -1

    def __del__(self) -> None:
        self.release()
