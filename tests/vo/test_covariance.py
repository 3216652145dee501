import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.vo.config import VoConfig, pair_method
from gpvo.vo.covariance import covariances_by_method, motion_covariance, spherical_covariance
from gpvo.vo.points import (
    point_covariance,
    pointing_matching_pixel_covariance,
    triangulate,
    triangulation_pixel_covariance,
)
from stereo_points import CAMERA, noisy, scene

T, BEFORE, AFTER = scene(np.random.default_rng(0), 80, (4, 50))


@pytest.mark.parametrize(
    "S", [triangulation_pixel_covariance(1.0), pointing_matching_pixel_covariance(0.1, 0.5)], ids=["tri", "pm"]
)
def test_equals_the_sums_over_points_in_space(S: np.ndarray) -> None:
    """``(sum H^T W H)^-1`` and ``(sum W)^-1`` with ``W = (R U R^T + V)^-1``, written out point by point."""
    R = T[:3, :3]
    U, V = point_covariance(AFTER, CAMERA, S), point_covariance(BEFORE, CAMERA, S)
    information, sum_W = np.zeros((6, 6)), np.zeros((3, 3))
    for P, U_i, V_i in zip(triangulate(AFTER, CAMERA), U, V, strict=True):
        W = np.linalg.inv(R @ U_i @ R.T + V_i)
        H = R @ np.column_stack([np.eye(3), -se3.skew(P)])
        information += H.T @ W @ H
        sum_W += W
    found = motion_covariance(T, BEFORE, CAMERA, S)
    np.testing.assert_allclose(found.full, np.linalg.inv(information), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.v_t, np.linalg.inv(sum_W), rtol=1e-6, atol=1e-12)


def test_perturbation_is_on_the_right() -> None:
    """2,000 draws of both frames' noise: the sample covariance of ``Log(T^-1 T_est)`` matches within 10 %."""
    from gpvo.vo.motion import refine

    rng = np.random.default_rng(1)
    errors = []
    for _ in range(2000):
        motion = refine(T, noisy(rng, BEFORE, 0.3), noisy(rng, AFTER, 0.3), CAMERA, robust=False, max_iterations=4)
        assert motion is not None
        errors.append(se3.log(se3.inverse(T) @ motion.T_prev_cur))
    C = motion_covariance(T, BEFORE, CAMERA, triangulation_pixel_covariance(0.3)).full
    L = np.linalg.cholesky(np.linalg.inv(C))
    whitened = np.cov(np.array(errors) @ L, rowvar=False)
    np.testing.assert_allclose(whitened, np.eye(6), atol=0.1)


def test_known_rotation_understates_the_lateral_variance() -> None:
    found = motion_covariance(T, BEFORE, CAMERA, triangulation_pixel_covariance(1.0))
    marginal = T[:3, :3] @ found.full[:3, :3] @ T[:3, :3].T
    assert (np.diag(marginal)[:2] > 1.5 * np.diag(found.v_t)[:2]).all()


def test_exact_points_are_overconfident() -> None:
    S = triangulation_pixel_covariance(1.0)
    full = motion_covariance(T, BEFORE, CAMERA, S).full
    naive = motion_covariance(T, BEFORE, CAMERA, S, exact_points=True).full
    assert np.linalg.eigvalsh(full - naive)[0] > 0
    assert np.linalg.slogdet(full)[1] - np.linalg.slogdet(naive)[1] > 6 * np.log(1.5)


def test_a_sphere_wastes_what_the_image_says() -> None:
    S = triangulation_pixel_covariance(1.0)
    sphere = spherical_covariance(T, BEFORE, AFTER, CAMERA, S).full
    assert np.linalg.slogdet(sphere)[1] > np.linalg.slogdet(motion_covariance(T, BEFORE, CAMERA, S).full)[1]


def test_covariance_scales_with_noise_and_count() -> None:
    one = motion_covariance(T, BEFORE, CAMERA, triangulation_pixel_covariance(1.0)).full
    np.testing.assert_allclose(
        motion_covariance(T, BEFORE, CAMERA, triangulation_pixel_covariance(3.0)).full, 9 * one, rtol=1e-9
    )
    twice = motion_covariance(T, np.tile(BEFORE, (2, 1)), CAMERA, triangulation_pixel_covariance(1.0)).full
    np.testing.assert_allclose(twice, one / 2, rtol=1e-9)


def test_every_method_is_symmetric_positive_definite() -> None:
    methods = ("triangulation", "pointing_matching", "spherical")
    found = covariances_by_method(VoConfig(methods=methods), (0.1, 0.5), T, BEFORE, AFTER, CAMERA)
    assert tuple(found) == methods
    for c in found.values():
        np.testing.assert_array_equal(c.full, c.full.T)
        assert np.linalg.eigvalsh(c.full)[0] > 0
        assert np.linalg.eigvalsh(c.v_t)[0] > 0


def test_points_in_one_place_do_not_determine_the_motion() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        motion_covariance(T, BEFORE[:1], CAMERA, triangulation_pixel_covariance(1.0))


def test_further_pairs_of_sigmas_are_stated_beside_the_methods() -> None:
    pairs = ((0.1, 0.5), (0.1, 1.0))
    config = VoConfig(methods=("pointing_matching",), sigma_pairs_px=pairs)
    found = covariances_by_method(config, (0.1, 0.5), T, BEFORE, AFTER, CAMERA)
    same, wider = (found[pair_method(*p)].full for p in pairs)
    np.testing.assert_array_equal(same, found["pointing_matching"].full)
    assert np.trace(wider) > 1.5 * np.trace(same)
