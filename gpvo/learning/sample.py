"""The sample of training rows that a model file keeps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.online.sample import TrainingSample

SAMPLE_ROWS = 1024
_LEAST_PER_SEQUENCE = 16


def draw_sample(sets: Sequence[TrainingSet], columns: Sequence[str], method: str | None) -> TrainingSample:
    """About 1,024 rows, evenly over the time of each sequence and equally many of each (at least 16, of at most 64
    sequences). ``method``: of the geometric covariances to keep."""
    wanted = SAMPLE_ROWS // _LEAST_PER_SEQUENCE
    chosen = np.unique(np.linspace(0, len(sets) - 1, min(len(sets), wanted)).round().astype(int))
    each = SAMPLE_ROWS // len(chosen)
    X, sequence, dt_s, geometry = [], [], [], []
    for i in chosen.tolist():
        s = sets[i]
        at = _leading_on(s)
        rows = at[np.unique(np.linspace(0, len(at) - 1, min(len(at), each)).round().astype(int))]
        X.append(s.select(columns)[rows])
        sequence.append(np.full(len(rows), i, dtype=np.int32))
        dt_s.append(s.dt_s[rows])
        if method is not None:
            geometry.append(s.covariances[method][rows])
    joined = np.concatenate(geometry) if geometry else None
    return TrainingSample(np.concatenate(X), np.concatenate(sequence), np.concatenate(dt_s), joined)


def _leading_on(s: TrainingSet) -> NDArray[np.int64]:
    """Rows from whose end the next motion starts; all where there are hardly any, as with overlapping windows."""
    starts = s.t_ns[1:] - np.round(s.dt_s[1:] * 1e9).astype(np.int64)
    rows = np.flatnonzero(np.abs(starts - s.t_ns[:-1]) < 1000)
    return rows if len(rows) >= _LEAST_PER_SEQUENCE else np.arange(len(s))
