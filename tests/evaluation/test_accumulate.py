"""Accumulated covariance against drawn trajectories with jitter, white noise and bias."""

from __future__ import annotations

import numpy as np
import pytest
from evaluation_runs import curved_path, stated_covariance
from gpvo.evaluation.accumulate import PoseError, Step, along
from gpvo.geometry import covariance, se3

N, DRAWS, DT_S, TAU_S = 60, 3000, 0.05, 0.8
C = stated_covariance()
PATH = curved_path(N, step_m=0.1)
CHAIN = np.arange(N) - 1


def _steps(jitter: float, white: float, bias: float, growth: float = 0.0, path: np.ndarray = PATH) -> list[Step]:
    """Shares of the covariance, which grows linearly along the path by ``growth`` in all."""
    tau = np.full(6, TAU_S)
    sizes = 1 + growth * np.arange(N) / N
    return [Step(T, s * jitter * C, s * white * C, s * bias * C, tau, DT_S) for T, s in zip(path, sizes, strict=True)]


def _drawn(steps: list[Step], seed: int = 0) -> np.ndarray:
    """(DRAWS, 6) errors of the last pose. The first step is the origin and has no motion."""
    rng = np.random.default_rng(seed)

    def draw(S: np.ndarray) -> np.ndarray:
        values, vectors = np.linalg.eigh(S)
        root = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
        return rng.standard_normal((DRAWS, 6)) @ root

    phi = np.exp(-DT_S / TAU_S)
    unit = rng.standard_normal((DRAWS, 6))
    # A frame's jitter is as if its own pose were off, so it is carried over the motion that it begins.
    last = draw(0.5 * steps[1].jitter) @ se3.adjoint(steps[1].T_prev_cur).T
    T_true, T_est = np.eye(4), np.broadcast_to(np.eye(4), (DRAWS, 4, 4))
    for step in steps[1:]:
        unit = phi * unit + np.sqrt(1 - phi**2) * rng.standard_normal((DRAWS, 6))
        values, vectors = np.linalg.eigh(step.bias)
        bias = unit @ ((vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T)
        now = draw(0.5 * step.jitter)
        T_true = T_true @ step.T_prev_cur
        T_est = T_est @ se3.exp(-last) @ step.T_prev_cur @ se3.exp(draw(step.white) + bias + now)
        last = now
    return se3.log(se3.inverse(T_true) @ T_est)


@pytest.mark.parametrize(
    "parts",
    [(0, 1, 0), (1, 0, 0), (0, 0, 1), (0.5, 0.3, 0.2), (0.3, 0.1, 0.6, 3.0)],
    ids=str,
)
def test_final_covariance_is_that_of_drawn_trajectories(parts):
    """3,000 draws: a variance scatters by 2.6 %; within 10 % on every axis, correlations within 0.1."""
    steps = _steps(*parts)
    predicted, errors = along(steps, CHAIN)[-1], _drawn(steps)
    sample = np.cov(errors.T)
    np.testing.assert_allclose(np.diagonal(predicted) / np.diagonal(sample), 1.0, atol=0.1)
    sigma = np.sqrt(np.diagonal(predicted))
    np.testing.assert_allclose(sample / np.outer(sigma, sigma), predicted / np.outer(sigma, sigma), atol=0.1)


@pytest.mark.parametrize("parts", [(1, 0, 0), (0.5, 0.3, 0.2)], ids=str)
def test_long_steps_turn_jitter_into_position_only_as_far_as_it_does(parts):
    """Two metres a frame: the lever makes a frame's jitter of rotation as large as that of translation."""
    steps = _steps(*parts, path=curved_path(N, step_m=2.0))
    predicted, sample = along(steps, CHAIN)[-1], np.cov(_drawn(steps).T)
    np.testing.assert_allclose(np.diagonal(predicted) / np.diagonal(sample), 1.0, atol=0.1)


def test_independent_motions_are_plain_compounding():
    covariances = np.array([(1 + k) * C for k in range(N)])
    covariances[0] = 0
    steps = [Step.independent(T, S) for T, S in zip(PATH, covariances, strict=True)]
    np.testing.assert_allclose(along(steps, CHAIN), covariance.accumulate(PATH, covariances), atol=1e-18)


def test_jitter_alone_stays_bounded_on_a_straight_path():
    T = np.broadcast_to(np.eye(4), (200, 4, 4))
    steps = [Step(t, C, 0 * C, 0 * C, np.ones(6), DT_S) for t in T]
    P = along(steps, np.arange(200) - 1)
    # Jitter of the first and the last frame, half of it each, however far.
    np.testing.assert_allclose(P[1:], np.broadcast_to(C, (199, 6, 6)), rtol=1e-9, atol=1e-18)


def test_white_noise_grows_with_frames_and_lasting_bias_with_their_square():
    steps = [Step(np.eye(4), 0 * C, C, 0 * C, np.ones(6), DT_S)] * 101
    np.testing.assert_allclose(along(steps, np.arange(101) - 1)[-1], 100 * C, rtol=1e-9)
    steps = [Step(np.eye(4), 0 * C, 0 * C, C, np.full(6, 1e9), DT_S)] * 101
    np.testing.assert_allclose(along(steps, np.arange(101) - 1)[-1], 1e4 * C, rtol=1e-6, atol=1e-15)


def test_covariance_of_one_motion_is_the_sum_of_its_parts():
    P = PoseError().add(_steps(0.5, 0.3, 0.2)[1])
    np.testing.assert_allclose(P, C, atol=1e-18)


@pytest.mark.parametrize("parts", [(0, 1, 0), (0.5, 0.3, 0.2)])
def test_a_frame_that_is_skipped_leaves_no_trace(parts):
    """Frame 3 is lost and frame 4 starts from frame 2: as if frame 3 had never been."""
    steps = _steps(*parts)[:8]
    parent = np.array([-1, 0, 1, 2, 2, 4, 5, 6])
    kept = [0, 1, 2, 4, 5, 6, 7]
    branched, straight = along(steps, parent), along([steps[k] for k in kept], np.arange(7) - 1)
    np.testing.assert_allclose(branched[kept], straight, atol=1e-18)


def test_a_copy_branches():
    steps = _steps(0.5, 0.3, 0.2)
    error = PoseError()
    error.add(steps[1])
    twin = error.copy()
    twin.add(steps[2])
    np.testing.assert_allclose(error.covariance, C, atol=1e-18)


@pytest.mark.parametrize("frames", [1, 2, 7, 8])
def test_what_calibration_adds_on_the_way_out_it_takes_back_on_the_way_home(frames):
    """There and back, always turned by the same: of a lasting error nothing is left after an even number of motions."""
    rng = np.random.default_rng(0)
    L, white, zero = rng.standard_normal((6, 6)), 0.1 * np.eye(6), np.zeros((6, 6))
    pose = PoseError()
    for k in range(frames):
        root = L if k % 2 == 0 else -L
        pose.add(Step(np.eye(4), zero, white, L @ L.T, np.ones(6), 0.05, root, np.full(6, np.inf)))
    np.testing.assert_allclose(pose.covariance, frames * white + frames % 2 * L @ L.T, atol=1e-9)
