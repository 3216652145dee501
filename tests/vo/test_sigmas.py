"""Noise from residuals: what persists is found, and few points do not state a noise of zero."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.types import Array
from gpvo.vo.covariance import DesignEffect, NoiseEstimator, SigmaEstimator, motion_covariance
from gpvo.vo.motion import refine, transfer, whitened
from gpvo.vo.points import PointNoise, ResidualMoments, pointing_matching_pixel_covariance
from stereo_points import CAMERA, noisy, scene


@pytest.mark.parametrize("persistent_px", [0.0, 0.3, 0.6])
def test_persistent_noise_is_found(persistent_px: float) -> None:
    """Forty motions of 100 points with white noise of 0.15 px, and three outliers in each."""
    rng = np.random.default_rng(0)
    noise = NoiseEstimator()
    for _ in range(40):
        T, before, after = scene(rng, 100, (8.0, 60.0))
        shared = np.array([0.0, 0.0, 1.0]) * rng.normal(0.0, persistent_px, (100, 1))
        before, after = noisy(rng, before, 0.15) + shared, noisy(rng, after, 0.15) + shared
        after[:3] += rng.uniform(-3, 3, (3, 3))
        motion = refine(T, before, after, CAMERA, noise=noise.value)
        assert motion is not None
        noise.update(motion, whitened(motion, CAMERA))
    assert 0.15 * np.sqrt(noise.value.persistent) == pytest.approx(persistent_px, rel=0.25, abs=0.03)


@pytest.mark.parametrize("shared", [1.0, 0.6])
def test_what_left_column_and_disparity_share_is_found(shared: float) -> None:
    """Forty motions of 100 points, with three outliers in each; nothing persists, and nothing is found to."""
    rng = np.random.default_rng(1)
    noise = NoiseEstimator()
    L = 0.2 * np.linalg.cholesky(PointNoise(shared).S)
    for _ in range(40):
        T, before, after = scene(rng, 100, (8.0, 60.0))
        before, after = (uvd + rng.standard_normal((100, 3)) @ L.T for uvd in (before, after))
        after[:3] += rng.uniform(-3, 3, (3, 3))
        motion = refine(T, before, after, CAMERA, noise=noise.value)
        assert motion is not None
        noise.update(motion, whitened(motion, CAMERA))
    assert noise.value.shared == pytest.approx(shared, abs=0.08)
    assert noise.value.persistent < 0.5


@pytest.mark.parametrize("count", [4, 6, 20])
def test_sigmas_of_few_points(count: int) -> None:
    """Pointing of 0.3 and matching of 0.45 px, ten runs of ten motions: the median NEES/dof, 0.89 for a Gaussian.

    The motion is weighted for noise of another form, which costs a factor of up to 1.5.
    """
    rng = np.random.default_rng(count)
    scores = []
    for _ in range(10):
        sigmas = SigmaEstimator(None, None)
        for _ in range(10):
            T, before, after = scene(rng, count, (8.0, 60.0))
            before, after = (uvd + rng.normal(0, [0.3, 0.3, 0.45], uvd.shape) for uvd in (before, after))
            motion = refine(T, before, after, CAMERA)
            if motion is None or len(motion.residuals) < 4:
                continue
            sigmas.update(ResidualMoments.of(motion.residuals, transfer(motion.T_prev_cur, motion.uvd_prev, CAMERA).G))
            S = pointing_matching_pixel_covariance(*sigmas.values)
            C = motion_covariance(motion.T_prev_cur, motion.uvd_prev, CAMERA, S).full
            e = se3.log(se3.inverse(T) @ motion.T_prev_cur)
            scores.append(e @ np.linalg.solve(C, e) / 6)
    assert 0.4 < np.median(scores) < 2.5
    assert np.mean(scores) < 10


@pytest.mark.parametrize(
    ("baselines", "disparity_px", "least"),
    [
        ((0.5, 0, 0), (4.0, 30.0), 0.7),
        ((4.0, 0, 0), (4.0, 30.0), 0.7),
        ((10.0, 0, 0), (4.0, 30.0), 0.7),
        ((0, 0, 17.0), (2.5, 18.0), 0.6),  # 0.77 over eight draws: what little shows pointing is noisy
    ],
)
def test_a_long_step_does_not_hide_pointing(
    baselines: tuple[float, float, float], disparity_px: tuple[float, float], least: float
) -> None:
    """By so many baselines, 0.05 px of each camera: NEES/dof stays near one (it was 23 at four sideways, 140 at ten,
    and 4 at 17 ahead).

    Noise of disparity moves points by as many times as much, and what it shares with the column is in neither sigma.
    """
    rng = np.random.default_rng(3)
    sigmas, scores = SigmaEstimator(None, None), []
    for k in range(80):
        _, before, _ = scene(rng, 150, disparity_px)
        T = se3.exp(np.r_[np.multiply(baselines, CAMERA.baseline_m) + 0.01, rng.normal(0.0, 0.01, 3)])
        after = transfer(T, before, CAMERA).uvd.T
        motion = refine(T, noisy(rng, before, 0.05), noisy(rng, after, 0.05), CAMERA)
        assert motion is not None
        sigmas.update(ResidualMoments.of(motion.residuals, whitened(motion, CAMERA).moved.G))
        if k >= 20:
            S = pointing_matching_pixel_covariance(*sigmas.values)
            e = se3.log(se3.inverse(T) @ motion.T_prev_cur)
            scores.append(e @ np.linalg.solve(motion_covariance(motion.T_prev_cur, motion.uvd_prev, CAMERA, S).full, e))
    assert least < np.mean(scores) / 6 < 1.5


def _flight(
    seed: int, shared_px: float, kept: float, count: int, reference: Callable[[int], int]
) -> tuple[Array, Array, float]:
    """Errors (count, 6) of motions whose points err by 0.15 px each and alike in each eighth of the image by
    ``shared_px``, of which a share ``kept`` is left in the next motion; the covariance (6, 6) stated for each; and the
    design effect at last."""
    rng = np.random.default_rng(seed)
    design, sigmas, shared, out = DesignEffect(), SigmaEstimator(None, None), np.zeros((8, 3)), []
    for k in range(count):
        T, before, after = scene(rng, 150, (8.0, 60.0))
        part = (before[:, 0] // 160 + 4 * (before[:, 1] // 240)).astype(int)
        before, after = noisy(rng, before, 0.15), noisy(rng, after, 0.15)
        shared = kept * shared + (1.0 - kept**2) ** 0.5 * shared_px * rng.standard_normal((8, 3))
        motion = refine(T, before, after + shared[part], CAMERA)
        assert motion is not None
        white = whitened(motion, CAMERA)
        design.update(motion, white, CAMERA, reference(k))
        sigmas.update(ResidualMoments.of(motion.residuals, white.moved.G))
        S = pointing_matching_pixel_covariance(*np.multiply(sigmas.values, design.ratio**0.5))
        C = motion_covariance(motion.T_prev_cur, motion.uvd_prev, CAMERA, S).full
        out.append((se3.log(se3.inverse(T) @ motion.T_prev_cur), C))
    errors, C = zip(*out, strict=True)
    return np.array(errors), np.array(C), design.ratio


@pytest.mark.parametrize(("shared_px", "least", "most"), [(0.0, 0.85, 1.15), (0.15, 2.5, 8.0)])
def test_points_that_err_alike_count_as_fewer(shared_px: float, least: float, most: float) -> None:
    """Noise of 0.15 px by point, and noise common to each eighth of the image; NEES/dof stays near one by it."""
    errors, C, ratio = _flight(0, shared_px, 0.0, 120, lambda k: k)
    scores = [e @ np.linalg.solve(stated, e) for e, stated in zip(errors[20:], C[20:], strict=True)]
    assert least < ratio < most
    assert 0.7 < np.mean(scores) / 6 < 1.5


def test_points_that_go_on_to_err_alike_count_as_fewer_still() -> None:
    """Over ten motions, twenty times in each of four flights; by single motions alone, NEES/dof would be 3.6."""
    nees = []
    for seed in range(4):
        errors, C, _ = _flight(seed, 0.15, 0.8, 220, lambda k: k)
        sums, stated = errors[20:].reshape(20, 10, 6).sum(1), C[20:].reshape(20, 10, 6, 6).sum(1)
        nees.append(np.einsum("bi,bi->b", sums, np.linalg.solve(stated, sums[..., None])[..., 0]).mean() / 6)
    assert 0.7 < np.mean(nees) < 1.4


def test_motions_since_one_frame_do_not_add_up() -> None:
    """They share its noise, as a camera at rest sees: that is one error, counted once."""
    _, moving, _ = _flight(0, 0.15, 0.9, 60, lambda k: k)
    _, resting, _ = _flight(0, 0.15, 0.9, 60, lambda k: 0)
    assert np.trace(moving[-1]) > 2.0 * np.trace(resting[-1])
