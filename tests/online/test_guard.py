"""The training domain: no training row is another place, and what lies beyond all of them is, the more the farther."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from gpvo.learning.basefit import learn_domain
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


def test_arrays_round_trip() -> None:
    domain = learn_domain(np.random.default_rng(0).standard_normal((50, 2)))
    arrays = domain.to_arrays("d.")
    for field in fields(Domain):
        np.testing.assert_array_equal(
            getattr(Domain.from_arrays(arrays, "d."), field.name), getattr(domain, field.name)
        )
