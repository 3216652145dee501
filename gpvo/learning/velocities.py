"""Learning how fast the vehicle usually is, and how its velocity changes."""

from __future__ import annotations

import numpy as np

from gpvo.dataset.build import TrainingSet
from gpvo.learning.rows import Rows
from gpvo.online.base import COASTED, TWIST_COLUMNS, Velocities
from gpvo.types import Array

_LEAST = 1e-6


def learn_velocities(rows: Rows) -> Velocities:
    """Of all sequences alike."""
    return Velocities(usual_rate_var(rows), rate_changes(rows))


def usual_rate_var(rows: Rows) -> Array:
    """(6,) mean square velocity of VO [m^2/s^2, rad^2/s^2], sequences alike."""
    return np.maximum(np.nanmean(rows.weight[:, None] * rows.select(TWIST_COLUMNS) ** 2, axis=0), _LEAST)


def rate_changes(rows: Rows) -> Array:
    """(K, 6) mean square [m^2/s^2, rad^2/s^2] by which the true velocity changes over ``COASTED`` usual motions,
    sequences alike; never less than over a shorter time, and that of unrelated velocities where no sequence is long
    enough."""
    out = []
    for m in COASTED:
        seen = [c for s in rows.sets if len(c := _changes(s, m, rows.step_s))]
        out.append(np.mean([np.mean(c**2, axis=0) for c in seen], axis=0) if seen else 2.0 * usual_rate_var(rows))
    return np.maximum(np.maximum.accumulate(np.array(out)), _LEAST)


def _changes(s: TrainingSet, m: int, step_s: float) -> Array:
    """(k, 6) changes of the true velocity over m usual motions: of those between rows that lie about so far apart."""
    later = np.searchsorted(s.t_ns, s.t_ns + round((m - 0.5) * step_s * 1e9))
    rate = s.select(TWIST_COLUMNS) - s.Y / s.dt_s[:, None]
    first = np.flatnonzero(later < len(s))
    first = first[s.t_ns[later[first]] - s.t_ns[first] <= (m + 0.5) * step_s * 1e9]
    change = rate[later[first]] - rate[first]
    return np.asarray(change[np.isfinite(change).all(axis=1)])
