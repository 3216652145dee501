"""The thesis' model of the error: a Gaussian process per axis on velocity and inlier count, with constant noise.

Kept in every model file for comparison with ``learned``. Formula: D. Ross, "Uncertainty Estimation for Stereo Visual
Odometry", eqs. 3.19 and 3.20, the latter with the inverse of the kernel matrix that it lacks in print.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import ModelError
from gpvo.online.features import THESIS
from gpvo.online.projected import NoisyGP
from gpvo.types import Array

_PREFIX = "thesis."
# Squares forgive single precision; what is subtracted before they are taken does not.
_SINGLE = ("projection",)


@dataclass(frozen=True)
class ThesisModel:
    """``columns``: features, those of ``thesis`` that the logs hold. ``centre``, ``spread`` (d,) standardise them.

    ``axes``: one GP of one output per axis of the error, in units of ``scale`` (D,), its noise inside.
    """

    columns: tuple[str, ...]
    centre: Array
    spread: Array
    scale: Array
    axes: tuple[NoisyGP, ...]

    def predict(self, X: Array) -> tuple[Array, Array]:
        """Mean (n, D) and covariance (n, D, D), diagonal, of rows X (n, d); a missing value counts as zero."""
        U = (np.nan_to_num(np.asarray(X, dtype=np.float64), nan=0.0) - self.centre) / self.spread
        mean, variance = (np.hstack(of_axes) for of_axes in zip(*(gp.predict(U) for gp in self.axes)))
        return mean * self.scale, (variance * self.scale**2)[:, :, None] * np.eye(len(self.axes))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file; :meth:`from_arrays` is the inverse, projections to single precision."""
        out: dict[str, NDArray[Any]] = {
            f"{_PREFIX}centre": self.centre,
            f"{_PREFIX}spread": self.spread,
            f"{_PREFIX}scale": self.scale,
            f"{_PREFIX}columns": np.array([THESIS.index(c) for c in self.columns], dtype=np.int64),
        }
        for j, gp in enumerate(self.axes):
            for name, values in gp.to_arrays(f"{_PREFIX}{j}.").items():
                out[name] = values.astype(np.float32) if name.endswith(_SINGLE) else values
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> ThesisModel | None:
        """From a model file's arrays; None where it holds none, as older files. Raises ModelError for damaged ones."""
        if f"{_PREFIX}scale" not in arrays:
            return None
        try:
            centre, spread, scale = (np.asarray(arrays[_PREFIX + n], np.float64) for n in ("centre", "spread", "scale"))
            columns = tuple(THESIS[i] for i in arrays[f"{_PREFIX}columns"])
        except (KeyError, IndexError) as missing:
            raise ModelError(f"the model file lacks the array or feature {missing}") from None
        axes = tuple(NoisyGP.from_arrays(arrays, f"{_PREFIX}{j}.") for j in range(len(scale)))
        if not len(columns) == len(centre) == len(spread) or any(
            (gp.latent.n_inputs, gp.latent.n_outputs) != (len(centre), 1) for gp in axes
        ):
            raise ModelError("the model file's thesis arrays do not fit together")
        return cls(columns, centre, spread, scale, axes)
