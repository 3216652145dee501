"""The other ways of stating the uncertainty, fitted to the same sequences: what ``learned`` is compared with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.dataset.build import TrainingSet
from gpvo.learning.thesis import ThesisModel
from gpvo.types import IMPORTED, Array

Statement = Callable[[TrainingSet], tuple[Array, Array] | None]
"""Mean (n, 6) and covariance (n, 6, 6) of a sequence; None where it lacks what the method needs."""

GEOMETRIC = ("triangulation", "pointing_matching")
STATED = (*GEOMETRIC, IMPORTED)
METHODS = (
    "constant",
    *STATED,
    *(f"{m}_scaled" for m in STATED),
    *(f"{m}_vt" for m in GEOMETRIC),
    "gp_thesis",
    "base",
    "learned",
)


def constant_covariance(sets: Sequence[TrainingSet]) -> Array:
    """(6, 6) mean square of the training errors."""
    Y = np.concatenate([s.Y for s in sets])
    return Y.T @ Y / len(Y) + 1e-15 * np.eye(6)


def best_scale(sets: Sequence[TrainingSet], method: str) -> Array | None:
    """(6,) factor per axis on the variance with the best joint likelihood on all rows.

    With ``D = diag(1 / a)`` the negative log-likelihood of ``D C D`` is ``a^T M a / 2 - sum ln a`` up to a constant,
    where M is the mean of ``e e^T * C^-1`` (element by element): convex, solved by damped Newton steps.
    """
    M, rows = np.zeros((6, 6)), 0
    for s in sets:
        if method in s.covariances:
            known = np.isfinite(s.covariances[method]).all(axis=(1, 2))
            e = s.Y[known]
            M += (e[:, :, None] * e[:, None, :] * np.linalg.inv(s.covariances[method][known])).sum(axis=0)
            rows += int(known.sum())
    if rows == 0:
        return None
    M /= rows
    a = 1.0 / np.sqrt(np.maximum(np.diagonal(M), 1e-300))
    for _ in range(100):
        slope = M @ a - 1.0 / a
        step = np.linalg.solve(M + np.diag(1.0 / a**2), slope)
        a = np.maximum(a - step, 0.1 * a)
        if np.abs(step / a).max() < 1e-12:
            break
    return 1.0 / a**2


def method_arrays(sets: Sequence[TrainingSet]) -> dict[str, NDArray[Any]]:
    """What a model file keeps of the simple methods: ``method.constant`` (6, 6), ``method.<stated>.scale`` (6,)."""
    out: dict[str, NDArray[Any]] = {"method.constant": constant_covariance(sets)}
    for method in STATED:
        scale = best_scale(sets, method)
        if scale is not None:
            out[f"method.{method}.scale"] = scale
    return out


def simple_statements(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Statement]:
    """All rows but ``gp_thesis``, ``base`` and ``learned``, from a model file's arrays."""
    out: dict[str, Statement] = {"constant": _constant(arrays["method.constant"])}
    for method in STATED:
        out[method] = _stated(method, None)
        scale = arrays.get(f"method.{method}.scale")
        out[f"{method}_scaled"] = _nothing if scale is None else _stated(method, scale)
    return out | {f"{method}_vt": _translation_only(method) for method in GEOMETRIC}


def _nothing(_: TrainingSet) -> None:
    return None


def _constant(C: Array) -> Statement:
    return lambda s: (np.zeros_like(s.Y), np.broadcast_to(C, (len(s), 6, 6)))


def _stated(method: str, scale: Array | None) -> Statement:
    root = np.ones(6) if scale is None else np.sqrt(scale)

    def state(s: TrainingSet) -> tuple[Array, Array] | None:
        if method not in s.covariances:
            return None
        return np.zeros_like(s.Y), s.covariances[method] * np.outer(root, root)

    return state


def _translation_only(method: str) -> Statement:
    return lambda s: (np.zeros_like(s.Y), s.v_t[method]) if method in s.v_t else None


def thesis_statement(model: ThesisModel) -> Statement:
    """What the thesis' model states of a sequence."""
    return lambda s: model.predict(s.select(model.columns))
