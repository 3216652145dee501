"""Settings as TOML: written here, as Python only reads it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpvo.errors import GpvoError
from gpvo.files import plain, write_text

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef,import-not-found,unused-ignore]

_MAX_BYTES = 200_000
_BARE = re.compile(r"[A-Za-z0-9_-]+")


def read_toml(path: Path) -> dict[str, Any]:
    """Settings of a file. Raises GpvoError where it cannot be read."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise GpvoError("is larger than 200 kB: no settings", where=path)
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as problem:
        raise GpvoError(f"cannot be read as TOML: {problem}", where=path) from None


def write_toml(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings; nested mappings become tables, and what is None is left out."""
    write_text(path, to_toml(settings))


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
