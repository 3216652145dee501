"""Several frames adjusted together: SciPy, exact points, two frames alone, and what the covariance states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpvo.errors import GpvoError
from gpvo.geometry import se3
from gpvo.io.source import open_source
from gpvo.sim.points import simulate_points
from gpvo.types import Array, Status, TrackFrame, VoRecord
from gpvo.vo.config import make_config
from gpvo.vo.motion import refine, transfer
from gpvo.vo.odometry import StereoOdometry
from gpvo.vo.points import PointNoise, triangulation_pixel_covariance
from gpvo.vo.window import Views, adjust
from scipy.optimize import least_squares
from stereo_points import CAMERA, noisy, scene


def views(rng: np.random.Generator, n_views: int = 4, count: int = 60, sigma_px: float = 0.3) -> tuple[Views, Array]:
    """What the frames of a curve saw, every second frame with gaps, from a start that is off; and the true poses."""
    T, uvd, _ = scene(rng, count, (4, 40))
    T_true = np.stack([se3.exp(-k * se3.log(T)) for k in range(n_views - 1, 0, -1)] + [T])
    seen = rng.random((n_views, count)) < np.where(np.arange(n_views) % 2, 1.0, 0.7)[:, None]
    seen[-1] = True
    exact = np.stack([transfer(T_j, uvd, CAMERA).uvd.T for T_j in T_true])
    measured = np.stack([noisy(rng, e, sigma_px) for e in exact])
    start = T_true @ se3.exp(0.003 * rng.standard_normal((n_views, 6)))
    return Views(noisy(rng, uvd, sigma_px), measured, seen, start, CAMERA), T_true


def off(T_true: Array, T: Array) -> Array:
    return np.asarray(se3.log(se3.inverse(T_true) @ T))


@pytest.mark.parametrize("noise", [PointNoise(), PointNoise(0.7, 5.0)], ids=["white", "with errors that persist"])
def test_the_minimum_is_that_of_scipy(noise: PointNoise) -> None:
    given, _ = views(np.random.default_rng(1))
    n_views, n = given.seen.shape
    found = adjust(given, noise, robust=False, tolerance=1e-10, max_iterations=30)
    assert found is not None
    whiten = np.linalg.inv(np.linalg.cholesky(noise.S))

    def residuals(x: Array) -> Array:
        poses = given.T_ref @ se3.exp(x[: 6 * n_views].reshape(-1, 6))
        places, kept = given.uvd_ref + x[6 * n_views :].reshape(n, 4)[:, :3], x[6 * n_views :].reshape(n, 4)[:, 3]
        e_d = np.outer(kept, [0.0, 0.0, 1.0]) * (noise.persistent > 0)
        rows = [(given.uvd_ref - places - e_d) @ whiten.T]
        for T, uvd, seen in zip(poses, given.uvd, given.seen, strict=True):
            rows.append(((uvd - transfer(T, places, CAMERA).uvd.T - e_d) @ whiten.T)[seen])
        return np.concatenate([np.concatenate(rows).ravel(), kept / max(noise.persistent, 1.0) ** 0.5])

    oracle = least_squares(residuals, np.zeros(6 * n_views + 4 * n), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    poses = given.T_ref @ se3.exp(oracle.x[: 6 * n_views].reshape(-1, 6))
    assert np.abs(off(poses, found.T_ref)).max() < 1e-6
    np.testing.assert_allclose(found.uvd - given.uvd_ref, oracle.x[6 * n_views :].reshape(n, 4)[:, :3], atol=1e-4)
    if not noise.persistent:  # the marginal of the last pose, from SciPy's own derivatives
        J = oracle.jac[:, np.r_[: 6 * n_views, (6 * n_views + np.arange(4 * n).reshape(n, 4)[:, :3]).ravel()]]
        last = slice(6 * n_views - 6, 6 * n_views)
        J0 = se3_jacobian_at(oracle.x[last])
        expected = J0 @ np.linalg.inv(J.T @ J)[last, last] @ J0.T
        np.testing.assert_allclose(np.linalg.inv(found.information(noise.S)), expected, rtol=2e-3, atol=1e-12)


def se3_jacobian_at(x: Array) -> Array:
    """(6, 6) derivative of ``Log(Exp(x)^-1 Exp(x + h))`` by h at zero."""
    h = 1e-6
    return np.stack([se3.log(se3.inverse(se3.exp(x)) @ se3.exp(x + h * e)) / h for e in np.eye(6)], axis=1)


@pytest.mark.parametrize("robust", [True, False])
def test_exact_points_give_the_true_poses(robust: bool) -> None:
    given, T_true = views(np.random.default_rng(2), sigma_px=0.0)
    found = adjust(given, PointNoise(), robust=robust)
    assert found is not None
    assert np.abs(off(T_true, found.T_ref)).max() < 1e-6


@pytest.mark.parametrize("noise", [PointNoise(), PointNoise(0.6, 10.0)], ids=["white", "with errors that persist"])
def test_two_frames_alone_are_a_motion(noise: PointNoise) -> None:
    given, _ = views(np.random.default_rng(3), n_views=1)
    found = adjust(given, noise, robust=False, tolerance=1e-9)
    motion = refine(given.T_ref[0], given.uvd_ref, given.uvd[0], CAMERA, robust=False, noise=noise)
    assert found is not None
    assert motion is not None
    assert np.abs(off(motion.T_prev_cur, found.T_ref[0])).max() < 1e-6
    if not noise.persistent:
        np.testing.assert_allclose(found.information(noise.S), motion.information, rtol=1e-4, atol=1e-3)


def test_outliers_are_left_out() -> None:
    rng = np.random.default_rng(4)
    given, T_true = views(rng, sigma_px=0.1)
    wrong = (rng.random(given.seen.shape) < 0.05) & given.seen
    given.uvd[wrong] += rng.uniform(3, 10, (int(wrong.sum()), 3))
    found = adjust(given, PointNoise())
    assert found is not None
    assert (found.weight[1:][wrong] == 0).mean() > 0.9
    assert np.abs(off(T_true, found.T_ref)).max() < 0.02


@pytest.mark.filterwarnings("error")
def test_a_view_that_loses_all_its_points_leads_nowhere() -> None:
    given, _ = views(np.random.default_rng(4))
    behind = given.T_ref.copy()
    behind[1] = behind[1] @ se3.exp(np.array([0.0, 0.0, 1e3, 0.0, 0.0, 0.0]))
    assert adjust(replace(given, T_ref=behind), PointNoise()) is None


def test_covariance_is_that_of_the_errors() -> None:
    """400 draws, 6 degrees of freedom each: the mean of NEES over them is within 0.029 of 1 at one sigma."""
    rng = np.random.default_rng(5)
    nees, alone = [], []
    for _ in range(400):
        given, T_true = views(rng)
        found = adjust(given, PointNoise(), robust=False)
        assert found is not None
        information = found.information(triangulation_pixel_covariance(0.3))
        e = off(T_true[-1], found.T_ref[-1])
        nees.append(e @ information @ e / 6)
        motion = refine(given.T_ref[-1], given.uvd_ref, given.uvd[-1], CAMERA, robust=False)
        assert motion is not None
        alone.append(np.trace(np.linalg.inv(information)) / (0.3**2 * np.trace(np.linalg.inv(motion.information))))
    assert 0.91 < np.mean(nees) < 1.09
    assert max(alone) < 1.0


def fly(frames: list[TrackFrame], camera: object, **settings: object) -> list[VoRecord]:
    odometry = StereoOdometry(camera, make_config(**settings))  # type: ignore[arg-type]
    return [odometry.step(f) for f in frames]


def test_a_flight_with_dark_frames(tmp_path: object) -> None:
    source = open_source(
        simulate_points("tunnel-clean", seed=5, duration_s=3.0, dark=(1.0, 1.3)).save(f"{tmp_path}/f.npz")
    )
    frames = [f for f in source if isinstance(f, TrackFrame)]
    plain, windowed, again = (fly(frames, source.camera, window=w) for w in (2, 5, 5))
    assert [r.status for r in windowed] == [r.status for r in plain]
    assert any(r.status is Status.LOST for r in windowed)
    assert windowed[-1].usable
    usable = [k for k, r in enumerate(plain) if r.usable]
    for a, b in zip(windowed, again, strict=True):
        assert a.T_prev_cur.tobytes() == b.T_prev_cur.tobytes()
        assert {m: C.tobytes() for m, C in a.covariances.items()} == {m: C.tobytes() for m, C in b.covariances.items()}
    for method in ("triangulation", "pointing_matching"):
        trace = np.array([[np.trace(r[k].covariances[method]) for k in usable] for r in (plain, windowed)])
        assert (trace[1] < 1.1 * trace[0]).all()  # more frames know no less, but for the points that are left out
    # Motions that have no frame before them stand as they are.
    np.testing.assert_array_equal(windowed[1].T_prev_cur, plain[1].T_prev_cur)


@pytest.mark.parametrize("turn_rad", [0.0, 0.02], ids=["standing", "turning"])
def test_standing_still_and_pure_rotation_hold(turn_rad: float) -> None:
    rng = np.random.default_rng(6)
    _, uvd, _ = scene(rng, 150, (2, 30))
    records, odometry = [], StereoOdometry(CAMERA, make_config(window=5))
    for k in range(12):
        now = noisy(rng, transfer(se3.exp(np.array([0, 0, 0, 0, k * turn_rad, 0])), uvd, CAMERA).uvd.T, 0.1)
        right = np.stack([now[:, 0] - now[:, 2], now[:, 1]], 1)
        records.append(odometry.step(TrackFrame(k * 50_000_000, np.arange(150), now[:, :2], right)))
    assert all(r.status is Status.OK for r in records[1:])
    e = np.stack([se3.log(r.T_prev_cur) for r in records[1:]])
    expected = turn_rad * np.array([(r.t_ns - r.t_prev_ns) // 50_000_000 for r in records[1:]])
    assert np.abs(e[:, 4] - expected).max() < 1e-3
    assert np.abs(e[:, :3]).max() < 0.01


def test_sizes_that_cannot_be_are_refused() -> None:
    with pytest.raises(GpvoError, match="window is 1"):
        make_config(window=1)
