"""Paths: they rest first, stay where they should, and their derivatives agree."""

import numpy as np
import pytest
from gpvo.errors import SourceError
from gpvo.sim import paths

LOW, HIGH = np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])


def make(kind: str) -> paths.Path3:
    rng = np.random.default_rng(8)
    line = np.stack([np.arange(0, 60, 0.5), 3 * np.sin(np.arange(0, 60, 0.5) / 9), np.zeros(120)], 1)
    return {
        "along": lambda: paths.along_curve(line, 20.0, 1.2, rng, sway_m=0.3),
        "wander": lambda: paths.wandering(LOW, HIGH, 20.0, 1.0, rng),
        "straight": lambda: paths.straight(np.zeros(3), np.array([1.0, 1.0, 0.0]), 20.0, 1.0),
        "ground": lambda: paths.straight(
            np.zeros(3), np.array([1.0, 0, 0]), 20.0, 1.0, lambda xy: 0.2 * np.sin(0.5 * xy[:, 0])
        ),
    }[kind]()


@pytest.mark.parametrize("kind", ["along", "wander", "straight", "ground"])
def test_rest_and_derivatives(kind):
    motion = make(kind).motion(500.0)
    still = motion.t_s < 2.9
    assert np.linalg.norm(motion.velocity_mps[still], axis=1).max() < 2e-3
    assert np.linalg.norm(motion.rate_radps[still], axis=1).max() < 2e-3
    by_difference = np.gradient(motion.position_m, motion.t_s, axis=0)[5:-5]
    assert np.abs(by_difference - motion.velocity_mps[5:-5]).max() < 1e-3
    R = motion.R_world_body
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-12


def test_wandering_stays_in_its_box():
    p = make("wander").motion(50.0).position_m
    assert (p > LOW - 1e-6).all()
    assert (p < HIGH + 1e-6).all()


def test_speed_is_what_was_asked_for():
    motion = make("straight").motion(50.0)
    assert np.linalg.norm(motion.velocity_mps[-50:], axis=1) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.filterwarnings("ignore:the path is flown at")  # made smaller, to fit
def test_flown_path_fits_and_keeps_its_turns(tmp_path):
    t = np.arange(0, 30, 0.05)
    yaw = 0.3 * np.sin(0.4 * t)
    lines = [
        f"{a:.3f} {9 * np.sin(0.3 * a):.6f} {9 * np.cos(0.3 * a):.6f} {1 + 0.2 * np.sin(a):.6f}"
        f" 0 0 {np.sin(y / 2):.9f} {np.cos(y / 2):.9f}"
        for a, y in zip(t, yaw)
    ]
    file = tmp_path / "flown.txt"
    file.write_text("\n".join(lines) + "\n")
    path = paths.read_recording(file, 15.0).fitted(LOW, HIGH, np.random.default_rng(0))
    motion = path.motion(100.0)
    assert (motion.position_m > LOW - 0.05).all()
    assert (motion.position_m < HIGH + 0.05).all()
    assert np.abs(motion.rate_radps[:, 2]).max() == pytest.approx(0.12, rel=0.1)
    with pytest.raises(SourceError, match="lasts"):
        paths.read_recording(file, 60.0)
