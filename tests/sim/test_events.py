"""What moves beside the camera: in the image, hiding what is behind, and without moving the camera's own path."""

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.sim import events
from gpvo.sim.points import simulate_points


@pytest.mark.parametrize(
    "name, without", [("street-traffic", {"cars": 0}), ("tunnel-smoke", {"smoke": 0.0}), ("lunar-dust", {"dust": 0.0})]
)
def test_the_camera_goes_its_way_whatever_moves_beside_it(name, without):
    busy, empty = simulate_points(name, 2, duration_s=20.0), simulate_points(name, 2, duration_s=20.0, **without)
    assert np.array_equal(busy.T_world_cam, empty.T_world_cam)
    assert np.array_equal(busy.imu.acc_mps2, empty.imu.acc_mps2)
    assert len(busy.uv_left) != len(empty.uv_left) or not np.array_equal(busy.uv_left, empty.uv_left)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_car_drives_up_to_its_speed_as_cars_do(seed):
    motion = simulate_points("street", seed, duration_s=60.0, speed_mps=30.0).motion
    speed = np.linalg.norm(motion.velocity_mps, axis=1)
    assert speed[motion.t_s < 2.9].max() < 2e-3
    assert 10.0 < speed.max() < 31.0
    assert np.linalg.norm(motion.acceleration_mps2, axis=1).max() < 12.0


def test_a_leader_stays_before_the_camera():
    t_s = np.arange(300) * 0.1
    T_world_cam = np.tile(np.eye(4), (300, 1, 1))
    T_world_cam[:, :3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T_world_cam[:, 0, 3] = 15.0 * t_s
    found = 0
    for seed in range(12):
        (car,) = events.draw_movers(t_s, T_world_cam, np.random.default_rng(seed), cars=1)
        there = np.flatnonzero(np.isfinite(car.T_world_body[:, 0, 3]))
        assert 50 <= len(there) <= 201
        relative = se3.inverse(T_world_cam[there]) @ car.T_world_body[there]
        speed_mps = np.linalg.norm(np.diff(relative[:, :3, 3], axis=0), axis=1) / 0.1
        found += bool(speed_mps.max() < 2.0)  # the others overtake, or come towards the camera
        assert speed_mps.max() < 36.0
    assert found >= 2


def test_a_lorry_hides_what_is_behind_it_alone():
    body = events.Body(np.array([[-1.0, -1, 0], [1, 1, 0]]), np.eye(4)[None], solid=True)
    uv = np.array([[50.0, 50.0], [50.0, 50.0], [500.0, 50.0], [40.0, 40.0], [60.0, 60.0]])
    depth_m = np.array([30.0, 2.0, 30.0, 10.0, 10.0])
    assert events.hidden((body,), 3, uv, depth_m).tolist() == [True, False, False, False, False]
