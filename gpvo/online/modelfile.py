"""The model file: one safetensors file whose metadata holds a JSON header. Loading runs no code.

Layout: as any safetensors file, with the single metadata entry ``gpvo``: a JSON object with ``schema``, ``kind``,
``digest`` and ``header`` (the caller's). ``digest`` is the SHA-256 of the canonical header and of every array's name,
type, shape and bytes. Equal content gives equal bytes.

Arrays of an error model (``model_schema`` 1), d features, n rows kept; readers ignore what they do not know:

* ``gp.*``: the GP of the log variance, see :class:`gpvo.online.projected.ProjectedGP`;
* ``domain.*``: the training domain, see :class:`gpvo.online.guard.Domain`;
* ``theta``, ``theta_plain`` (6, 5): the base variance, see :class:`gpvo.online.base.BaseVariance`;
* ``usual_rate_var``, ``rate_change_var`` (6, 6): see :class:`gpvo.online.base.Velocities`;
* ``correlation``, ``geometry_weight``, ``share``, ``growth``, ``level``, ``ln_speed``, ``bias_tau_s``,
  ``calibration_patterns``, ``calibration_tau_s``: see :class:`gpvo.online.division.Division`;
* ``inputs``, ``factor``, ``outside_power``, ``high``, ``typical_ln_det``, ``nu``: see
  :class:`gpvo.online.estimate.ErrorModel`;
* ``base.*`` (optional): those in which the model with its GP held at the mean function differs;
* ``method.constant`` (6, 6), ``method.<stated>.scale`` (6,): the simple methods that ``evaluate`` compares with;
* ``thesis.*`` (optional): the thesis' model, see :class:`gpvo.learning.thesis.ThesisModel`; all that a model of
  positions holds;
* ``sample.*`` (optional): training rows for forecasts, see :class:`gpvo.learning.sample.TrainingSample`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as _load_tensors
from safetensors.numpy import save as _save_tensors

from gpvo.errors import ModelError
from gpvo.files import parse_json, plain, printable_document, read_bounded, replacing

SCHEMA = 1
KIND = "gpvo-error-model"
MAX_FILE_BYTES = 1 << 30
_KNOWN = {"<f8", "<f4", "<i8", "<i4", "|u1", "|b1"}


def save(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> str:
    """Write arrays and header atomically; returns the digest (64 hexadecimal digits).

    Arrays are float64, float32, int64, int32, uint8 or bool. The header is anything JSON can hold; numbers that are not
    finite become null. Raises ModelError for what the file cannot hold, SourceError where it cannot be written.
    """
    path = Path(path)
    tidy = {name: _storable(name, arrays[name]) for name in sorted(arrays)}
    clean = plain(header, _not_held)
    digest = _digest(tidy, clean)
    document = {"schema": SCHEMA, "kind": KIND, "digest": digest, "header": clean}
    with replacing(path) as temporary:
        temporary.write_bytes(_save_tensors(tidy, metadata={"gpvo": _canonical(document)}))
    return digest


def load(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and header of a model file; ModelError (one line) if it is missing, damaged, truncated or too new."""
    return parse(read(path), path)


def read(path: str | os.PathLike[str]) -> bytes:
    """The bytes of a model file, for :func:`parse`. Raises ModelError where it cannot be read."""
    path = Path(path)
    if path.exists() and not path.is_file():  # a pipe cannot be read again, by the next that asks
        kind = "folder" if path.is_dir() else "pipe or a device"
        raise ModelError(f"is a {kind}, not a model file", where=path, cure="give one of gpvo train, before the run")
    return read_bounded(path, MAX_FILE_BYTES, f"is larger than {MAX_FILE_BYTES} bytes: not a model file", ModelError)


