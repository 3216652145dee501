"""GP regressors behind one protocol, chosen by name; others join by the entry point group ``gpvo.regressors``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpvo.errors import GpvoError, plugins
from gpvo.online.projected import ProjectedGP
from gpvo.types import Array


@dataclass(frozen=True)
class Hyperparameters:
    """Of a squared-exponential kernel shared by D outputs of d inputs, in the units of the data.

    ``lengthscale`` (d,); ``signal_var``, ``noise_var`` (D,).
    """

    lengthscale: Array
    signal_var: Array
    noise_var: Array


@dataclass(frozen=True)
class FittedGP:
    """A fitted GP: its posterior in projected form, in the units of the data.

    ``gp``: posterior of the latent functions (NumPy, see ``gpvo.online.projected``). ``hyper``: what was learned.
    ``log_evidence``: log marginal likelihood, or its lower bound, in nats and in the units of the data.
    """

    gp: ProjectedGP
    hyper: Hyperparameters
    log_evidence: float

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Mean (n, D) and latent variance (n, D) at rows X (n, d); add ``hyper.noise_var`` for an observation."""
        return self.gp.evaluate(X)


class Regressor(Protocol):
    """Fits D outputs that share one kernel. Options go to the constructor; the same data give the same bits."""

    @property
    def name(self) -> str:
        """By which it is chosen."""
        ...

    def fit(self, X: Array, Y: Array, *, seed: int = 0) -> FittedGP:
        """Learn the hyperparameters and the posterior of X (n, d) and Y (n, D), both finite.

        Raises ValueError on shapes that do not fit.
        """
        ...


@dataclass(frozen=True)
class Scaling:
    """Affine maps that give inputs and outputs zero mean and unit variance: centres and scales (d,), (D,)."""

    x_centre: Array
    x_scale: Array
    y_centre: Array
    y_scale: Array

    @classmethod
    def of(cls, X: Array, Y: Array) -> Scaling:
        """Moments of the columns; constant columns get scale 1."""
        x_centre, y_centre, x_scale, y_scale = X.mean(axis=0), Y.mean(axis=0), X.std(axis=0), Y.std(axis=0)
        x_scale[~(x_scale > 1e-12 * (1 + np.abs(x_centre)))] = 1.0
        y_scale[~(y_scale > 1e-12 * np.abs(y_centre))] = 1.0
        return cls(x_centre, x_scale, y_centre, y_scale)

    def inputs(self, X: Array) -> Array:
        """Standardised inputs."""
        return (X - self.x_centre) / self.x_scale

    def outputs(self, Y: Array) -> Array:
        """Standardised outputs."""
        return (Y - self.y_centre) / self.y_scale

    def scaled(self, hyper: Hyperparameters) -> Hyperparameters:
        """Hyperparameters of the data as those of the standardised data."""
        y2 = self.y_scale**2
        return Hyperparameters(hyper.lengthscale / self.x_scale, hyper.signal_var / y2, hyper.noise_var / y2)

    def unscaled(self, hyper: Hyperparameters) -> Hyperparameters:
        """Hyperparameters of the standardised data as those of the data."""
        y2 = self.y_scale**2
        return Hyperparameters(hyper.lengthscale * self.x_scale, hyper.signal_var * y2, hyper.noise_var * y2)


def checked(X: Array, Y: Array) -> tuple[Array, Array]:
    """X (n, d) and Y (n, D) as float64, or ValueError with the shapes received."""
    X, Y = np.asarray(X, dtype=np.float64), np.asarray(Y, dtype=np.float64)
    Y = Y[:, None] if Y.ndim == 1 else Y
    if X.ndim != 2 or Y.ndim != 2 or len(X) != len(Y) or len(X) < 2:
        raise ValueError(f"expected X (n, d) and Y (n, D) with n >= 2, got {X.shape} and {Y.shape}")
    if not (np.isfinite(X).all() and np.isfinite(Y).all()):
        raise ValueError("X and Y must be finite")
    return X, Y


__all__ = ["FittedGP", "Hyperparameters", "Regressor", "get_regressor", "regressor_names"]

ON_ALL_ROWS = ("exact", "sklearn")
"""Those whose time grows with the cube of the rows."""
EXACT_ROWS, MOST_EXACT_ROWS = 2000, 10_000
"""Above this many rows ``auto`` takes ``sparse``, and those of :data:`ON_ALL_ROWS` are refused: ten thousand take an
hour or so, a hundred thousand 80 GB for each matrix."""

_BUILT_IN = {
    "exact": "gpvo.learning.regressors.sparse:exact",
    "sparse": "gpvo.learning.regressors.sparse:SparseRegressor",
    "svgp": "gpvo.learning.regressors.svgp:SvgpRegressor",
    "sklearn": "gpvo.learning.regressors.sparse:SklearnRegressor",
}


def regressor_names() -> tuple[str, ...]:
    """Names that :func:`get_regressor` knows: the built-in ones, then those of installed packages.

    A package joins with ``[project.entry-points."gpvo.regressors"]`` and ``name = "package.module:Class"``; the class
    follows :class:`Regressor`, takes options as keywords, and is chosen by ``gpvo train --regressor name``. A built-in
    name cannot be overridden.
    """
    return (*_BUILT_IN, *sorted(plugins("gpvo.regressors", {}).keys() - _BUILT_IN.keys()))


def get_regressor(name: str, *, n_rows: int | None = None, **options: Any) -> Regressor:
    """A regressor by name; ``auto`` is ``exact`` up to 2,000 rows and ``sparse`` above.

    ``options`` go to the regressor: all take ``isotropic``, ``threads`` and ``hyper`` (fixed hyperparameters);
    ``sparse`` and ``svgp`` also ``inducing``; ``svgp`` ``device`` ("auto", "cpu", "cuda"). Raises GpvoError for
    unknown names, and where ``n_rows`` are more than it can learn from.
    """
    if name == "auto":
        name = "exact" if n_rows is not None and n_rows <= EXACT_ROWS else "sparse"
    known = plugins("gpvo.regressors", _BUILT_IN)
    if name not in known:
        raise GpvoError(f"unknown regressor '{name}'", cure=f"one of: auto, {', '.join(regressor_names())}")
    if name in ON_ALL_ROWS and n_rows is not None and n_rows > MOST_EXACT_ROWS:
        text = f"'{name}' learns from at most {MOST_EXACT_ROWS:,} rows, and these are {n_rows:,}"
        raise GpvoError(text, cure="--regressor sparse or svgp")
    return known[name]()(**options)
