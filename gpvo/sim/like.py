"""A scenario like a run: its camera, rate, path, counts of points, depths and pixel noise."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.run import Run, read_run, read_tracks
from gpvo.sim.recorded import longest_flight_s
from gpvo.types import Array, StereoCamera, StereoTracks
from gpvo.vo.motion import predict_uvd, refine, whitened
from gpvo.vo.sigmas import NoiseEstimator

_IMU_HZ = 200.0
_MIN_POINTS = 12
_MIN_PAIRS = 10


def like(path: Path) -> dict[str, Any]:
    """Values of a :class:`gpvo.sim.scenario.Scenario`, dots reaching into tables, for a flight like a run.

    ``camera`` and ``trajectory`` name the run's folder: its rectified camera, and its path as odometry found it.
    Counts, ends and outliers of tracks, the depth that 95 % of the inliers lie within, and the pixel noise, white and
    kept by a point while it is followed, are taken over all its motions. Raises SourceError where the run holds no
    tracks or no camera, or too few motions to tell the noise.
    """
    run, tracks = read_run(path), read_tracks(path)
    camera, log = run.log.camera, run.log
    if camera is None:
        raise SourceError("does not know its camera", where=path, cure="run the sequence with 'gpvo run --keep-tracks'")
    found = _Tracking(camera)
    for before, record in pairwise(log):
        if record.usable and record.t_prev_ns == before.t_ns:
            found.add(record.T_prev_cur, _at(tracks, before.t_ns), _at(tracks, record.t_ns))
    if len(found.sigma_px) < _MIN_PAIRS:
        raise SourceError(
            f"only {len(found.sigma_px)} motions have {_MIN_POINTS} inliers: too few to tell its noise",
            where=path,
            cure="a longer run, or one with more features",
        )
    rate_hz = 1.0 / float(np.median(np.diff(log.t_ns))) * 1e9
    return {
        "camera": str(path),
        "trajectory": str(path),
        "vehicle": "path",
        "duration_s": longest_flight_s((log.t_ns[-1] - log.t_ns[0]) * 1e-9),
        "rate_hz": rate_hz,
        # A whole number of samples between frames.
        "imu_rate_hz": rate_hz * round(_IMU_HZ / rate_hz),
        "speed_mps": float(np.clip(np.quantile(_speeds(run), 0.95), 0.05, 40.0)),
        **{f"points.{name}": value for name, value in found.values().items()},
    }


def _speeds(run: Run) -> Array:
    moved = [(np.linalg.norm(r.T_prev_cur[:3, 3]), r.dt_s) for r in run.log if r.usable and r.dt_s > 0]
    distance_m, dt_s = np.array(moved).T
    return np.asarray(distance_m / dt_s)


def _at(tracks: StereoTracks, t_ns: int) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Identities, (u, v, d) and inliers of a frame."""
    rows = slice(*np.searchsorted(tracks.t_ns, [t_ns, t_ns + 1]))
    return tracks.track[rows], tracks.uvd[rows], tracks.is_inlier[rows]


class _Tracking:
    """What the tracks of a run are like, motion by motion."""

    def __init__(self, camera: StereoCamera) -> None:
        self._camera, self._noise = camera, NoiseEstimator()
        self.sigma_px: list[float] = []
        self._count: list[int] = []
        self._ended: list[float] = []
        self._outliers: list[float] = []
        self._depths: list[Array] = []

    def add(self, T_prev_cur: Array, before: tuple[Any, Array, Any], now: tuple[Any, Array, Any]) -> None:
        """Take in the observations of two neighbouring frames and the motion between them."""
        camera = self._camera
        both, i, j = np.intersect1d(before[0], now[0], return_indices=True)
        good = now[2][j]
        if good.sum() < _MIN_POINTS:
            return
        uvd, uvd_now = before[1][i][good], now[1][j][good]
        motion = refine(T_prev_cur, uvd, uvd_now, camera, noise=self._noise.value)
        if motion is None:
            return
        self._noise.update(motion, whitened(motion, camera))
        (u, v, _), in_front = predict_uvd(T_prev_cur, before[1], camera)
        stays = in_front & (u > 0) & (v > 0) & (u < camera.width) & (v < camera.height)
        self.sigma_px.append(motion.scale_px)
        self._count.append(len(now[0]))
        self._ended.append(1.0 - float(np.isin(before[0][stays], both).mean()))
        # A wrong observation spoils two motions.
        self._outliers.append(1.0 - float(good.mean()) ** 0.5)
        self._depths.append(camera.fx_px * camera.baseline_m / np.maximum(uvd_now[:, 2], 0.1))

    def values(self) -> dict[str, float | int]:
        """Those of :class:`gpvo.sim.points.PointsScenario`."""
        sigma_px = float(np.median(self.sigma_px))
        return {
            "tracks": int(np.median(self._count)),
            "drop": float(np.median(self._ended)),
            "outliers": float(np.mean(self._outliers)),
            "sigma_px": sigma_px,
            "persistent_px": sigma_px * self._noise.value.persistent**0.5,
            "blur_px": 0.0,
            "reach_m": float(np.quantile(np.concatenate(self._depths), 0.95)),
        }
