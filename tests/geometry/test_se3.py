"""SE(3) against SciPy, and its shapes."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.geometry import se3
from scipy.spatial.transform import Rotation, Slerp

ROTATIONS = Rotation.random(200, random_state=0)
HALF_TURNS = Rotation.from_rotvec(np.pi * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, 0.6, -0.8]]))
POSES = se3.exp(np.random.default_rng(2).normal(size=(20, 6)))


def test_rotation_vectors_are_scipys():
    np.testing.assert_allclose(se3.so3_exp(ROTATIONS.as_rotvec()), ROTATIONS.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(se3.so3_log(ROTATIONS.as_matrix()), ROTATIONS.as_rotvec(), atol=1e-12)


@pytest.mark.parametrize("rotations", [ROTATIONS, HALF_TURNS, Rotation.identity(3)])
def test_quaternions_are_scipys(rotations):
    q = se3.rotation_to_quaternion_xyzw(rotations.as_matrix())
    theirs = rotations.as_quat()
    sign = np.sign((q * theirs).sum(1, keepdims=True))
    np.testing.assert_allclose(q * sign, theirs, atol=1e-14)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(
        se3.from_quaternion(np.zeros((len(q), 3)), q)[:, :3, :3], rotations.as_matrix(), atol=1e-14
    )


def test_log_at_half_turns_has_angle_pi():
    phi = se3.so3_log(HALF_TURNS.as_matrix())
    np.testing.assert_allclose(np.linalg.norm(phi, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(se3.so3_exp(phi), HALF_TURNS.as_matrix(), atol=1e-12)


def test_right_jacobian_inverse_is_the_derivative_of_the_logarithm():
    rng = np.random.default_rng(3)
    xi = rng.normal(size=(40, 6)) * [1, 1, 1, 0.5, 0.5, 0.5]
    step = 1e-6
    columns = [
        (se3.log(se3.exp(xi) @ se3.exp(step * axis)) - se3.log(se3.exp(xi) @ se3.exp(-step * axis))) / (2 * step)
        for axis in np.eye(6)
    ]
    np.testing.assert_allclose(se3.right_jacobian_inverse(xi), np.stack(columns, axis=-1), atol=1e-3)


def test_quaternions_of_any_length_are_normalised():
    T = se3.from_quaternion(np.zeros(3), np.array([0.0, 0.0, 2.002, 2.002]))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-15)


def test_interpolation_is_scipys_slerp():
    key = Rotation.concatenate([ROTATIONS[0], ROTATIONS[1]])
    a, b = se3.from_rt(key.as_matrix(), np.array([[0.0, 0, 0], [1.0, 2, 3]]))
    fractions = np.linspace(0, 1, 11)
    T = se3.interpolate(np.broadcast_to(a, (11, 4, 4)), np.broadcast_to(b, (11, 4, 4)), fractions)
    np.testing.assert_allclose(T[:, :3, :3], Slerp([0, 1], key)(fractions).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(T[:, :3, 3], fractions[:, None] * [1, 2, 3], atol=1e-15)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_batches_in_the_leading_axes(shape):
    xi = np.random.default_rng(3).normal(size=(*shape, 6))
    T = se3.exp(xi)
    assert T.shape == se3.inverse(T).shape == se3.orthonormalise(T).shape == (*shape, 4, 4)
    assert se3.log(T).shape == (*shape, 6)
    assert se3.adjoint(T).shape == (*shape, 6, 6)
    for k in np.ndindex(shape):
        np.testing.assert_allclose(T[k], se3.exp(xi[k]), atol=1e-15)


def test_orthonormalise_gives_back_a_rotation():
    rng = np.random.default_rng(4)
    noisy = POSES.copy()
    noisy[:, :3, :3] += 1e-4 * rng.normal(size=(20, 3, 3))
    mended = se3.orthonormalise(noisy)
    R = mended[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(mended, POSES, atol=1e-3)


@pytest.mark.parametrize("wrong", [np.diag([1.0, -1.0, 1.0, 1.0]), -np.eye(4), POSES[0].T, np.diag([1.0, 1, 1, 0])])
def test_mirror_images_and_transposed_poses_are_not_rigid(wrong):
    assert all(se3.is_rigid(T, 100.0) for T in POSES)
    assert not se3.is_rigid(wrong, 100.0)


@pytest.mark.parametrize("at", [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)])
def test_what_is_stretched_or_sheared_along_one_axis_is_not_rigid(at):
    bent = np.eye(4)
    bent[at] += 5e-3
    slightly = np.eye(4)
    slightly[at] += 1e-4
    for T in POSES:
        assert not se3.is_rigid(T @ bent, 100.0)
        assert se3.is_rigid(T @ slightly, 100.0)


def test_transform_moves_points():
    points = np.random.default_rng(5).normal(size=(7, 3))
    expected = (POSES[0] @ np.column_stack([points, np.ones(7)]).T).T[:, :3]
    np.testing.assert_allclose(se3.transform(POSES[0], points), expected, atol=1e-14)
    np.testing.assert_allclose(se3.skew(points[0]) @ points[1], np.cross(points[0], points[1]), atol=1e-15)


def test_fixed_frames():
    forward, right, down = np.eye(3)[[2, 0, 1]]
    np.testing.assert_array_equal(se3.R_FLU_OPTICAL @ forward, [1, 0, 0])
    np.testing.assert_array_equal(se3.R_FLU_OPTICAL @ right, [0, -1, 0])
    np.testing.assert_array_equal(se3.R_FLU_OPTICAL @ down, [0, 0, -1])
    np.testing.assert_array_equal(se3.R_FRD_FLU @ [0, 1, 0], [0, -1, 0])
    np.testing.assert_array_equal(se3.R_NED_ENU @ [1, 2, 3], [2, 1, -3])
    np.testing.assert_array_equal(se3.R_FLU_T265 @ [0, 0, -1], [1, 0, 0])
    np.testing.assert_array_equal(se3.R_FLU_T265 @ [0, 1, 0], [0, 0, 1])
    for R in (se3.R_FLU_OPTICAL, se3.R_FRD_FLU, se3.R_NED_ENU, se3.R_FLU_T265):
        np.testing.assert_array_equal(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1)
        assert not R.flags.writeable


def test_rotated_covariance_is_that_of_rotated_samples():
    A = np.random.default_rng(6).normal(size=(6, 6))
    C = se3.rotate_covariance(se3.R_FLU_OPTICAL, A @ A.T)
    rows = np.vstack([se3.R_FLU_OPTICAL @ A[:3], se3.R_FLU_OPTICAL @ A[3:]])
    np.testing.assert_allclose(C, rows @ rows.T, atol=1e-14)
