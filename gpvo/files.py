"""Files written whole or not at all, by one writer at a time: JSON without NaN, settings as TOML, tables as CSV."""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import math
import os
import re
import stat
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gpvo.errors import GpvoError, OutputError, SourceError, printable

if TYPE_CHECKING:
    from jinja2 import Environment

try:
    import fcntl
except ImportError:  # Windows: two writers there are not told of one another.
    fcntl = None  # type: ignore[assignment]

_MAX_BYTES = 50_000_000
_MAX_TOML_BYTES = 200_000
_STEP_BYTES = 1 << 20
_AT_ONCE: int = getattr(os, "O_NONBLOCK", 0)  # Windows has no pipes among its files
_BARE = re.compile(r"[A-Za-z0-9_-]+")
Own = tuple[bytes, str]
"""A pattern that every file of a kind bears, if gpvo wrote it, and what to call the kind."""


class TooLarge(Exception):
    """A file, or a part of one, is longer than anything that may stand in its place."""


def at_once(path: str, flags: int) -> int:
    """An ``opener`` of ``open``, for reading: a pipe that nobody writes to is empty instead of waited for. Raises
    OSError for a device, which may have no end, or wait for someone to type."""
    handle = os.open(path, flags | _AT_ONCE)
    if stat.S_ISCHR(mode := os.fstat(handle).st_mode) or stat.S_ISBLK(mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "it is a device, not a file")
    if _AT_ONCE:
        os.set_blocking(handle, True)  # one that somebody writes to may be slow
    return handle


def read_bounded(path: Path, most: int, beyond: str, kind: type[GpvoError] = SourceError) -> bytes:
    """All of a file or pipe. Raises an error of the ``kind`` where it cannot be read, or holds more than ``most``
    bytes, which is said as ``beyond``."""
    data = bytearray()
    try:
        with open(path, "rb", opener=at_once) as file:
            while part := file.read(_STEP_BYTES):  # read(most) would allocate all of it at once
                data += part
                if len(data) > most:
                    raise kind(beyond, where=path)
    except OSError as error:
        raise kind(f"cannot be read: {error.strerror}", where=path) from None
    return bytes(data)


@contextmanager
def replacing(path: Path, own: Own | None = None) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to, in a folder made on the way; at the end of the block it takes its
    place.

    If the block fails, what was written is removed, and ``path`` is as it was. No two writers share a temporary path;
    one that a killed process left is taken over. Raises OutputError, naming ``path``, where it is not of its ``own``
    kind (:func:`refuse_foreign`), or the block or the replacement raises OSError: no right, no space.
    """
    temporary, handle = None, -1
    refuse_foreign(path, *own or (b"", "file"))
    make_folder(path.parent)
    try:
        handle, temporary = _part(path)
        yield temporary
        os.umask(mask := os.umask(0))  # which cannot be asked for otherwise
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            reason = error.strerror or (str(error).splitlines() or ["the disk refuses"])[-1]
            raise OutputError(f"cannot be written: {reason}", where=path) from None
        raise
    finally:
        if handle >= 0:
            os.close(handle)


def _part(path: Path) -> tuple[int, Path]:
    """An empty file beside ``path``, and the handle that keeps it from other writers: always of one name, so that
    processes that are killed leave no more than one; or of a new one, which needs no handle (-1), where that is in use
    or cannot be locked."""
    part = path.with_name(f".{path.name}.part")
    if fcntl is not None:
        handle = -1
        try:
            handle = os.open(part, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(part)):  # else a writer put it in place before it was locked
                os.fchmod(handle, 0o600)  # nobody else's
                os.ftruncate(handle, 0)
                return handle, part
        except OSError as error:  # mkstemp tells, if it is no matter of this one name
            if handle >= 0 and not isinstance(error, (BlockingIOError, PermissionError)):
                part.unlink(missing_ok=True)  # nothing can be locked on this disk
        if handle >= 0:
            os.close(handle)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    os.close(handle)  # Windows replaces no open file
    return -1, Path(name)


def refuse_foreign(path: Path, mark: bytes, what: str) -> None:
    """Raise OutputError, as well before the work as at its end, where no ``what`` can be written to ``path``.

    It is a folder, a device or a pipe; or its folder can be neither made nor written to; or it is a file without the
    ``mark``, a pattern that every ``what`` of gpvo matches in its first or last megabyte: somebody's, which no output
    replaces. An empty file is nobody's.
    """
    if path.is_dir():
        raise OutputError("is a folder", where=path, cure="name a file")
    if path.exists() and not path.is_file():
        raise OutputError("cannot be written: it is a device or a pipe, not a file", where=path)
    refuse_folder(path.parent, path)
    if not mark or not path.is_file():
        return
    try:
        with path.open("rb") as file:
            ends = file.read(_STEP_BYTES)
            file.seek(max(0, os.fstat(file.fileno()).st_size - _STEP_BYTES))
            ends += file.read()
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}", where=path) from None
    if ends.strip() and not re.search(mark, ends, re.DOTALL):
        raise OutputError(f"is another file, not an earlier {what}", where=path, cure="choose another name")


def refuse_folder(path: Path | None, file: Path | None = None) -> None:
    """Raise OutputError, before the work, where nothing, or not the ``file``, can be written into a folder, made if it
    is missing."""
    if path is None:
        return
    folder = next((p for p in (path, *path.parents) if p.exists()), path)
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        reason = "may not be written to" if folder.is_dir() else "is no folder"
        cure = "choose a writable folder" if file is None else "name a file in a writable folder"
        raise OutputError(f"cannot be written: {folder} {reason}", where=file or path, cure=cure)


def make_folder(path: Path) -> Path:
    """The folder, made with those above it where it is missing. Raises OutputError where it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", where=path) from None
    return path


