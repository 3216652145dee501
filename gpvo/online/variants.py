"""A model file holds two models: the one that predicts, and its base without the GP; how older files are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.online.projected import ProjectedGP
from gpvo.types import field_names

BASE = "base."
"""Prefix of the arrays in which the model with its GP held at the mean function, the base variance, differs."""
_FOR_FILTER = "for_filter."
_Arrays = dict[str, NDArray[Any]]


def arrays_of_base(arrays: Mapping[str, NDArray[Any]]) -> _Arrays:
    """The arrays of a model file with those of its base in their place: the base variance, and a calibration of its
    own. The same as the model where the GP is not at work."""
    return _over(arrays, BASE)


def different_arrays(own: Mapping[str, NDArray[Any]], others: Mapping[str, NDArray[Any]]) -> _Arrays:
    """The arrays of a base ``own`` that differ from ``others``, by their names in a file."""
    return {BASE + name: a for name, a in own.items() if name not in others or not np.array_equal(a, others[name])}


def upgraded(arrays: Mapping[str, NDArray[Any]]) -> _Arrays:
    """The arrays of a file by their names of today.

    Older files hold the log variance ratio beside a GP of the error's mean, and a model without such a mean for
    filters, which then is the model. Raises ModelError where a mean is all there is.
    """
    if "gp.points" in arrays or "basis.log_noise_offset" not in arrays:
        return dict(arrays)
    arrays = _over(arrays, _FOR_FILTER)
    if f"{BASE}basis.log_noise_offset" in arrays and "calibration_patterns" in arrays:
        arrays.setdefault(f"{BASE}calibration_patterns", np.zeros((6, 6, 6)))
    out = {name: a for name, a in arrays.items() if not name.removeprefix(BASE).startswith("basis.")}
    for prefix in ("", BASE):
        if f"{prefix}basis.log_noise_offset" in arrays:
            out |= _log_ratio(arrays, f"{prefix}basis.").to_arrays(f"{prefix}gp.")
    return out


def _over(arrays: Mapping[str, NDArray[Any]], prefix: str) -> _Arrays:
    own = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    kept = {name: a for name, a in arrays.items() if not name.startswith((prefix, _FOR_FILTER))}
    if any(name.startswith("basis.") for name in own):
        kept = {name: a for name, a in kept.items() if not name.startswith(("basis.", "calibration_"))}
    return {**kept, **own}


def _log_ratio(arrays: Mapping[str, NDArray[Any]], prefix: str) -> ProjectedGP:
    """The log variance ratio of an older file: its noise by the kernel of the mean, unless it has its own."""
    at_work = ("weights", "signal_var", "offset")
    if any(np.any(arrays.get(f"{prefix}mean.{name}", 0)) for name in at_work):
        raise ModelError("its GP has a mean of the error, which never gained and is no longer read")
    level = np.asarray(arrays[f"{prefix}log_noise_offset"], np.float64)
    if f"{prefix}noise.weights" not in arrays:
        return ProjectedGP.constant(level)
    names = [(n, f"{prefix}noise.{n}", f"{prefix}mean.{n}") for n in field_names(ProjectedGP)]
    gp = {n: arrays[own if own in arrays else shared] for n, own, shared in names if {own, shared} & arrays.keys()}
    found = ProjectedGP.from_arrays(gp)
    if level.shape != found.offset.shape:
        raise ModelError("the model file's GP arrays do not fit together")
    return replace(found, offset=found.offset + level)
