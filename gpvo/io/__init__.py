"""Sequences, trajectories, run folders and other people's logs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpvo.io.run import Run, RunWriter, read_run
    from gpvo.io.source import Source, SourceReport, guess, open_source

__all__ = ["Run", "RunWriter", "Source", "SourceReport", "guess", "open_source", "read_run"]

_HOMES = {"Run": "run", "RunWriter": "run", "read_run": "run"}


def __getattr__(name: str) -> Any:
    """Load the modules behind the public names when they are first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'gpvo.io' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"gpvo.io.{_HOMES.get(name, 'source')}"), name)
