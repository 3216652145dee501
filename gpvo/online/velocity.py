"""How fast a vehicle is and how its velocity changes: all there is to say of a motion that was lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.types import Array

COASTED = (1, 2, 5, 10, 20, 50)
"""Over so many usual motions training tells how much a velocity changes."""


@dataclass(frozen=True)
class Velocities:
    """``usual_rate_var`` (6,): mean square velocity in training [m^2/s^2, rad^2/s^2]. ``rate_change_var`` (K, 6): of
    the true one's changes over :data:`COASTED` motions."""

    usual_rate_var: Array
    rate_change_var: Array

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Named arrays for a model file."""
        return dict(vars(self))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Velocities:
        """The inverse of :meth:`to_arrays`. Raises KeyError where the velocities are missing."""
        usual = arrays["usual_rate_var"]
        # Velocities that have nothing to do with each other, where an older file does not say.
        unrelated = np.tile(2.0 * usual, (len(COASTED), 1))
        return cls(usual, arrays.get("rate_change_var", unrelated))

    def largest_error_var(self, rate: Array, duration_s: Array) -> Array:
        """(n, 6) as wrong as a motion of velocity (n, 6) and duration (n,) can be: VO's motion less the true one is no
        longer than both together, whatever is said of its variance."""
        return _block_sums((rate**2 + self.usual_rate_var) * duration_s[:, None] ** 2)

    def lost_variance(
        self, step_s: float, dt_s: float, age_s: float, rate: Array, rate_var: Array, jump: Array
    ) -> Array:
        """(6,) variance of a lost motion of duration ``dt_s``, of which nothing was measured.

        The vehicle has gone on with the velocity ``rate`` (6,) [m/s, rad/s] of ``age_s`` ago, known to ``rate_var``
        (6,), but for what velocities changed in training over such a time, and more if it is faster than was usual
        there; at most, and after longer times than training shows, it is as wrong as the vehicle is fast. ``jump`` (6,)
        [m, rad]: by how much the motion given differs from that velocity's. ``step_s``: the usual duration.
        """
        lags = step_s * np.array(COASTED)
        change = np.array([np.interp(age_s, lags, of_axis, right=np.inf) for of_axis in self.rate_change_var.T])
        speed2 = _block_sums(rate**2)
        faster = np.maximum(speed2 / _block_sums(self.usual_rate_var), 1.0)
        changed = np.minimum(change * faster, np.maximum(self.usual_rate_var, speed2))
        return np.asarray((changed + rate_var) * dt_s**2 + _block_sums(jump**2))


def _block_sums(values: Array) -> Array:
    """(..., 6) sums over the axes of the translation, three times, and over those of the rotation."""
    return np.repeat(values.reshape(*values.shape[:-1], 2, 3).sum(axis=-1), 3, axis=-1)
