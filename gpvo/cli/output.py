"""What the commands print: JSON and tables on standard output, notes and a progress bar beside it."""

from __future__ import annotations

import json
import math
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from gpvo.errors import GpvoError
from gpvo.files import plain

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T", bound=str)
Json = Annotated[bool, "Print the result as JSON."]
_MOST = 1e10  # of any number on a command line: metres, seconds
_loud = {"quiet": False, "verbose": False}


@contextmanager
def loudness(*, quiet: bool, verbose: bool) -> Iterator[None]:
    """How much the commands print in the block; with ``verbose`` also time and memory."""
    _loud.update(quiet=quiet, verbose=verbose)
    start = time.perf_counter()
    yield
    detail(f"took {time.perf_counter() - start:.1f} s{_peak_memory()}")


def is_verbose() -> bool:
    """Whether the current command was called with ``-v``."""
    return _loud["verbose"]


def note(text: str) -> None:
    """A remark alongside the result, on standard error; not with ``-q``."""
    if not _loud["quiet"]:
        print(text, file=sys.stderr)


def detail(text: str) -> None:
    """The same, only with ``-v``."""
    if _loud["verbose"]:
        print(f"gpvo: {text}", file=sys.stderr)


def _peak_memory() -> str:
    try:
        import resource
    except ImportError:  # Windows
        return ""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    return f" and {peak:.0f} MB"


def say(text: str) -> None:
    """A line of the result; on a terminal, broken between words with what follows indented."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else math.inf
    indent = " " * (len(text) - len(text.lstrip()) + 2)
    print(text if len(text) <= width else textwrap.fill(text, int(width), subsequent_indent=indent))


def show(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table without rules between its columns, numbers to the right; the first column holds names. It is as
    wide as the terminal, 80 columns in a pipe; never narrower, where its numbers would break."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left", overflow="fold", no_wrap=not k)
    for row in rows:
        table.add_row(*row)
    Console(width=max(Console().width, 80), highlight=False, markup=False).print(table)


def print_json(document: dict[str, Any]) -> None:
    """Print a document as JSON, for scripts."""
    print(json.dumps(plain(document), indent=2))


def answer(as_json: bool, document: dict[str, Any], told: Callable[[], object]) -> None:
    """Print a result: the document for scripts, or as people are ``told`` it."""
    print_json(document) if as_json else told()


def one_of(option: str, value: str, choices: Iterable[T]) -> T:
    """The value of an option, as one of the choices. Raises GpvoError if it is none of them."""
    known = list(choices)
    if (chosen := next((choice for choice in known if choice == value), None)) is None:
        cure = f"choose {known[0]} or {known[1]}" if len(known) == 2 else f"choose one of: {', '.join(known)}"
        raise GpvoError(f"{option} is '{value}'", cure=cure)
    return chosen


def numbers(option: str, text: str, cure: str, *, counts: Sequence[int] = (), least: float = -math.inf) -> list[float]:
    """The numbers of an option, separated by commas: finite, at least ``least``, of one of the ``counts`` if given.

    Raises GpvoError with the ``cure`` if the text is anything else.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = [math.nan]
    if not all(abs(x) < _MOST and x >= least for x in found) or (counts and len(found) not in counts):
        raise GpvoError(f"{option} is '{text}'", cure=cure)
    return found


def time_offset(text: str) -> float | None:
    """The seconds of ``--time-offset``, None for ``auto``. Raises GpvoError for anything else."""
    cure = "give seconds, such as -0.02, or auto"
    return None if text == "auto" else numbers("--time-offset", text, cure, counts=(1,))[0]


def cell(value: float | str | None, digits: int = 3) -> str:
    """A number as tables show it, a dash for an unknown one; text as it is."""
    if isinstance(value, str):
        return value
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.{digits}g}"


@contextmanager
def status(what: str) -> Iterator[Callable[[str], None]]:
    """A line on a terminal that says what is done while it is, from the start on; silence in a pipe, or with ``-q``.

    Yields the function to call with what is done next.
    """
    from rich.text import Text

    if (console := _terminal()) is None:
        yield lambda _: None
        return
    with console.status(Text(what)) as line:  # as text: names of runs may hold brackets
        yield lambda what: line.update(Text(what))


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A progress bar with the time left on a terminal; silence in a pipe, or with ``-q``.

    Yields the function to call once per item, or with how many are done, of how many.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    if (console := _terminal()) is None:
        yield lambda done=None, total=None: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # Of all items so far: a fit may take minutes, and the last half minute holds none.
    with Progress(*columns, console=console, transient=True, speed_estimate_period=1e9) as bar:
        task = bar.add_task(what, total=total)

        def tell(done: int | None = None, total: int | None = total) -> None:
            bar.update(task, advance=1 if done is None else None, completed=done, total=total)

        yield tell


def _terminal() -> Console | None:
    """Standard error, where somebody looks at it and wants to see how far the work is."""
    from rich.console import Console

    console = Console(stderr=True)
    return console if console.is_terminal and not _loud["quiet"] else None
