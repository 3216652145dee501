"""How much of the geometry's correlation is believed, and what is stated of sums when it is."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.accumulation import PoseError
from gpvo.geometry.covariance import correlation
from gpvo.learning.geometryweight import Divided, _Sums, choose_geometry_weight

from motion_errors import motion_error

PHI = 0.9
OWN = np.eye(6)
TIED = np.eye(6)
TIED[0, 4] = TIED[4, 0] = -0.8
PARTS = np.array([OWN, OWN, OWN])


def _flight(rng: np.random.Generator, n: int, geometry: np.ndarray, truth: np.ndarray) -> Divided:
    """Errors that are mostly white and go together as ``truth`` says, of deviations that change."""
    sigma = np.exp(0.3 * rng.standard_normal((n, 1))) * np.ones(6)
    error = rng.standard_normal((n, 6)) @ np.linalg.cholesky(truth).T * sigma
    small = 1e-3 * sigma
    return Divided(error, small, sigma, small, np.tile(geometry, (n, 1, 1)))


@pytest.mark.parametrize("truth, weight", [(TIED, 1.0), (OWN, 0.0), (0.5 * TIED + 0.5 * OWN, 0.5)])
def test_the_geometry_is_believed_as_far_as_it_is_right(truth, weight):
    rng = np.random.default_rng(0)
    flights = [_flight(rng, 3000, TIED, truth) for _ in range(4)]
    assert choose_geometry_weight(flights, PARTS, PHI) == weight


def test_sums_have_their_say():
    """Single motions are tied as the geometry says, by a jitter of which sums hold nothing; the rest is not."""
    rng = np.random.default_rng(1)
    flights = []
    for _ in range(4):
        frames = rng.standard_normal((4001, 6)) @ np.linalg.cholesky(TIED).T
        white = 0.5 * rng.standard_normal((4000, 6))
        one = np.ones((4000, 6))
        error = np.diff(frames, axis=0) + white
        flights.append(Divided(error, np.sqrt(2.0) * one, 0.5 * one, 1e-3 * one, np.tile(TIED, (4000, 1, 1))))
    single = _Sums.over(flights, PARTS, PHI, 1)
    assert single.loss(1.0) < single.loss(0.0)
    hundred = _Sums.over(flights, PARTS, PHI, 100)
    assert hundred.loss(0.0) < hundred.loss(1.0)
    assert 0.0 < choose_geometry_weight(flights, PARTS, PHI) < 1.0


def test_a_geometry_that_is_mostly_unknown_is_not_believed():
    rng = np.random.default_rng(2)
    assert choose_geometry_weight([_flight(rng, 500, np.full((6, 6), np.nan), TIED)], PARTS, PHI) == 0.0


def test_what_is_stated_of_a_sum_is_what_adds_up_along_a_path():
    """The accumulation of a vehicle that does not move, with its own code, as the oracle."""
    rng = np.random.default_rng(3)
    n, tau_s, dt_s = 40, 0.5, 0.05
    R = np.array([_random_correlation(rng) for _ in range(3)])
    jitter, white, bias = np.exp(0.5 * rng.standard_normal((3, n, 6)))
    unknown = np.full((n, 6, 6), np.nan)
    chain = Divided(np.zeros((n, 6)), jitter, white, bias, unknown)
    sums = _Sums.over([chain], R, float(np.exp(-dt_s / tau_s)), n)
    error = PoseError()
    for j, w, b in zip(jitter, white, bias):
        parts = [C * np.outer(s, s) for C, s in zip(R, (j, w, b))]
        error = error.after(np.eye(4), motion_error(*parts, tau_s, dt_s=dt_s))
    for stated in (sums.own, sums.by_geometry):  # where the geometry is unknown, its place is taken
        np.testing.assert_allclose((stated + sums.bias)[0], error.covariance, rtol=1e-9, atol=1e-9)


def _random_correlation(rng: np.random.Generator) -> np.ndarray:
    A = rng.standard_normal((6, 8))
    return correlation(A @ A.T)
