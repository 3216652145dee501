"""Which readings of an IMU are used, and what is known of those that are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.filters import plausible
from gpvo.filters.plausible import Samples, saturated
from gpvo.filters.policies import LearnedPolicy
from gpvo.filters.run import Flight, fuse_flight
from gpvo.filters.sanity import check_flight
from gpvo.types import Array, ImuLog
from synthetic_flights import synthetic_flight


def test_a_gap_is_judged_by_the_samples_before_it_however_long_the_flight() -> None:
    """Readings that sway over ten seconds, a gap of two, and records that let go of what is old meanwhile."""
    t_s = np.arange(0.0, 30.0, 0.01)
    values = np.sin(0.6 * t_s)[:, None] * np.ones(6)
    samples = Samples()
    for t, value in zip(t_s, values, strict=True):
        if not 25.0 < t < 27.0:
            samples.insert(round(1e9 * t), value)
        if t < 25.0:
            samples.drop_before(round(1e9 * t))
    i = int(np.searchsorted(samples.t_ns, round(25.5e9)))
    assert 1000 <= i <= 2001
    ends = np.array([samples.at(round(1e9 * t), i) for t in (25.4, 25.5)])
    gap = samples.over_gap(i, round(25.4e9), round(25.5e9), ends)
    assert gap is not None
    samples.drop_before(round(25.4e9))
    i = int(np.searchsorted(samples.t_ns, round(25.5e9)))
    again = samples.over_gap(i, round(25.4e9), round(25.5e9), ends)
    assert again is not None
    np.testing.assert_allclose(again[1], gap[1], rtol=0.2)


def clipped(flight: Flight, most_radps: float) -> Flight:
    imu = flight.imu
    assert imu is not None
    gyro = np.clip(imu.gyro_radps, -most_radps, most_radps)
    return replace(flight, imu=ImuLog(imu.t_ns, gyro, imu.acc_mps2, imu.noise))


def test_a_sensor_at_the_end_of_its_range_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plausible, "_LEAST_RANGE", (0.5, 15.0))  # the flight turns by no more
    flight = clipped(synthetic_flight(2, duration_s=15), 0.6)
    assert [f.kind for f in check_flight(flight)] == ["saturated"]
    scores = fuse_flight(flight, LearnedPolicy()).scores
    assert scores is not None
    assert (scores.nees_position or 99.0) < 2.0
    assert (scores.nees_attitude or 99.0) < 2.0


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.02])
def test_coarse_held_and_resting_readings_are_in_range(step: float) -> None:
    imu = synthetic_flight(1, duration_s=15).imu
    assert imu is not None

    def coarse(values: Array) -> Array:
        return np.round(values / step) * step if step else values

    gyro, acc = (np.repeat(coarse(v), 4, axis=0) for v in (imu.gyro_radps, imu.acc_mps2))
    assert not saturated(ImuLog(np.arange(len(gyro)), gyro, acc)).any()
    rest = np.tile([0.0, 0.0, 0.01, 0.0, 0.0, 9.81], (500, 1)) + step * np.round(np.sin(np.arange(500)))[:, None]
    assert not saturated(ImuLog(np.arange(500), rest[:, :3], rest[:, 3:])).any()


@pytest.mark.parametrize("most, expected", [(0.5, False), (4.0, True)])
def test_a_steady_turn_without_noise_is_in_range(most: float, expected: bool) -> None:
    gyro = np.minimum(np.linspace(0.0, 2.0 * most, 1000), most)[:, None] * [0.0, 0.0, 1.0]
    assert saturated(ImuLog(np.arange(1000), gyro, np.full((1000, 3), 5.0))).any() == expected
