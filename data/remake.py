"""Remake the small simulated logs of this folder: ``python data/remake.py [FOLDER]``.

Five flights of 20 s down a mine tunnel (stereo tracks and IMU, no images), run through the odometry. In each, over a
fifth of the time, something hits seeing hard. ``tunnel-1`` to ``tunnel-4`` are for training, ``unseen`` for judging; it
also keeps what odometry saw, for twins.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from gpvo.io import open_source
from gpvo.runner import run
from gpvo.sim.points import simulate_points

FLIGHTS = {"tunnel-1": 101, "tunnel-2": 102, "tunnel-3": 103, "tunnel-4": 104, "unseen": 105}


def remake(name: str, folder: Path, keep_tracks: bool = False) -> Path:
    """Simulate one flight and write its run folder ``folder/name``."""
    with tempfile.TemporaryDirectory() as temporary:
        tracks = Path(temporary) / f"{name}.npz"
        simulate_points("tunnel-bursts", FLIGHTS[name], duration_s=20.0, rate_hz=10.0, imu_rate_hz=100.0).save(tracks)
        run(open_source(tracks), folder / name, keep_tracks=keep_tracks)
    return folder / name


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for flight in FLIGHTS:
        print(remake(flight, target, keep_tracks=flight == "unseen"))
