"""What the arrays and the header of a model file must be: one schema, checked once, where a model is loaded.

What has passed may be believed by the arithmetic. A new array of a model gets a line in ``_ARRAYS``; arrays that are in
no line are left alone, as readers ignore what they do not know.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.geometry.covariance import is_positive_definite
from gpvo.online.variants import BASE

LARGEST = 1e12
"""No number of a model is larger, nor is a feature: a value beyond counts as missing, as its powers would overflow."""
_NARROWEST = 1e-12  # No standard deviation or length scale is smaller.


@dataclass(frozen=True)
class ArraySpec:
    """What one array must be.

    ``shape``: a length per axis, None any, ``"d"`` that of the features; None as a whole: the reader checks it.
    ``low``, ``high``: range of its values. ``kind``: NumPy's kinds that it may have. ``semidefinite``: its last two
    axes hold symmetric positive semidefinite matrices; ``unit_diagonal``: with ones on the diagonal. ``gaps``: NaN may
    stand for unknown values.
    """

    shape: tuple[int | str | None, ...] | None
    low: float = -LARGEST
    high: float = LARGEST
    kind: str = "f"
    semidefinite: bool = False
    unit_diagonal: bool = False
    gaps: bool = False

    def problem(self, array: NDArray[Any], d: int | None) -> str:
        """What is wrong with the array, empty where nothing is; ``d``: number of features, None where unknown."""
        if array.dtype.kind not in self.kind:
            return f"holds {array.dtype}"
        if self.shape is not None and not self._fits(array.shape, d):
            return f"has shape {array.shape}, expected {tuple('any' if n is None else n for n in self.shape)}"
        if array.size == 0:
            return "is empty"
        if array.dtype.kind == "f" and not self.gaps and not np.isfinite(array).all():
            return "holds a number that is not finite"
        with np.errstate(invalid="ignore"):
            if (array < self.low).any() or (array > self.high).any():
                return (
                    f"goes from {np.nanmin(array):.3g} to {np.nanmax(array):.3g}, outside {self.low:g} to {self.high:g}"
                )
        if self.semidefinite and not all(_is_semidefinite(C) for C in array.reshape(-1, *array.shape[-2:])):
            return "is not symmetric positive semidefinite"
        if self.unit_diagonal and np.abs(np.diagonal(array, axis1=-2, axis2=-1) - 1.0).max() > 1e-6:
            return "is not a correlation: its diagonal is not one"
        return ""

    def _fits(self, shape: tuple[int, ...], d: int | None) -> bool:
        assert self.shape is not None
        wanted = [d if n == "d" else n for n in self.shape]
        return len(shape) == len(wanted) and all(w is None or w == n for w, n in zip(wanted, shape))


def _is_semidefinite(C: NDArray[Any]) -> bool:
    """Up to rounding: a millionth of the diagonal makes it positive definite."""
    diagonal = np.diagonal(C)
    return bool((diagonal >= 0).all()) and is_positive_definite(C + np.diag(1e-6 * diagonal + 1e-30))


def _positive(*shape: int | str | None) -> ArraySpec:
    return ArraySpec(shape, low=_NARROWEST)


def _not_negative(*shape: int | str | None) -> ArraySpec:
    return ArraySpec(shape, low=0.0)


def _ln(*shape: int | str | None) -> ArraySpec:
    return ArraySpec(shape, low=-60.0, high=60.0)


_ARRAYS: dict[str, ArraySpec] = {
    "inputs": ArraySpec((None,), low=0, kind="iu"),
    "factor": _positive(6),
    "outside_power": ArraySpec((1,), low=0.0, high=10.0),
    "high": _ln(6),
    "correlation": ArraySpec((3, 6, 6), semidefinite=True, unit_diagonal=True),
    "geometry_weight": ArraySpec((1,), low=0.0, high=1.0),
    "share": ArraySpec((3, 6), low=0.0, high=1.0),
    "growth": _ln(2, 6),
    "level": ArraySpec((6,), low=-1e3, high=1e3),
    "ln_speed": _ln(1),
    "bias_tau_s": _not_negative(6),
    "typical_ln_det": ArraySpec((1,), low=-1e4, high=1e4),
    "usual_rate_var": ArraySpec((6,), low=1e-24),
    "rate_change_var": _not_negative(6, 6),
    "calibration_patterns": ArraySpec((6, 6, 6), low=-1e6, high=1e6),
    "calibration_tau_s": _positive(6),
    "nu": ArraySpec((1,), low=0.0, high=1e6),
    "theta": _not_negative(6, 5),
    "theta_plain": _not_negative(6, 5),
    "domain.scale": _positive("d"),
    "domain.whitening": ArraySpec(("d", "d")),
    "domain.radius": _not_negative(1),
    "domain.may_miss": ArraySpec(("d",), kind="b"),
    "domain.*": ArraySpec(("d",)),
    "feature.centre": ArraySpec(("d",)),
    "feature.scale": _positive("d"),
    "thesis.columns": ArraySpec((None,), low=0, high=3, kind="iu"),
    "thesis.spread": _positive(None),
    "thesis.scale": _not_negative(None),
    "thesis.centre": ArraySpec((None,)),
    "method.constant": ArraySpec((6, 6), semidefinite=True),
    "method.*.scale": _not_negative(6),
    "sample.X": ArraySpec((None, "d"), gaps=True),
    "sample.sequence": ArraySpec((None,), low=0, kind="iu"),
    "sample.dt_s": ArraySpec((None,), low=1e-9),
    "sample.geometry": ArraySpec((None, 21), gaps=True),
    # Gaussian processes, wherever they stand.
    "*.lengthscale": _positive(None),
    "*.points": ArraySpec((None, None)),
    "*.weights": ArraySpec((None, None)),
    "*.reduction": ArraySpec((None, None), low=-1e-3),
    "*.signal_var": _not_negative(None),
    "*.projection": ArraySpec(None),
    "*.centre": ArraySpec((None,)),
    "*.offset": ArraySpec((None,)),
    "*.log_noise_offset": _ln(None),
}


@cache
def spec_of(name: str) -> ArraySpec | None:
    """The specification of an array, None where nothing is known of it; the first line that fits its name counts."""
    name = name.removeprefix(BASE)
    return _ARRAYS.get(name) or next((spec for key, spec in _ARRAYS.items() if fnmatchcase(name, key)), None)


def check_arrays(arrays: Mapping[str, NDArray[Any]], n_features: int | None) -> None:
    """Raise ModelError, one line, for the first array that is not what the schema says.

    ``n_features``: d, where it is known.
    """
    for name in sorted(arrays):
        spec = spec_of(name)
        if spec is not None and (problem := spec.problem(arrays[name], n_features)):
            raise ModelError(f"the array '{name}' {problem}")


def check_related(arrays: Mapping[str, NDArray[Any]], n_features: int) -> None:
    """Raise ModelError where arrays of an error model, each right by itself, contradict one another."""
    low, high = (arrays.get(f"domain.{side}") for side in ("low", "high"))
    least, most = (arrays.get(f"domain.{side}", other) for side, other in (("least", low), ("most", high)))
    for one, other in ((low, high), (least, most)):
        if one is not None and other is not None and (one > other).any():
            raise ModelError("the training domain ends before it begins")
    if arrays["inputs"].max() >= n_features:
        raise ModelError(f"input {arrays['inputs'].max()} is none of the {n_features} features")
    if (arrays["share"].sum(axis=0) < 1e-6).any():
        raise ModelError("jitter, white and bias have no share of the variance")
    if (arrays["theta"].sum(axis=1) <= 0).any():
        raise ModelError("the base variance 'theta' of an axis is zero")


@dataclass(frozen=True)
class _Key:
    """One key of a header: what it must be, in words and as a test; absent keys are for the reader to miss."""

    words: str
    holds: Callable[[Any], bool] = field(repr=False)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def _are_objects(values: Any) -> bool:
    return all(isinstance(v, dict) for v in values)


_MAPPING = _Key("an object", lambda v: isinstance(v, dict))
_TEXT = _Key("text", lambda v: isinstance(v, str))
_HEADER: dict[str, _Key] = {
    "features": _Key(
        "a list of different names", lambda v: _are_texts(v) and 0 < len(v) <= 1000 and len(set(v)) == len(v)
    ),
    "units": _Key("a list of texts", _are_texts),
    "dt_s": _Key("a number of seconds from 1e-6 to 1e4", lambda v: _is_number(v) and 1e-6 <= v <= 1e4),
    "rate_hz": _Key("a positive number", lambda v: _is_number(v) and v > 0),
    "target": _TEXT,
    "frame": _TEXT,
    "base_method": _TEXT,
    "camera": _MAPPING,
    "scores": _Key("an object of objects", lambda v: isinstance(v, dict) and _are_objects(v.values())),
    "calibration": _MAPPING,
    "config": _MAPPING,
    "versions": _MAPPING,
    "sequences": _Key(
        "a list of named sequences",
        lambda v: isinstance(v, list) and _are_objects(v) and _are_texts([s.get("name") for s in v]),
    ),
}


def check_header(header: Mapping[str, Any]) -> None:
    """Raise ModelError, one line, for the first key of a header that is not what its readers take; null is unknown."""
    for name, key in _HEADER.items():
        value = header.get(name)
        if value is not None and not key.holds(value):
            raise ModelError(f"its header's '{name}' is not {key.words}")
    features, units = header.get("features"), header.get("units")
    if features and units and len(features) != len(units):
        raise ModelError(f"its header names {len(units)} units of {len(features)} features")
