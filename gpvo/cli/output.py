"""What the commands share: JSON on standard output, a progress bar on a terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from gpvo.errors import GpvoError


def jsonable(value: Any) -> Any:
    """The same document with plain Python values; what is not finite becomes None."""
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(v) for v in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_json(document: dict[str, Any]) -> None:
    """Print a document in the form scripts read."""
    print(json.dumps(jsonable(document), indent=2))


def one_of(option: str, value: str, choices: Iterable[str]) -> str:
    """The value of an option. Raises GpvoError where it is none of the choices."""
    if value not in choices:
        raise GpvoError(f"{option} is '{value}'", cure=f"choose {' or '.join(choices)}")
    return value


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on a terminal, silence in a pipe. Yields the function to call once per item."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)
