"""A scenario like a run: its camera, rate and path, and frame by frame its counts of points, depths and pixel noise."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.run import read_run, read_tracks
from gpvo.sim.paths import longest_flight_s, smooth_start
from gpvo.twin.replicate import estimate
from gpvo.types import Array, StereoCamera, StereoTracks, VoLog
from gpvo.vo.config import KNOWN_DEPTH_PX
from gpvo.vo.covariance import NoiseEstimator
from gpvo.vo.motion import Motion, Whitened, persistent_direction, predict_uvd, refine, whitened

_IMU_HZ = 200.0
_MIN_POINTS = 12
_MIN_PAIRS = 10
_REST_S = 3.0  # before a flight sets off
_LAGS = 8  # motions: as long as most points are followed
_CUT = 6.0
_MOST_DRIFT = 1.9  # of two, which would leave no white noise
Slips = tuple[int, NDArray[np.int64], Array]
"""Of a motion: its number, the tracks (n,), and their residuals (n,)."""


def like(path: Path) -> dict[str, Any]:
    """Values of a :class:`gpvo.sim.scenario.Scenario`, dots reaching into tables, for a flight like a run.

    ``camera`` and ``trajectory`` name the run's folder: its rectified camera, and its path as odometry found it.
    Counts, ends and outliers of tracks, the depth that 95 % of the inliers lie within, and the white pixel noise are
    those of each frame, at its place on the path. What a point keeps while it is followed, an error of its disparity
    and the way its image slips, and the errors that all points share (:mod:`gpvo.twin.common`), are taken over the
    whole run. Raises SourceError where the run holds no tracks or no camera, or too few motions to tell the noise.
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
        "rest_s": _REST_S,
        "duration_s": longest_flight_s((log.t_ns[-1] - log.t_ns[0]) * 1e-9, _REST_S),
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


def _tracking(log: VoLog, tracks: StereoTracks, camera: StereoCamera, where: Path) -> dict[str, Any]:
    """Values of :class:`gpvo.sim.points_scenario.PointsScenario`: what the tracks are like, frame by frame."""
    noise = NoiseEstimator()
    rows, slips = [], []
    for row, slip in _motions(log, tracks, camera, noise):
        rows.append(row)
        slips.append(slip)
    if len(rows) < _MIN_PAIRS:
        raise SourceError(
            f"only {len(rows)} motions have {_MIN_POINTS} inliers: too few to estimate its noise",
            where=where,
            cure="a longer run, or one with more features",
        )
    t_ns, all_px, ended_shares, outliers, reach_m = np.array(rows).T
    drift, memory = _drift(slips)
    usual_px = float(np.median(all_px))
    sigma_px = all_px * (1.0 - 0.5 * drift) ** 0.5
    counts = np.diff(np.searchsorted(tracks.t_ns, [*log.t_ns, log.t_ns[-1] + 1]))
    step_s = float(np.median(np.diff(log.t_ns)) * 1e-9)
    at_ns = _as_flown(log, step_s)
    drop, wrong, noise_px, depth_m = (
        tuple(np.interp(at_ns, t_ns, x).tolist()) for x in (ended_shares, outliers, sigma_px, reach_m)
    )
    return {
        "shared_px": _shared_px(where),
        "tracks": tuple(max(1, round(n)) for n in np.interp(at_ns, log.t_ns, counts).tolist()),
        "drop": drop,
        "outliers": wrong,
        "sigma_px": noise_px,
        "persistent_px": usual_px * noise.value.persistent**0.5,
        "drift_px": usual_px * drift**0.5,
        "drift_s": float(np.clip(-step_s / np.log(memory), 0.1, 1e6)),
        "blur_px": 0.0,
        "reach_m": depth_m,
    }


