"""Covariances of inverse, compound and moved motions are those of samples."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.accumulation import along
from gpvo.geometry import covariance as cov
from gpvo.geometry import se3
from gpvo.types import MotionError

TRIALS = 20_000
# An entry of a sample covariance scatters by sqrt(2 / trials) = 1 % of its variances; 5 of that.
TOLERANCE = 0.05
T_A_B = se3.exp(np.array([1.0, -0.5, 2.0, 0.3, -0.6, 0.9]))
T_B_C = se3.exp(np.array([-0.4, 0.8, 1.5, -0.2, 0.5, 0.1]))


def _spd(seed: int) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    return 1e-6 * (A @ A.T + np.eye(6))


def _draw(C: np.ndarray, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((TRIALS, 6)) @ np.linalg.cholesky(C).T


def _assert_close(C: np.ndarray, samples: np.ndarray) -> None:
    sigma = np.sqrt(np.diagonal(C))
    np.testing.assert_allclose(np.cov(samples.T) / np.outer(sigma, sigma), C / np.outer(sigma, sigma), atol=TOLERANCE)


def test_compound_is_that_of_samples():
    C_ab, C_bc = _spd(2), _spd(3)
    T = T_A_B @ se3.exp(_draw(C_ab, 4)) @ T_B_C @ se3.exp(_draw(C_bc, 5))
    _assert_close(cov.compound(T_B_C, C_ab, C_bc), se3.log(se3.inverse(T_A_B @ T_B_C) @ T))


def test_change_body_is_that_of_samples():
    C = _spd(6)
    T = T_A_B @ se3.exp(_draw(C, 7))
    X = T_B_C  # T_new_old
    moved, exact = X @ T @ se3.inverse(X), X @ T_A_B @ se3.inverse(X)
    _assert_close(cov.change_body(X, C), se3.log(se3.inverse(exact) @ moved))


def test_position_in_world_is_that_of_samples():
    C = _spd(8)
    p = (T_A_B @ se3.exp(_draw(C, 9)))[:, :3, 3]
    np.testing.assert_allclose(np.cov(p.T), cov.position_in_world(T_A_B, C), atol=TOLERANCE * np.trace(C[:3, :3]))


def test_accumulate_is_repeated_compounding_and_follows_parents():
    T = se3.exp(0.3 * np.random.default_rng(10).normal(size=(5, 6)))
    C = np.array([_spd(k) for k in range(5)])
    errors = [MotionError.independent(S) for S in C]
    _, chain = along(T, errors, np.arange(5) - 1)
    expected = np.zeros((6, 6))
    for k in range(1, 5):
        expected = cov.compound(T[k], expected, C[k])
    np.testing.assert_allclose(chain[-1], expected, atol=1e-18)
    # Frame 3 is left out: frame 4 starts from frame 2.
    _, branched = along(T, errors, [-1, 0, 1, 2, 2])
    np.testing.assert_allclose(branched[4], cov.compound(T[4], chain[2], C[4]), atol=1e-18)


@pytest.mark.parametrize(
    ("twist", "sigma_m", "sigma_rad"),
    [
        (None, 3.0, 0.1),  # no motion yet: 15 m/s
        (np.zeros(6), 0.2, 0.1),
        (np.array([0.4, 0.0, 0.3, 0.0, 0.3, 0.0]), 0.2, 0.1),
        (np.array([3.0, 0.0, 4.0, 0.6, 0.0, 0.8]), 1.0, 0.2),
    ],
)
def test_a_motion_that_was_not_measured_is_as_large_as_the_last_one_or_a_start(twist, sigma_m, sigma_rad):
    variances = np.square(np.repeat([sigma_m, sigma_rad], 3))
    np.testing.assert_allclose(cov.lost_covariance(0.2, twist), np.diag(variances))
    # However short, it is no motion that is known: a millimetre, a milliradian.
    np.testing.assert_allclose(cov.lost_covariance(0.2e-6, twist), 1e-6 * np.eye(6))


@pytest.mark.parametrize(
    ("C", "expected"),
    [
        (np.eye(6), True),
        (np.diag([1e-9, 1e-9, 1e-9, 1e-12, 1e-12, 1e-12]), True),
        (np.zeros((6, 6)), False),
        (np.diag([1.0, 1, -1e-3]), False),
        (np.array([[1.0, 0.5], [0.4, 1.0]]), False),
        (np.full((3, 3), np.nan), False),
        (np.diag([np.inf, 1.0]), False),
        (np.diag([1e-300, 1.0]), False),  # its whitened errors have no finite squares
    ],
)
def test_is_positive_definite(C, expected):
    assert cov.is_positive_definite(C) is expected
    many = np.array([np.eye(len(C)), C, 2.0 * np.eye(len(C))])
    assert cov.are_covariances(many).tolist() == [True, expected, True]
    assert cov.are_covariances(many[:0]).tolist() == []


def test_the_scaled_root_follows_the_units():
    """L L^T = C, also for a singular C; in other units the root is in other units, nothing else."""
    A = np.random.default_rng(5).standard_normal((6, 4))
    C, units = A @ A.T, np.array([1.0, 10.0, 0.1, 1e-3, 1e-2, 1e3])
    L = cov.scaled_root(C)
    np.testing.assert_allclose(L @ L.T, C, atol=1e-12)
    np.testing.assert_allclose(cov.scaled_root(C * units[:, None] * units), units[:, None] * L, rtol=1e-6, atol=1e-9)
    assert not cov.scaled_root(np.zeros((6, 6))).any()
