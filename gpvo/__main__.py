"""The ``gpvo`` command, also as ``python -m gpvo``."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

from gpvo.cameras.imagesize import MAX_PIXELS

_heard: list[int] = []


def _interrupt(number: int, _frame: object) -> NoReturn:
    """Ctrl-C, as Python itself does it, and remembered."""
    _heard.append(number)
    raise KeyboardInterrupt


def _terminate(number: int, _frame: object) -> NoReturn:
    """End as by Ctrl-C: worker processes and temporary folders go too. A second signal ends the process at once."""
    _heard.append(number)
    from gpvo.parallel import after_first

    signal.signal(number, after_first(number))
    sys.exit(128 + number)  # the exit code that shells know it by


def main() -> None:
    """Run the command line; where it is not installed (``pip install --no-deps``), say so in one line."""
    # OpenCV reads this as it is loaded: a second guard behind the sizes that image headers state.
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))
    # Arrow's own pool keeps what it once held; from the system's, NumPy uses it again.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # whoever started this has closed it
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif hasattr(getattr(sys, name), "reconfigure"):  # no file's name is beyond what ASCII, or Windows, can show
            getattr(sys, name).reconfigure(errors="backslashreplace")
    try:
        from gpvo.parallel import ending_signals

        for number in ending_signals():
            signal.signal(number, _terminate)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        try:
            from gpvo.cli import main as run
        except ModuleNotFoundError as error:
            if error.name not in ("typer", "rich"):
                raise
            print(f"gpvo: the command line needs the package '{error.name}' (pip install typer rich)", file=sys.stderr)
            sys.exit(2)
        run()
    except KeyboardInterrupt:  # also while all this is loaded
        print("gpvo: interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception:
        if not _heard:
            raise
        # A library that was being loaded said of the signal that it cannot be.
        if _heard[0] == signal.SIGINT:
            print("gpvo: interrupted", file=sys.stderr)
        sys.exit(128 + _heard[0])
    finally:  # all is written: a signal while Python winds down its worker processes would print a traceback
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        from gpvo.parallel import after_first, ending_signals  # anew where Ctrl-C came while it was loaded

        for number in ending_signals():
            if signal.getsignal(number) is _terminate:
                signal.signal(number, after_first(number))


if __name__ == "__main__":
    main()