def write_text(path: Path, text: str, encoding: str = "utf-8", own: Own | None = None) -> None:
    """Write a text file whole or not at all; lines end as in ``text``. Raises as :func:`replacing`."""
    with replacing(path, own) as temporary:
        temporary.write_bytes(text.encode(encoding))


def write_arrays(path: Path, arrays: Mapping[str, Any], own: Own | None = None) -> None:
    """Write named arrays as a packed ``.npz`` whole or not at all. Raises as :func:`replacing`."""
    with replacing(path, own) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})


def digest_of_file(path: Path) -> str:
    """SHA-256 of a file, which may not fit into memory: the tracks of a long run."""
    sha = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_STEP_BYTES):
            sha.update(block)
    return sha.hexdigest()


class FolderLock:
    """Held from its making to :meth:`release`, the end of its ``with`` block, or that of the process, however it comes.

    ``path``: the folder, or with ``create`` a file that stands for ``where``. Raises OutputError where another process,
    or another writer of this one, holds it, or it cannot be opened.
    """

    def __init__(self, path: Path, *, create: bool = False, where: Path | None = None) -> None:
        self._handle = -1
        if fcntl is None:
            return
        try:
            self._handle = os.open(path, os.O_RDWR | os.O_CREAT if create else os.O_RDONLY)
        except OSError as error:
            raise OutputError(f"cannot be written: {error.strerror}", where=where or path) from None
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.release()
            if not isinstance(error, BlockingIOError | PermissionError):
                return  # a file system that knows no locks, as a network's may be: as on Windows
            cure = "wait for it, or choose another folder with -o"
            raise OutputError("is being written by another process", where=where or path, cure=cure) from None

    def holds(self, path: Path) -> bool:
        """Whether ``path`` is locked by this: not where there are no locks, nor what was removed meanwhile."""
        return self._handle >= 0 and os.path.samestat(os.fstat(self._handle), path.lstat())

    def release(self) -> None:
        """Let others write; a second time does nothing."""
        if self._handle >= 0:
            os.close(self._handle)
        self._handle = -1

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def __del__(self) -> None:
        self.release()


def plain(value: Any, other: Callable[[Any], Any] = str) -> Any:
    """A value as JSON knows it: arrays as lists, NaN and infinity as null; ``other``: what becomes of the rest, by
    default its text, as of paths and enums."""
    kind = type(value)  # most are of these, and to ask for a Mapping first would take twice as long
    if value is None or kind is str or kind is int or (kind is float and math.isfinite(value)):
        return value
    if isinstance(value, Mapping):
        return {str(k): plain(v, other) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), other)
    if isinstance(value, (list, tuple)):
        return [plain(v, other) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, str) else other(value)


def write_json(path: Path, document: Mapping[str, Any], own: Own | None = None) -> None:
    """Write a document under a temporary name, then put it in place."""
    write_text(path, json.dumps(plain(document), indent=1, allow_nan=False) + "\n", own=own)