def parse(blob: bytes, path: str | os.PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and header of the bytes of the model file ``path``; raises as :func:`load`."""
    path = Path(path)
    try:
        # Whatever the header declares is held against the bytes there are.
        arrays = _load_tensors(blob)
        (n_header,) = struct.unpack("<Q", blob[:8])
        text = json.loads(blob[8 : 8 + n_header])["__metadata__"]["gpvo"]
        document = parse_json(text)
    except (SafetensorError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise ModelError("is not a gpvo model file, or is truncated or damaged", where=path) from None
    _check_document(document, path)
    if _digest(arrays, document["header"]) != document["digest"]:
        raise ModelError("the content does not match its digest", where=path, cure="copy or train the model again")
    # Without escapes, all text of the header stands as it is in the text that it was read from.
    plain_text = text.isprintable() and "\\" not in text
    return arrays, document["header"] if plain_text else printable_document(document["header"])


def _check_document(document: Any, path: Path) -> None:
    if not isinstance(document, dict) or document.get("kind") != KIND:
        raise ModelError("is not a gpvo model file", where=path)
    check_version("schema", document.get("schema"), SCHEMA, path)
    if not isinstance(document.get("header"), dict) or not isinstance(document.get("digest"), str):
        raise ModelError("has a damaged header", where=path)
    _check_header(document["header"], path)


def check_version(name: str, found: Any, newest: int, path: Path | None = None) -> None:
    """Raise ModelError if a file was written in a later version of a format than can be read."""
    if not isinstance(found, int) or found < 1:
        raise ModelError("has a damaged header", where=path)
    if found > newest:
        what = f"was written by a newer gpvo ({name} {found}, this one reads up to {newest})"
        raise ModelError(what, where=path, cure="update gpvo")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are(kind: type, values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(v, kind) for v in values)


def _is_calibration(value: Any) -> bool:
    """Whether it is an object; if it holds intervals, with a width for each axis and level."""
    if not isinstance(value, dict):
        return False
    levels, widths = value.get("interval_levels", []), value.get("interval_sigmas", [[]] * 6)
    fit = _are(list, [levels, widths]) and _are(list, widths) and [*map(len, widths)] == [len(levels)] * 6
    return fit and all(_is_number(x) and x >= 0 for row in (levels, *widths) for x in row)


_OBJECT = "an object", lambda v: isinstance(v, dict)
_TEXT = "text", lambda v: isinstance(v, str)
_HEADER: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "features": ("a list of different names", lambda v: _are(str, v) and 0 < len(v) <= 1000 and len(set(v)) == len(v)),
    "units": ("a list of texts", lambda v: _are(str, v)),
    "dt_s": ("a number of seconds from 1e-6 to 1e4", lambda v: _is_number(v) and 1e-6 <= v <= 1e4),
    "rate_hz": ("a positive number", lambda v: _is_number(v) and v > 0),
    "target": _TEXT,
    "frame": _TEXT,
    "base_method": _TEXT,
    "camera": _OBJECT,
    "odometry": _OBJECT,
    "scores": ("an object of objects", lambda v: isinstance(v, dict) and _are(dict, list(v.values()))),
    "calibration": ("an object whose 'interval_sigmas' hold a positive number per level for six axes", _is_calibration),
    "config": _OBJECT,
    "versions": _OBJECT,
    "constant_best": (
        "two positive numbers",
        lambda v: isinstance(v, list) and [_is_number(x) and x > 0 for x in v] == [True] * 2,
    ),
    "simulated_truth": ("a list of objects", lambda v: _are(dict, v)),
    "sequences": (
        "a list of named sequences",
        lambda v: _are(dict, v) and _are(str, [s.get("name") for s in v]),
    ),
}
"""What a key of a header must be, in words and as a test; absent keys are for the reader to miss."""


def _check_header(header: Mapping[str, Any], path: Path) -> None:
    """Raise ModelError, one line, for the first header key that its readers cannot accept; null means unknown."""
    for name, (words, holds) in _HEADER.items():
        value = header.get(name)
        if value is not None and not holds(value):
            raise ModelError(f"its header's '{name}' is not {words}", where=path)
    features, units = header.get("features"), header.get("units")
    if features and units and len(features) != len(units):
        raise ModelError(f"its header names {len(units)} units for {len(features)} features", where=path)


def _storable(name: str, array: NDArray[Any]) -> NDArray[Any]:
    array = np.ascontiguousarray(array)
    if array.dtype.newbyteorder("<").str not in _KNOWN:
        raise ModelError(f"array '{name}' has type {array.dtype}, which a model file cannot hold")
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


def _not_held(value: Any) -> NoReturn:
    raise ModelError(f"a model header cannot hold a {type(value).__name__}")


def _canonical(document: Any) -> str:
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def _digest(arrays: Mapping[str, NDArray[Any]], header: Any) -> str:
    sha = hashlib.sha256(_canonical(header).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()
