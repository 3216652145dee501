"""The simulator: how much faster than real time the quadrotor flies, and flights without images are made."""

from __future__ import annotations

import time

import numpy as np
from gpvo.sim import paths, vehicles
from gpvo.sim.points import simulate_points

_LENGTH_S = 20.0


def _entry(value: float) -> dict[str, object]:
    return {"value": value, "unit": "x real time (CPU)", "peer": None, "peer_value": None, "ratio": None}


def run() -> dict[str, dict[str, object]]:
    """Simulated seconds per second of CPU time."""
    low, high = np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])
    path = paths.wandering(low, high, _LENGTH_S, 1.2, np.random.default_rng(0))
    begin = time.process_time()
    vehicles.fly(path)
    flown = time.process_time()
    simulate_points("tunnel-clean", 0, duration_s=_LENGTH_S)
    done = time.process_time()
    return {
        "sim_quadrotor": _entry(_LENGTH_S / (flown - begin)),
        "sim_points": _entry(_LENGTH_S / (done - flown)),
    }
