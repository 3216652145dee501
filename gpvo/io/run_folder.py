"""A run folder while it is written: one writer, complete at the end, resumable after an interruption."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpvo.errors import OutputError, SourceError
from gpvo.files import FolderLock, make_folder, read_json
from gpvo.io import run_table
from gpvo.io.parquet import RowGroup, placed_columns, read_columns
from gpvo.io.run_read import check_log
from gpvo.io.snapshot import load_snapshot
from gpvo.types import StoredRecords, VoLog

FILES = (
    "vo_log.parquet", "trajectory.tum", "rig.json", "truth.parquet", "imu.parquet", "predictions.parquet",
    "tracks.parquet",
)  # fmt: skip
OWN = (*FILES, "config.toml", "run.json", "calibration_state.json")
"""All files of a run; its folder may hold others."""
STATE = "state.npz"
"""In the folder of the chunks: how many there are, and where what made them stood."""


@dataclass(frozen=True)
class Kept:
    """What a run that broke off left: its records up to the last chunk whose state was kept, the chunks' tables by
    kind, and that state."""

    records: StoredRecords
    parts: dict[str, list[RowGroup]]
    state: Any


def take_up(chunks: Path, key: str) -> Kept | None:
    """What was kept under the same key; None where there is nothing of it, or nothing whole. Later chunks go."""
    found = load_snapshot(chunks / STATE, key)
    try:
        count, state = found
        parts = {kind: sorted(chunks.glob(f"{kind}_*.parquet")) for kind in run_table.COLUMNS_OF}
        late = [p for paths in parts.values() for p in paths if int(p.stem.rpartition("_")[2]) >= count]
        kept = {kind: [p for p in paths if p not in late] for kind, paths in parts.items() if paths}
        records = StoredRecords.join([run_table.records_from(read_columns(path)[0]) for path in kept["log"]])
        check_log(VoLog(records), chunks)
        groups = {kind: [placed_columns(path) for path in paths] for kind, paths in kept.items()}
        whole = len(kept["log"]) == count and all(len(g) in (0, count) for g in groups.values())
    # No state, one of other settings or another version, a damaged chunk, or no library that reads it.
    except (SourceError, ImportError, TypeError, ValueError, KeyError):
        return None
    for path in late:
        path.unlink()
    return Kept(records, groups, state) if whole else None


def is_finished(path: Path) -> bool:
    """Whether a folder holds a run that was written to its end."""
    try:
        return read_json(path / "run.json").get("complete") is True
    except SourceError:
        return False


def beside(path: str | Path, overwrite: bool) -> Path:
    """Where a new run is written that is to replace a finished one. Raises SourceError where it may not."""
    if not overwrite:
        raise SourceError("holds a finished run", where=path, cure="give --overwrite, or another folder with -o")
    target = Path(path).resolve()
    return target.with_name(f".{target.name}.new")


def claim(path: Path) -> FolderLock:
    """Make the folder, for one writer."""
    if path.exists() and not path.is_dir():
        raise SourceError("is a file, not a folder for a run", where=path)
    return FolderLock(make_folder(path))


def put_in_place(new: Path, target: Path) -> None:
    """Exchange a folder for a newer one, in one step where the system can: else ``target`` is missing for a moment.
    What else lay in it than a run stays."""
    old = new if _exchanged(new, target) else target.with_name(f".{target.name}.old")
    try:
        if old is not new:
            os.replace(target, old)
            os.replace(new, target)
        clear(old)
        for other in old.iterdir():
            os.replace(other, target / other.name)
    except OSError as error:
        raise OutputError(f"cannot be replaced: {error.strerror}; run the command again", where=target) from None
    discard(old)


def clear(path: Path, *, keep_chunks: bool = False) -> None:
    """Remove a run, whole or not, and no other file. Raises OSError where that is not possible."""
    if not keep_chunks:
        shutil.rmtree(path / "chunks", ignore_errors=True)
    for file in (*path.glob(".*.part"), *(path / name for name in OWN)):
        file.unlink(missing_ok=True)


def discard(path: Path) -> None:
    """The same, with its folder if that holds no more, as far as possible."""
    with suppress(OSError):
        clear(path)
        path.rmdir()


def _exchanged(one: Path, other: Path) -> bool:
    """Whether two folders have changed places, which Linux does in one step on most file systems."""
    swap = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    at, flag = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return swap is not None and swap(at, os.fsencode(one), at, os.fsencode(other), flag) == 0


def prepare(path: Path, *, keep_chunks: bool) -> None:
    """Make the folder; clear an older run of exactly the files that a run has."""
    try:
        make_folder(path)
        present = {p.name for p in path.iterdir()} - {p.name for p in path.glob(".*.part")}
        if present and "run.json" not in present:
            raise SourceError("holds something that is not a run", where=path, cure="choose an empty folder with -o")
        clear(path, keep_chunks=keep_chunks)
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", where=path) from None
