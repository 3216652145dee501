"""Sequences, trajectories, run folders and other people's logs."""

from gpvo.io.run import Run, RunWriter, read_run
from gpvo.io.source import Source, SourceReport, guess, open_source

__all__ = ["Run", "RunWriter", "Source", "SourceReport", "guess", "open_source", "read_run"]
