"""The fixed transform between a log and its truth, found again from their motions."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.dataset.hand_eye import fit_fixed_transform, windowed_motions
from gpvo.dataset.misread import fixed_rotation, inverse_poses, late_by
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.types import Status, TruthLog, VoLog, VoRecord

X = se3.exp(np.array([0.06, -0.03, 0.1, 1.2, -0.8, 0.4]))


def _motions(n: int, noise: float, seed: int = 0, planar: bool = False) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(n, 6)) * [0.3, 0.3, 1.0, 0.2, 0.4, 0.1]
    if planar:
        xi *= [0, 0, 1, 0, 1, 0]
        xi[:, 2] += 5.0
    B = se3.exp(xi)
    A = X @ B @ se3.inverse(X) @ se3.exp(noise * rng.normal(size=(n, 6)) * [1, 1, 1, 0.3, 0.3, 0.3])
    return A, B


def test_exact_motions_give_the_exact_transform():
    fit = fit_fixed_transform(*_motions(60, 0.0))
    # The prior on the lever arm is all that holds it back.
    np.testing.assert_allclose(fit.T_log_truth, X, atol=1e-6)
    assert fit.lever_m == pytest.approx(np.linalg.norm(X[:3, 3]), abs=1e-6)


def test_noise_and_slips():
    A, B = _motions(300, 0.01)
    A[::15] = A[::15] @ se3.exp(np.array([3.0, -2.0, 5.0, 0.5, 0.2, -0.3]))
    fit = fit_fixed_transform(A, B)
    error = se3.log(se3.inverse(X) @ fit.T_log_truth)
    assert np.linalg.norm(error[3:]) < 2e-3
    assert np.linalg.norm(error[:3]) < 2e-2
    assert fit.residual_m < 0.03


def test_planar_motion_leaves_the_height_near_zero():
    fit = fit_fixed_transform(*_motions(200, 0.002, planar=True))
    error = se3.log(se3.inverse(X) @ fit.T_log_truth)
    assert np.linalg.norm(error[3:]) < 2e-3
    # Turning about one axis says nothing on the offset along it: it must not run away.
    assert fit.lever_m < 0.5


def test_exactly_planar_motions_and_noise():
    """As of wheel odometry and a SLAM in the plane: both have exact zeros on three axes."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(200, 6)) * [5e-3, 5e-3, 0, 0, 0, 2e-3]
    B = se3.exp(rng.normal(size=(200, 6)) * [0.3, 0, 0, 0, 0, 0.4] + [0.8, 0, 0, 0, 0, 0])
    planar = se3.exp(np.array([0.4, -0.2, 0, 0, 0, 0.3]))
    fit = fit_fixed_transform(planar @ B @ se3.inverse(planar) @ se3.exp(noise), B)
    np.testing.assert_allclose(fit.T_log_truth, planar, atol=5e-3)


def test_rotation_alone():
    A, B = _motions(200, 0.001)
    A = se3.inverse(X) @ A @ X
    R = se3.exp(np.array([0, 0, 0, 0.5, -1.0, 2.0]))
    fit = fit_fixed_transform(R @ A @ se3.inverse(R), B, lever_arm=False)
    np.testing.assert_allclose(fit.T_log_truth[:3, :3], R[:3, :3], atol=2e-3)
    assert fit.lever_m == 0.0


def test_derivative_equals_the_numerical_one():
    from gpvo.dataset.hand_eye import residuals

    A, B = _motions(20, 0.0)
    _, J = residuals(A, B, X)
    h = 1e-6
    for i in range(6):
        d = np.eye(6)[i] * h
        numeric = (residuals(A, B, X @ se3.exp(d))[0] - residuals(A, B, X @ se3.exp(-d))[0]) / (2 * h)
        np.testing.assert_allclose(J[:, :, i], numeric, atol=1e-6)


def test_windows_skip_lost_frames_and_gaps():
    n = 100
    t = np.arange(n) * 50_000_000
    poses = se3.exp(np.outer(np.arange(n), [0.0, 0, 0.1, 0, 0.01, 0]))
    motions = np.concatenate([np.eye(4)[None], se3.inverse(poses[:-1]) @ poses[1:]])
    status = [Status.START, *[Status.OK] * (n - 1)]
    status[50] = Status.LOST
    records = [VoRecord(int(t[k]), int(t[max(k - 1, 0)]), status[k], motions[k]) for k in range(n)]
    A, B, attitudes = windowed_motions(VoLog(records), TruthLog(t, poses))
    assert len(A) == 6
    np.testing.assert_allclose(A, B, atol=1e-9)
    assert attitudes.shape == (6, 3, 3)
    late = TruthLog(t[40:], poses[40:])
    assert len(windowed_motions(VoLog(records), late)[0]) == 3


def test_what_cannot_be_aligned():
    A, B = _motions(5, 0.0)
    with pytest.raises(GpvoError, match="too few to align: 5 windows"):
        fit_fixed_transform(A, B)
    still = np.tile(np.eye(4), (30, 1, 1))
    with pytest.raises(GpvoError, match="do not show"):
        fit_fixed_transform(still, still)
    straight = se3.exp(np.tile([0, 0, 1.0, 0, 0, 0], (30, 1)))
    with pytest.raises(GpvoError, match="turns as well"):
        fit_fixed_transform(straight, straight)


