"""Curves of one run that both the figures and the page draw."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from gpvo.evaluation.evaluate import Evaluation
from gpvo.evaluation.statements import Statement
from gpvo.stats.consistency import nees
from gpvo.types import Array

LEVELS: Array = np.linspace(0.02, 0.98, 49)
_HALF_WIDTHS: Array = np.array([NormalDist().inv_cdf(0.5 + p / 2) for p in LEVELS])
_NEES_WINDOW_S = 0.5


def full_statements(e: Evaluation) -> list[Statement]:
    """The methods that speak of all six axes of at least two motions with truth."""
    return [s for s in e.statements if s.errors is not None and _stated(e, s).sum() >= 2]


def stated_sigma(s: Statement) -> tuple[Array, Array]:
    """(N,) one stated standard deviation of translation [m] and of rotation [rad], root mean square over axes."""
    variance = np.diagonal(s.covariance, axis1=1, axis2=2)
    return np.sqrt(variance[:, :3].mean(axis=1)), np.sqrt(variance[:, 3:].mean(axis=1))


def best_statement(e: Evaluation) -> Statement | None:
    """The statement to draw bounds of: ``learned`` where there is one, else ``triangulation``, else any full one."""
    full = {s.method: s for s in e.statements if s.errors is not None}
    return full.get("learned") or full.get("triangulation") or next(iter(full.values()), None)


def error_times_s(e: Evaluation) -> Array:
    """(M,) seconds since the first frame, of the motions with truth."""
    return (e.run.log.t_ns[e.errors.index] - e.run.log.t_ns[0]) * 1e-9


def reliability(e: Evaluation, s: Statement) -> Array:
    """Share of errors inside the stated central interval (49,), all axes together, for each of ``LEVELS``."""
    error, C = _stated_errors(e, s)
    z = np.abs(error) / np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    return np.array([(z <= q).mean() for q in _HALF_WIDTHS])


def nees_over_time(e: Evaluation, s: Statement) -> tuple[Array, Array]:
    """Times [s] and joint NEES per degree of freedom, averaged over half a second around each."""
    error, C = _stated_errors(e, s)
    values = nees(error, C) / s.dof
    width = min(len(values), max(1, round(_NEES_WINDOW_S / max(float(np.median(e.errors.dt_s)), 1e-3))))
    # Divide by what lies under the window, or both ends would seem more honest than they are.
    ones = np.ones(width)
    smooth = np.convolve(values, ones, mode="same") / np.convolve(np.ones(len(values)), ones, mode="same")
    return error_times_s(e)[_stated(e, s)], np.maximum(smooth, 1e-3)


def _stated(e: Evaluation, s: Statement) -> NDArray[np.bool_]:
    """(M,) whether the method speaks of each motion with truth."""
    C = s.covariance[e.errors.index]
    return np.asarray(np.isfinite(C).all(axis=(1, 2)), dtype=bool)


def _stated_errors(e: Evaluation, s: Statement) -> tuple[Array, Array]:
    """Errors about the stated mean (K, d) and covariances (K, d, d) of the motions that the method speaks of."""
    known, index = _stated(e, s), e.errors.index
    return (e.errors.xi[:, : s.dof] - s.mean[index][:, : s.dof])[known], s.covariance[index][known]
