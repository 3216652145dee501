"""The state of objects between two frames as one file, from which a run resumes with the same bytes.

It holds numbers, texts, arrays, containers, and objects of odometry's own classes by their attributes, shared ones
once. Reading it runs no code: a class is looked up by its name in :data:`HOMES`, and its attributes are set.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from enum import Enum
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.files import replacing
from gpvo.geometry.covariance import LARGEST
from gpvo.io.tracks import load_arrays

HOMES = ("gpvo.types", "gpvo.vo")
"""Modules and packages whose classes a snapshot may hold."""
_MAPPINGS: dict[str, Callable[[Any], Any]] = {"dict": dict, "OrderedDict": OrderedDict, "Counter": Counter}


def save_snapshot(path: Path, key: str, state: Any) -> None:
    """Write ``state``, whole or not at all; ``key`` says what it belongs to. TypeError for what cannot be held."""
    tree, data = _Capture.of(state)
    text = json.dumps({"key": key, "state": tree}, separators=(",", ":")).encode()
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, tree=np.frombuffer(text, np.uint8), data=np.frombuffer(data, np.uint8))


def load_snapshot(path: Path, key: str) -> Any:
    """What was saved under the same key; None where there is no such file, or it is damaged or of another key."""
    try:
        arrays = load_arrays(path, ("tree", "data"))
        document = json.loads(arrays["tree"].tobytes())
        return None if document["key"] != key else _Restore(arrays["data"].tobytes()).value(document["state"])
    except (SourceError, ImportError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError,
            ValueError):  # fmt: skip
        return None


def digest_of(*state: Any) -> str:
    """SHA-256 of a state and of gpvo's own code: where it is the same, the same comes of the same input."""
    tree, data = _Capture.of(state)
    return hashlib.sha256(json.dumps([tree, code_digest()]).encode() + data).hexdigest()


@cache
def code_digest(folder: Path = Path(__file__).parents[1]) -> str:
    """SHA-256 of a folder of the package, by default of all of it, and of what it runs on: what other code has kept is
    not taken up."""
    sha = hashlib.sha256(f"{platform.python_version()} {np.__version__}".encode())
    for path in sorted(folder.rglob("*.py")):
        sha.update(path.read_bytes())
    return sha.hexdigest()


class _Capture:
    """Turns values into plain JSON, and arrays into bytes beside it."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._seen: dict[int, tuple[int, Any]] = {}  # the values too, so that no id is given twice

    @classmethod
    def of(cls, value: Any) -> tuple[Any, bytes]:
        self = cls()
        return self.node(value), bytes(self._data)

    def node(self, value: Any) -> Any:
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.generic):
            return {"number": self._array(np.asarray(value))}
        if isinstance(value, bytes):
            return {"bytes": value.hex()}
        if isinstance(value, tuple):
            return {"tuple": [self.node(v) for v in value]}
        if isinstance(value, Enum):
            return {"enum": _name(type(value)), "value": value.value}
        if id(value) in self._seen:
            return {"same": self._seen[id(value)][0]}
        self._seen[id(value)] = (len(self._seen), value)
        return self._shared(value)

    def _shared(self, value: Any) -> dict[str, Any]:
        """What may be held in two places, and is one thing all the same."""
        if isinstance(value, np.ndarray):
            return {"array": self._array(value)}
        if isinstance(value, (list, deque)):
            most = getattr(value, "maxlen", None)
            return {"list": [self.node(v) for v in value], "most": most, "is": type(value).__name__}
        if type(value).__name__ in _MAPPINGS:
            return {"mapping": [[self.node(k), self.node(v)] for k, v in value.items()], "is": type(value).__name__}
        if isinstance(value, ThreadPoolExecutor):
            return {"threads": value._max_workers}
        if isinstance(value, Future):
            return {"result": self.node(value.result())}
        return {"object": _name(type(value)), "fields": {k: self.node(v) for k, v in vars(value).items()}}

    def _array(self, array: NDArray[Any]) -> list[Any]:
        if array.dtype.hasobject:
            raise TypeError(f"a snapshot cannot hold an array of {array.dtype}")
        order: Literal["F", "C"] = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
        offset = len(self._data)
        self._data += array.tobytes(order=order)
        return [array.dtype.str, list(array.shape), order, offset]


class _Restore:
    """The way back."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._made: list[Any] = []

    def value(self, node: Any) -> Any:
        if not isinstance(node, dict):
            if isinstance(node, float) and LARGEST < abs(node) < math.inf:
                raise ValueError(f"{node:g} is too large")
            return node
        kind = next(iter(node), "")
        if kind == "number":
            return self._array(node[kind])[()]
        if kind == "bytes":
            return bytes.fromhex(node[kind])
        if kind == "tuple":
            return tuple(self.value(v) for v in node[kind])
        if kind == "enum":
            return _class(node[kind], Enum)(node["value"])
        if kind == "same":
            return self._made[node[kind]]
        at = len(self._made)
        self._made.append(None)
        return self._shared(kind, node, at)

    def _shared(self, kind: str, node: dict[str, Any], at: int) -> Any:
        made: Any
        if kind == "array":
            made = self._array(node[kind])
        elif kind == "list":
            made = [] if node["is"] == "list" else deque(maxlen=node["most"])
        elif kind == "mapping":
            made = _MAPPINGS[node["is"]](())
        elif kind == "threads":
            made = ThreadPoolExecutor(node[kind])
        elif kind == "result":
            made = Future()
        else:
            made = object.__new__(_class(node["object"]))
        self._made[at] = made  # before what it holds, which may hold it
        if kind == "list":
            made.extend(self.value(v) for v in node[kind])
        elif kind == "mapping":
            made.update({self.value(k): self.value(v) for k, v in node[kind]})
        elif kind == "result":
            made.set_result(self.value(node[kind]))
        elif kind == "object":
            for name, held in node["fields"].items():
                object.__setattr__(made, name, self.value(held))
        return made

    def _array(self, of: list[Any]) -> NDArray[Any]:
        dtype, shape, order, offset = of
        count = int(np.prod(shape, dtype=np.int64))
        array = np.frombuffer(self._data, np.dtype(dtype), count, offset).reshape(shape, order=order)
        if array.dtype.kind == "f" and (np.isfinite(array) & (np.abs(array) > np.float64(LARGEST))).any():
            raise ValueError("a number is too large")
        return array.copy(order="K")


def _name(cls: type) -> str:
    if not _is_home(cls.__module__) or "." in cls.__qualname__:
        raise TypeError(f"a snapshot cannot hold {cls.__module__}.{cls.__qualname__}")
    return f"{cls.__module__}:{cls.__qualname__}"


def _class(name: str, base: type = object) -> Any:
    module, _, cls = name.partition(":")
    found = getattr(import_module(module), cls) if _is_home(module) else None
    if not isinstance(found, type) or not issubclass(found, base) or found.__module__ != module:
        raise TypeError(f"no class of a snapshot: {name}")
    return found


def _is_home(module: str) -> bool:
    return any(module == home or module.startswith(f"{home}.") for home in HOMES)
