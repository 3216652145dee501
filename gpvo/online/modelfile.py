"""The model file: one safetensors file whose metadata holds a JSON header. Loading runs no code.

Layout: as any safetensors file, with the single metadata entry ``gpvo``: a JSON object with ``schema``, ``kind``,
``digest`` and ``header`` (the caller's). ``digest`` is the SHA-256 of the canonical header and of every array's name,
type, shape and bytes. Equal content gives equal bytes.

Arrays of an error model (``model_schema`` 1), d features, n rows kept; readers ignore what they do not know, and older
files lack what is marked optional:

* ``gp.*``: the GP of the log variance, see :class:`gpvo.online.projected.ProjectedGP`;
* ``domain.*``: the training domain, see :class:`gpvo.online.guard.Domain`;
* ``theta``, ``theta_plain`` (6, 5): the base variance, see :class:`gpvo.online.base.BaseVariance`;
* ``inputs``, ``factor``, ``outside_power``, ``high``, ``correlation``, ``geometry_weight``, ``share``, ``growth``,
  ``level``, ``ln_speed``, ``bias_tau_s``, ``typical_ln_det``, ``usual_rate_var``: see
  :class:`gpvo.online.estimate.ErrorModel`;
* ``rate_change_var`` (6, 6), ``calibration_patterns`` (6, 6, 6), ``calibration_tau_s`` (6,), ``nu`` (1,) (all
  optional): the same class;
* ``base.*`` (optional): those in which the model with its GP held at the mean function differs;
* ``method.constant`` (6, 6), ``method.<stated>.scale`` (6,): the simple methods that ``evaluate`` compares with;
* ``thesis.*`` (optional): the thesis' model, see :class:`gpvo.online.thesis.ThesisModel`;
* ``basis.*``, ``for_filter.*``: of older files, see :func:`gpvo.online.variants.upgraded`; of a model of positions,
  its GP, see :class:`gpvo.online.position.PositionPredictor`;
* ``sample.*`` (optional): training rows for forecasts, see :class:`gpvo.online.sample.TrainingSample`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as _load_tensors
from safetensors.numpy import save as _save_tensors

from gpvo.errors import ModelError, printable
from gpvo.online.validation import check_header

SCHEMA = 1
KIND = "gpvo-error-model"
MAX_FILE_BYTES = 1 << 30
MAX_HEADER_BYTES = 1 << 24

_DTYPES = {"F64": "<f8", "F32": "<f4", "I64": "<i8", "I32": "<i4", "U8": "|u1", "BOOL": "|b1"}
_KNOWN = set(_DTYPES.values())


def save(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> str:
    """Write arrays and header atomically; returns the digest (64 hexadecimal digits).

    Arrays are float64, float32, int64, int32, uint8 or bool. The header is anything JSON can hold; numbers that are not
    finite become null. Raises ModelError where an array's type is not one of these.
    """
    path = Path(path)
    tidy = {name: _storable(name, arrays[name]) for name in sorted(arrays)}
    clean = _jsonable(header)
    digest = _digest(tidy, clean)
    document = {"schema": SCHEMA, "kind": KIND, "digest": digest, "header": clean}
    blob = _save_tensors(tidy, metadata={"gpvo": _canonical(document)})
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(blob)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException as problem:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(problem, OSError):
            raise ModelError(f"cannot be written: {problem.strerror}", where=path) from None
        raise
    return digest


def load(path: str | os.PathLike[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Arrays and header of a model file; ModelError (one line) if it is missing, damaged, truncated or too new."""
    path = Path(path)
    document, size = _read_document(path)
    _check_document(document, path)
    try:
        blob = path.read_bytes()
        if len(blob) != size:
            raise ModelError("changed while it was being read", where=path)
        arrays = _load_tensors(blob)
    except (OSError, SafetensorError, KeyError, ValueError) as problem:
        raise ModelError(f"cannot be read as a model file: {problem}", where=path) from None
    if _digest(arrays, document["header"]) != document["digest"]:
        raise ModelError("the content does not match its digest", where=path, cure="copy or train the model again")
    return arrays, document["printable"]


