"""The thesis' own prediction: the residual of the position at a point of the trajectory. Not for filters.

It has its own type on purpose: a residual of an accumulated position is no error of a motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.errors import ModelError
from gpvo.online import modelfile
from gpvo.online.observer import Observer
from gpvo.online.projected import NoisyGP
from gpvo.types import Array, StereoCamera, VoRecord


@dataclass(frozen=True)
class PositionPrediction:
    """``mean`` (3,) and ``sigma`` (3,) [m] of the position's residual in the axes of the first camera."""

    t_ns: int
    mean: Array
    sigma: Array


class PositionPredictor:
    """Predicts position residuals from features; see :class:`gpvo.online.predictor.Predictor` for errors of motions."""

    def __init__(self, arrays: Mapping[str, NDArray[Any]], header: Mapping[str, Any]) -> None:
        if header.get("target") != "position":
            raise ModelError("this model predicts the error of a motion", cure="use Predictor")
        self.header = dict(header)
        self.features = tuple(header["features"])
        self._gp = NoisyGP.from_arrays(arrays, "basis.")
        self._centre, self._scale = arrays["feature.centre"], arrays["feature.scale"]
        camera = header.get("camera")
        self._observer = Observer(self.features, "position", None if camera is None else StereoCamera(**camera))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> PositionPredictor:
        """From a model file. Raises ModelError, one line, where the file cannot be used."""
        return cls(*modelfile.load(path))

    def predict(self, features: ArrayLike) -> tuple[Array, Array]:
        """Mean and standard deviation [m], (n, 3) each, for rows (n, d); (3,) each for one row (d,)."""
        X = np.asarray(features, dtype=np.float64)
        U = (np.where(np.isfinite(X), X, self._centre) - self._centre) / self._scale
        mean, variance = self._gp.predict(np.atleast_2d(U))
        return (mean[0], np.sqrt(variance[0])) if X.ndim == 1 else (mean, np.sqrt(variance))

    def step(self, record: VoRecord) -> PositionPrediction:
        """Prediction for the next record of a run."""
        seen = self._observer.step(record)
        assert seen is not None  # Only windows take time to fill.
        mean, sigma = self.predict(seen[1])
        return PositionPrediction(record.t_ns, mean, sigma)
