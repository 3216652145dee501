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


IN_TURN = {"tracks": 90, "sigma_px": 0.2, "outliers": 0.1, "drop": 0.05, "reach_m": 20.0}


def test_values_of_the_frames_in_turn():
    one = simulate_points("tunnel-clean", 2, duration_s=4.0, persistent_px=0.3, **IN_TURN)
    several = simulate_points(
        "tunnel-clean", 2, duration_s=4.0, persistent_px=0.3, **{n: (v,) * 3 for n, v in IN_TURN.items()}
    )
    assert np.array_equal(one.uv_right, several.uv_right)
    counts = np.bincount(simulate_points("tunnel-clean", 2, duration_s=4.0, tracks=[50, 20]).frame)
    assert (counts[::2] == 50).all()
    assert (counts[1::2] == 20).all()


@pytest.mark.parametrize("name", IN_TURN)
@pytest.mark.parametrize(
    "bad", [[], [-1], [float("nan")], ["many"], [[1]], [0.1] * 99 + [float("inf")], {}, None, True]
)
def test_values_that_are_none_are_refused(name, bad):
    with pytest.raises(GpvoError, match=name) as refused:
        simulate_points("tunnel-clean", 0, **{name: bad})
    assert len(str(refused.value)) < 200
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("bad", [0.1, [0.1], [[0.1]], [[0.1, -0.1]], [[0.1, float("nan")]], [[0.1, 0.1]] * 5])
def test_shared_errors_that_are_none_are_refused(bad):
    with pytest.raises(GpvoError, match="shared_px"):
        simulate_points("tunnel-clean", 0, shared_px=bad)


def test_a_point_slips_on_in_both_images():
    """The variance of a sum of n steps with correlation m: s^2 (n (1 + m) / (1 - m) - 2 m (1 - m^n) / (1 - m)^2)."""
    still = {"path": "hover", "duration_s": 6.0, "sigma_px": 0.0, "blur_px": 0.0, "outliers": 0.0, "drop": 0.0}
    clean = simulate_points("room-t265", 1, **still)
    slipping = simulate_points("room-t265", 1, drift_px=0.1, **still)
    assert np.array_equal(clean.track, slipping.track)
    left, right = slipping.uv_left - clean.uv_left, slipping.uv_right - clean.uv_right
    assert np.abs(left - right).max() < 1e-3
    m, n = np.exp(-1 / 20), 20
    expected = 0.1**2 * (n * (1 + m) / (1 - m) - 2 * m * (1 - m**n) / (1 - m) ** 2)
    begun = clean.track[clean.frame == 0]
    at_n = (clean.frame == n) & np.isin(clean.track, begun)
    assert left[at_n].var() == pytest.approx(expected, rel=0.25)
    assert np.abs(left[clean.frame == 0]).max() == 0.0
