"""Run every ``bench/bench_*.py``, print a table, and write ``bench.json``.

``python -m bench NAME...`` runs only the files whose names contain one of the words.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.table import Table


def main(words: list[str]) -> None:
    """Collect the figures of all benchmark files."""
    results: dict[str, dict[str, object]] = {}
    for path in sorted(Path(__file__).parent.glob("bench_*.py")):
        if words and not any(word in path.stem for word in words):
            continue
        print(f"{path.stem} ...", file=sys.stderr, flush=True)
        results.update(import_module(f"bench.{path.stem}").run())
    table = Table("benchmark", "value", "unit", "peer", "peer's value", "ratio")
    for name, row in results.items():
        cells = [row.get(k) for k in ("value", "unit", "peer", "peer_value", "ratio")]
        table.add_row(name, *("" if c is None else f"{c:.4g}" if isinstance(c, float) else str(c) for c in cells))
    Console(width=140).print(table)
    Path("bench.json").write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
