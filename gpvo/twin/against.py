"""Twins against ground truth: how much larger real errors are than those of twins, per axis and distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpvo.dataset.align import interpolate_truth
from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.io.run import Run
from gpvo.types import Array

SPANS = ("motion", "1 s", "10 m")
_MIN_WINDOWS = 5


@dataclass(frozen=True)
class Ratios:
    """``ratio`` (R, S, 6): root mean square of the real error over that of the twins, per run, span and axis; NaN
    where a run is too short. ``real`` and ``twin`` (R, S, 6) are the errors themselves [m, rad]."""

    runs: tuple[str, ...]
    real: Array
    twin: Array

    @property
    def ratio(self) -> Array:
        """See the class."""
        return np.asarray(self.real / self.twin, np.float64)

    @property
    def pooled(self) -> tuple[Array, Array]:
        """(S, 6) geometric mean of the ratios over the runs, and the factor by which they spread about it, NaN where
        one run alone is long enough."""
        logs = np.log(self.ratio)
        known = np.isfinite(logs)
        count = np.maximum(known.sum(axis=0), 1)
        mean = np.where(known, logs, 0.0).sum(axis=0) / count
        spread = np.where(known, logs - mean, 0.0) ** 2
        mean = np.where(known.any(axis=0), mean, np.nan)
        variance = spread.sum(axis=0) / np.where(count > 1, count - 1.0, np.nan)
        return np.exp(mean), np.exp(np.sqrt(variance))


def compare(runs: Sequence[Run], twins: Sequence[Sequence[Run]]) -> Ratios:
    """Runs with truth against the twins of each. Raises SourceError where a run has no truth."""
    for run in runs:
        if run.truth is None:
            raise SourceError("has no ground truth to compare twins with", where=run.path, cure="leave out --against")
    real = [errors_over_spans([r]) for r in runs]
    return Ratios(tuple(r.name for r in runs), np.stack(real), np.stack([errors_over_spans(t) for t in twins]))


def errors_over_spans(runs: Sequence[Run]) -> Array:
    """(S, 6) root mean square error over all runs; NaN where fewer than five windows are."""
    return np.stack([_rms(np.concatenate([_errors(run, span) for run in runs])) for span in range(len(SPANS))])


def _rms(xi: Array) -> Array:
    return np.sqrt((xi**2).mean(axis=0)) if len(xi) >= _MIN_WINDOWS else np.full(6, np.nan)


def _errors(run: Run, span: int) -> Array:
    """(M, 6) errors over all windows that hold no lost frame and have truth at both ends."""
    assert run.truth is not None
    T = run.log.trajectory()
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    t_s = (run.log.t_ns - run.log.t_ns[0]) * 1e-9
    length_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    start = np.arange(len(T))
    end = (start + 1, np.searchsorted(t_s, t_s + 1.0 - 1e-6), np.searchsorted(length_m, length_m + 10.0))[span]
    inside = end < len(T)
    start, end = start[inside], end[inside]
    lost = np.cumsum(~run.log.usable)
    whole = (lost[start] == lost[end]) & known[start] & known[end]
    start, end = start[whole], end[whole]
    true, estimated = (se3.inverse(P[start]) @ P[end] for P in (T_true, T))
    return se3.log(se3.inverse(true) @ estimated).reshape(-1, 6)
