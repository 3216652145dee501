"""The Gaussian processes of an error model, of its mean and its noise, on one shared kernel where they can share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.errors import ModelError
from gpvo.online.projected import ProjectedGP
from gpvo.online.rowplan import RowPlan, StackedBasis, stack
from gpvo.types import Array

__all__ = ["NEVER", "BasisPrediction", "ProjectedGP", "SharedBasis"]

NEVER = 1e12
"""Length scale of an input that plays no part."""

_GP_FIELDS = ("centre", "lengthscale", "points", "projection", "weights", "reduction", "signal_var", "offset")
_SHARED_FIELDS = ("weights", "reduction", "signal_var", "offset")


class BasisPrediction(NamedTuple):
    """What the GPs say, each (n, D) for many rows or (D,) for one.

    ``mean``: of the error. ``epistemic_var``: variance of that mean, grows away from the training data.
    ``log_noise_var``: log of the expected squared noise; with a base log-variance the model was trained as a ratio to
    it, so add the base. ``log_noise_spread``: variance of the log noise variance, whose half is already inside
    ``log_noise_var``: ``exp(log_noise_var) (1 - exp(-log_noise_spread / 2))`` is the part of the noise variance owed
    to ignorance.
    """

    mean: Array
    epistemic_var: Array
    log_noise_var: Array
    log_noise_spread: Array


class SharedBasis:
    """Mean, epistemic variance and input-dependent noise of D outputs, from features alone; NumPy only.

    ``mean``: GP of the error. ``noise``: GP of the log of the noise variance (or of its ratio to a base), None for
    constant noise; where it is built on the very arrays ``points`` and ``projection`` of ``mean``, kernel and
    projection are computed once. ``log_noise_offset`` (D,): added to the log-variance (tail and calibration
    constants; all of it if ``noise`` is None).

    ``predict_one`` reuses its buffers: one instance per thread.
    """

    def __init__(self, mean: ProjectedGP, noise: ProjectedGP | None, log_noise_offset: Array) -> None:
        self.mean = mean
        self.noise = noise
        self.log_noise_offset = np.asarray(log_noise_offset, dtype=np.float64)
        if self.log_noise_offset.shape != (mean.n_outputs,):
            raise ModelError(f"log_noise_offset has shape {self.log_noise_offset.shape}, expected ({mean.n_outputs},)")
        if noise is not None and (noise.n_inputs, noise.n_outputs) != (mean.n_inputs, mean.n_outputs):
            raise ModelError("the GPs of mean and noise differ in their number of inputs or outputs")
        self._row: RowPlan | None = None

    @property
    def n_inputs(self) -> int:
        """d."""
        return self.mean.n_inputs

    @property
    def n_outputs(self) -> int:
        """D."""
        return self.mean.n_outputs

    @property
    def shares_kernel(self) -> bool:
        """Whether the noise model uses the points and the projection of the mean."""
        return self.noise is not None and self.noise.points is self.mean.points

    def predict(self, X: ArrayLike) -> BasisPrediction:
        """Rows X (n, d), in the units of training, in float64."""
        X = np.asarray(X, dtype=np.float64)
        if X.ndim != 2 or X.shape[1] != self.n_inputs:
            raise ValueError(f"expected rows of {self.n_inputs} features, got an array of shape {X.shape}")
        mean, var = self.mean.evaluate(X)
        if self.noise is None:
            log_noise, spread = np.zeros_like(mean), np.zeros_like(mean)
        else:
            log_noise, spread = self.noise.evaluate(X)
        return BasisPrediction(mean, var, log_noise + 0.5 * spread + self.log_noise_offset, spread)

    def predict_one(self, x: Array) -> BasisPrediction:
        """One row x (d,), float64: the same from a float32 projection, in buffers made once; fresh arrays out."""
        if self._row is None:
            self._row = RowPlan(self.stacked())
        return BasisPrediction(*self._row(x))

    def stacked(self) -> StackedBasis:
        """The same as plain matrices."""
        return stack(self.mean, self.noise, self.log_noise_offset)

    def to_arrays(self, prefix: str = "") -> dict[str, Array]:
        """Named arrays for a model file; :meth:`from_arrays` is the inverse."""
        out = {f"{prefix}mean.{name}": getattr(self.mean, name) for name in _GP_FIELDS}
        out[f"{prefix}log_noise_offset"] = self.log_noise_offset
        if self.noise is not None:
            names = _SHARED_FIELDS if self.shares_kernel else _GP_FIELDS
            out |= {f"{prefix}noise.{name}": getattr(self.noise, name) for name in names}
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> SharedBasis:
        """The basis from named arrays. Raises ModelError where one is missing or of the wrong shape."""
        try:
            mean = ProjectedGP(**{n: np.asarray(arrays[f"{prefix}mean.{n}"], np.float64) for n in _GP_FIELDS})
            noise = None
            if f"{prefix}noise.weights" in arrays:
                own = f"{prefix}noise.points" in arrays
                found = {
                    n: np.asarray(arrays[f"{prefix}noise.{n}"], np.float64)
                    for n in _GP_FIELDS
                    if own or n in _SHARED_FIELDS
                }
                noise = ProjectedGP(**{n: found[n] if n in found else getattr(mean, n) for n in _GP_FIELDS})
            return cls(mean, noise, np.asarray(arrays[f"{prefix}log_noise_offset"], np.float64))
        except KeyError as missing:
            raise ModelError(f"the model file lacks the array {missing}") from None
        except (ValueError, IndexError) as wrong:
            raise ModelError(f"the model file's GP arrays do not fit together: {wrong}") from None
