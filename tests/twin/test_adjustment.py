"""Bundle adjustment against SciPy's least squares, and against what simulated tracks say."""

from dataclasses import replace

import numpy as np
import pytest
from gpvo.geometry import se3
from gpvo.twin.bundle import REACH, WHITEN, Estimate, NormalEquations, Observations, Pieces, damped
from gpvo.twin.noise import adjust, without_loose_frames
from gpvo.types import StereoCamera
from scipy.linalg import block_diag
from scipy.optimize import least_squares

CAMERA = StereoCamera(380.0, 385.0, 319.5, 239.5, 0.12, 640, 480)


def small_problem(rng, n_frames=5, n_tracks=25, sigma_px=0.2):
    """A curved path past landmarks at 2 to 30 m, some of them not seen by every frame."""
    T = np.stack([se3.exp([0.02 * k, 0.01 * k, 0.1 * k, 0.0, 0.02 * k, 0.01]) for k in range(n_frames)])
    T = se3.inverse(T[0]) @ T
    depth = rng.uniform(2.0, 30.0, n_tracks)
    points = np.stack([rng.uniform(-0.6, 0.6, n_tracks) * depth, rng.uniform(-0.4, 0.4, n_tracks) * depth, depth], 1)
    frame, track = (i.ravel() for i in np.meshgrid(np.arange(n_frames), np.arange(n_tracks), indexing="ij"))
    kept = (rng.random(len(frame)) < 0.8) | (frame < 2)
    frame, track = frame[kept], track[kept]
    P = np.stack([se3.transform(se3.inverse(T[k]), points[i]) for k, i in zip(frame, track)])
    noise = sigma_px * rng.standard_normal((len(P), 4))
    noise = np.stack([noise[:, 0], (noise[:, 1] + noise[:, 3]) / 2, noise[:, 0] - noise[:, 2]], 1)
    seen = Observations(CAMERA, frame, track, CAMERA.project(P) + noise, np.ones(len(P), bool))
    return T, points, seen


def test_plain_fit_is_that_of_scipy():
    rng = np.random.default_rng(1)
    T, points, seen = small_problem(rng)
    start = T @ se3.exp(0.01 * rng.standard_normal((len(T), 6)))
    start[0] = T[0]
    found = adjust(seen, start, robust=False, tolerance=1e-13, max_iterations=60)
    assert found.converged

    def residuals(x):
        poses = np.concatenate([T[:1], T[1:] @ se3.exp(x[: 6 * (len(T) - 1)].reshape(-1, 6))])
        X = points + x[6 * (len(T) - 1) :].reshape(-1, 3)
        P = np.stack([se3.transform(se3.inverse(poses[k]), X[i]) for k, i in zip(seen.frame, seen.track)])
        return ((seen.uvd - CAMERA.project(P)) @ WHITEN.T).ravel()

    oracle = least_squares(residuals, np.zeros(6 * (len(T) - 1) + 3 * len(points)), xtol=1e-14, ftol=1e-14)
    poses = T[1:] @ se3.exp(oracle.x[: 6 * (len(T) - 1)].reshape(-1, 6))
    assert np.abs(se3.log(se3.inverse(poses) @ found.T_world_cam[1:])).max() < 1e-6
    assert (found.residual_px @ WHITEN.T).ravel() == pytest.approx(oracle.fun, abs=1e-4)


@pytest.mark.parametrize("scale", [0.01, 30.0])
def test_the_fit_has_no_scale_of_its_own(scale):
    """A rig with a baseline of 1.2 mm among landmarks at 2 to 30 cm, as in an endoscope; and one of 3.6 m."""
    T, _, seen = small_problem(np.random.default_rng(3))
    camera = replace(CAMERA, baseline_m=scale * CAMERA.baseline_m)
    scaled = T.copy()
    scaled[:, :3, 3] *= scale
    found, other = adjust(seen, T), adjust(replace(seen, camera=camera), scaled)
    assert np.allclose(other.T_world_cam[:, :3, 3], scale * found.T_world_cam[:, :3, 3], atol=1e-5 * scale)
    assert np.allclose(other.residual_px, found.residual_px, atol=1e-3)


