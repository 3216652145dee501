"""The ``gpvo`` command in the process of a test: what a user types, and what comes of it."""

from __future__ import annotations

import contextlib
import io
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple

import pytest
from gpvo import cli
from gpvo.cli import output


class Done(NamedTuple):
    """How a command ended, and what it wrote."""

    returncode: int
    stdout: str
    stderr: str


def gpvo(*words: object, folder: Path | None = None) -> Done:
    """Run a line in ``folder``, 80 columns wide. What a command imports, and does as a process, takes a process."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setattr("sys.argv", ["gpvo", *map(str, words)])
        patch.setenv("COLUMNS", "80")
        if folder is not None:
            patch.chdir(folder)
        stack.enter_context(warnings.catch_warnings())
        warnings.resetwarnings()
        for kind in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)  # as Python starts; all others are shown
        with output.loudness(quiet=False, verbose=False):
            pass  # a line before that ended in an error leaves what it asked for
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        stop = stack.enter_context(pytest.raises(SystemExit))
        cli.main()
    # The end of a process lets go of all that it holds, as of the lock on a run; here, errors hold their frames.
    error: BaseException | None = stop.value
    while error is not None:
        traceback.clear_frames(error.__traceback__)
        error = error.__context__
    return Done(int(stop.value.code or 0), out.getvalue(), err.getvalue())
