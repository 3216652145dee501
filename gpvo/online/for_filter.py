"""A model file holds two models: one that predicts, and the one that a filter needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

FOR_FILTER = "for_filter."
"""Prefix of the arrays in which the model for filters differs."""
_ONLY_SOME = ("basis.", "calibration_")
"""Of these a model may have fewer than the other."""


def arrays_for_filter(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays of a model file with those of the model for filters in their place.

    Its covariance is that of the error as it stands, and its mean the steady one alone. A GP's mean that sees VO's own
    motion holds what was usual in training, and says "you did not really move like that" where VO sees little; one that
    sees the conditions is right of plain sums, where bad frames count most, and too large in the good frames by which a
    filter goes.
    """
    own = {name.removeprefix(FOR_FILTER): a for name, a in arrays.items() if name.startswith(FOR_FILTER)}
    dropped = (FOR_FILTER, *_ONLY_SOME) if any(name.startswith("basis.") for name in own) else (FOR_FILTER,)
    return {**{name: a for name, a in arrays.items() if not name.startswith(dropped)}, **own}
