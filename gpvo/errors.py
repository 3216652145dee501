"""The errors gpvo raises on purpose: one line each that names the file, the place and the cure; and the packages beside
it, which may be absent, or add to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

_EXTRAS = {
    "vo": ("cv2", "yaml"),
    "runs": ("pyarrow", "scipy", "matplotlib", "jinja2", "joblib"),
    "train": ("torch", "gpytorch", "sklearn", "linear_operator"),
    "sim": ("embreex", "mujoco", "numba", "pydantic"),
    "ros": ("rosbags", "zenoh", "cyclonedds"),
    "mavlink": ("pymavlink", "serial"),
    "onnx": ("onnx",),
    "dask": ("distributed",),
    "viz": ("rerun",),
}
EXTRA_OF = {package: extra for extra, packages in _EXTRAS.items() for package in packages}
"""Which extra of gpvo brings a package."""

NO_TRUTH = "'gpvo import RUN --truth GT -o NEW' gives it some; --twins needs none, for a run with tracks"
"""The cure of a run without ground truth."""


def printable(text: object) -> str:
    """Text without what a terminal would obey: control and formatting characters become ``?``."""
    plain = str(text)
    return plain if plain.isprintable() else "".join(c if c.isprintable() else "?" for c in plain)


def counted(count: int, noun: str) -> str:
    """``1 frame``, ``2 frames``: a noun that is regular."""
    return f"{count} {noun}{'s' * (count != 1)}"


class GpvoError(Exception):
    """Bad input, described for the person who can fix it.

    The command line prints it as one line and exits with code 2; library callers catch it.
    """

    def __init__(self, what: str, *, where: object = None, cure: str | None = None) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.cure = cure
        place = f"{self.where}: " if self.where else ""
        hint = f" ({cure})" if cure else ""
        super().__init__(printable(" ".join(f"{place}{what}{hint}".split())))


class SourceError(GpvoError):
    """A sequence, log or trajectory cannot be read as what it claims to be."""


class OutputError(SourceError):
    """A file or folder cannot be written: no right, no space, or another process is writing it."""


class CalibrationError(GpvoError):
    """A camera or rig calibration is missing, malformed or impossible."""


class ModelError(GpvoError):
    """A model file is damaged, too new, or does not fit the data at hand."""


class MissingExtraError(GpvoError, ImportError):
    """An optional dependency is absent."""

    def __init__(self, package: str, extra: str) -> None:
        GpvoError.__init__(
            self,
            f"this needs the package '{package}', which is not installed",
            cure=f"pip install 'gpvo[{extra}]'",
        )
        self.name = package


def require(package: str) -> None:
    """Raise MissingExtraError where a package of one of gpvo's extras is not installed."""
    if find_spec(package) is None:
        raise MissingExtraError(package, EXTRA_OF[package])


def plugins(group: str, built_in: Mapping[str, str]) -> dict[str, Callable[[], Any]]:
    """Loaders by name: of what is ``built_in``, each a ``package.module:name``, then of what installed packages add
    under the entry point ``group``; they cannot take over a built-in name."""
    from importlib.metadata import EntryPoint, entry_points

    known: dict[str, Callable[[], Any]] = {n: EntryPoint(n, place, group).load for n, place in built_in.items()}
    for entry in entry_points(group=group):
        known.setdefault(entry.name, entry.load)
    return known
