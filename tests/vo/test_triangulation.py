import cv2
import numpy as np
import pytest
from gpvo.types import StereoCamera
from gpvo.vo.points import (
    point_covariance,
    point_jacobian,
    pointing_matching_pixel_covariance,
    triangulate,
    triangulation_pixel_covariance,
)
from stereo_points import CAMERA

ODD = StereoCamera(400.0, 410.0, 310.0, 250.0, 0.2, 640, 480)


def test_triangulation_inverts_projection() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, 50), rng.uniform(-1, 1, 50), rng.uniform(1, 30, 50)])
    for camera in (CAMERA, ODD):
        np.testing.assert_allclose(triangulate(camera.project(points), camera), points, rtol=1e-12, atol=1e-12)


def test_triangulation_equals_opencv() -> None:
    rng = np.random.default_rng(1)
    uvd = np.column_stack([rng.uniform(0, 640, 20), rng.uniform(0, 480, 20), rng.uniform(3, 60, 20)])
    P_left = CAMERA.K @ np.eye(3, 4)
    P_right = CAMERA.K @ np.column_stack([np.eye(3), [-CAMERA.baseline_m, 0, 0]])
    X = cv2.triangulatePoints(P_left, P_right, uvd[:, :2].T.copy(), (uvd[:, :2] - uvd[:, 2:] * [1, 0]).T.copy())
    np.testing.assert_allclose(triangulate(uvd, CAMERA), (X[:3] / X[3]).T, rtol=1e-6)


@pytest.mark.parametrize("camera", [CAMERA, ODD])
def test_jacobian_is_the_numerical_derivative(camera: StereoCamera) -> None:
    uvd = np.array([[100.0, 50.0, 5.0], [600.0, 470.0, 40.0], [320.0, 240.0, 1.5]])
    J = point_jacobian(uvd, camera)
    for k, h in enumerate((1e-3, 1e-3, 1e-5)):
        step = np.eye(3)[k] * h
        numeric = (triangulate(uvd + step, camera) - triangulate(uvd - step, camera)) / (2 * h)
        np.testing.assert_allclose(J[:, :, k], numeric, rtol=1e-6, atol=1e-6 * np.abs(J).max())


def test_pixel_covariance_of_four_measurements() -> None:
    S = triangulation_pixel_covariance(0.5)
    np.testing.assert_allclose(S, 0.25 * np.array([[1, 0, 1], [0, 0.5, 0], [1, 0, 2]]))
    rng = np.random.default_rng(2)
    uL, vL, uR, vR = 0.5 * rng.standard_normal((4, 400_000))
    sample = np.cov(np.stack([uL, (vL + vR) / 2, uL - uR]))
    np.testing.assert_allclose(S, sample, atol=0.005)


def test_pointing_matching_holds_squares() -> None:
    np.testing.assert_allclose(pointing_matching_pixel_covariance(0.1, 0.5), np.diag([0.01, 0.01, 0.25]))


def test_point_covariance_against_monte_carlo() -> None:
    """100,000 draws; the sample variance is within 3 % of the first-order one at 20 sigmas of disparity."""
    rng = np.random.default_rng(3)
    S = triangulation_pixel_covariance(0.5)
    uvd = np.array([420.0, 300.0, 0.5 * np.sqrt(2) * 20])
    draws = uvd + rng.multivariate_normal(np.zeros(3), S, 100_000)
    sample = np.cov(triangulate(draws, CAMERA).T)
    C = point_covariance(uvd[None], CAMERA, S)[0]
    np.testing.assert_allclose(np.diag(C), np.diag(sample), rtol=0.03)


def test_bias_of_far_points_grows_below_ten_sigmas() -> None:
    """1/d is not Gaussian: depth is over-estimated by the fraction (sigma_d / d)^2, 1 % at the cut-off of 10 sigmas."""
    rng = np.random.default_rng(4)
    sigma_d = 0.5
    for ratio in (5, 10, 20):
        d = sigma_d * (ratio + rng.standard_normal(400_000))
        uvd = np.column_stack([np.full_like(d, 320), np.full_like(d, 240), d])
        bias = triangulate(uvd, CAMERA)[:, 2].mean() / (380 * 0.12 / (sigma_d * ratio)) - 1
        assert bias == pytest.approx(1 / ratio**2, rel=0.35)
