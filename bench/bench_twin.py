"""Cost of twins: 8 of a minute of VGA at 20 Hz, odometry included, and the structure of a long run. Peak memory too."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from gpvo.geometry import se3
from gpvo.io import open_source
from gpvo.runner import run as run_odometry
from gpvo.sim.points import simulate_points
from gpvo.twin.bundle import Observations
from gpvo.twin.noise import adjust
from gpvo.twin.replicate import TwinSettings, make_twins
from gpvo.types import StereoCamera
from gpvo.vo.points import triangulate

from bench import Rows, row

_CAMERA = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)
_STEP = np.array([0.002, 0.0, 0.05, 0.0, 0.003, 0.0])


def long_run(n_frames: int, per_frame: int = 100, life: int = 12) -> tuple[Observations, np.ndarray]:
    """Tracks of ``life`` frames along a wide circle, and the path as an odometry would have it."""
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((n_frames, 6)) * [2e-3, 2e-3, 2e-3, 5e-4, 5e-4, 5e-4]
    T, guess = np.tile(np.eye(4), (2, n_frames, 1, 1))
    for k in range(1, n_frames):
        T[k] = T[k - 1] @ se3.exp(_STEP)
        guess[k] = guess[k - 1] @ se3.exp(_STEP) @ se3.exp(noise[k])
    n = n_frames * per_frame // life
    begin = rng.integers(0, n_frames - 2, n)
    uvd = np.stack([rng.uniform(20, 620, n), rng.uniform(20, 460, n), rng.uniform(4, 40, n)], axis=1)
    points = np.einsum("nij,nj->ni", T[begin, :3, :3], triangulate(uvd, _CAMERA)) + T[begin, :3, 3]
    frame, track = (begin[:, None] + np.arange(life)).ravel(), np.repeat(np.arange(n), life)
    frame, track = (i[frame < n_frames] for i in (frame, track))
    P = np.einsum("mji,mj->mi", T[frame, :3, :3], points[track] - T[frame, :3, 3])
    order = np.argsort(frame, kind="stable")
    order = order[P[order, 2] > 0.3]
    seen = _CAMERA.project(P[order]) + rng.standard_normal((len(order), 3)) * [0.15, 0.1, 0.2]
    track = np.unique(track[order], return_inverse=True)[1]
    return Observations(_CAMERA, frame[order], track, seen, np.ones(len(order), bool)), guess


def structure(n_frames: int) -> tuple[float, float]:
    """Seconds of CPU for the structure of a long run, and the peak memory of the process [GB]."""
    seen, guess = long_run(n_frames)
    begin = time.process_time()
    adjust(seen, guess)
    return time.process_time() - begin, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def run() -> Rows:
    """Measure on this machine: about five minutes."""
    with tempfile.TemporaryDirectory() as folder:
        flight = simulate_points("tunnel-clean", seed=1, duration_s=60.0).save(Path(folder) / "flight.npz")
        run_odometry(open_source(flight), Path(folder) / "run", keep_tracks=True)
        begin = time.perf_counter()
        make_twins(Path(folder) / "run", Path(folder) / "twins", TwinSettings(replicates=8), jobs=2)
        seconds = time.perf_counter() - begin
    # A process of its own, so that nothing else counts in its memory.
    told = subprocess.run([sys.executable, "-m", "bench.bench_twin"], capture_output=True, text=True, check=True)
    fit_s, fit_gb = map(float, told.stdout.split())
    return {
        "twins of 60 s, 8 replicates, 2 processes": row(seconds, "s", "limit", 180.0),
        "structure of 10,000 frames x 100 points": row(fit_s, "s of CPU", "limit", 300.0),
        "its peak memory": row(fit_gb, "GB", "limit", 1.0),
    }


if __name__ == "__main__":
    print(*structure(10_000))
