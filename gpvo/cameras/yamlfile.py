"""YAML as calibration tools write it: OpenCV's dialect included, no code ever run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gpvo.errors import CalibrationError
from gpvo.types import Array

_MAX_BYTES = 100_000  # a calibration has a few thousand


class _Loader(yaml.SafeLoader):
    """Safe loader that knows OpenCV's matrices, and no aliases: nested, a few of them stand for a billion nodes."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(
                None, None, f"the alias *{event.anchor}; write its value out", event.start_mark
            )
        return super().compose_node(parent, index)


def _opencv_matrix(loader: _Loader, node: yaml.Node) -> Array:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.constructor.ConstructorError(None, None, "opencv-matrix must be a mapping", node.start_mark)
    fields = loader.construct_mapping(node, deep=True)
    data = np.asarray(fields["data"], dtype=np.float64)
    return data.reshape(int(fields["rows"]), int(fields["cols"]))


for _tag in ("tag:yaml.org,2002:opencv-matrix", "!opencv-matrix"):
    _Loader.add_constructor(_tag, _opencv_matrix)


def calibration_text(path: Path) -> str:
    """The text of a file. Raises CalibrationError where it cannot be read, or is too large for a calibration."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise CalibrationError("too large for a calibration", where=path)
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise CalibrationError(f"cannot be read: {error.strerror}", where=path) from None


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file; ``!!opencv-matrix`` becomes an array (rows, cols).

    OpenCV's first line ``%YAML:1.0`` is no YAML and is dropped; tags that would build Python objects are refused.
    Raises CalibrationError where the file is missing, too large, not YAML or not a mapping.
    """
    text = calibration_text(path)
    # A leading directive without the document marker, a byte order mark, and tabs are what these files suffer from.
    text = re.sub(r"\A\ufeff?\s*%YAML[: ][^\n]*\n(---[^\n]*\n)?", "", text).expandtabs(4)
    try:
        document = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise CalibrationError(f"not readable as YAML{line}: {problem}", where=path) from None
    if not isinstance(document, dict):
        raise CalibrationError("holds no keys", where=path, cure="is this the calibration file?")
    return document


def get_numbers(block: dict[str, Any], key: str, count: int | tuple[int, ...], where: object) -> list[float]:
    """``block[key]`` as a list of finite numbers of one of the given lengths.

    Raises CalibrationError where the key is absent or holds something else.
    """
    allowed = (count,) if isinstance(count, int) else count
    if key not in block:
        raise CalibrationError(f"lacks the key '{key}'", where=where)
    try:
        values = np.asarray(block[key], dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise CalibrationError(f"'{key}' is not a list of numbers", where=where) from None
    if len(values) not in allowed or not np.isfinite(values).all():
        wanted = " or ".join(str(n) for n in allowed)
        raise CalibrationError(f"'{key}' holds {len(values)} numbers, expected {wanted} finite ones", where=where)
    return [float(v) for v in values]
