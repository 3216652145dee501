"""A scenario like a run: its camera, rate, path, counts of points, depths and pixel noise."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.run import read_run, read_tracks
from gpvo.sim.recorded import longest_flight_s
from gpvo.types import Array, StereoCamera, StereoTracks, VoLog
from gpvo.vo.config import KNOWN_DEPTH_PX
from gpvo.vo.covariance import NoiseEstimator
from gpvo.vo.motion import predict_uvd, refine, whitened

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
    values = _tracking(log, tracks, camera, path)
    moved = [(np.linalg.norm(r.T_prev_cur[:3, 3]), r.dt_s) for r in log if r.usable and r.dt_s > 0]
    distance_m, dt_s = np.array(moved).T
    rate_hz = 1.0 / float(np.median(np.diff(log.t_ns))) * 1e9
    return {
        "camera": str(path),
        "trajectory": str(path),
        "vehicle": "path",
        "duration_s": longest_flight_s((log.t_ns[-1] - log.t_ns[0]) * 1e-9),
        "rate_hz": rate_hz,
        # A whole number of samples between frames.
        "imu_rate_hz": rate_hz * round(_IMU_HZ / rate_hz),
        "speed_mps": float(np.clip(np.quantile(distance_m / dt_s, 0.95), 0.05, 40.0)),
        **{f"points.{name}": value for name, value in values.items()},
    }


def _at(tracks: StereoTracks, t_ns: int) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Identities, (u, v, d) and inliers of a frame."""
    rows = slice(*np.searchsorted(tracks.t_ns, [t_ns, t_ns + 1]))
    return tracks.track[rows], tracks.uvd[rows], tracks.is_inlier[rows]


def _tracking(log: VoLog, tracks: StereoTracks, camera: StereoCamera, where: Path) -> dict[str, float | int]:
    """Values of :class:`gpvo.sim.points.PointsScenario`: what the tracks are like, over all motions."""
    noise = NoiseEstimator()
    motions: list[tuple[float, ...]] = []
    depths: list[Array] = []
    for before, record in pairwise(log):
        if not record.usable or record.t_prev_ns != before.t_ns:
            continue
        old, uvd, _ = _at(tracks, before.t_ns)
        new, uvd_now, is_inlier = _at(tracks, record.t_ns)
        both, i, j = np.intersect1d(old, new, return_indices=True)
        good = is_inlier[j]
        if good.sum() < _MIN_POINTS:
            continue
        motion = refine(record.T_prev_cur, uvd[i][good], uvd_now[j][good], camera, noise=noise.value)
        if motion is None:
            continue
        noise.update(motion, whitened(motion, camera))
        (u, v, _), in_front = predict_uvd(record.T_prev_cur, uvd, camera)
        stays = in_front & (u > 0) & (v > 0) & (u < camera.width) & (v < camera.height)
        ended = 1.0 - float(np.isin(old[stays], both).mean())
        # A wrong observation spoils two motions.
        motions.append((motion.scale_px, len(new), ended, 1.0 - float(good.mean()) ** 0.5))
        # Farther ones are as far as can be told.
        depths.append(camera.fx_px * camera.baseline_m / np.maximum(uvd_now[j][good][:, 2], KNOWN_DEPTH_PX))
    if len(motions) < _MIN_PAIRS:
        raise SourceError(
            f"only {len(motions)} motions have {_MIN_POINTS} inliers: too few to estimate its noise",
            where=where,
            cure="a longer run, or one with more features",
        )
    all_px, counts, ended_shares, outliers = np.array(motions).T
    sigma_px = float(np.median(all_px))
    return {
        "tracks": int(np.median(counts)),
        "drop": float(np.median(ended_shares)),
        "outliers": float(np.mean(outliers)),
        "sigma_px": sigma_px,
        "persistent_px": sigma_px * noise.value.persistent**0.5,
        "blur_px": 0.0,
        "reach_m": float(np.quantile(np.concatenate(depths), 0.95)),
    }