def _motions(
    log: VoLog, tracks: StereoTracks, camera: StereoCamera, noise: NoiseEstimator
) -> Iterator[tuple[tuple[float, ...], Slips]]:
    """Of each motion: its stamp [ns], noise [px], shares of the tracks that end and that are wrong, and the depth [m]
    that 95 % of the inliers lie within; and the residuals of its tracks. ``noise`` takes it in."""
    for k, (before, record) in enumerate(pairwise(log)):
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
        white = whitened(motion, camera)
        noise.update(motion, white)
        (u, v, _), in_front = predict_uvd(record.T_prev_cur, uvd, camera)
        stays = in_front & (u > 0) & (v > 0) & (u < camera.width) & (v < camera.height)
        ended = 1.0 - float(np.isin(old[stays], both).mean()) if stays.any() else 0.0
        # Farther ones are as far as can be told.
        far_px = max(float(np.quantile(uvd_now[j][good][:, 2], 0.05)), KNOWN_DEPTH_PX)
        # A wrong observation spoils two motions.
        wrong = 1.0 - float(good.mean()) ** 0.5
        row = (record.t_ns, motion.scale_px, ended, wrong, camera.fx_px * camera.baseline_m / far_px)
        yield row, (k, both[good][motion.inliers], _across(motion, white))


def _shared_px(run: Path) -> tuple[tuple[float, float], ...]:
    """Standard deviations of the errors that points share, by kind; none where the run does not tell its structure."""
    try:
        common = estimate(run).common
    except SourceError:
        return ()
    return tuple((float(of_uv), float(of_d)) for of_uv, of_d in np.sqrt(common.variance_px2))


def _as_flown(log: VoLog, step_s: float) -> Array:
    """Stamps [ns] of the run at which each frame of a flight is that rests, sets off and then follows it."""
    flight_s = longest_flight_s((log.t_ns[-1] - log.t_ns[0]) * 1e-9, _REST_S)
    frames = int(flight_s / step_s) + 1
    return np.asarray(log.t_ns[0] + 1e9 * smooth_start(np.linspace(0.0, (frames - 1) * step_s, frames), _REST_S))


def _across(motion: Motion, white: Whitened) -> Array:
    """Residuals (n,) in the image, across the direction in which an error of depth would show, over the noise's scale:
    with a variance of two where the noise is white."""
    direction = persistent_direction(white.moved.G)[:2]
    direction = np.where(np.hypot(*direction) > 0, direction, 1.0)
    u, v = motion.residuals[:, :2].T / max(motion.scale_px, 1e-9)
    across = (v * direction[0] - u * direction[1]) / np.hypot(*direction)
    return np.clip(across, -_CUT, _CUT)


def _drift(slips: list[Slips]) -> tuple[float, float]:
    """Variance of what a point slips by per frame, over that of white noise, and its correlation from frame to frame.

    White noise of an observation is in two motions, with opposite signs, and correlates them alone; slips correlate
    motions further apart, too: the variance times a power of the memory. (0, 1/e) where that is not beyond chance.
    """
    of_motion = {k: (ids, z) for k, ids, z in slips}
    sums, counts = np.zeros(_LAGS + 1), np.zeros(_LAGS + 1)
    for k, (ids, z) in of_motion.items():
        for lag in range(_LAGS + 1):
            if k + lag in of_motion:
                later, z_later = of_motion[k + lag]
                _, i, j = np.intersect1d(ids, later, return_indices=True)
                sums[lag] += z[i] @ z_later[j]
                counts[lag] += len(i)
    covariance = sums / np.maximum(counts, 1)
    far = covariance[2:]
    if counts[-1] < _MIN_PAIRS or far.mean() <= 4.0 * covariance[0] / counts[2] ** 0.5:
        return 0.0, float(np.exp(-1.0))
    memory = float(np.clip(far[1:].sum() / far[:-1].sum(), 0.05, 0.99))
    drift = far.sum() / (memory ** np.arange(2, _LAGS + 1)).sum()
    return float(np.clip(drift * 2.0 / covariance[0], 0.0, _MOST_DRIFT)), memory
