"""The ``gpvo`` command: one file per group of commands, each a thin layer over the library.

Exit codes: 0; 1 if the answer of ``gpvo check`` is no; 2 with one line that says what is wrong with which file and
how to fix it.
"""

from __future__ import annotations

import sys
import traceback
import unicodedata
import warnings
from typing import Any, NoReturn

import typer
from rich.console import Console

from gpvo import __version__
from gpvo.cli import (
    common,
    evaluate,
    files,
    fuse,
    learn,
    live,
    model,
    output,
    reproduce,
    run,
    score,
    selftest,
    simulate,
    twin,
)
from gpvo.errors import EXTRA_OF, GpvoError, MissingExtraError, printable

app = typer.Typer(
    name="gpvo",
    cls=common.Groups,
    help="Tells your filter how wrong stereo visual odometry is, right now.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(show: bool) -> None:
    if show:
        print(f"gpvo {__version__}")
        raise typer.Exit()


@app.callback()
def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Options that come before the command."""


for group, commands in {
    "Record": (run.run, files.import_, simulate.simulate, files.info, run.calibration),
    "Judge": (evaluate.evaluate, evaluate.report, score.score, live.doctor),
    "Learn": (learn.train, twin.twin, model.check, model.predict, model.forecast),
    "Fly": (fuse.fuse, fuse.publish, live.live, model.export),
    "More": (selftest.selftest, reproduce.reproduce),
}.items():
    for command in commands:
        app.command(command.__name__.rstrip("_"), rich_help_panel=group)(common.with_common_options(command))


_ANY_CLICK_ERROR: Any = typer.BadParameter.__mro__[1]
_CTRL_C = 130  # what typer makes of a KeyboardInterrupt


def main() -> None:
    """Entry point of the ``gpvo`` script."""
    warnings.showwarning = lambda message, *_: print(f"gpvo: {printable(message)}", file=sys.stderr)
    try:
        _refuse_control_characters(sys.argv[1:])
        code = app(standalone_mode=False) or 0
        if code == _CTRL_C:
            raise KeyboardInterrupt
        sys.exit(code)
    except _ANY_CLICK_ERROR as error:
        if error.ctx is not None and not sys.argv[1:]:
            error.show()  # the help of a command without arguments
            sys.exit(2)
        where = f"{error.ctx.command_path} --help" if error.ctx is not None else "gpvo --help"
        _fail(f"{' '.join(error.format_message().split())} ({where})")
    except GpvoError as error:  # a MissingExtraError is an ImportError too
        _fail(str(error))
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRA_OF:
            raise
        _fail(str(MissingExtraError(package, _extra(package))))
    except OSError as error:  # a full disk, a folder in place of a file; a broken pipe has ended inside quietly
        # Only what asks for the current folder misses something without a name.
        place = error.filename or ("the current folder" if isinstance(error, FileNotFoundError) else "")
        _fail(": ".join(filter(None, (place, " ".join((error.strerror or str(error)).split())))))
    except typer.Abort:
        raise KeyboardInterrupt from None


def _refuse_control_characters(arguments: list[str]) -> None:
    """File names are echoed to the terminal, which would obey any control characters in them."""
    for argument in arguments:
        kinds = {unicodedata.category(c) for c in argument}
        if "Cc" in kinds:
            raise GpvoError("a control character in an argument", where=argument, cure="rename the file")
        if "Cs" in kinds:
            cure = "set PYTHONUTF8=1, or rename the file"
            raise GpvoError("an argument is not in the encoding of this system", where=argument, cure=cure)


def _extra(package: str) -> str:
    """The extra that provides all that this command needs, not only the first missing package."""
    of_command = {"run": "vo", "train": "train", "simulate": "sim", "reproduce": "all"}.get(
        sys.argv[1] if sys.argv[1:] else ""
    )
    return of_command or ("runs" if EXTRA_OF[package] == "vo" else EXTRA_OF[package])


def _fail(text: str) -> NoReturn:
    if output.is_verbose():
        traceback.print_exc()
    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"gpvo: {text}")
    sys.exit(2)
