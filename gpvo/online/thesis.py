"""The thesis' model: Gaussian processes on velocity and inlier count, with constant noise.

Of the error of a motion, an axis each, kept in every model file for comparison with ``learned``; or of the residual of
the position at a point of the trajectory, which is no error of a motion and hence not for filters. Formula: D. Ross,
"Uncertainty Estimation for Stereo Visual Odometry", eqs. 3.19 and 3.20, the latter with the inverse of the kernel
matrix that it lacks in print.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.online import modelfile
from gpvo.online.features import THESIS
from gpvo.online.projected import NoisyGP
from gpvo.online.stored import check_arrays
from gpvo.types import Array

_PREFIX = "thesis."
# Squares forgive single precision; what is subtracted before they are taken does not.
_SINGLE = ("projection",)


@dataclass(frozen=True)
class ThesisModel:
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

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file; :meth:`from_arrays` is the inverse, projections to single precision."""
        out: dict[str, NDArray[Any]] = {
            _PREFIX + name: values
            for name, values in (("centre", self.centre), ("spread", self.spread), ("scale", self.scale))
        }
        if set(self.columns) <= set(THESIS):
            out[f"{_PREFIX}columns"] = np.array([THESIS.index(c) for c in self.columns], dtype=np.int64)
        for j, gp in enumerate(self.gps):
            for name, values in gp.to_arrays(f"{_PREFIX}{j}.").items():
                out[name] = values.astype(np.float32) if name.endswith(_SINGLE) else values
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], columns: tuple[str, ...] = ()) -> ThesisModel:
        """From a model file's arrays; ``columns`` where they are not the thesis' own. Raises ModelError for damaged
        ones."""
        try:
            centre, spread, scale = (np.asarray(arrays[_PREFIX + n], np.float64) for n in ("centre", "spread", "scale"))
            columns = columns or tuple(THESIS[i] for i in arrays[f"{_PREFIX}columns"])
        except (KeyError, IndexError) as missing:
            raise ModelError(f"the model file lacks the array or feature {missing}") from None
        last = [name for name in arrays if name.startswith(_PREFIX) and name.endswith(".log_noise_offset")]
        gps = tuple(NoisyGP.from_arrays(arrays, f"{_PREFIX}{j}.") for j in range(len(last)))
        fit = all(gp.latent.n_inputs == len(columns) == len(centre) for gp in gps)
        if not fit or sum(gp.latent.n_outputs for gp in gps) != len(scale):
            raise ModelError("the model file's thesis arrays do not fit together")
        return cls(columns, centre, spread, scale, gps)

    @classmethod
    def of_positions(cls, path: str | PathLike[str]) -> ThesisModel:
        """From a file of ``--target position``: residuals [m] in the axes of the first camera. Raises ModelError, one
        line, where the file cannot be used."""
        arrays, header = modelfile.load(path)
        if header.get("target") != "position":
            raise ModelError("this model predicts the error of a motion", where=path, cure="use Predictor")
        check_arrays(arrays)
        return cls.from_arrays(arrays, tuple(header["features"]))
