"""From a run folder to its structure: the path, the landmarks and the pixel noise that twins are made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.errors import SourceError
from gpvo.io.run import Run, read_run, read_tracks
from gpvo.runner import config_of
from gpvo.twin.noise import Neighbours, Structure, adjust, without_loose_frames
from gpvo.twin.observations import Observations
from gpvo.types import Array
from gpvo.vo.config import VoConfig
from gpvo.vo.rig_error import RigError, RigState
from gpvo.vo.rig_findings import STATE_FILE, read_state

MIN_POINTS = 12
"""A run whose median motion has fewer inliers is refused: path, landmarks and noise cannot be told apart."""


@dataclass(frozen=True)
class Original:
    """A run with its structure. ``noise_px`` (M, 3): residuals of the observations as large as the noise was;
    ``neighbours``: which tracks may err alike; ``first`` (M,) the first observation of each track; ``repeats`` (F,)
    frames that repeat the one before. ``rig``: what odometry found of its calibration's errors; measurements are
    ``seen`` without them."""

    run: Run
    config: VoConfig
    rig: RigState
    seen: Observations
    structure: Structure
    noise_px: Array
    neighbours: Neighbours
    first: NDArray[np.bool_]
    repeats: NDArray[np.bool_]


def estimate(path: Path) -> Original:
    """The structure of a run.

    Raises
    ------
    SourceError
        Where the run holds no tracks, no camera, or too few points to tell path, landmarks and noise apart.
    """
    run = read_run(path)
    tracks = read_tracks(path)
    if run.log.camera is None:
        raise SourceError("does not know its camera", where=path, cure="run the sequence with 'gpvo run --keep-tracks'")
    t_ns = run.log.t_ns
    frame = np.searchsorted(t_ns, tracks.t_ns)
    if len(frame) == 0 or frame.max() >= len(t_ns) or not (t_ns[frame] == tracks.t_ns).all():
        raise SourceError("its tracks are not of its frames", where=path / "tracks.parquet", cure="run it again")
    _, begins, track = np.unique(tracks.track, return_index=True, return_inverse=True)
    first = np.isin(np.arange(len(track)), begins)
    _refuse_too_few(frame[tracks.is_inlier & ~first], len(t_ns), path)
    repeats = np.array(["frozen" in r.reason for r in run.log])
    camera = run.log.camera
    rig = read_state(path, camera) if (path / STATE_FILE).is_file() else RigState.exact()
    uvd = RigError(camera, rig, learn=False).correct(tracks.uvd)
    seen = Observations(camera, frame, track, uvd, tracks.is_inlier & ~repeats[frame])
    structure = without_loose_frames(adjust(seen, run.log.trajectory()), seen, t_ns)
    if not np.isfinite(structure.residual_px).all():
        raise SourceError("its structure cannot be estimated: the fit fails", where=path, cure="look at the run")
    neighbours = Neighbours.of(seen, structure)
    return Original(run, config_of(path), rig, seen, structure, _noise(seen, structure), neighbours, first, repeats)


def _refuse_too_few(frame: NDArray[np.int64], n_frames: int, path: Path) -> None:
    usual = float(np.median(np.bincount(frame, minlength=n_frames)[1:])) if n_frames > 1 else 0.0
    if usual < MIN_POINTS:
        raise SourceError(
            f"its structure cannot be estimated: {usual:.0f} points a motion, {MIN_POINTS} are needed",
            where=path,
            cure="run it with more features, or train on runs with ground truth",
        )


def _noise(seen: Observations, structure: Structure) -> Array:
    """Residuals (M, 3) as large as the noise behind them.

    The fit takes 3 degrees of freedom for each landmark and 6 for each pose. What two frames say of their motion does
    not depend on where the landmarks are, so residuals keep it whole (of a point seen twice they hold the difference
    of both measurements, exactly). What the pose took is given back: a frame whose observations have ``n`` degrees of
    freedom beside the landmarks keeps ``n - 6`` of them.
    """
    used = structure.weight > 0
    length = np.bincount(seen.track, used, minlength=len(structure.points_world))
    share = np.where(used, 1.0 - 1.0 / np.maximum(length[seen.track], 1.0), 0.0)
    dof = 3.0 * np.bincount(seen.frame, share, minlength=len(structure.T_world_cam))
    factor = np.sqrt(dof / np.maximum(dof - 6.0, 0.25 * np.maximum(dof, 1.0)))
    return structure.residual_px * np.where(used, factor[seen.frame], 1.0)[:, None]
