import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.types import StereoCamera
from gpvo.vo.covariance import motion_covariance
from gpvo.vo.frontend import Matches
from gpvo.vo.motion import refine, residual_covariance, transfer, whitener
from gpvo.vo.points import PointNoise, triangulate, triangulation_pixel_covariance
from gpvo.vo.quality import disparities_px
from stereo_points import CAMERA, noisy, scene


def test_transfer_moves_points() -> None:
    T_prev_cur, uvd, moved = scene(np.random.default_rng(0), 40, (5, 50))
    P_cur = se3.transform(se3.inverse(T_prev_cur), triangulate(uvd, CAMERA))
    np.testing.assert_allclose(moved, CAMERA.project(P_cur), rtol=1e-10)


def test_transfer_holds_at_infinity() -> None:
    """Zero disparity is a direction: it turns with the camera, and translation does not move it."""
    T = se3.exp(np.array([1.0, 2, 3, 0.01, -0.02, 0.03]))
    only_rotation = se3.from_rt(T[:3, :3], np.zeros(3))
    uvd = np.array([[100.0, 200.0, 0.0]])
    np.testing.assert_allclose(transfer(T, uvd, CAMERA).uvd, transfer(only_rotation, uvd, CAMERA).uvd)


@pytest.mark.parametrize("camera", [CAMERA, StereoCamera(400.0, 430.0, 300.0, 250.0, 0.5, 640, 480)])
def test_derivatives_are_numerical_ones(camera: StereoCamera) -> None:
    T, uvd, _ = scene(np.random.default_rng(1), 10, (3, 60))
    moved = transfer(T, uvd, camera)
    for k in range(6):
        step = np.eye(6)[k] * 1e-6
        plus, minus = (transfer(T @ se3.exp(s * step), uvd, camera).uvd for s in (1, -1))
        np.testing.assert_allclose(moved.H[:, k], (plus - minus) / 2e-6, rtol=1e-6, atol=1e-6 * np.abs(moved.H).max())
    for k in range(3):
        step = np.eye(3)[k] * 1e-4
        plus, minus = (transfer(T, uvd + s * step, camera).uvd for s in (1, -1))
        np.testing.assert_allclose(moved.G[:, k], (plus - minus) / 2e-4, rtol=1e-6, atol=1e-6)


def test_whitener_inverts() -> None:
    T, uvd, _ = scene(np.random.default_rng(2), 20, (3, 60))
    S = triangulation_pixel_covariance(0.7)
    C = residual_covariance(transfer(T, uvd, CAMERA).G, S, S, 3.0).transpose(2, 0, 1)
    W = whitener(C.transpose(1, 2, 0)).transpose(2, 0, 1)
    np.testing.assert_allclose(W @ C @ W.transpose(0, 2, 1), np.broadcast_to(np.eye(3), C.shape), atol=1e-12)


def test_exact_measurements_give_the_exact_motion() -> None:
    T, before, after = scene(np.random.default_rng(3), 60, (2, 50))
    motion = refine(np.eye(4), before, after, CAMERA)
    assert motion is not None
    assert motion.converged
    np.testing.assert_allclose(motion.T_prev_cur, T, atol=1e-9)


def test_outliers_are_left_out() -> None:
    rng = np.random.default_rng(4)
    T, before, after = scene(rng, 100, (5, 50))
    before, after = noisy(rng, before, 0.2), noisy(rng, after, 0.2)
    after[:20, :2] += rng.uniform(5, 20, (20, 2))
    motion = refine(T, before, after, CAMERA)
    assert motion is not None
    assert not motion.inliers[:20].any()
    assert motion.inliers[20:].mean() > 0.95
    assert motion.scale_px == pytest.approx(0.2, rel=0.25)


def test_an_estimate_at_rest_has_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """80 motions of 20 points far ahead, close together, whose disparity is off by half a pixel in both frames alike.

    Each step then leaves most of what the one before had left. That is no doubt about the motion where it is a
    hundredth of its standard deviation; 200 steps end at the same place.
    """
    camera, noise = StereoCamera(720.0, 720.0, 610.0, 175.0, 0.54, 1242, 375), PointNoise(persistent=30.0)
    start, slow = se3.exp(np.array([0.0, 0, 1, 0, 0, 0])), 0
    for seed in range(80):
        rng = np.random.default_rng(seed)
        before = np.stack([rng.uniform(a, b, 20) for a, b in ((535, 685), (100, 250), (1 / 8, 1 / 3))], axis=1)
        before[:, 2] = 1 / before[:, 2]
        T = start @ se3.exp(rng.normal(0, (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)))
        pair = noisy(rng, before, 0.1), noisy(rng, transfer(T, before, camera).uvd.T, 0.1)
        motion = refine(start, *pair, camera, noise=noise, tolerance_px=4.0)
        with monkeypatch.context() as patch:
            patch.setattr("gpvo.vo.motion._PATIENCE", 200)
            last = refine(start, *pair, camera, noise=noise, tolerance_px=4.0, max_iterations=200)
        if motion is None or last is None:  # the noise may leave a motion undetermined
            continue
        off = se3.log(se3.inverse(motion.T_prev_cur) @ last.T_prev_cur)
        assert motion.converged
        assert off @ motion.information @ off < (0.05 * motion.scale_px) ** 2
        slow += np.abs(off).max() > 1e-6
    assert slow > 2  # by a rule of a micrometre these had not converged


