"""Routes: clear of walls, refused where they leave the world, recordings placed where they fit."""

from types import SimpleNamespace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.sim import paths, sequence_plan
from gpvo.sim.scenario import load_scenario

RADIUS_M = 1.6


def pipe(length_m: float = 80.0, radius_m: float = RADIUS_M):
    """A straight pipe along x."""
    x = np.arange(0.0, length_m, 0.5)
    return SimpleNamespace(
        kind="tunnel",
        bounds=np.array([[0.0, -radius_m, -radius_m], [length_m, radius_m, radius_m]]),
        clearance=lambda p: radius_m - np.hypot(p[:, 1], p[:, 2]),
        centreline=np.stack([x, 0 * x, 0 * x], 1),
        start_pose=se3.from_rt(np.eye(3), np.array([2.0, 0.0, 0.0])),
    )


def recording(tmp_path, suffix=".txt"):
    """A loop of 8 by 4 m, turning about the vertical."""
    t = np.arange(0, 30, 0.02)
    p = np.stack([4 * np.cos(0.3 * t) + 7, 2 * np.sin(0.3 * t) - 3, 1 + 0.3 * np.sin(0.5 * t)], 1)
    half = 0.15 * np.sin(0.4 * t)
    q_xyzw = np.stack([0 * t, 0 * t, np.sin(half), np.cos(half)], 1)
    file = tmp_path / f"flown{suffix}"
    if suffix == ".csv":
        rows = [f"{round(a * 1e9)},{','.join(f'{v:.9f}' for v in (*x, q[3], *q[:3]))}" for a, x, q in zip(t, p, q_xyzw)]
    else:
        rows = [f"{a:.9f} {' '.join(f'{v:.9f}' for v in (*x, *q))}" for a, x, q in zip(t, p, q_xyzw)]
    file.write_text("\n".join(rows) + "\n")
    return file


@pytest.mark.filterwarnings("ignore:the path is flown at")  # made smaller, to fit
@pytest.mark.parametrize("suffix", [".txt", ".csv"])
def test_recording_fits_into_the_pipe(tmp_path, suffix):
    scenario = load_scenario("tunnel", {"trajectory": str(recording(tmp_path, suffix)), "duration_s": 20.0})
    path = sequence_plan.plan_path(scenario, pipe(), np.random.default_rng(0))
    motion = path.motion(100.0)
    assert pipe().clearance(motion.position_m).min() > 0.25
    extent = np.ptp(motion.position_m, axis=0)
    assert extent[0] > 1.5 * extent[1], "its longest side lies along the pipe"
    assert extent[1] > 1.0, "no smaller than it must be"
    assert np.linalg.norm(motion.velocity_mps[:290], axis=1).max() < 2e-3, "it rests first"
    assert np.abs(motion.R_world_body[0] @ [0, 0, 1] - [0, 0, 1]).max() < 1e-3, "it begins level"


def test_recording_is_never_blown_up(tmp_path):
    scenario = load_scenario("tunnel", {"trajectory": str(recording(tmp_path)), "duration_s": 20.0})
    wide = pipe(400.0, 60.0)
    path = sequence_plan.plan_path(scenario, wide, np.random.default_rng(0))
    read = paths.read_recording(recording(tmp_path), 20.0)
    extent = np.ptp(path.position(np.arange(3.0, 20.0, 0.02)), axis=0)
    assert extent[2] == pytest.approx(np.ptp(read.position_m[:, 2]), rel=0.05)


def test_recording_that_cannot_fit(tmp_path):
    scenario = load_scenario("tunnel", {"trajectory": str(recording(tmp_path)), "duration_s": 20.0})
    with pytest.raises(GpvoError, match="does not fit"):
        sequence_plan.plan_path(scenario, pipe(radius_m=0.45), np.random.default_rng(0))


def test_sway_gives_way_to_walls():
    scenario = load_scenario("tunnel", {"sway_m": 1.2, "duration_s": 30.0})
    path = sequence_plan.plan_path(scenario, pipe(), np.random.default_rng(1))
    assert pipe().clearance(path.position(np.arange(0, 30, 0.02))).min() > 0.25


