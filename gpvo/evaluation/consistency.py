"""Is what a method states about the motions of a run honest? Per motion, over a second, and over lengths of path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpvo.accumulation import PoseError, carry, over_windows
from gpvo.dataset.errors import MotionErrors
from gpvo.dataset.truth_noise import drift_variance
from gpvo.evaluation.statements import Statement
from gpvo.geometry import se3
from gpvo.geometry.covariance import compound, variances
from gpvo.learning.methods import score
from gpvo.stats.consistency import (
    BLOCKS,
    by_difficulty,
    correlation_gain,
    counted_axes,
    energy_score,
    marginal,
    nees_by_block,
    seen_axes,
)
from gpvo.stats.series import Interval, block_bootstrap
from gpvo.types import Array, MotionError, VoLog

BY_MODEL = "prediction"
"""The last reason of a motion whose status is the model's and not the odometry's."""

UNITS = {"translation_m": "translation", "rotation_rad": "rotation"}
"""Names of scores in the unit of a block of the error, and the block."""
_SCORED = ("nees_dof_median", "coverage", "nll_per_dim", "nll_stated_per_dim", "nees_dof_median_stated", "crps")

HORIZONS_M = (1.0, 10.0, 100.0)
TOO_FAR = 2.5
"""Times a span: where frames are sparser than it, or missing, what lies between two of them is not called by it."""
_MAX_WINDOWS = 60
# Times that are sums of a frame period must not miss the round number.
_HAIR = 1 - 1e-9


@dataclass(frozen=True)
class Horizon:
    """Joint NEES per degree of freedom of the motion over a stretch, from ``count`` windows; NaN where none fits.

    ``span``: metres of path, or seconds. ``nees_dof_truth_noise``: with the truth's own noise added to what is stated;
    ``z2_truth_noise`` (6,): likewise, the mean squared error of each axis over its variance. ``truth_drift_m`` (3,):
    standard deviation of the truth's displacement over such a stretch that its own velocities contradict, added too.
    ``independent``: as many windows with independent errors would tell as much, if what is stated of them is right.
    """

    span: float
    nees_dof: float
    nees_dof_truth_noise: float
    z2_truth_noise: tuple[float, ...]
    truth_drift_m: tuple[float, ...]
    count: int
    independent: float


@dataclass(frozen=True)
class Consistency:
    """Of one method on one run; None where it cannot be computed, and of a method that says nothing.

    ``nees_dof`` by block of the error, with a block-bootstrap interval; ``nees_dof_truth_noise`` and all that follows:
    with the truth's own noise added to what the method says. ``coverage``: per axis at 1, 2, 3 sigma, averaged over the
    axes. ``nll_per_dim`` is that of a Gaussian, ``nll_stated_per_dim`` that of the stated Student-t, which expects a
    median of ``nees_dof_median_stated``. ``energy``, ``correlation_gain_nats`` and the quartiles ``by_difficulty``: see
    :mod:`gpvo.stats.consistency`.
    ``one_second`` and ``horizons`` (1, 10, 100 m of path) are of windows without lost frames. ``axes``: those that
    count, of 0 to 5, :func:`gpvo.stats.consistency.seen_axes`; a block without any has no score.
    """

    method: str
    count: int = 0
    axes: tuple[int, ...] = ()
    nees_dof: dict[str, Interval | None] = field(default_factory=partial(dict.fromkeys, BLOCKS))
    nees_dof_median: dict[str, float | None] = field(default_factory=partial(dict.fromkeys, BLOCKS))
    nees_dof_truth_noise: dict[str, float | None] = field(default_factory=partial(dict.fromkeys, BLOCKS))
    coverage: dict[str, float | None] = field(default_factory=partial(dict.fromkeys, "123"))
    nll_per_dim: float | None = None
    nll_stated_per_dim: float | None = None
    nees_dof_median_stated: float | None = None
    crps: dict[str, float | None] = field(default_factory=partial(dict.fromkeys, UNITS))
    energy: dict[str, float | None] = field(default_factory=partial(dict.fromkeys, UNITS))
    correlation_gain_nats: float | None = None
    by_difficulty: dict[str, list[float] | None] = field(
        default_factory=partial(dict.fromkeys, ("nees_dof", "coverage"))
    )
    predicted_final_error_m: float | None = None
    predicted_final_error_independent_m: float | None = None
    one_second: Horizon | None = None
    horizons: tuple[Horizon, ...] = ()


def consistency(
    statement: Statement, errors: MotionErrors, log: VoLog, T_true: Array, known: NDArray[np.bool_],
    noise: tuple[Array, Array] | None = None, by_velocity: Array | None = None,
) -> Consistency | None:  # fmt: skip
    """Scores of one method, None where it says nothing about any motion with truth.

    ``T_true`` (N, 4, 4) and ``known`` (N,): truth at the log's stamps. ``noise``: covariance of these
    (N, 6, 6), and what that adds to errors (M, 6, 6).
    ``by_velocity`` (N, 3): where the truth's own velocities lead (:func:`gpvo.dataset.truth_noise.velocity_path`).
    """
    C = statement.covariance[errors.index]
    stated = np.isfinite(C).all(axis=(1, 2))
    if stated.sum() < 2:
        return None
    index, d = errors.index[stated], statement.dof
    axes = counted_axes(seen_axes(errors.xi), d)
    e, C = (errors.xi[stated] - statement.mean[index])[:, :d], C[stated]
    per_block = nees_by_block(e, C, axes)
    if noise is not None:
        # From here on, errors are those of odometry and of the truth.
        C = C + noise[1][stated, :d, :d]
    scores = score(errors.xi[stated], statement.mean[index], C, statement.nu, axes)
    by_unit = {unit: axes[np.isin(axes, BLOCKS[block])] for unit, block in UNITS.items()}
    energy = {u: float(energy_score(e[:, a], marginal(C, a)).mean()) if len(a) else None for u, a in by_unit.items()}
    e, C = e[:, axes], marginal(C, axes)
    quartiles = by_difficulty(e, C)
    final, independent = _final_errors(statement, log, known)
    progress = se3.path_length_m(T_true[:, :3, 3]), (log.t_ns - log.t_ns[0]) * 1e-9

    def over(along: Array, span: float) -> Horizon:
        return horizon(statement, log, T_true, known, along, span, noise and noise[0], by_velocity, axes)

    return Consistency(
        method=statement.method,
        count=int(stated.sum()),
        axes=tuple(axes.tolist()),
        nees_dof={n: block_bootstrap(per_block[n]) if n in per_block else None for n in BLOCKS},
        nees_dof_truth_noise=scores["nees_dof"],
        **{name: scores[name] for name in _SCORED},
        energy=energy,
        correlation_gain_nats=float(correlation_gain(e, C).mean()),
        by_difficulty={"nees_dof": quartiles[0].tolist(), "coverage": quartiles[1].tolist()},
        predicted_final_error_m=final,
        predicted_final_error_independent_m=independent,
        one_second=over(progress[1], 1.0) if d == 6 else None,
        horizons=tuple(over(progress[0], m) for m in HORIZONS_M if d == 6),
    )


def _final_errors(statement: Statement, log: VoLog, known: NDArray[np.bool_]) -> tuple[float | None, float | None]:
    """Stated standard deviation [m] of the last position with truth, from the first on: by the parts, and as if motions
    were independent."""
    if statement.errors is None:
        return None, None
    covered = np.flatnonzero(known)
    chain = _ancestors(int(covered[-1]), int(covered[0]), log.parent)
    pose, independent = PoseError(), np.zeros((6, 6))
    T = log.T_prev_cur[chain]
    for k, T_prev_cur, A in zip(chain, T, carry(T)):
        error = statement.errors[k]
        pose = pose.after(T_prev_cur, error)
        independent = A @ independent @ A.T + error.covariance
    a, b = (float(np.sqrt(np.trace(C[:3, :3]))) for C in (pose.covariance, independent))
    return a, b


def _ancestors(frame: int, root: int, parent: NDArray[np.int64]) -> list[int]:
    """The motions that lead to ``frame``, in order, from ``root`` or the first frame after it on the way."""
    chain = []
    while frame > root and parent[frame] >= root:
        chain.append(frame)
        frame = int(parent[frame])
    return chain[::-1]


def horizon(
    statement: Statement, log: VoLog, T_true: Array, known: NDArray[np.bool_], progress: Array, span: float,
    noise: Array | None, by_velocity: Array | None, axes: ArrayLike,
) -> Horizon:  # fmt: skip
    """NEES over windows of ``span`` of a growing ``progress`` (N,), at most sixty, without lost frames.

    Each begins where the one before has at least half passed. ``axes``: those that count.
    """
    assert statement.errors is not None
    chains = list(_windows(log, known, progress, span))
    if not chains:
        return Horizon(span, np.nan, np.nan, (np.nan,) * 6, (0.0,) * 3, 0, 0.0)
    starts, ends = log.parent[[chain[0] for chain in chains]], np.array([chain[-1] for chain in chains])
    T = se3.inverse(T_true[starts]) @ T_true[ends]
    # The mean is taken off each motion, as a filter would.
    motion = log.T_prev_cur @ se3.exp(-statement.mean)
    T_est = np.array([reduce(np.matmul, motion[chain], np.eye(4)) for chain in chains])
    C = over_windows(log.T_prev_cur, statement.errors, chains)
    e, drift = se3.log(se3.inverse(T) @ T_est), np.zeros(3)
    own = np.zeros_like(C) if noise is None else compound(T, noise[starts], noise[ends])
    if by_velocity is not None:
        moved = T_true[ends, :3, 3] - T_true[starts, :3, 3] - (by_velocity[ends] - by_velocity[starts])
        drift = drift_variance(np.einsum("nji,nj->ni", T_true[ends, :3, :3], moved), e[:, :3])
        # The white noise of two poses is in the variance of a displacement, too.
        own[:, range(3), range(3)] = np.maximum(own[:, range(3), range(3)], drift)
    z2 = (e**2 / variances(C + own)).mean(axis=0)
    plain, noisy = (float(nees_by_block(e, S, axes)["joint"].mean()) for S in (C, C + own))
    worth = _independent(statement.errors, log, chains, C, C + own, np.asarray(axes))
    return Horizon(span, plain, noisy, tuple(z2.tolist()), tuple(np.sqrt(drift).tolist()), len(chains), worth)


def _independent(
    errors: Sequence[MotionError], log: VoLog, chains: list[list[int]], C: Array, judged: Array, axes: NDArray[np.intp]
) -> float:
    """How many windows with independent errors the mean NEES of these is worth, of stated covariances ``C`` (W, 6, 6),
    ``judged`` with the truth's noise.

    Of Gaussian errors whitened over d axes, with correlations R_ij between windows, the mean of NEES/dof has the
    variance ``2 / (W d)^2 sum_ij |R_ij|^2``. Windows overlap by half, which alone costs at most half of them; and
    errors that persist, as of a wrong calibration, are the same in many.
    """
    half = 0.5 * len(chains)
    tau_s = max(float(errors[chain[0]].persistent_tau_s.max(initial=0.0)) for chain in chains)
    if tau_s == 0.0:
        return half
    used = {k: errors[k] for chain in chains for k in chain}
    passing = {k: replace(e, persistent_root=np.zeros_like(e.persistent_root)) for k, e in used.items()}
    lasting = C - over_windows(log.T_prev_cur, passing, chains)
    share = np.linalg.solve(marginal(judged, axes), marginal(lasting, axes))
    t_s = 1e-9 * (log.t_ns[[c[-1] for c in chains]] - log.t_ns[0])
    both = np.einsum("iab,jba->ij", share, share) * np.exp(-2.0 * np.abs(t_s[:, None] - t_s) / tau_s)
    np.fill_diagonal(both, 0.0)
    return half / (1.0 + both.sum() / (2.0 * len(chains) * len(axes)))


def _windows(log: VoLog, known: NDArray[np.bool_], progress: Array, span: float) -> Iterator[list[int]]:
    """The motions of each window: it ends where odometry measures first beyond its length."""
    stride, t_next = max(0.5 * span, float(progress[-1] - progress[0]) / _MAX_WINDOWS), float(progress[0])
    parent, usable = log.parent, log.usable
    leads_on = np.append(parent[1:] == np.arange(len(parent) - 1), False)  # whether the next motion starts there
    measured = np.flatnonzero(usable & (parent >= 0))
    place = np.searchsorted(measured, np.searchsorted(progress, progress + span * _HAIR))
    end = np.append(measured, 0)[place]
    broken = np.cumsum(leads_on & ~usable)
    may_begin = leads_on & known & (place < len(measured)) & known[end] & (broken[end] == broken)
    may_begin &= progress[end] - progress < TOO_FAR * span
    for start in np.flatnonzero(may_begin).tolist():
        if progress[start] < t_next:
            continue
        chain = _ancestors(int(end[start]), start, parent)
        if chain and parent[chain[0]] == start:
            t_next = float(progress[start]) + stride
            yield chain
