"""Without an IMU: how much the vehicle's velocity walks, from the log itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.filters.policies import GeometricPolicy
from gpvo.filters.propagation import constant_velocity_noise
from gpvo.filters.run import Flight, fuse_flight
from gpvo.geometry import se3
from gpvo.types import MotionError, Prediction, Status, VoRecord

RATE_HZ = 20.0
SIGMA = np.repeat([2e-4, 1e-4], 3)


def _records(T_world_cam: np.ndarray, rng: np.random.Generator) -> list[VoRecord]:
    t_ns = np.round(np.arange(len(T_world_cam)) / RATE_HZ * 1e9).astype(np.int64)
    T = se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:] @ se3.exp(SIGMA * rng.standard_normal((len(t_ns) - 1, 6)))
    stated = {"triangulation": np.diag(SIGMA**2)}
    start = VoRecord(int(t_ns[0]), int(t_ns[0]), Status.START, np.eye(4))
    moved = (VoRecord(int(t_ns[k + 1]), int(t_ns[k]), Status.OK, T[k], covariances=stated) for k in range(len(T)))
    return [start, *moved]


def _from_rest(rest_s: float, move_s: float, swing: float = 1.0) -> Flight:
    """A vehicle that rests, and then sets off within two seconds, to 2 m/s and swings of half a radian, or ``swing`` of
    them."""
    t = np.arange(round((rest_s + move_s) * RATE_HZ) + 1) / RATE_HZ
    u = np.maximum(t - rest_s, 0.0)
    w = np.minimum(u / 2.0, 1.0)
    rise = w**3 * (10 - 15 * w + 6 * w * w)
    forward, zero = 2.0 * np.cumsum(rise) / RATE_HZ, np.zeros_like(t)
    sway = swing * rise
    position = np.stack([0.3 * np.sin(1.1 * u) * sway, 0.1 * np.sin(2 * u) * sway, forward], axis=1)
    T = se3.from_rt(se3.so3_exp(np.stack([zero, 0.5 * np.sin(0.8 * u) * sway, zero], axis=1)), position)
    return Flight("rest", _records(T, np.random.default_rng(0)), T_world_cam=T, truth_valid=np.ones(len(t), bool))


def test_a_vehicle_that_rested_long_is_followed_when_it_sets_off() -> None:
    run = fuse_flight(_from_rest(50.0, 10.0), GeometricPolicy("triangulation"))
    assert run.scores.rejected == 0
    assert run.scores.final_error_m < 0.1
    assert run.scores.nees_position < 3.0


@pytest.mark.parametrize("rest_s", [0.0, 3.0])
@pytest.mark.parametrize("move_s", [8.0, 20.0, 60.0])
def test_an_acceleration_that_lasts_is_followed_though_cruising_is_smooth(rest_s: float, move_s: float) -> None:
    """In each frame it is small, and most have none: 21 motions of setting off were rejected, at a NEES of 300."""
    run = fuse_flight(_from_rest(rest_s, move_s, swing=0.1), GeometricPolicy("triangulation"))
    assert run.scores.rejected == 0
    assert run.scores.nees_position < 3.0


@pytest.mark.parametrize("axes", [1, 3])
def test_the_walk_of_a_known_acceleration_is_found(axes: int) -> None:
    """White acceleration of known density in steps of a hundredth of a frame, so that motions hold its integrals."""
    rng, fine, n, density, dt = np.random.default_rng(1), 100, 4000, 0.3, 1.0 / RATE_HZ
    a = np.zeros((n * fine, 3))
    a[:, :axes] = density / np.sqrt(dt / fine) * rng.standard_normal((n * fine, axes))
    position = np.cumsum(5.0 + np.cumsum(a, axis=0) * dt / fine, axis=0)[fine - 1 :: fine] * dt / fine
    T = se3.from_rt(np.broadcast_to(np.eye(3), (n, 3, 3)), position)
    found = constant_velocity_noise(_records(T, rng)).acceleration
    assert 0.97 * density < found < 2.0 * density


def test_failures_of_vo_are_not_taken_for_motion() -> None:
    """Slips of half a metre, one by one, and a motion that is no number."""
    flight = _from_rest(10.0, 10.0)
    known = constant_velocity_noise(flight.records)
    rng, records = np.random.default_rng(2), list(flight.records)
    for i in (*rng.choice(np.arange(220, 395, 5), 6, replace=False), 300):
        T = records[i].T_prev_cur.copy()
        T[:3, 3] += 0.5 * rng.standard_normal(3) if i != 300 else np.nan
        records[i] = replace(records[i], T_prev_cur=T)
    found = constant_velocity_noise(records)
    assert found.acceleration == pytest.approx(known.acceleration, rel=0.3)
    assert found.angular_acceleration == pytest.approx(known.angular_acceleration, rel=0.3)


class _ScaleDiffersByFlight:
    """White noise, and a scale that is off by two per cent (1 sigma) of what was measured, the same all flight."""

    name = "scale"

    def noise(self, record: VoRecord, prediction: Prediction | None) -> MotionError:
        moved = (record.T_prev_cur[:3, :3].T @ record.T_prev_cur[:3, 3])[:, None]
        root, white = np.concatenate([0.02 * moved, np.zeros((3, 1))]), MotionError.independent(np.diag(SIGMA**2))
        return replace(white, persistent_root=root, persistent_tau_s=np.array([1e6]), dt_s=record.dt_s).row(None)


@pytest.mark.parametrize("off", [-0.02, 0.0, 0.02])
def test_an_error_that_persists_makes_the_path_no_other_than_that_of_vo(off: float) -> None:
    """The place followed what changes of speed seem to tell of the scale, and ended 3.4 m short of VO's, whatever the
    scale was."""
    rng, t = np.random.default_rng(3), np.arange(round(30.0 * RATE_HZ) + 1) / RATE_HZ
    forward = 4.0 * t - 2.0 / 0.5 * np.cos(0.5 * t)
    T = se3.from_rt(np.broadcast_to(np.eye(3), (len(t), 3, 3)), forward[:, None] * np.array([0.0, 0.0, 1.0]))
    scaled = T.copy()
    scaled[:, :3, 3] *= 1.0 + off
    flight = Flight("scale", _records(scaled, rng), T_world_cam=T, truth_valid=np.ones(len(t), bool))
    place = np.eye(4)
    for record in flight.records:
        place = place @ record.T_prev_cur
    run = fuse_flight(flight, _ScaleDiffersByFlight())
    assert run.scores.rejected == 0
    np.testing.assert_allclose(run.T_world_cam[-1, :3, 3] - T[0, :3, 3], place[:3, 3], atol=0.1)
    assert run.scores.nees_position < 2.0
