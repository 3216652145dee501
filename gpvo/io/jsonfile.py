"""JSON documents: written whole or not at all, read with a size limit, without NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gpvo.errors import SourceError
from gpvo.io.atomic import write_text

_MAX_BYTES = 50_000_000


def plain(value: Any) -> Any:
    """A value as JSON knows it: arrays as lists, NaN and infinity as null, paths and enums as text."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return None if value is None else str(value)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document under a temporary name, then put it in place."""
    write_text(path, json.dumps(plain(document), indent=1, allow_nan=False) + "\n")


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no number of JSON")
    return value


def _whole(text: str) -> int:
    if len(text) > 20:  # of 64 bits: a longer one overflows where it becomes a float
        raise ValueError(f"{text[:20]}... is no number of JSON")
    return int(text)


def read_json(path: Path) -> dict[str, Any]:
    """Read a document. Raises SourceError where the file is missing, too large, or not a JSON object."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise SourceError("is larger than 50 MB", where=path)
        text = path.read_text(encoding="utf-8")
        document = json.loads(text, parse_constant=_number, parse_float=_number, parse_int=_whole)
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from None
    except (ValueError, RecursionError) as error:
        raise SourceError(f"is damaged: {str(error).splitlines()[0]}", where=path) from None
    if not isinstance(document, dict):
        raise SourceError("is damaged: no JSON object", where=path)
    return document
