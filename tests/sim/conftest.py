"""A world and an eye that cost nothing, for tests of what surrounds the images."""

from types import SimpleNamespace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.sim import sequence
from gpvo.sim.scenario import load_scenario

SHORT = {"duration_s": 4.0, "rate_hz": 5.0, "rest_s": 2.0, "speed_mps": 0.5}


@pytest.fixture
def quick(monkeypatch):
    """A maker of scenarios in a hall of air where images are noise of the seed: all but rendering is as it is."""
    world = SimpleNamespace(
        bounds=np.array([[-5.0, -5.0, 0.0], [5.0, 5.0, 4.0]]),
        clearance=lambda p: np.minimum(5.0 - np.abs(p[:, 0]), 5.0 - np.abs(p[:, 1])),
        start_pose=se3.from_rt(np.eye(3), np.array([-3.0, 0.0, 1.5])),
        centreline=np.stack([np.linspace(-4, 4, 40), np.zeros(40), np.full(40, 1.5)], 1),
    )
    monkeypatch.setattr(sequence, "build_world", lambda kind, seed, **params: world)

    class Eye:
        depth_m = None

        def __init__(self, scenario, seed, world, rig, motion, threads):
            self.seed = seed

        def see(self, index, plan):
            rng = np.random.default_rng([self.seed, index])
            pair = rng.integers(1, 256, (2, 480, 640), dtype=np.uint8)
            return (pair[0], pair[1]) if plan.fate != "black" else (pair[0] * 0, pair[1] * 0)

    monkeypatch.setattr(sequence, "Eye", Eye)
    return lambda **values: load_scenario("tunnel", {**SHORT, "vehicle": "path", "path": "straight", **values})
