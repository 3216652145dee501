"""One writer of a folder or file at a time."""

from __future__ import annotations

import os
from pathlib import Path

from gpvo.errors import SourceError

try:
    import fcntl
except ImportError:  # Windows: two writers there are not told of one another.
    fcntl = None  # type: ignore[assignment]


class FolderLock:
    """Held from its making to :meth:`release`, or to the end of the process, however that comes.

    ``path``: the folder, or with ``create`` a file that stands for ``where``.

    Raises
    ------
    SourceError
        Where another process, or another writer of this one, holds it.
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
            raise SourceError("is being written by somebody else", where=where or path, cure=cure) from None

    def release(self) -> None:
        """Let others write; a second time does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
        self._handle = -1

    def __del__(self) -> None:
        self.release()