def read_header(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The header alone, without reading the arrays (their digest is therefore not checked)."""
    document, _ = _read_document(Path(path))
    _check_document(document, Path(path))
    return dict(document["printable"])


def _read_document(path: Path) -> tuple[dict[str, Any], int]:
    """The ``gpvo`` document and the file's size, after every declared size was held against the bytes there are."""
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if not 8 <= size <= MAX_FILE_BYTES:
                raise ModelError(f"is {size} bytes long: not a model file", where=path)
            (n_header,) = struct.unpack("<Q", stream.read(8))
            if n_header > min(MAX_HEADER_BYTES, size - 8):
                raise ModelError("is truncated or not a model file", where=path)
            raw = stream.read(n_header)
    except OSError as problem:
        raise ModelError(f"cannot be opened: {problem.strerror}", where=path) from None
    try:
        tensors = json.loads(raw)
        metadata = tensors.pop("__metadata__")
        _check_sizes(tensors, size - 8 - n_header, path)
        document = json.loads(metadata["gpvo"], parse_constant=_refuse, parse_float=_finite)
    except ModelError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise ModelError("is not a gpvo model file, or its header is damaged", where=path) from None
    return document, size


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no JSON")


def _finite(number: str) -> float:
    value = float(number)
    return value if math.isfinite(value) else _refuse(number)


def _check_sizes(tensors: dict[str, Any], n_bytes: int, path: Path) -> None:
    end = 0
    for name, entry in tensors.items():
        if entry["dtype"] not in _DTYPES:
            raise ModelError(f"array '{name}' has the unknown type {entry['dtype']}", where=path)
        first, last = entry["data_offsets"]
        count = math.prod(int(n) for n in entry["shape"])
        if count * np.dtype(_DTYPES[entry["dtype"]]).itemsize != last - first or not 0 <= first <= last <= n_bytes:
            raise ModelError(f"is truncated or damaged at array '{name}'", where=path)
        end = max(end, last)
    if end != n_bytes:
        raise ModelError("is truncated or has trailing bytes", where=path)


def _check_document(document: Any, path: Path) -> None:
    if not isinstance(document, dict) or document.get("kind") != KIND:
        raise ModelError("is not a gpvo model file", where=path)
    schema = document.get("schema")
    if not isinstance(schema, int) or schema < 1:
        raise ModelError("has a damaged header", where=path)
    if schema > SCHEMA:
        what = f"was written by a newer gpvo (schema {schema}, this one reads up to {SCHEMA})"
        raise ModelError(what, where=path, cure="update gpvo")
    if not isinstance(document.get("header"), dict) or not isinstance(document.get("digest"), str):
        raise ModelError("has a damaged header", where=path)
    document["printable"] = _printable(document["header"])
    try:
        check_header(document["header"])
    except ModelError as problem:
        raise ModelError(problem.what, where=path) from None


def _printable(value: Any) -> Any:
    """The same document, none of whose texts a terminal would obey."""
    if isinstance(value, dict):
        return {printable(k): _printable(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_printable(v) for v in value]
    return printable(value) if isinstance(value, str) else value


def _storable(name: str, array: NDArray[Any]) -> NDArray[Any]:
    array = np.ascontiguousarray(array)
    if array.dtype.newbyteorder("<").str not in _KNOWN:
        raise ModelError(f"array '{name}' has type {array.dtype}, which a model file cannot hold")
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


def _jsonable(value: Any) -> Any:
    """Plain JSON types: NumPy values converted, numbers that are not finite as None, keys as text."""
    if isinstance(value, Mapping):
        return {str(k): _jsonable(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_jsonable(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, str | int | float | bool):
        return value
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