@pytest.mark.parametrize(
    "values, message",
    [
        ({"duration_s": 90.0}, "line is"),
        ({"path": "straight", "duration_s": 90.0}, r"leaves the world at t = 6\d"),
        ({"path": "waypoints", "waypoints": [[1, 0, 0], [5, 0, 9]]}, "leaves the world"),
        ({"trajectory": "nowhere.txt"}, "nowhere.txt: no such trajectory"),
        ({"needs_trajectory": True}, "--trajectory"),
    ],
)
def test_refused_up_front(values, message):
    with pytest.raises(GpvoError, match=message):
        sequence_plan.plan_path(load_scenario("tunnel", values), pipe(), np.random.default_rng(0))


def test_worlds_grow_with_the_flight():
    assert sequence_plan.world_parameters(load_scenario("tunnel")) == {}
    long = sequence_plan.world_parameters(load_scenario("tunnel", {"duration_s": 300.0}))
    assert long["length"] >= 300.0 * 1.2
    own = {"duration_s": 300.0, "world_params": {"length": 50.0}}
    assert sequence_plan.world_parameters(load_scenario("tunnel", own)) == {"length": 50.0}


def test_waypoints_are_passed_and_the_end_is_reached():
    corners = np.array([[0.0, 0, 1], [4, 0, 2], [4, 4, 1], [0, 4, 1.5]])
    motion = paths.waypoints(corners, 30.0, 1.0).motion(200.0)
    for corner in corners:
        assert np.linalg.norm(motion.position_m - corner, axis=1).min() < 0.05
    assert np.linalg.norm(motion.velocity_mps[-100:], axis=1).max() < 1e-2
    assert np.linalg.norm(motion.velocity_mps[1500:2000], axis=1).mean() == pytest.approx(1.0, rel=0.02)
    jumps = np.abs(np.diff(motion.acceleration_mps2, axis=0)).max()
    assert jumps < 0.1, "twice continuously differentiable"


@pytest.mark.parametrize("turn_m", [3.0, 3.1])
def test_waypoints_that_turn_back_on_the_spot_are_refused(turn_m):
    with pytest.raises(GpvoError, match="turns back on the spot at"):
        paths.waypoints(np.array([[0.0, 0, 1], [turn_m, 0, 1], [0, 0, 1]]), 12.0, 1.0)
    assert paths.waypoints(np.array([[0.0, 0, 1], [turn_m, 0.5, 1], [0, 1.0, 1]]), 12.0, 1.0).duration_s == 12.0


def test_waypoints_at_no_speed_stay_at_the_first():
    motion = paths.waypoints(np.array([[0.0, 0, 1], [4, 0, 2]]), 5.0, 0.0).motion(100.0)
    assert np.allclose(motion.position_m, [0.0, 0, 1])
    assert np.isfinite(motion.rate_radps).all()


@pytest.mark.parametrize("kind", ["along", "wander"])
def test_agility_bends_tighter(kind):
    line = np.stack([np.arange(0, 60, 0.5), np.zeros(120), np.zeros(120)], 1)
    low, high = np.array([-4.0, -4.0, 0.8]), np.array([4.0, 4.0, 3.2])

    def strain(agility):
        rng = np.random.default_rng(2)
        path = (
            paths.along_curve(line, 25.0, 1.0, rng, sway_m=0.3, agility=agility)
            if kind == "along"
            else paths.wandering(low, high, 25.0, 1.0, rng, agility=agility)
        )
        motion = path.motion(100.0)
        return motion.acceleration_mps2[700:].std(), motion.velocity_mps[700:].std()

    calm, agile = strain(1.0), strain(2.0)
    assert agile[0] > 1.4 * calm[0]


def test_soft_end():
    d = np.linspace(0, 50, 5001)
    s = paths.soft_end(d, 20.0, 0.5)
    assert s[0] == pytest.approx(0.0, abs=1e-9)
    assert s[1000] == pytest.approx(10.0, abs=1e-6)
    assert s[-1] == pytest.approx(20.0, abs=1e-6)
    assert (np.diff(s) >= 0).all()
