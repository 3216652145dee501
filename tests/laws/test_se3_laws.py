"""SE(3) is a group, and its exponential, adjoint and Jacobians keep their laws, near zero and near pi too."""

from __future__ import annotations

import numpy as np
from gpvo.geometry import se3
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

EXAMPLES = settings(max_examples=60, deadline=None)
UNIT = st.integers(0, 2**32 - 1).map(lambda seed: _unit(seed))
ANGLE = st.one_of(
    st.floats(0.0, np.pi - 1e-3),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 0.99e-4, 1.01e-4, 0.99e-2, 1.01e-2, np.pi - 1e-7, np.pi - 1e-10]),
)
LENGTH = st.sampled_from([0.0, 1e-7, 1e-3, 1.0, 100.0])


def _unit(seed: int) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=3)
    return v / np.linalg.norm(v)


@st.composite
def tangents(draw) -> np.ndarray:
    return np.concatenate([draw(LENGTH) * draw(UNIT), draw(ANGLE) * draw(UNIT)])


poses = tangents().map(se3.exp)


def _hat(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = se3.skew(xi[3:]), xi[:3]
    return out


@EXAMPLES
@given(poses, poses, poses)
def test_group_axioms(a, b, c):
    scale = 1 + np.abs([a, b, c]).max()
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-13 * scale)
    np.testing.assert_allclose(a @ se3.inverse(a), np.eye(4), atol=1e-13 * scale)
    np.testing.assert_allclose(se3.inverse(a) @ a, np.eye(4), atol=1e-13 * scale)
    np.testing.assert_allclose(se3.inverse(a @ b), se3.inverse(b) @ se3.inverse(a), atol=1e-12 * scale)


@EXAMPLES
@given(poses)
def test_rotations_stay_rotations(T):
    R = T[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert abs(np.linalg.det(R) - 1) < 1e-14


@EXAMPLES
@given(tangents())
def test_log_inverts_exp(xi):
    back = se3.log(se3.exp(xi))
    # Within 1e-9 of pi the axis may flip sign: the pose is the test then.
    np.testing.assert_allclose(se3.exp(back), se3.exp(xi), atol=1e-12 * (1 + np.abs(xi[:3]).max()))
    if np.linalg.norm(xi[3:]) < np.pi - 1e-8:
        np.testing.assert_allclose(back[3:], xi[3:], rtol=1e-7, atol=1e-15)
        np.testing.assert_allclose(back[:3], xi[:3], atol=1e-7 * (1e-6 + np.linalg.norm(xi[:3])))


@EXAMPLES
@given(tangents())
def test_exp_is_the_matrix_exponential(xi):
    np.testing.assert_allclose(se3.exp(xi), expm(_hat(xi)), atol=1e-12 * (1 + np.abs(xi[:3]).max()))


@EXAMPLES
@given(poses, tangents())
def test_adjoint_carries_a_perturbation_across(T, xi):
    left = T @ se3.exp(xi) @ se3.inverse(T)
    right = se3.exp(se3.adjoint(T) @ xi)
    np.testing.assert_allclose(left, right, atol=1e-11 * (1 + np.abs(T).max() + np.abs(xi).max()))


@EXAMPLES
@given(poses, poses)
def test_adjoint_is_a_homomorphism(a, b):
    scale = (1 + np.abs(a).max()) * (1 + np.abs(b).max())
    np.testing.assert_allclose(se3.adjoint(a @ b), se3.adjoint(a) @ se3.adjoint(b), atol=1e-12 * scale)
    np.testing.assert_allclose(se3.adjoint(se3.inverse(a)) @ se3.adjoint(a), np.eye(6), atol=1e-12 * scale**2)


@EXAMPLES
@given(tangents())
def test_jacobians_are_the_numerical_derivatives(xi):
    phi, h = xi[3:], 1e-6
    left, right = np.empty((3, 3)), np.empty((3, 3))
    for j, d in enumerate(h * np.eye(3)):
        ahead, behind = se3.so3_exp(phi + d), se3.so3_exp(phi - d)
        left[:, j] = se3.so3_log(ahead @ behind.T) / (2 * h)
        right[:, j] = se3.so3_log(behind.T @ ahead) / (2 * h)
    R, (J_right, J_left) = se3.so3_exp_and_right_jacobian(np.stack([phi, -phi]))
    np.testing.assert_array_equal(R, se3.so3_exp(np.stack([phi, -phi])))
    np.testing.assert_allclose(J_left, left, atol=2e-9)
    np.testing.assert_allclose(J_right, right, atol=2e-9)
    np.testing.assert_allclose(se3.so3_left_jacobian_inverse(phi) @ J_left, np.eye(3), atol=1e-13)


@EXAMPLES
@given(tangents())
def test_one_is_taken_as_many_are(xi):
    """A single vector or pose goes another way than a batch, and a batch of one the way of a single one."""
    one, many = xi[None], np.stack([xi, xi])
    np.testing.assert_array_equal(se3.exp(one)[0], se3.exp(xi))
    np.testing.assert_array_equal(se3.log(se3.exp(one))[0], se3.log(se3.exp(xi)))
    np.testing.assert_array_equal(se3.exp(many)[0], se3.exp(xi))
    scale = 1 + np.abs(xi).max()
    np.testing.assert_allclose(se3.log(se3.exp(many))[0], se3.log(se3.exp(xi)), rtol=0, atol=1e-9 * scale)


@EXAMPLES
@given(poses, tangents(), st.floats(0, 1))
def test_interpolation_is_even_and_has_the_right_ends(a, xi, fraction):
    b = a @ se3.exp(xi)
    np.testing.assert_allclose(se3.interpolate(a, b, 0.0), a, atol=1e-13 * (1 + np.abs(a).max()))
    np.testing.assert_allclose(se3.interpolate(a, b, 1.0), b, atol=1e-11 * (1 + np.abs(b).max()))
    middle = se3.interpolate(a, b, fraction)
    turned = np.linalg.norm(se3.so3_log(a[:3, :3].T @ middle[:3, :3]))
    assert abs(turned - fraction * np.linalg.norm(xi[3:])) < 1e-7
    expected = a[:3, 3] + fraction * (b[:3, 3] - a[:3, 3])
    np.testing.assert_allclose(middle[:3, 3], expected, atol=1e-12 * (1 + np.abs(b).max()))
