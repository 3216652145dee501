"""The ``gpvo`` command, also as ``python -m gpvo``."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line; where it is not installed (``pip install --no-deps``), say so in one line."""
    try:
        from gpvo.cli import main as run
    except ModuleNotFoundError as error:
        if error.name not in ("typer", "rich"):
            raise
        print(f"gpvo: the command line needs the package '{error.name}' (pip install typer rich)", file=sys.stderr)
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
