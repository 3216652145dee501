"""The training domain: no training row is another place, and what lies beyond all of them is, the more the farther."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from gpvo.learning.basefit import learn_domain
from gpvo.online.base import (
    ACCELERATION_COLUMNS,
    COASTED,
    TWIST_COLUMNS,
    Velocities,
    feature_noise,
    motion_noise,
)
from gpvo.online.guard import Domain
from hypothesis import given
from hypothesis import strategies as st


@given(st.integers(0, 1000), st.sampled_from(["normal", "t", "mixed"]))
def test_no_training_row_is_outside(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((6000, 3)) if kind == "normal" else rng.standard_t(1.5, (6000, 3))
    if kind == "mixed":
        X[:, 1] = rng.random(6000) < 0.001
    place = learn_domain(X).locate(X)
    np.testing.assert_allclose(place.distance, 0.0, atol=1e-9)
    np.testing.assert_allclose(place.in_domain, 1.0)


def test_beyond_all_training_rows_the_distance_grows() -> None:
    """Rare values far out belong to the domain; what a model is given of them is drawn into where it could learn."""
    rng = np.random.default_rng(0)
    X = rng.standard_normal((20_000, 2))
    X[7, 0] = 30.0
    domain = learn_domain(X)
    at = np.array([[30.0, 0.0], [31.0, 0.0], [34.0, 0.0], [50.0, 0.0], [-10.0, 0.0]])
    place = domain.locate(at)
    assert place.distance[0] < 1e-9
    assert (np.diff(place.distance[:4]) > 0.5).all()
    assert place.distance[4] > 5.0
    assert (place.inside[:4, 0] < 5.0).all()


def test_what_is_not_finite_is_missing() -> None:
    X = np.random.default_rng(0).standard_normal((500, 2))
    X[3, 0], X[4, 0], X[5, 1] = np.inf, -np.inf, np.nan
    domain = learn_domain(X)
    assert np.isfinite(np.stack([domain.least, domain.most])).all()
    assert domain.may_miss.all()
    assert domain.locate(np.array([[np.inf, 0.0], [9.0, 0.0]])).distance[1] > 3.0


def test_noise_and_missing_values_count_as_far_as_they_are() -> None:
    X = np.random.default_rng(0).standard_normal((5000, 1)) * 20.0
    domain = learn_domain(X)
    at = domain.reach[1] + 6.0 * domain.scale
    for noise in (0.0, 30.0, 3000.0):
        expected = 6.0 / np.sqrt(1.0 + noise / domain.scale[0] ** 2)
        assert abs(domain.locate(at[None], np.array([[noise]])).distance[0] - expected) < 1e-9
    assert domain.locate(np.array([[np.nan]])).distance[0] == 2.0


def test_the_noise_of_velocities_and_accelerations_is_that_of_drawn_motions() -> None:
    rng, sigma, dt_s = np.random.default_rng(1), np.array([0.01, 0.02, 0.03, 1e-3, 2e-3, 4e-3]), 0.05
    names = (*TWIST_COLUMNS, *ACCELERATION_COLUMNS, "n_inliers")
    before, now = rng.standard_normal((2, 40_000, 6)) * sigma / dt_s
    square = np.square((now - before) / dt_s).mean(axis=0).reshape(2, 3).sum(axis=1)
    drawn = [*np.square(now).mean(axis=0), *square, 0.0]
    noise = feature_noise(motion_noise(names), sigma[None] ** 2, np.array([dt_s]))[0]
    np.testing.assert_allclose(noise, drawn, rtol=0.05)


def test_a_lost_motion_coasts_as_training_did() -> None:
    change = 1e-3 * np.arange(1.0, 37.0).reshape(6, 6)
    velocities, none = Velocities(np.full(6, 4.0), change), np.zeros(6)
    for motions, expected in zip(COASTED, change, strict=True):
        C = velocities.lost_covariance(0.1, 0.2, 0.1 * motions, none, none, none)
        np.testing.assert_allclose(np.diagonal(C), expected * 0.2**2, rtol=1e-9)


def test_arrays_round_trip() -> None:
    domain = learn_domain(np.random.default_rng(0).standard_normal((50, 2)))
    arrays = domain.to_arrays("d.")
    for field in fields(Domain):
        np.testing.assert_array_equal(
            getattr(Domain.from_arrays(arrays, "d."), field.name), getattr(domain, field.name)
        )
