"""The covariance of each motion of a run from the errors that its twins made there: the method ``twin``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gpvo.dataset.errors import motion_errors
from gpvo.io.run import Run
from gpvo.types import Array, VoLog

METHOD = "twin"
_HALF_WINDOW = 10  # motions on either side that share the shape of a covariance
_ROUNDS = 5
_DOF = 6


def twin_covariance(log: VoLog, twins: Sequence[Run]) -> Array:
    """(N, 6, 6) second moment of the twins' errors of each motion; NaN where too few measured it.

    Few twins show the size of a motion's error, not its shape: eight have 48 numbers for a matrix of 21. So motions
    within a second or so share a shape, and each has a size of its own (D. Tyler, "A distribution-free M-estimator of
    multivariate scatter", 1987, over a moving window): ``C_k = q_k P_k`` with ``P_k`` the mean of ``xi xi^T / q`` of
    the neighbours and ``q_k`` the mean of ``xi^T P_k^-1 xi / 6``. Sizes are widened for what few draws leave unknown.
    """
    xi = np.stack([_errors(log, twin) for twin in twins])
    known = np.isfinite(xi[:, :, 0])
    count = known.sum(axis=0)
    moment = np.einsum("rni,rnj->nij", np.nan_to_num(xi), np.nan_to_num(xi))
    size, shape = np.ones(len(log)), np.full((len(log), _DOF, _DOF), np.nan)
    enough = _over_window(count) >= 4 * _DOF
    if not enough.any():
        return shape
    for _ in range(_ROUNDS):
        mean = _over_window(moment / size[:, None, None]) / np.maximum(_over_window(count), 1)[:, None, None]
        shape[enough] = mean[enough]
        # trace(P^-1 sum xi xi^T) is the sum of the squared, whitened errors.
        solved = np.linalg.solve(shape[enough], moment[enough])
        found = np.trace(solved, axis1=1, axis2=2) / (_DOF * np.maximum(count[enough], 1))
        size[enough] = np.where(count[enough] > 0, np.maximum(found, 1e-6), 1.0)
    dof = _DOF * count.astype(np.float64)
    widened = size * dof / np.maximum(dof - 2.0, 1.0)
    return np.where((enough & (count >= 2))[:, None, None], widened[:, None, None] * shape, np.nan)


def _errors(log: VoLog, twin: Run) -> Array:
    """(N, 6) errors of the twin's motions; NaN where it did not measure the same motion."""
    out = np.full((len(log), _DOF), np.nan)
    assert twin.truth is not None
    place = {(r.t_prev_ns, r.t_ns): k for k, r in enumerate(log)}
    errors = motion_errors(twin.log, twin.truth)
    for k, xi in zip(errors.index, errors.xi, strict=True):
        record = twin.log.records[k]
        own = place.get((record.t_prev_ns, record.t_ns))
        if own is not None and record.dt_s > 0:
            out[own] = xi
    return out


def _over_window(values: Array) -> Array:
    """Sums over each entry (N, ...) and its neighbours."""
    n = len(values)
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    k = np.arange(n)
    return total[np.minimum(k + _HALF_WINDOW + 1, n)] - total[np.maximum(k - _HALF_WINDOW, 0)]
