"""Tables for people: CSV and Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpvo.files import write_text


def write_csv(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write columns of one length with their names; None and NaN are left empty, other numbers exact."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    plain = (c.tolist() if hasattr(c, "tolist") else c for c in columns.values())
    writer.writerows([None if v != v else v for v in row] for row in zip(*plain, strict=True))
    write_text(path, stream.getvalue())


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown."""
    cells = [head, ["---"] * len(head), *rows]
    return ["| " + " | ".join(v.replace("|", "\\|") for v in row) + " |" for row in cells]
