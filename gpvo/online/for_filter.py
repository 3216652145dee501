"""A model file holds three models: one that predicts, the one that a filter needs, and its base without the GP."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOR_FILTER = "for_filter."
"""Prefix of the arrays in which the model for filters differs."""
BASE = "base."
"""Prefix of the arrays in which the model with its GP held at the mean function, the base variance, differs."""
_ONLY_SOME = ("basis.", "calibration_")
"""Of these a model may have fewer than the other."""


def arrays_for_filter(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays of a model file with those of the model for filters in their place.

    Its covariance is that of the error as it stands, and its mean the steady one alone. Older files hold a mean that
    depends on the conditions, and a model fitted without it for filters: such a mean is right of plain sums, where bad
    frames count most, and too large in the good frames by which a filter goes.
    """
    return _variant(arrays, FOR_FILTER)


def arrays_of_base(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays of a model file with those of its base in their place: the base variance, and a calibration of its
    own. The same as the model where the GP is not at work, and in older files."""
    return _variant(arrays, BASE)


def different_arrays(
    prefix: str, own: Mapping[str, NDArray[Any]], others: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[Any]]:
    """The arrays ``own`` that differ from ``others``, and those that only some models have, under a prefix."""
    return {
        prefix + name: a
        for name, a in own.items()
        if name.startswith(_ONLY_SOME) or name not in others or not np.array_equal(a, others[name])
    }


def _variant(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    own = {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}
    dropped = (FOR_FILTER, BASE, *_ONLY_SOME) if any(name.startswith("basis.") for name in own) else (FOR_FILTER, BASE)
    return {**{name: a for name, a in arrays.items() if not name.startswith(dropped)}, **own}
