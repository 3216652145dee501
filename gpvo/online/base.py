"""The variance that is known before anything is learnt, per axis: a sum of physical parts.

``v_j = a_j g_j + b_j + c_j |t|^2 + d_j |phi|^2``: the geometric variance g (pixel noise carried through the geometry),
a floor, and parts that grow with the motion (S. Thrun, W. Burgard, D. Fox, "Probabilistic Robotics" (2005), section
5.4).
Coefficients are not negative, so it never shrinks when a part grows. The GP learns the log of the ratio to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpvo.online.features import AXES
from gpvo.types import Array

TWIST_COLUMNS = ("v_x_mps", "v_y_mps", "v_z_mps", "w_x_radps", "w_y_radps", "w_z_radps")


def base_columns(method: str | None) -> tuple[str, ...]:
    """Feature columns that the base variance needs; ``method`` None where there is no geometric covariance."""
    return TWIST_COLUMNS + (() if method is None else tuple(f"ln_var_{method}_{a}" for a in AXES))


@dataclass(frozen=True)
class BaseVariance:
    """``theta`` (6, 4): coefficients of geometry, floor, squared translation and squared rotation of the motion.

    ``method``: name of the geometric covariance, None without one (its coefficient is then 0).
    """

    theta: Array
    method: str | None

    def __call__(self, columns: Array, dt_s: Array) -> Array:
        """(n, 6) variance from the columns of :func:`base_columns` (n, c) and the durations of the motions (n,)."""
        return np.einsum("jc,njc->nj", self.theta, self.parts(columns, dt_s))

    def parts(self, columns: Array, dt_s: Array) -> Array:
        """(n, 6, 4) the parts before they are weighted."""
        return parts(columns, dt_s)


def parts(columns: Array, dt_s: Array) -> Array:
    """(n, 6, 4) geometry, one, squared translation [m^2], squared rotation [rad^2]."""
    out = np.ones((len(columns), 6, 4))
    out[:, :, 0] = np.exp(columns[:, 6:12]) if columns.shape[1] >= 12 else 0.0
    out[:, :, 2] = ((columns[:, :3] * dt_s[:, None]) ** 2).sum(1)[:, None]
    out[:, :, 3] = ((columns[:, 3:6] * dt_s[:, None]) ** 2).sum(1)[:, None]
    return out


def positions(names: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Where each wanted column is among ``names``."""
    place = {n: i for i, n in enumerate(names)}
    return [place[w] for w in wanted]
