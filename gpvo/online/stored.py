"""What a model file holds: classes whose arrays go in and out by their names, and one schema that all arrays must fit.

The schema is checked once, when a model is loaded; the arithmetic may rely on what has passed. A new array gets a line
in ``_ARRAYS``; arrays without a line are left alone, because readers ignore what they do not know. A file holds
two models: the one that predicts and, where its arrays differ, its base with the GP held at its mean function.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.geometry.covariance import is_positive_definite
from gpvo.types import field_names

LARGEST = 1e12
"""Largest number of a model or feature: anything larger counts as missing, because its powers would overflow."""
BASE = "base."
"""Prefix of the arrays in which the model with its GP held at the mean function, the base variance, differs."""
_NARROWEST = 1e-12  # No standard deviation or length scale is smaller.
_FACTOR = 1e40  # Of what other software states: as little as it likes.
_Arrays = Mapping[str, NDArray[Any]]
_Stored = TypeVar("_Stored", bound="Stored")


class Stored:
    """A dataclass whose arrays are stored in a model file under a prefix and the names of its fields."""

    parts: ClassVar[Mapping[str, tuple[type[Stored], str]]] = {}
    """Fields that are stored in turn: of which class, and what stands before the names of their arrays."""

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Named arrays for a model file; :meth:`from_arrays` is the inverse."""
        own = {name: getattr(self, name) for name in field_names(type(self))}
        out = {prefix + name: a for name, a in own.items() if isinstance(a, np.ndarray)}
        for name, (_, place) in self.parts.items():
            out |= own[name].to_arrays(prefix + place)
        return out

    @classmethod
    def from_arrays(cls: type[_Stored], arrays: _Arrays, prefix: str = "", **others: Any) -> _Stored:
        """From arrays that fit the schema, and ``others``, fields of it or its parts that are none.

        Raises ModelError where an array is missing.
        """
        own = {name: value for name, value in others.items() if name in field_names(cls)}
        own |= {name: part.from_arrays(arrays, prefix + place, **others) for name, (part, place) in cls.parts.items()}
        for name in field_names(cls):
            if name not in own:
                own[name] = _array(arrays, prefix + name)
        return cls(**own)


def _array(arrays: _Arrays, name: str) -> NDArray[Any]:
    """One array, floats in double precision."""
    if name not in arrays:
        raise ModelError(f"lacks the array '{name}': an older gpvo wrote the file, or it is damaged")
    return np.asarray(arrays[name], np.float64) if arrays[name].dtype.kind == "f" else arrays[name]


def arrays_of_base(arrays: _Arrays) -> dict[str, NDArray[Any]]:
    """The arrays of a model file with those of its base substituted: the base variance, and a calibration of its own.
    The same as the model if the GP is not in use."""
    kept = {name: a for name, a in arrays.items() if not name.startswith(BASE)}
    return kept | {name.removeprefix(BASE): a for name, a in arrays.items() if name.startswith(BASE)}


@dataclass(frozen=True)
class ArraySpec:
    """What one array must be.

    ``shape``: a length per axis, or a letter for one that all arrays of a group have in common; ``"features"`` for that
    of the features. ``low``, ``high``: range of its values. ``kind``: NumPy kinds allowed. ``semidefinite``: its last
    two axes hold symmetric positive semidefinite matrices; ``unit_diagonal``: with ones on the diagonal.
    ``gaps``: NaN may stand for unknown values.
    """

    shape: tuple[int | str, ...]
    low: float = -LARGEST
    high: float = LARGEST
    kind: str = "f"
    semidefinite: bool = False
    unit_diagonal: bool = False
    gaps: bool = False

    def problem(self, array: NDArray[Any], sizes: dict[str, int]) -> str:
        """What is wrong with the array, empty if nothing is; ``sizes``: of the letters, which it adds to."""
        if array.dtype.kind not in self.kind:
            return f"holds {array.dtype}"
        wanted = [w if isinstance(w, int) else sizes.setdefault(w, n) for w, n in zip(self.shape, array.shape)]
        if array.ndim != len(self.shape) or list(array.shape) != wanted:
            return f"has shape {array.shape}, expected {tuple(sizes.get(str(w), w) for w in self.shape)}"
        if array.size == 0:
            return "is empty"
        if array.dtype.kind == "f" and not self.gaps and not np.isfinite(array).all():
            return "holds a number that is not finite"
        with np.errstate(invalid="ignore", over="ignore"):
            if (array < self.low).any() or (array > self.high).any():
                return (
                    f"goes from {np.nanmin(array):.3g} to {np.nanmax(array):.3g}, outside {self.low:g} to {self.high:g}"
                )
        if self.semidefinite and not all(_is_semidefinite(C) for C in array.reshape(-1, *array.shape[-2:])):
            return "is not symmetric positive semidefinite"
        if self.unit_diagonal and np.abs(np.diagonal(array, axis1=-2, axis2=-1) - 1.0).max() > 1e-6:
            return "is not a correlation: its diagonal is not one"
        return ""


def _is_semidefinite(C: NDArray[Any]) -> bool:
    """Up to rounding: a millionth of the diagonal makes it positive definite."""
    diagonal = np.diagonal(C)
    return bool((diagonal >= 0).all()) and is_positive_definite(C + np.diag(1e-6 * diagonal + 1e-30))


