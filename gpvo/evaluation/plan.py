"""A planned path as the motions that odometry would measure along it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpvo.errors import GpvoError, SourceError
from gpvo.geometry import se3
from gpvo.io.foreign import T_FLU_OPTICAL
from gpvo.io.trajectory import Trajectory, read_tum
from gpvo.types import Array

MAX_MOTIONS = 200_000
_MIN_MOTIONS = 2


@dataclass(frozen=True)
class Plan:
    """``t_s`` (N,) from zero, evenly spaced; ``T_world_cam`` (N, 4, 4) in the plan's own world [m]."""

    t_s: Array
    T_world_cam: Array

    @property
    def step_s(self) -> float:
        """Time between two poses."""
        return float(self.t_s[1] - self.t_s[0])

    @property
    def motions(self) -> Array:
        """(N - 1, 4, 4) ``T_prev_cur``."""
        return se3.inverse(self.T_world_cam[:-1]) @ self.T_world_cam[1:]

    @property
    def distance_m(self) -> Array:
        """(N,) length of the path up to each pose."""
        steps = np.linalg.norm(np.diff(self.T_world_cam[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def read_plan(path: str | Path, dt_s: float, frame: str = "cam") -> Plan:
    """A TUM file of poses at any spacing, resampled every ``dt_s``.

    ``frame``: ``cam``, poses of the left camera (x right, y down, z forward), or ``body`` (FLU), whose camera then
    looks forward from the body's origin.

    Raises
    ------
    SourceError
        Where the file cannot be read, or the plan is too short or too long.
    """
    if frame not in ("cam", "body"):
        raise GpvoError(f"there is no frame '{frame}'", cure="cam or body")
    given = read_tum(path)
    T = given.T_world_body @ T_FLU_OPTICAL if frame == "body" else given.T_world_body
    n = 1 + int((given.t_ns[-1] - given.t_ns[0]) * 1e-9 / dt_s + 1e-6)
    if n < _MIN_MOTIONS + 1:
        raise SourceError(f"lasts less than {_MIN_MOTIONS} motions of {dt_s:.3g} s", where=path, cure="plan further")
    if n > MAX_MOTIONS:
        raise SourceError(f"lasts for {n} motions of {dt_s:.3g} s, more than {MAX_MOTIONS}", where=path)
    return resample(Trajectory(given.t_ns, T), np.arange(n, dtype=np.float64) * dt_s)


def resample(given: Trajectory, t_s: Array) -> Plan:
    """Poses at seconds since the first one, smooth in velocity: a vehicle does not change its speed at waypoints."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    known_s = (given.t_ns - given.t_ns[0]) * 1e-9
    position = CubicSpline(known_s, given.T_world_body[:, :3, 3])(t_s)
    turned = RotationSpline(known_s, Rotation.from_matrix(given.T_world_body[:, :3, :3]))(t_s).as_matrix()
    return Plan(t_s, se3.from_rt(turned, position))