def test_outliers_are_left_out_and_frames_have_their_own_noise():
    rng = np.random.default_rng(2)
    T, _, seen = small_problem(rng, n_frames=12, n_tracks=80, sigma_px=0.1)
    uvd = seen.uvd.copy()
    wrong = rng.random(len(uvd)) < 0.05
    uvd[wrong, :2] += rng.uniform(5, 20, (wrong.sum(), 2))
    noisy = seen.frame == 6  # its own noise hides what would be an outlier elsewhere
    uvd[noisy] += 0.8 * rng.standard_normal((noisy.sum(), 3))
    found = adjust(Observations(CAMERA, seen.frame, seen.track, uvd, seen.trusted), T)
    assert (found.weight[wrong & ~noisy] == 0).mean() > 0.95
    assert (found.weight[~wrong] > 0).mean() > 0.95
    others = np.delete(found.sigma_px, 6)
    assert found.sigma_px[6] > 3 * others.max()
    assert np.abs(se3.log(se3.inverse(T) @ found.T_world_cam)).max() < 0.02


@pytest.mark.parametrize("step", ([0.0] * 6, [0.0, 0.0, 0.0, 0.0, 0.03, 0.0]), ids=["standing", "turning"])
def test_standing_still_and_pure_rotation_hold(step):
    rng = np.random.default_rng(3)
    T = np.stack([se3.exp(np.array(step) * k) for k in range(6)])
    depth = rng.uniform(2, 50, 60)
    points = np.stack([rng.uniform(-0.3, 0.3, 60) * depth, rng.uniform(-0.3, 0.3, 60) * depth, depth], 1)
    frame, track = (i.ravel() for i in np.meshgrid(np.arange(6), np.arange(60), indexing="ij"))
    P = np.stack([se3.transform(se3.inverse(T[k]), points[i]) for k, i in zip(frame, track)])
    uvd = CAMERA.project(P) + 0.1 * rng.standard_normal((len(P), 3))
    found = adjust(Observations(CAMERA, frame, track, uvd, np.ones(len(P), bool)), np.tile(np.eye(4), (6, 1, 1)))
    assert np.abs(se3.log(se3.inverse(T) @ found.T_world_cam)[:, 3:]).max() < 2e-3
    assert np.median(found.sigma_px) == pytest.approx(0.1, abs=0.05)


def test_a_frame_without_points_lies_between_its_neighbours():
    rng = np.random.default_rng(4)
    T, _, seen = small_problem(rng, n_frames=7, n_tracks=60)
    trusted = seen.frame != 3
    start = T.copy()
    start[3, :3, 3] += 5.0
    part = Observations(CAMERA, seen.frame, seen.track, seen.uvd, trusted)
    found = without_loose_frames(adjust(part, start), part, np.arange(7) * 50_000_000)
    assert np.linalg.norm(found.T_world_cam[3, :3, 3] - T[3, :3, 3]) < 0.03


@pytest.mark.parametrize(("n_frames", "error"), [(15, 1e-9), (50, 1e-2)], ids=["short tracks", "tracks that are cut"])
def test_steps_are_those_of_the_dense_equations(n_frames, error):
    rng = np.random.default_rng(6)
    T, _, seen = small_problem(rng, n_frames=n_frames, n_tracks=40)
    pieces = Pieces.of(seen)
    start = T @ se3.exp(0.01 * rng.standard_normal((n_frames, 6)))
    now = Estimate.begin(seen, start)
    normal = NormalEquations.of(seen, pieces, now, np.ones(len(seen.frame)))
    assert (len(pieces.track) > 40) == (n_frames > REACH)
    C = np.zeros((40, 3, 3))
    np.add.at(C, pieces.track, normal.C)
    E = normal.E.toarray()
    dense = np.block([[block_diag(*damped(normal.B, 1e-4)), E], [E.T, block_diag(*damped(C, 1e-4))]])
    expected = np.linalg.solve(dense, np.concatenate([normal.pose_gradient.ravel(), normal.point_gradient.ravel()]))
    found = np.concatenate([step.ravel() for step in normal.solve(1e-4)])
    off = found - expected
    assert np.sqrt((off @ dense @ off) / (expected @ dense @ expected)) < error
