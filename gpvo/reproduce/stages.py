"""Work kept between runs, in files named by the digest of what they were made from, each whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gpvo.errors import GpvoError, OutputError
from gpvo.files import FolderLock, make_folder, plain
from gpvo.parallel import map_jobs

Progress = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
_LENGTH = 12


def digest_of(*parts: Any) -> str:
    """Short SHA-256 of anything JSON can hold."""
    text = json.dumps(plain(list(parts)), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:_LENGTH]


@dataclass(frozen=True)
class Store:
    """A folder of stages: ``paths``, ``flights`` (on their way to odometry), ``runs``, ``models``, ``bounds`` and
    ``likelihoods``."""

    root: Path

    def folder(self, kind: str) -> Path:
        """The folder of one stage, made on first use."""
        return make_folder(self.root / "stages" / kind)


class Stage(Protocol):
    """Something to make once: a file whose name says what it is made from."""

    def path(self, store: Store) -> Path:
        """Where it lies. Names of runs and models hold the digests of what they were made from in turn."""

    def make(self, path: Path, store: Store) -> None:
        """Compute it and write it there, whole or not at all."""


def keep(stage: Stage, store: Store) -> Path:
    """Make a stage, unless it is there."""
    path = stage.path(store)
    if not path.is_file():
        stage.make(path, store)
    return path


@dataclass(frozen=True)
class Workers:
    """Where jobs run, and who is told of progress."""

    jobs: int = 1
    backend: str = "local"
    scheduler: str | None = None
    progress: Progress = lambda what, total: nullcontext(lambda: None)

    def map(self, what: str, function: Callable[..., Any], jobs: Iterable[Any], store: Store) -> list[Any]:
        """``function(job, store)`` of every job, in order."""
        listed = [(job, store) for job in jobs]
        with self.progress(what, len(listed)) as done:
            return map_jobs(
                function, listed, jobs=self.jobs, backend=self.backend, scheduler=self.scheduler, on_done=done
            )

    def keep(self, what: str, stages: Iterable[Stage], store: Store) -> None:
        """Make every stage, each once."""
        self.map(what, keep, dict.fromkeys(stages), store)


def only_user(root: Path) -> FolderLock:
    """Hold the folder, so that two reproductions never fill one. Raises GpvoError where another process has it."""
    folder = Store(root).folder(".")
    try:
        return FolderLock(folder)
    except OutputError:
        raise GpvoError("another reproduction is running here", where=root, cure="give another --out") from None
