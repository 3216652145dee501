"""Recorded motion, flown again: a TUM or EuRoC trajectory, smoothed, scaled and put where it fits."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from gpvo.errors import SourceError
from gpvo.geometry import se3
from gpvo.sim.paths import RAMP_S, Path3, knots, rotations, smooth_start
from gpvo.types import Array

_STEP_S = 0.02
_UNNOTICED = 0.9


@dataclass(frozen=True)
class Recording:
    """Motion relative to its start: ``position_m`` (N, 3) about the middle of its extent, every 0.02 s, z up;
    ``turned_xyzw`` (N, 4) how far the body has turned since the start, in world axes; for a flight of ``duration_s``
    that rests at first."""

    position_m: Array
    turned_xyzw: Array
    duration_s: float
    rest_s: float

    @property
    def main_direction_rad(self) -> float:
        """Heading of the longest horizontal extent [rad]."""
        xy = self.position_m[:, :2] - self.position_m[:, :2].mean(0)
        x, y = np.linalg.svd(xy, full_matrices=False)[2][0]
        return float(np.arctan2(y, x))

    def turned_by(self, yaw_rad: float) -> Array:
        """Positions (N, 3) of the recording turned about the vertical."""
        return self.position_m @ _about_z(yaw_rad).T

    def placed(self, middle: Array, yaw_rad: float, scale: float, heading_rad: float) -> Path3:
        """The recording as a path: turned by ``yaw_rad``, scaled, its extent about ``middle`` (3,), the body level at
        the start with the nose at ``heading_rad``. Warns where it is made smaller: the speeds are, too."""
        if scale < _UNNOTICED:
            warnings.warn(f"the path is flown at {scale:.2g} of its size and speed, to fit the world", stacklevel=2)
        turn = _about_z(yaw_rad)
        grid = np.arange(len(self.position_m)) * _STEP_S
        place = make_interp_spline(grid, self.turned_by(yaw_rad) * scale + middle, k=5)
        pose = make_interp_spline(grid, self.turned_xyzw, k=5)
        t = knots(self.duration_s)

        def attitude(u: Array) -> Array:
            return turn @ rotations(pose(smooth_start(u, self.rest_s))) @ turn.T @ _about_z(heading_rad)

        return Path3(make_interp_spline(t, place(smooth_start(t, self.rest_s)), k=5), attitude, self.duration_s)

    def fitted(self, low: Array, high: Array, rng: np.random.Generator) -> Path3:
        """The recording scaled down to fit a box [m], looking in a random direction at its start."""
        scale = min(1.0, float(((high - low) / np.maximum(np.ptp(self.position_m, axis=0), 1e-6)).min()))
        return self.placed((high + low) / 2, 0.0, scale, rng.uniform(-np.pi, np.pi))


def read_recording(file: Path, duration_s: float, rest_s: float = 3.0) -> Recording:
    """The part of a trajectory that a flight of ``duration_s`` needs.

    Of a file, ``.csv`` in EuRoC's layout, else TUM lines, or of a run folder, whose first camera pose is taken as
    level.

    Laser and motion capture jitter by millimetres: the motion is smoothed over a tenth of a second. Raises SourceError
    where the file is no trajectory, or is shorter than the flight.
    """
    clock, T_world_body = _read(file)
    needed = float(smooth_start(np.array([duration_s]), rest_s)[0])
    if clock[-1] < needed:
        cure = f"a duration of at most {longest_flight_s(clock[-1], rest_s):g} s"
        raise SourceError(f"lasts {clock[-1]:.1f} s, the flight needs {needed:.1f} s of it", where=file, cure=cure)
    grid = np.arange(0.0, needed + 0.3, _STEP_S)
    poses = _resample(clock, T_world_body, np.minimum(grid, clock[-1]))
    p, turned = _smoothed(poses[:, :3, 3], poses[:, :3, :3] @ poses[0, :3, :3].T)
    return Recording(p - (p.max(0) + p.min(0)) / 2, turned, duration_s, rest_s)


def _read(path: Path) -> tuple[Array, Array]:
    """Times (N,) [s] from 0 and poses (N, 4, 4) of a body (forward, left, up) in a world whose z points up."""
    from gpvo.io.run_read import is_run, read_run
    from gpvo.io.trajectory import read_euroc_csv, read_tum

    if is_run(path):
        log = read_run(path).log
        return (log.t_ns - log.t_ns[0]) * 1e-9, se3.T_FLU_OPTICAL @ log.trajectory() @ se3.T_FLU_OPTICAL.T
    recorded = read_euroc_csv(path) if path.suffix.lower() == ".csv" else read_tum(path)
    return (recorded.t_ns - recorded.t_ns[0]) * 1e-9, recorded.T_world_body


def smooth_path(t_s: Array, T_world_body: Array) -> Path3:
    """A path near poses (N, 4, 4) at times ``t_s`` (N,) from 0 on that a vehicle can fly: smoothed likewise."""
    grid = np.arange(0.0, t_s[-1] + 0.3, _STEP_S)
    poses = _resample(t_s, T_world_body, np.minimum(grid, t_s[-1]))
    place, turn = (make_interp_spline(grid, v, k=5) for v in _smoothed(poses[:, :3, 3], poses[:, :3, :3]))
    return Path3(place, lambda u: rotations(turn(u)), float(t_s[-1]))


def longest_flight_s(length_s: float, rest_s: float = 3.0) -> float:
    """Duration [s] of the longest flight that a trajectory of a length in time allows, in tenths."""
    return float(np.floor(10 * (length_s + rest_s + RAMP_S / 2)) / 10)


def _about_z(angle_rad: float) -> Array:
    return se3.so3_exp(np.array([0.0, 0.0, angle_rad]))


def _resample(clock: Array, T: Array, at: Array) -> Array:
    j = np.clip(np.searchsorted(clock, at), 1, len(clock) - 1)
    share = (at - clock[j - 1]) / np.maximum(clock[j] - clock[j - 1], 1e-9)
    return se3.interpolate(T[j - 1], T[j], np.clip(share, 0, 1))


def _smoothed(position: Array, R: Array) -> tuple[Array, Array]:
    """Positions (N, 3) and quaternions (N, 4), x y z w, of poses every 0.02 s, without jitter."""
    q = se3.rotation_to_quaternion_xyzw(R)
    # q and -q are equal: signs must not jump.
    flips = np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)
    q = q * np.cumprod(np.concatenate([[1.0], flips]))[:, None]
    smooth = (gaussian_filter1d(v, 0.1 / _STEP_S, axis=0, mode="nearest") for v in (position, q))
    return next(smooth), next(smooth)
