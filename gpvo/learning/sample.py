"""The sample of training rows that a model file keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.errors import ModelError
from gpvo.geometry.covariance import from_upper, upper
from gpvo.types import Array


@dataclass(frozen=True)
class TrainingSample:
    """Rows of the training set, equally from every sequence: motions whose end is the reference of the next.

    ``X`` (n, d): the model's features, NaN where unknown. ``sequence`` (n,): which sequence each row is from.
    ``dt_s`` (n,): duration of each motion, more than a frame's where odometry kept its reference.
    ``geometry`` (n, 6, 6): covariance by the model's geometric method [m, rad]; None where the model has none.
    """

    X: Array
    sequence: NDArray[np.int32]
    dt_s: Array
    geometry: Array | None

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file; :meth:`from_arrays` is the inverse (features to single precision)."""
        out: dict[str, NDArray[Any]] = {"sample.X": self.X.astype(np.float32), "sample.sequence": self.sequence}
        out["sample.dt_s"] = self.dt_s
        if self.geometry is not None:
            out["sample.geometry"] = upper(self.geometry)
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_features: int) -> TrainingSample:
        """The sample of a model file. Raises ModelError if it has none, as in older files."""
        if any(f"sample.{name}" not in arrays for name in ("X", "sequence", "dt_s")):
            raise ModelError("the model holds no sample of its training rows", cure="train it again")
        X, sequence, dt_s = arrays["sample.X"].astype(np.float64), arrays["sample.sequence"], arrays["sample.dt_s"]
        packed = arrays.get("sample.geometry")
        sizes_fit = X.ndim == 2 and X.shape[1] == n_features and sequence.shape == dt_s.shape == (len(X),) != (0,)
        if not sizes_fit or (packed is not None and packed.shape != (len(X), 21)):
            raise ModelError("the model's sample of training rows does not fit its features", cure="train it again")
        return cls(X, sequence, dt_s, None if packed is None else from_upper(packed, 6))


SAMPLE_ROWS = 1024
_LEAST_PER_SEQUENCE = 16


def draw_sample(sets: Sequence[TrainingSet], columns: Sequence[str], method: str | None) -> TrainingSample:
    """About 1,024 rows, evenly over the time of each sequence and equally many of each (at least 16, of at most 64
    sequences). ``method``: of the geometric covariances to keep."""
    wanted = SAMPLE_ROWS // _LEAST_PER_SEQUENCE
    chosen = np.unique(np.linspace(0, len(sets) - 1, min(len(sets), wanted)).round().astype(int))
    each = SAMPLE_ROWS // len(chosen)
    parts = []
    for i in chosen.tolist():
        s, at = sets[i], _leading_on(sets[i])
        rows = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), each)).round().astype(int))]
        stated = [] if method is None else [s.covariances[method][rows]]
        parts.append((s.select(columns)[rows], np.full(len(rows), i, dtype=np.int32), s.dt_s[rows], *stated))
    X, sequence, dt_s, *geometry = (np.concatenate(of_all) for of_all in zip(*parts, strict=True))
    return TrainingSample(X, sequence, dt_s, geometry[0] if geometry else None)


def _leading_on(s: TrainingSet) -> NDArray[np.int64]:
    """Rows from whose end the next motion starts; all rows if there are hardly any, as with overlapping windows."""
    starts = s.t_ns[1:] - np.round(s.dt_s[1:] * 1e9).astype(np.int64)
    rows = np.flatnonzero(np.abs(starts - s.t_ns[:-1]) < 1000)
    return rows if len(rows) >= _LEAST_PER_SEQUENCE else np.arange(len(s))
