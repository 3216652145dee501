"""The error of every position of a flight beside what is said of it, by each way of saying it.

All positions are in the axes of the first camera, whose pose is made equal to the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.accumulation import along
from gpvo.dataset.align import interpolate_truth
from gpvo.geometry import se3
from gpvo.io.run import Run
from gpvo.types import Array, MotionError, VoLog

_FIELDS = ("t_s", "path_m", "error_m", "mean_m", "covariance_m2")


@dataclass(frozen=True)
class Bounds:
    """One flight, N frames with truth. ``t_s``, ``path_m`` (N,): time and length of the true path so far; ``error_m``
    (N, 3) estimate minus truth; ``mean_m`` (N, 3) and ``covariance_m2`` (N, 3, 3): what is said of that error."""

    name: str
    t_s: Array
    path_m: Array
    error_m: Array
    mean_m: Array
    covariance_m2: Array

    @property
    def sigma_m(self) -> Array:
        """(N, 3) stated standard deviations."""
        return np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2))

    @property
    def predicted_m(self) -> Array:
        """(N,) root of the expected squared error: sqrt(|mean|^2 + trace of the covariance)."""
        return np.sqrt((self.mean_m**2).sum(1) + np.trace(self.covariance_m2, axis1=1, axis2=2))


def bounds_of(run: Run, mean_m: Array, covariance_m2: Array) -> Bounds:
    """The frames with truth, of what is said (N, 3), (N, 3, 3) of every frame of a run."""
    assert run.truth is not None
    T_true, known = interpolate_truth(run.truth, run.log.t_ns)
    T_est, first = run.log.trajectory(), int(np.argmax(known))
    T_first_world = T_est[first] @ se3.inverse(T_true[first])
    true_m = (T_first_world @ T_true)[known, :3, 3]
    steps = np.linalg.norm(np.diff(true_m, axis=0), axis=1)
    return Bounds(
        name=run.name,
        t_s=(run.log.t_ns[known] - run.log.t_ns[0]) * 1e-9,
        path_m=np.concatenate([[0.0], np.cumsum(steps)]),
        error_m=T_est[known, :3, 3] - true_m,
        mean_m=mean_m[known],
        covariance_m2=covariance_m2[known],
    )


def summed_v_t(log: VoLog, method: str) -> Array:
    """(N, 3, 3) the thesis' bound: V_T of every motion, turned into the axes of the first camera and summed."""
    T, parent = log.trajectory(), log.parent
    out = np.zeros((len(log), 3, 3))
    last = 1e-12 * np.eye(3)
    for k, record in enumerate(log):
        if parent[k] < 0:
            continue
        stated = record.v_t.get(method)
        last = last if stated is None or not np.isfinite(stated).all() else stated
        R = T[parent[k], :3, :3]
        out[k] = out[parent[k]] + R @ last @ R.T
    return out


def compounded(log: VoLog, errors: Sequence[MotionError]) -> Array:
    """(N, 3, 3) covariance of every position from the errors stated of every motion."""
    R = log.trajectory()[:, :3, :3]
    return R @ along(log.T_prev_cur, errors, log.parent)[1][:, :3, :3] @ np.swapaxes(R, 1, 2)


def mean_shift(log: VoLog, mean: Array) -> Array:
    """(N, 3) [m] by how much positions are expected to be off, given the mean error (N, 6) of every motion."""
    moved = zip(log, log.T_prev_cur @ se3.exp(-mean), strict=True)
    corrected = VoLog([replace(record, T_prev_cur=T) for record, T in moved])
    return log.trajectory()[:, :3, 3] - corrected.trajectory()[:, :3, 3]


def as_arrays(bounds: Sequence[Bounds]) -> dict[str, NDArray[Any]]:
    """All flights as named arrays."""
    out = {f"{k}.{name}": getattr(b, name) for k, b in enumerate(bounds) for name in _FIELDS}
    return {"names": np.array([b.name for b in bounds]), **out}


def load_bounds(path: Path) -> list[Bounds]:
    """The flights of one file of :func:`as_arrays`."""
    with np.load(path, allow_pickle=False) as data:
        names = [str(n) for n in data["names"]]
        return [Bounds(n, **{name: data[f"{k}.{name}"] for name in _FIELDS}) for k, n in enumerate(names)]
