"""The simulator: how much faster than real time the quadrotor flies, flights without images are made,
and how long a minute of pictures takes."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from gpvo.sim import paths, vehicles
from gpvo.sim.points import simulate_points
from gpvo.sim.scenario import load_scenario
from gpvo.sim.sequence import simulate

from bench import Rows, row

_LENGTH_S, _CORES = 20.0, 2


def run() -> Rows:
    """Simulated seconds per second of CPU time."""
    low, high = np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])
    path = paths.wandering(low, high, _LENGTH_S, 1.2, np.random.default_rng(0))
    begin = time.process_time()
    vehicles.fly(path)
    flown = time.process_time()
    simulate_points("tunnel-clean", 0, duration_s=_LENGTH_S)
    done = time.process_time()
    with TemporaryDirectory() as folder:
        began = time.process_time()
        simulate(load_scenario("tunnel-clean", {"duration_s": 60.0, "rate_hz": 20.0}), 0, Path(folder) / "seq")
        minute = (time.process_time() - began) / _CORES
    unit = "x real time (CPU)"
    return {
        "sim_minute_with_pngs, 20 Hz": row(minute, "s (CPU over 2 cores)", "wanted", 120.0, smaller_wins=True),
        "sim_quadrotor": row(_LENGTH_S / (flown - begin), unit),
        "sim_points": row(_LENGTH_S / (done - flown), unit),
    }
