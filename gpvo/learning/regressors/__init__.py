"""GP regressors behind one protocol, chosen by name; others join by the entry point group ``gpvo.regressors``."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from gpvo.errors import GpvoError
from gpvo.learning.regressors.base import FittedGP, Hyperparameters, Regressor

__all__ = ["FittedGP", "Hyperparameters", "Regressor", "get_regressor", "regressor_names"]

EXACT_ROWS = 2000
"""Above this many rows ``auto`` takes ``sparse``."""

_BUILT_IN = {
    "exact": "gpvo.learning.regressors.sparse:exact",
    "sparse": "gpvo.learning.regressors.sparse:SparseRegressor",
    "svgp": "gpvo.learning.regressors.svgp:SvgpRegressor",
    "sklearn": "gpvo.learning.regressors.sklearn_gp:SklearnRegressor",
}


def regressor_names() -> tuple[str, ...]:
    """Names that :func:`get_regressor` knows: the built-in ones, then those of installed packages.

    A package joins with ``[project.entry-points."gpvo.regressors"]`` and ``name = "package.module:Class"``; the class
    follows :class:`Regressor`, takes options as keywords, and is chosen by ``gpvo train --regressor name``. A built-in
    name cannot be taken over.
    """
    outside = {entry.name for entry in entry_points(group="gpvo.regressors")}
    return (*_BUILT_IN, *sorted(outside - set(_BUILT_IN)))


def get_regressor(name: str, *, n_rows: int | None = None, **options: Any) -> Regressor:
    """A regressor by name; ``auto`` is ``exact`` up to 2,000 rows and ``sparse`` above.

    ``options`` go to the regressor: all take ``isotropic``, ``threads`` and ``hyper`` (fixed hyperparameters);
    ``sparse`` and ``svgp`` also ``inducing``; ``svgp`` ``device`` ("auto", "cpu", "cuda"). Raises GpvoError for
    unknown names.
    """
    if name == "auto":
        name = "exact" if n_rows is not None and n_rows <= EXACT_ROWS else "sparse"
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        found = getattr(import_module(module), attribute)
    else:
        outside = {entry.name: entry for entry in entry_points(group="gpvo.regressors")}
        if name not in outside:
            raise GpvoError(f"unknown regressor '{name}'", cure=f"one of: auto, {', '.join(regressor_names())}")
        found = outside[name].load()
    return found(**options)