def read_json(path: Path, *, as_is: Collection[str] = ()) -> dict[str, Any]:
    """Read a document, its texts without what a terminal would obey, but for what stands under the keys ``as_is``, such
    as paths. Raises SourceError where the file is missing, too large, or not a JSON object."""
    try:
        document = parse_json(read_bounded(path, _MAX_BYTES, "is larger than 50 MB").decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise SourceError(f"is damaged: {str(error).splitlines()[0]}", where=path) from None
    if not isinstance(document, dict):
        raise SourceError("is damaged: no JSON object", where=path)
    return {printable(k): v if k in as_is else printable_document(v) for k, v in document.items()}


def printable_document(value: Any) -> Any:
    """The same document, without text that a terminal would obey."""
    if isinstance(value, dict):
        return {printable(k): printable_document(v) for k, v in value.items()}
    if isinstance(value, list):
        return [printable_document(v) for v in value]
    return printable(value) if isinstance(value, str) else value


def parse_json(text: str) -> Any:
    """What a text of JSON says. Raises ValueError where it is none, or a number is not finite or beyond 64 bits."""
    return json.loads(text, parse_constant=_number, parse_float=_number, parse_int=_whole)


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a JSON number")
    return value


def _whole(text: str) -> int:
    if len(text) > 20:  # of 64 bits: a longer one overflows where it becomes a float
        raise ValueError(f"{text[:20]}... is not a JSON number")
    return int(text)


def read_toml(path: Path) -> dict[str, Any]:
    """Settings of a file. Raises GpvoError where it cannot be read."""
    data = read_bounded(path, _MAX_TOML_BYTES, "is larger than 200 kB, too large for settings", GpvoError)
    try:
        return parse_toml(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as problem:
        raise GpvoError(f"cannot be read as TOML: {problem}", where=path) from None


def parse_toml(text: str) -> dict[str, Any]:
    """What a text of TOML says. Raises ValueError where it is none."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef,import-not-found,unused-ignore]
    return tomllib.loads(text)


def write_toml(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings; nested mappings become tables, and what is None is left out."""
    write_text(path, to_toml(settings))


def to_toml(settings: Mapping[str, Any]) -> str:
    """Settings as TOML text."""
    return "\n".join(_toml_lines(plain(settings), ())) + "\n"


def _toml_lines(table: dict[str, Any], parents: tuple[str, ...]) -> list[str]:
    lines = [
        f"{_toml_key(k)} = {_toml_value(v)}" for k, v in table.items() if v is not None and not isinstance(v, dict)
    ]
    for key, value in table.items():
        if isinstance(value, dict):
            names = (*parents, _toml_key(key))
            lines += ["", f"[{'.'.join(names)}]", *_toml_lines(value, names)]
    return lines


def _toml_key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _toml_value(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(v) for v in value if v is not None) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml_key(k)} = {_toml_value(v)}" for k, v in value.items() if v is not None) + "}"
    return json.dumps(value)  # numbers, texts and truth values are written alike


def write_csv(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write columns of one length with their names; None and NaN are left empty, other numbers exact. Another table
    than one that begins with the same column is not replaced."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    plain = (c.tolist() if hasattr(c, "tolist") else c for c in columns.values())
    writer.writerows([None if v != v else v for v in row] for row in zip(*plain, strict=True))
    head = rb"\A" + re.escape(next(iter(columns), "").encode()) + rb"[,\n]"
    write_text(path, stream.getvalue(), own=(head, "table") if columns else None)


def columns_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Columns, as :func:`write_csv` takes them, of rows with the same names."""
    return {name: [row[name] for row in rows] for name in rows[0]} if rows else {}


def in_metres(length_m: float) -> str:
    """A length for people: to a decimetre, of less than a metre, as of an endoscope's path, three digits."""
    return f"{length_m:{'.1f' if length_m >= 1 else '.3g'}} m"


def templates(*packages: str, **options: Any) -> Environment:
    """The Jinja templates of packages, which fill in HTML escaped and other text as it is; further ``options``: of
    Jinja's environment. Raises ImportError without Jinja."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, select_autoescape

    loader = ChoiceLoader([PackageLoader(package) for package in packages])
    return Environment(loader=loader, autoescape=select_autoescape(), trim_blocks=True, **options)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    cells = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(v.replace("|", "\\|") for v in row) + " |" for row in cells]
