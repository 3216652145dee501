"""Flights without images: equal seeds give equal bytes, and VO's errors on them come from where they should."""

import numpy as np
import pytest
from gpvo.dataset.errors import motion_errors
from gpvo.errors import GpvoError
from gpvo.io import open_source
from gpvo.runner import steps
from gpvo.sim.points import simulate_points
from gpvo.types import VoLog
from gpvo.vo.config import make_config

# White in each image coordinate, as the triangulation method assumes.
SIGMA_PX = 0.1


def clean(tmp_path, seed, duration_s=20.0, **values):
    flight = simulate_points(
        "tunnel-clean", seed, duration_s=duration_s, sigma_px=SIGMA_PX, blur_px=0.0, spread=0.0, outliers=0.0, **values
    )
    return flight.save(tmp_path / f"{seed}.npz")


def odometry(file, **settings):
    source = open_source(file)
    log = VoLog([step.record for step in steps(source, make_config(**settings))], source.camera)
    return motion_errors(log, source.truth)


def test_equal_seeds_equal_bytes(tmp_path):
    a = simulate_points("tunnel-bursts", 4, duration_s=8.0).save(tmp_path / "a.npz")
    b = simulate_points("tunnel-bursts", 4, duration_s=8.0).save(tmp_path / "b.npz")
    c = simulate_points("tunnel-bursts", 5, duration_s=8.0).save(tmp_path / "c.npz")
    assert a.read_bytes() == b.read_bytes() != c.read_bytes()


def test_unknown_values_are_refused():
    with pytest.raises(GpvoError, match="unknown points scenario"):
        simulate_points("cave")
    with pytest.raises(GpvoError, match="unknown scenario value"):
        simulate_points("tunnel-clean", 0, sigma=1.0)


def test_noise_does_not_move_the_path():
    a = simulate_points("tunnel-clean", 3, duration_s=5.0)
    b = simulate_points("tunnel-clean", 3, duration_s=5.0, sigma_px=2.0)
    assert np.array_equal(a.T_world_cam, b.T_world_cam)


def test_a_world_may_be_flown_again_with_other_noise():
    one, two = (simulate_points("tunnel-clean", seed, duration_s=4.0, world_seed=5) for seed in (1, 2))
    assert np.array_equal(one.T_world_cam, two.T_world_cam)
    assert one.uv_left.shape != two.uv_left.shape or not np.array_equal(one.uv_left, two.uv_left)
    own, given = (
        simulate_points("tunnel-clean", 5, duration_s=4.0),
        simulate_points("tunnel-clean", 5, world_seed=5, duration_s=4.0),
    )
    assert np.array_equal(own.uv_left, given.uv_left)


def test_wrong_baseline_shows_as_scale(tmp_path):
    """Written calibration with a baseline 1 % too long: every motion comes out 1 % too long."""
    file = clean(tmp_path, 1)
    arrays = dict(np.load(file))
    arrays["baseline_m"] = arrays["baseline_m"] * 1.01
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, **arrays)
    errors = odometry(wrong)
    true, found = errors.T_true[:, :3, 3], errors.T_est[:, :3, 3]
    scale = (true * found).sum() / (true * true).sum()
    assert scale == pytest.approx(1.01, abs=0.002)


@pytest.mark.slow
def test_covariance_is_honest_at_the_true_noise(tmp_path):
    total, dof = 0.0, 0
    settings = {"methods": ("triangulation",), "sigma_px": SIGMA_PX}
    for seed in range(3):
        file = clean(tmp_path, seed)
        source = open_source(file)
        log = VoLog([step.record for step in steps(source, make_config(**settings))], source.camera)
        errors = motion_errors(log, source.truth)
        for index, xi in zip(errors.index, errors.xi):
            covariance = log.records[index].covariances["triangulation"]
            total += xi @ np.linalg.solve(covariance, xi)
            dof += 6
    assert 0.8 < total / dof < 1.25


@pytest.mark.parametrize("rate_hz", [7.0, 20.0, 30.0, 60.0, 200.0])
def test_frames_come_at_the_rate_that_was_asked_for(rate_hz):
    flight = simulate_points("tunnel-clean", 0, duration_s=2.0, rate_hz=rate_hz, imu_rate_hz=110.0)
    assert np.diff(flight.t_s) == pytest.approx(1 / rate_hz)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), "fast"])
@pytest.mark.parametrize("name", ["rate_hz", "imu_rate_hz", "duration_s"])
def test_a_rate_or_duration_that_is_none_is_refused(name, value):
    with pytest.raises(GpvoError, match=name):
        simulate_points("tunnel-clean", 0, **{name: value})
