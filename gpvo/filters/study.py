"""All policies over many runs: the scalars of the tuned constants, paired differences with intervals, every run."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gpvo.errors import GpvoError
from gpvo.filters.metrics import Scores
from gpvo.filters.policies import (
    CONSTANT,
    CONSTANT_BEST,
    CONSTANT_HINDSIGHT,
    LEARNED,
    STATED,
    ConstantPolicy,
    GeometricPolicy,
    LearnedPolicy,
    Policy,
)
from gpvo.filters.run import Flight, FusedRun, FuseOptions, Progress, ate_of_members, fuse_flight, no_progress
from gpvo.stats.series import Interval, sequence_bootstrap
from gpvo.types import Array, VoLog

# Variance factors tried for (translation, rotation): first these powers of four, then between the neighbours.
_COARSE: Array = np.power(4.0, np.arange(-6, 2))
_FINE: Array = np.power(4.0, [-0.5, 0.0, 0.5])
_COARSE_FLIGHTS = 12  # so many are enough to tell factors of four apart


@dataclass(frozen=True)
class Constants:
    """Per-axis mean squares (6,) [m^2, rad^2] per motion of ``dt_s``, and the two scalars best on training runs."""

    mean_squares: Array
    dt_s: float
    best: tuple[float, float] | None = None
    hindsight: tuple[float, float] | None = None


def grid_scores(
    flights: Sequence[Flight], constants: Constants, grid: Array, options: FuseOptions, progress: Progress = no_progress
) -> Array:
    """Mean ATE [m] over runs (G,) of the constant times each pair of scalars in ``grid`` (G, 2).

    A run that left the truth counts with its ATE, infinite where that is no number.
    """
    policy = ConstantPolicy(constants.mean_squares, constants.dt_s, grid)
    total = np.zeros(len(grid))
    for flight in flights:
        total += ate_of_members(flight, policy, replace(options, history_s=0.0), batch=len(grid), progress=progress)
    return np.where(np.isfinite(total), total / max(len(flights), 1), np.inf)


def fit_scalars(
    flights: Sequence[Flight],
    constants: Constants,
    options: FuseOptions | None = None,
    *,
    progress: Progress = no_progress,
) -> tuple[float, float]:
    """One translation and one rotation scalar on the variances that minimise the mean ATE over ``flights``.

    On training runs this is ``constant_best``; on the test runs themselves, ``constant_hindsight``. Flights without
    truth are passed over; raises ``GpvoError`` where all are.
    """
    options = options or FuseOptions()
    flights = [f for f in flights if f.has_truth]
    if not flights:
        raise GpvoError("no run has ground truth to tune a constant on", cure="give other runs to --train")
    with np.errstate(all="ignore"):
        coarse = _pairs(_COARSE, _COARSE)
        some = flights[:: -(-len(flights) // _COARSE_FLIGHTS)]
        centre = coarse[np.argmin(grid_scores(some, constants, coarse, options, progress))]
        fine = _pairs(_FINE * centre[0], _FINE * centre[1])
        best = fine[np.argmin(grid_scores(flights, constants, fine, options, progress))]
    return float(best[0]), float(best[1])


def _pairs(a: Array, b: Array) -> Array:
    return np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)


def make_policies(constants: Constants | None, *, names: Sequence[str], learned: bool) -> dict[str, Policy | None]:
    """The named policies; None for one that lacks what it needs."""
    out: dict[str, Policy | None] = {}
    for name in names:
        out[name] = None
        if name in STATED:
            out[name] = GeometricPolicy(name)
        elif name == LEARNED:
            out[name] = LearnedPolicy() if learned else None
        elif constants is not None:
            scalars = {CONSTANT: (1.0, 1.0), CONSTANT_BEST: constants.best, CONSTANT_HINDSIGHT: constants.hindsight}
            if scalars.get(name) is not None:
                out[name] = ConstantPolicy(constants.mean_squares, constants.dt_s, np.array([scalars[name]]), name)
    return out


@dataclass(frozen=True)
class Comparison:
    """One policy less another, run by run: mean ATE gain in percent and the paired interval of the difference [m]."""

    policy: str
    against: str
    gain_percent: float
    difference_m: Interval

    def __str__(self) -> str:
        d = self.difference_m
        interval = f" [{d.low:+.4f}, {d.high:+.4f}]" if d.high < np.inf else ""
        return f"{self.policy} less {self.against}: ATE {d.mean:+.4f} m{interval}, gain {self.gain_percent:.1f} %"


@dataclass(frozen=True)
class Study:
    """Scores of every run under every policy: ``scores[policy][run]``, None where the policy could not run."""

    runs: tuple[str, ...]
    scores: Mapping[str, tuple[Scores | None, ...]]
    constants: Constants | None = None

    def column(self, policy: str, name: str) -> Array:
        """(runs,) of one score, NaN where missing."""
        return np.array([None if s is None else getattr(s, name) for s in self.scores[policy]], dtype=np.float64)

    def mean(self, policy: str, name: str) -> float:
        """Mean over the runs that have it."""
        values = self.column(policy, name)
        values = values[~np.isnan(values)]
        return float(values.mean()) if len(values) else float("nan")

    def diverged(self, policy: str) -> int | None:
        """How many runs diverged; None where no truth tells."""
        told = [s.diverged for s in self.scores[policy] if s is not None and s.diverged is not None]
        return sum(told) if told else None

    def compare(self, policy: str, against: str) -> Comparison:
        """Paired over the runs that both have."""
        a, b = self.column(policy, "ate_rmse_m"), self.column(against, "ate_rmse_m")
        both = np.isfinite(a) & np.isfinite(b)
        a, b = a[both], b[both]
        gain = 100.0 * (1.0 - a.mean() / b.mean()) if len(a) and b.mean() > 0 else float("nan")
        return Comparison(policy, against, float(gain), sequence_bootstrap(a - b))


def study(
    flights: Sequence[Flight],
    policies: Mapping[str, Policy | None],
    options: FuseOptions | None = None,
    *,
    constants: Constants | None = None,
    progress: Progress = no_progress,
    on_run: Callable[[Flight, FusedRun], None] | None = None,
) -> Study:
    """Filter every run under every policy, one after another, that speaks for at least half of its measured motions;
    ``on_run`` sees each filtered run before it is reduced to scores."""
    scores: dict[str, list[Scores | None]] = {name: [] for name in policies}
    for flight in flights:
        for name, policy in policies.items():
            if policy is None or not _speaks(policy, flight):
                scores[name].append(None)
                continue
            fused = fuse_flight(flight, policy, options, progress=progress)
            scores[name].append(fused.scores)
            if on_run:
                on_run(flight, fused)
    return Study(tuple(f.name for f in flights), {k: tuple(v) for k, v in scores.items()}, constants)


def _speaks(policy: Policy, flight: Flight) -> bool:
    """Whether a policy states the noise of at least half of the motions that were measured, and of any."""
    said = (policy.noise(r, flight.predictions.get(r.t_ns)) is not None for r in flight.records if r.usable)
    return 2 * sum(said) >= max(int(VoLog(flight.records).usable.sum()), 1)


def table(study: Study) -> str:
    """Mean of every policy that could run and, of several runs, its ATE on each; at most 80 columns."""
    names = [name for name, scores in study.scores.items() if any(scores)]
    columns = (
        ("ATE m", "ate_rmse_m", 4, 7),
        ("final m", "final_error_m", 4, 8),
        ("drift %", "drift_percent", 3, 8),
        ("NEES p", "nees_position", 2, 7),
        ("NEES a", "nees_attitude", 2, 7),
        ("NIS", "nis_dof", 2, 6),
        ("reject", "rejected", 1, 7),
    )
    lines = [f"{'policy':<20}" + "".join(f"{title:>{width}}" for title, _, _, width in columns) + f"{'diverged':>9}"]
    for name in names:
        values = "".join(_cell(study.mean(name, key), digits, width) for _, key, digits, width in columns)
        diverged = study.diverged(name)
        lines.append(f"{name:<20}{values}{'-' if diverged is None else diverged:>9}")
    lines.append("NEES p, a (position, attitude) and NIS: per degree of freedom; 1 is right.")
    if len(study.runs) == 1:
        return "\n".join(lines)
    runs = ", ".join(f"{i + 1}: {run}" for i, run in enumerate(study.runs))
    lines += ["", *textwrap.wrap(f"ATE m on {runs}", 80, break_on_hyphens=False)]
    for begin in range(0, len(study.runs), 6):
        some = range(begin, min(begin + 6, len(study.runs)))
        lines.append(" " * 20 + "".join(f"{i + 1:>10}" for i in some))
        for name in names:
            ate_m = study.column(name, "ate_rmse_m")
            lines.append(f"{name:<20}" + "".join(_cell(ate_m[i], 4, 10) for i in some))
    return "\n".join(lines)


def _cell(value: float, digits: int, width: int) -> str:
    """Right in its column, with as many digits as fit; what is not known is a dash."""
    if not np.isfinite(value):
        return f"{'-':>{width}}"
    while digits and len(f"{value:.{digits}f}") >= width:
        digits -= 1
    text = f"{value:.{digits}f}"
    return f"{text if len(text) < width else f'{value:.0e}':>{width}}"