def test_undetermined_motion_is_none() -> None:
    uvd = np.tile([[320.0, 240.0, 10.0]], (10, 1))
    assert refine(np.eye(4), uvd[:2], uvd[:2], CAMERA) is None


def test_persistent_errors_are_part_of_the_weights() -> None:
    """150 motions of 80 points whose disparity is off by 0.5 px in both frames alike, over white noise of 0.1 px.

    The information states the motion's error, and the mean error of the forward motion is smaller than without.
    """
    rng = np.random.default_rng(6)
    nees, forward_m = [], []
    for _ in range(150):
        T, before, after = scene(rng, 80, (8.0, 60.0))
        shared = np.array([0.0, 0.0, 1.0]) * rng.normal(0.0, 0.5, (80, 1))
        before, after = noisy(rng, before, 0.1) + shared, noisy(rng, after, 0.1) + shared
        errors = []
        for persistent in (25.0, 0.0):
            motion = refine(T, before, after, CAMERA, robust=False, noise=PointNoise(persistent=persistent))
            assert motion is not None
            errors.append(se3.log(se3.inverse(T) @ motion.T_prev_cur))
            if persistent:
                nees.append(errors[0] @ motion.information @ errors[0] / 0.1**2 / 6)
        forward_m.append([e[2] for e in errors])
    assert 0.85 < np.mean(nees) < 1.15
    rms = np.sqrt(np.mean(np.square(forward_m), axis=0))
    assert rms[0] < 0.95 * rms[1]


@pytest.mark.parametrize("count", [5, 6, 8])
def test_few_points_state_their_error(count: int) -> None:
    """400 motions; the stated error of the mean NEES is 0.03."""
    assert 0.9 < nees_per_dof(count, (20.0, 80.0), 0.3, 400) < 1.15


def nees_per_dof(count: int, disparity_px: tuple[float, float], sigma_px: float, trials: int) -> float:
    """Mean joint NEES/dof of independent trials with fresh scenes and noise."""
    rng = np.random.default_rng(5)
    total = 0.0
    for _ in range(trials):
        T, before, after = scene(rng, count, disparity_px)
        before, after = noisy(rng, before, sigma_px), noisy(rng, after, sigma_px)
        motion = refine(T, before, after, CAMERA)
        assert motion is not None
        C = motion_covariance(motion.T_prev_cur, motion.uvd_prev, CAMERA, triangulation_pixel_covariance(sigma_px)).full
        e = se3.log(se3.inverse(T) @ motion.T_prev_cur)
        total += e @ np.linalg.solve(C, e) / 6
    return total / trials


# Near: 20 to 80 px of disparity. Far: from the cut-off of 10 sigmas of disparity to 30, sigma_d = 0.5 sqrt(2) px. With
# all points between 10 and 14 sigmas their noise is as large as their spread in depth: NEES/dof is 1.04 to 1.08 there.
NEAR, FAR = (20.0, 80.0), (0.5 * np.sqrt(2) * 10, 0.5 * np.sqrt(2) * 30)


def test_nees_is_one() -> None:
    """300 trials: the standard error of NEES/dof is 0.033, the bound 3 of them."""
    assert nees_per_dof(100, NEAR, 0.5, 300) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("disparity_px", [NEAR, FAR], ids=["near", "far"])
@pytest.mark.parametrize("count", [30, 100, 300])
def test_nees_is_one_over_2000_trials(count: int, disparity_px: tuple[float, float]) -> None:
    """The standard error of NEES/dof is sqrt(2 / (6 * 2000)) = 0.013."""
    value = nees_per_dof(count, disparity_px, 0.5, 2000)
    print(f"NEES/dof {value:.3f}")
    assert 0.95 <= value <= 1.05


def test_percentiles_of_disparities_are_numpys():
    uvd = np.random.default_rng(2).uniform(1.0, 80.0, (50, 3))
    inliers = uvd[:, 0] > 20.0
    found = disparities_px(Matches(uvd, uvd, uvd[:, 0], len(uvd)), inliers, 10, 50, 90)
    np.testing.assert_allclose(found, np.percentile(uvd[inliers, 2], [10, 50, 90]), rtol=1e-14)
