"""Writing settings as TOML (Python reads it, but cannot write it)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpvo.io.jsonfile import plain

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def write_toml(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings; nested mappings become tables, and what is None is left out."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(to_toml(settings), encoding="utf-8")
    os.replace(temporary, path)


def to_toml(settings: Mapping[str, Any]) -> str:
    """Settings as TOML text."""
    return "\n".join(_lines(plain(settings), ())) + "\n"


def _lines(table: dict[str, Any], parents: tuple[str, ...]) -> list[str]:
    lines = [f"{_key(k)} = {_value(v)}" for k, v in table.items() if v is not None and not isinstance(v, dict)]
    for key, value in table.items():
        if isinstance(value, dict):
            names = (*parents, _key(key))
            lines += ["", f"[{'.'.join(names)}]", *_lines(value, names)]
    return lines


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else json.dumps(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(_value(v) for v in value if v is not None) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + "}"
    if isinstance(value, (int, float)):
        return repr(value)
    return json.dumps(str(value))
