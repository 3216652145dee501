"""What the Makefile gives the commands that it runs."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_bytecode_is_kept_also_where_python_was_told_not_to() -> None:
    """Or each command of the tests compiles all that it imports again."""
    asking = ["make", "--silent", "--eval", 'asked:;@echo "<$$PYTHONDONTWRITEBYTECODE>"', "asked"]
    told = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    assert subprocess.run(asking, cwd=ROOT, env=told, capture_output=True, text=True, check=True).stdout == "<>\n"
