"""The thesis' model: Gaussian processes on velocity and inlier count, with constant noise.

They predict the error of a motion, one axis each, kept in every model file for comparison with ``learned``; or the
residual of the position at a point of the trajectory, which is not the error of a motion and hence not for filters.
Formula: D. Ross, "Uncertainty Estimation for Stereo Visual Odometry", eqs. 3.19 and 3.20, the latter with the inverse
of the kernel matrix that is missing in print.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.errors import ModelError
from gpvo.learning.config import supported_columns
from gpvo.learning.regressors import ON_ALL_ROWS, get_regressor
from gpvo.online import modelfile
from gpvo.online.features import THESIS
from gpvo.online.projected import ProjectedGP
from gpvo.online.stored import Stored, check_arrays
from gpvo.types import Array

_PREFIX = "thesis."
# Squares forgive single precision; what is subtracted before they are taken does not.
_SINGLE = ("projection",)


@dataclass(frozen=True)
class NoisyGP(Stored):
    """A GP of a measured quantity: ``latent``, and noise that is the same everywhere, ``log_noise_offset`` (D,)."""

    latent: ProjectedGP
    log_noise_offset: Array

    parts: ClassVar = {"latent": (ProjectedGP, "mean.")}

    def predict(self, X: ArrayLike) -> tuple[Array, Array]:
        """Mean and variance (n, D) of the measured quantity at rows X (n, d)."""
        mean, variance = self.latent.evaluate(X)
        return mean, variance + np.exp(self.log_noise_offset)


@dataclass(frozen=True)
class ThesisModel(Stored):
    """``columns``: features, by default those of ``thesis`` that the logs hold. ``centre``, ``spread`` (d,) standardise
    them. ``gps``: of all D outputs, in units of ``scale`` (D,); outputs of one share its kernel. Their noise is inside.
    """

    columns: tuple[str, ...]
    centre: Array
    spread: Array
    scale: Array
    gps: tuple[NoisyGP, ...]

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Mean (n, D) and covariance (n, D, D), diagonal, of rows X (n, d); a missing value counts as typical."""
        U = np.nan_to_num((np.asarray(X, dtype=np.float64) - self.centre) / self.spread, nan=0.0)
        mean, variance = (np.hstack(of_gps) for of_gps in zip(*(gp.predict(U) for gp in self.gps)))
        return mean * self.scale, (variance * self.scale**2)[:, :, None] * np.eye(len(self.scale))

    def to_arrays(self, prefix: str = _PREFIX) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file; :meth:`of_file` is the inverse, projections to single precision."""
        out = super().to_arrays(prefix)
        if set(self.columns) <= set(THESIS):
            out[f"{prefix}columns"] = np.array([THESIS.index(c) for c in self.columns], dtype=np.int64)
        for j, gp in enumerate(self.gps):
            out |= gp.to_arrays(f"{prefix}{j}.")
        return {name: a.astype(np.float32) if name.endswith(_SINGLE) else a for name, a in out.items()}

    @classmethod
    def of_file(cls, arrays: Mapping[str, NDArray[Any]], columns: tuple[str, ...] = ()) -> ThesisModel:
        """From a model file's arrays; ``columns`` where they are not the thesis' own. Raises ModelError for damaged
        ones."""
        try:
            columns = columns or tuple(THESIS[i] for i in arrays[f"{_PREFIX}columns"])
        except (KeyError, IndexError) as missing:
            raise ModelError(f"the model file lacks the array or feature {missing}") from None
        count = sum(name.startswith(_PREFIX) and name.endswith(".log_noise_offset") for name in arrays)
        gps = tuple(NoisyGP.from_arrays(arrays, f"{_PREFIX}{j}.") for j in range(count))
        model = cls.from_arrays(arrays, _PREFIX, columns=columns, gps=gps)
        fit = all(len(gp.latent.centre) == len(columns) == len(model.centre) for gp in gps)
        if not fit or sum(len(gp.latent.offset) for gp in gps) != len(model.scale):
            raise ModelError("the model file's thesis arrays do not fit together")
        return model

    @classmethod
    def of_positions(cls, path: str | PathLike[str]) -> ThesisModel:
        """From a file of ``--target position``: residuals [m] in the axes of the first camera. Raises ModelError, one
        line, if the file cannot be used."""
        arrays, header = modelfile.load(path)
        if header.get("target") != "position":
            raise ModelError("this model predicts the error of a motion", where=path, cure="use Predictor")
        check_arrays(arrays)
        return cls.of_file(arrays, tuple(header["features"]))


def fit_thesis(
    sets: Sequence[TrainingSet],
    columns: Sequence[str] = THESIS,
    regressor: str = "sparse",
    *,
    shared: bool = False,
    seed: int = 0,
    inducing: int = 128,
) -> ThesisModel:
    """GPs of the errors on ``columns``, by default velocity and inlier count (velocity alone where the log has no
    counts): one isotropic RBF kernel for each axis, or one that all ``shared``, by ``regressor``; constant noise."""
    names = supported_columns(sets, columns) or THESIS[:3]
    X, Y = np.concatenate([s.select(names) for s in sets]), np.concatenate([s.Y for s in sets])
    known = np.isfinite(X).all(axis=1)
    X, Y = X[known], Y[known]
    centre, spread = X.mean(axis=0), np.maximum(X.std(axis=0), 1e-9)
    scale = np.maximum(Y.std(axis=0), 1e-12)
    U, Y = (X - centre) / spread, Y / scale
    if shared:
        points = {} if regressor in ON_ALL_ROWS else {"inducing": inducing}
        fits = [get_regressor(regressor, n_rows=len(X), isotropic=True, **points).fit(U, Y, seed=seed)]
    else:
        from gpvo.learning.regressors.sparse import SparseRegressor  # with torch, which reading a model does without

        fits = SparseRegressor(inducing=inducing).fit_each(U, Y, seed=seed)
    gps = tuple(NoisyGP(fit.gp, np.log(fit.hyper.noise_var)) for fit in fits)
    return ThesisModel(tuple(names), centre, spread, scale, gps)