def _flight(rng: np.random.Generator, n: int = 600) -> np.ndarray:
    """Poses (n, 4, 4) of a flight that goes and turns all ways, ten a second."""
    phase = np.linspace(0, 60, n)[:, None] * rng.uniform(0.3, 0.8, 6) + rng.uniform(0, 6, 6)
    poses = se3.exp(np.concatenate([np.zeros((n, 3)), np.sin(phase[:, 3:]) * [0.2, 0.2, 2.5]], axis=1))
    poses[:, :3, 3] = 2.0 * np.sin(phase[:, :3])
    return poses


def test_attitudes_in_another_world_than_the_positions():
    rng = np.random.default_rng(5)
    poses, t = _flight(rng), np.arange(600) * 100_000_000
    motions = np.concatenate([np.eye(4)[None], se3.inverse(poses[:-1]) @ poses[1:]])
    motions[1:] = motions[1:] @ se3.exp(1e-4 * rng.normal(size=(599, 6)))
    records = [VoRecord(int(t[k]), int(t[max(k - 1, 0)]), Status.OK, motions[k]) for k in range(600)]
    worlds = se3.so3_exp(np.deg2rad([0.2, -0.3, 5.0]))
    told = poses @ X
    told[:, :3, :3] = worlds.T @ told[:, :3, :3]
    found = windowed_motions(VoLog(records), TruthLog(t, told))
    fit = fit_fixed_transform(*found)
    assert fit.worlds_deg == pytest.approx(5.01, abs=0.2)
    np.testing.assert_allclose(fit.R_position_attitude, worlds, atol=3e-3)
    np.testing.assert_allclose(fit.in_log_frame(told), poses, atol=2e-2)
    rigid = fit_fixed_transform(*found[:2])
    assert fit.residual_m < 0.2 * rigid.residual_m
    np.testing.assert_array_equal(rigid.R_position_attitude, np.eye(3))


def test_a_truth_of_one_world_is_left_in_one():
    rng = np.random.default_rng(6)
    poses, t = _flight(rng), np.arange(600) * 100_000_000
    motions = np.concatenate([np.eye(4)[None], se3.inverse(poses[:-1]) @ poses[1:]])
    motions[1:] = motions[1:] @ se3.exp(1e-4 * rng.normal(size=(599, 6)))
    records = [VoRecord(int(t[k]), int(t[max(k - 1, 0)]), Status.OK, motions[k]) for k in range(600)]
    fit = fit_fixed_transform(*windowed_motions(VoLog(records), TruthLog(t, poses @ X)))
    assert fit.worlds_deg < 0.1


def _driven(steps: np.ndarray) -> tuple[VoLog, np.ndarray]:
    """A log of motions (n, 6), and its poses from the identity."""
    T = [np.eye(4)]
    records = [VoRecord(0, 0, Status.START, np.eye(4))]
    for k, motion in enumerate(se3.exp(steps), 1):
        T.append(T[-1] @ motion)
        records.append(VoRecord(k * 50_000_000, (k - 1) * 50_000_000, Status.OK, motion))
    return VoLog(records), np.array(T)


def _truth(T: np.ndarray) -> TruthLog:
    return TruthLog(np.arange(len(T)) * 50_000_000, T)


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_a_robot_that_mostly_rests_is_accused_of_nothing(share: float):
    """The median error is rounding, which every other reading of the poses can halve."""
    steps = np.where((np.arange(1200) % 250 < 250 * share)[:, None], [0, 0, 0.05, 0, 0.01, 0], 0.0)
    log, _ = _driven(steps * [1, 1, 1.02, 1, 1, 1])
    truth = _truth(se3.exp(np.array([5.0, -3, 2, 0, 0.7, 0])) @ _driven(steps)[1])
    assert inverse_poses(log, truth) is None
    assert late_by(log, truth) is None
    assert fixed_rotation(log, truth) is None


@pytest.mark.parametrize("turning", [0.0, 0.02])
def test_inverse_poses_and_a_camera_that_looks_backwards(turning: float):
    """Where the path turns, the two differ; straight ahead they do not, and both are said."""
    rng = np.random.default_rng(1)
    steps = np.zeros((1200, 6))
    steps[:, 2], steps[:, 4] = 0.05, turning * np.sin(np.arange(1200) / 60)
    log, T = _driven(steps + rng.standard_normal((1200, 6)) * ([2e-3] * 3 + [5e-4] * 3))
    _, exact = _driven(steps)
    backwards = exact @ se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    inverse_log, _ = _driven(se3.log(T[:-1] @ se3.inverse(T[1:])))
    found, turned = inverse_poses(inverse_log, _truth(exact)), inverse_poses(log, _truth(backwards))
    assert found is not None
    assert found.of == "odometry"
    assert found.or_backwards == (turning == 0.0)
    if turning:
        assert turned is None
        assert fixed_rotation(log, _truth(backwards)) is not None
    else:
        assert turned is not None
        assert turned.or_backwards