_ARRAYS: dict[str, ArraySpec] = {
    "inputs": ArraySpec(("inputs",), low=0, kind="iu"),
    "factor": ArraySpec((6,), low=_NARROWEST),
    "outside_power": ArraySpec((1,), low=0.0, high=10.0),
    "high": ArraySpec((6,), low=-60.0, high=60.0),
    "correlation": ArraySpec((3, 6, 6), semidefinite=True, unit_diagonal=True),
    "geometry_weight": ArraySpec((1,), low=0.0, high=1.0),
    "share": ArraySpec((3, 6), low=0.0, high=1.0),
    "growth": ArraySpec((2, 6), low=-60.0, high=60.0),
    "level": ArraySpec((6,), low=-1e3, high=1e3),
    "ln_speed": ArraySpec((1,), low=-60.0, high=60.0),
    "bias_tau_s": ArraySpec((6,), low=0.0),
    "typical_ln_det": ArraySpec((1,), low=-1e4, high=1e4),
    "usual_rate_var": ArraySpec((6,), low=1e-24),
    "rate_change_var": ArraySpec((6, 6), low=0.0),
    "calibration_patterns": ArraySpec((6, 6, 6), low=-1e6, high=1e6),
    "calibration_tau_s": ArraySpec((6,), low=_NARROWEST),
    "nu": ArraySpec((1,), low=0.0, high=1e6),
    "theta": ArraySpec((6, 5), low=0.0, high=_FACTOR),
    "theta_plain": ArraySpec((6, 5), low=0.0, high=_FACTOR),
    "domain.scale": ArraySpec(("features",), low=_NARROWEST),
    "domain.whitening": ArraySpec(("features", "features")),
    "domain.radius": ArraySpec((1,), low=0.0),
    "domain.may_miss": ArraySpec(("features",), kind="b"),
    "domain.*": ArraySpec(("features",)),
    "thesis.columns": ArraySpec(("d",), low=0, high=3, kind="iu"),
    "thesis.spread": ArraySpec(("d",), low=_NARROWEST),
    "thesis.scale": ArraySpec(("D",), low=_NARROWEST),
    "thesis.centre": ArraySpec(("d",)),
    "method.constant": ArraySpec((6, 6), semidefinite=True),
    "method.*.scale": ArraySpec((6,), low=0.0, high=_FACTOR),
    "sample.X": ArraySpec(("n", "features"), gaps=True),
    "sample.sequence": ArraySpec(("n",), low=0, kind="iu"),
    "sample.dt_s": ArraySpec(("n",), low=1e-9),
    "sample.geometry": ArraySpec(("n", 21), gaps=True),
    # Gaussian processes, wherever they stand.
    "*.lengthscale": ArraySpec(("d",), low=_NARROWEST),
    "*.points": ArraySpec(("m", "d")),
    "*.weights": ArraySpec(("D", "r")),
    "*.reduction": ArraySpec(("D", "r"), low=-1e-3),
    "*.signal_var": ArraySpec(("D",), low=0.0),
    "*.projection": ArraySpec(("r", "m")),
    "*.centre": ArraySpec(("d",)),
    "*.offset": ArraySpec(("D",)),
    "*.log_noise_offset": ArraySpec(("D",), low=-60.0, high=60.0),
}


@cache
def spec_of(name: str) -> ArraySpec | None:
    """The specification of an array, None if there is none; the first line that fits its name counts."""
    name = name.removeprefix(BASE)
    return _ARRAYS.get(name) or next((spec for key, spec in _ARRAYS.items() if fnmatchcase(name, key)), None)


def check_arrays(arrays: _Arrays, n_features: int | None = None) -> None:
    """Raise ModelError, one line, for the first array that is not what the schema says.

    ``n_features``: from the header, if known.
    """
    groups: dict[str, dict[str, int]] = {}
    for name in sorted(arrays):
        group = name.rpartition(".")[0].removesuffix(".mean")
        sizes = groups.setdefault(group, {} if n_features is None else {"features": n_features})
        spec = spec_of(name)
        if spec is not None and (problem := spec.problem(arrays[name], sizes)):
            raise ModelError(f"the array '{name}' {problem}")


def check_related(arrays: _Arrays, n_features: int) -> None:
    """Raise ModelError if arrays of an error model, each valid on its own, contradict one another."""
    if (arrays["domain.low"] > arrays["domain.high"]).any() or (arrays["domain.least"] > arrays["domain.most"]).any():
        raise ModelError("the training domain ends before it begins")
    if arrays["inputs"].max() >= n_features:
        raise ModelError(f"input {arrays['inputs'].max()} is not one of the {n_features} features")
    if (arrays["share"].sum(axis=0) < 1e-6).any():
        raise ModelError("jitter, white and bias have no share of the variance")
    if (arrays["theta"].sum(axis=1) <= 0).any():
        raise ModelError("the base variance 'theta' of an axis is zero")
    if 0.0 < arrays["nu"][0] <= 2.0:
        raise ModelError(f"errors of {arrays['nu'][0]:.3g} degrees of freedom ('nu') have no covariance: 0, or above 2")
