"""What odometry finds of its calibration's errors: exact rigs stay exact, wrong ones are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from gpvo.cameras.kalibr import read_camchain, read_yaml
from gpvo.cameras.rectify import Rectifier
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError
from gpvo.files import write_json
from gpvo.geometry import se3
from gpvo.geometry.covariance import is_positive_definite
from gpvo.sim.rig import camera_rig
from gpvo.types import Array, StereoCamera
from gpvo.vo.covariance import NoiseEstimator
from gpvo.vo.motion import refine, whitened
from gpvo.vo.rig_error import N_TERMS, ORDER, RigError, RigState, prior_covariance, terms
from gpvo.vo.rig_findings import camchain, corrected, document, explained_px, findings, read_state, rig_of

CAMERA = StereoCamera(380.0, 380.0, 319.5, 239.5, 0.12, 640, 480)


def _fly(
    coefficients: Array,
    seed: int,
    frames: int = 60,
    sigma_px: float = 0.15,
    persistent_px: float = 0.0,
    depth_m: tuple[float, float] = (1.0, 5.0),
    rig: RigError | None = None,
) -> RigError:
    """A rig wrong by ``coefficients`` (30,) over motions with fresh points and fresh noise, white and persistent: a new
    one, or ``rig`` goes on."""
    rng = np.random.default_rng(seed)
    noise = NoiseEstimator()
    rig = rig or RigError(CAMERA)
    truth = RigError(CAMERA, RigState(coefficients, 1e-12 * np.eye(2 * N_TERMS), 1.0), learn=False)
    for _ in range(frames):
        T = se3.exp(np.array([*rng.normal(0, 0.05, 2), 0.15, *rng.normal(0, 0.02, 3)]))
        Z = rng.uniform(*depth_m, 200)
        uv = rng.uniform([60, 40], [580, 440], (200, 2))
        P = np.column_stack([(uv - [CAMERA.cx_px, CAMERA.cy_px]) / CAMERA.fx_px * Z[:, None], Z])
        seen, shared = [], rng.normal(0, persistent_px, len(P)) if persistent_px else 0.0
        for X in (P, se3.transform(se3.inverse(T), P)):
            uvd = CAMERA.project(X)
            d_error, row = truth.errors(uvd)
            left, right = rng.normal(0, sigma_px, (2, len(P), 2))
            row_error = row + right[:, 1] - left[:, 1]
            u, v = uvd[:, 0] + left[:, 0], uvd[:, 1] + left[:, 1] + 0.5 * row_error
            seen.append(np.column_stack([u, v, uvd[:, 2] + d_error + shared + left[:, 0] - right[:, 0]]))
        motion = refine(T, rig.correct(seen[0]), rig.correct(seen[1]), CAMERA, noise=noise.value)
        assert motion is not None
        white = whitened(motion, CAMERA)
        noise.update(motion, white)
        rig.update(motion, white, row_error[motion.inliers], 0.5)
    return rig


def _turn(axis: int, rad: float) -> Array:
    out = np.zeros(2 * N_TERMS)
    n = N_TERMS
    places = {0: ([4, n, n + 5], [-1, -1, -1]), 1: ([0, 3, n + 4], [1, 1, 1]), 2: ([2, n + 1], [-1, 1])}[axis]
    out[places[0]] = rad * np.array(places[1])
    return out


def test_an_exact_rig_is_left_alone() -> None:
    rig = _fly(np.zeros(2 * N_TERMS), seed=1)
    assert rig.state.probability < 0.01
    assert np.abs(rig.state.mean[:N_TERMS]).max() * CAMERA.fx_px < 0.01
    assert findings(rig.state, CAMERA) == []


def test_an_exact_rig_is_never_known_without_doubt() -> None:
    """After months, its state can still be the start of another run."""
    rig = _fly(np.zeros(2 * N_TERMS), seed=1, frames=5)
    for block in rig._blocks:
        block.sums = replace(block.sums, information=1e7 * block.sums.information)
    rig._conclude()
    assert rig.state.probability < 1e-12
    assert is_positive_definite(rig.state.covariance)
    RigError(CAMERA, rig.state)


def test_persistent_errors_of_single_points_are_no_error_of_the_rig() -> None:
    """Each point's disparity is off by 0.5 px in both frames alike: taken for white noise, this bends the estimate."""
    states = [_fly(np.zeros(2 * N_TERMS), seed=seed, sigma_px=0.1, persistent_px=0.5).state for seed in range(5)]
    assert np.mean([state.probability for state in states]) < 0.5
    assert np.abs([state.mean[0] for state in states]).max() * CAMERA.fx_px < 0.03


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_is_found_and_named(axis: int) -> None:
    truth = _turn(axis, np.deg2rad(0.2))
    state = _fly(truth, seed=axis).state
    assert state.probability > 0.99
    assert np.abs(state.mean[[0, 1, 2]] - truth[[0, 1, 2]]).max() * CAMERA.fx_px < 0.1
    word = ("horizontal", "vertical", "optical")[axis]
    assert any(f"about the {word} axis" in " ".join(line.split()) for line in findings(state, CAMERA))


def test_a_bend_is_as_large_as_in_the_image() -> None:
    """A car's image of 1241x376: y^3 at half the width would be 36 times what it is at the upper border."""
    camera = StereoCamera(718.0, 718.0, 620.0, 187.5, 0.54, 1241, 376)
    x, y = 0.5 * camera.width / camera.fx_px, 0.5 * camera.height / camera.fy_px
    at_half_width_px = np.zeros(2 * N_TERMS)
    at_half_width_px[[6, 9]] = 0.7, 5.0  # x^3, y^3
    reach = np.tile(x**ORDER, 2) * camera.fx_px
    state = RigState(at_half_width_px / reach, np.diag((0.02 / reach) ** 2), 1.0)
    largest_px = 0.7 + 5.0 * (y / x) ** 3
    assert findings(state, camera) == [f"disparities bend over the image by up to {largest_px:.1f} px, most in x^3"]
    in_doubt = replace(state, covariance=np.diag((0.5 / reach) ** 2))
    assert findings(in_doubt, camera) == []
    rows = np.zeros(2 * N_TERMS)
    rows[N_TERMS + 2] = 0.5 / reach[1]  # the y term: 0.15 px at the upper border
    assert findings(replace(state, mean=rows), camera) == []


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("before", ["exact", "wrong", "from a file"])
def test_cameras_that_are_knocked_in_flight_are_as_new(axis: int, before: str) -> None:
    """After 43 motions the right camera turns by 0.2 deg: twenty motions later it is known, at an honest sigma.

    One estimate over all motions is still off by 0.6 (axis 0 and 2) to 1.1 px, at 35 to 150 sigma."""
    was, truth = 1.0 * (before != "exact") * _turn(1, -1e-3), _turn(axis, np.deg2rad(0.2))
    rig = RigError(CAMERA, _fly(was, seed=9).state) if before == "from a file" else RigError(CAMERA)
    _fly(was, seed=axis, frames=43, rig=rig)
    assert rig.moved == 0
    _fly(was + truth, seed=10 + axis, frames=20, rig=rig)
    assert rig.moved == 1
    e = (rig.state.mean - was - truth)[:N_TERMS]
    assert np.abs(e[:3]).max() * CAMERA.fx_px < 0.3
    assert e @ np.linalg.solve(rig.state.covariance[:N_TERMS, :N_TERMS], e) / N_TERMS < 3.0


def test_a_rig_that_stays_is_never_said_to_have_moved() -> None:
    """20 rigs drawn from the prior and 10 exact ones, 60 motions each, half of them with errors that stay with a
    point."""
    rng = np.random.default_rng(3)
    L = np.linalg.cholesky(prior_covariance(CAMERA, 4.0))
    for seed in range(30):
        truth = L @ rng.standard_normal(2 * N_TERMS) * (seed >= 10)
        assert _fly(truth, seed=200 + seed, persistent_px=0.4 * (seed % 2)).moved == 0


@pytest.mark.parametrize("degrees", [0.2, -0.2, 0.5])
def test_rows_show_a_turn_about_the_optical_axis_at_once(degrees: float) -> None:
    """After one motion, whatever the disparities say: no lens bends rows like that."""
    truth = _turn(2, np.deg2rad(degrees))
    share = [_fly(truth, seed=seed, frames=1).state.mean[2] / truth[2] for seed in range(3)]
    assert 0.8 < np.mean(share) < 1.1


def test_rows_show_it_where_all_points_are_far() -> None:
    """Disparities of a pixel tell nothing for sure; rows do, of points at any depth."""
    truth = _turn(2, np.deg2rad(0.2))
    state = _fly(truth, seed=1, frames=5, depth_m=(60.0, 120.0)).state
    assert 0.8 < state.mean[2] / truth[2] < 1.2


@pytest.mark.parametrize("wrong", ["a shift of 0.3 px", "a turn of 0.05 deg about the vertical axis"])
def test_level_rows_do_not_prove_that_a_rig_is_exact(wrong: str) -> None:
    """That nothing is turned about the optical axis says little of other errors: after three motions they are not yet
    found, and the covariance says so."""
    truth = _turn(1, np.deg2rad(0.05))
    if "shift" in wrong:
        truth = np.zeros(2 * N_TERMS)
        truth[0] = 0.3 / CAMERA.fx_px
    scores = []
    for seed in range(6):
        state = _fly(truth, seed=seed, frames=3).state
        e = (state.mean - truth)[:N_TERMS]
        scores.append(e @ np.linalg.solve(state.covariance[:N_TERMS, :N_TERMS], e) / N_TERMS)
    assert np.mean(scores) < 2.0


@pytest.mark.parametrize(("mounting", "roll"), [(1.0, 1.0), (16.0, 1.0), (16.0, 16.0)])
def test_the_posterior_is_consistent(mounting: float, roll: float) -> None:
    """30 rigs drawn from the prior, 15 motions each: NEES of the disparity's coefficients per degree of freedom.

    Information begins divided by 16, so that short flights state too much rather than too little."""
    rng = np.random.default_rng(7)
    L = np.linalg.cholesky(prior_covariance(CAMERA, mounting, roll=roll))
    scores = []
    for seed in range(30):
        truth = L @ rng.standard_normal(2 * N_TERMS)
        state = _fly(truth, seed=100 + seed, frames=15).state
        e = (state.mean - truth)[:N_TERMS]
        scores.append(e @ np.linalg.solve(state.covariance[:N_TERMS, :N_TERMS], e) / N_TERMS)
    assert 0.05 < np.mean(scores) < 1.1


def test_known_state_is_used_and_never_learnt_away() -> None:
    known = RigState(_turn(1, 1e-3), 1e-10 * np.eye(2 * N_TERMS), 1.0)
    uvd = np.array([[300.0, 200.0, 10.0]])
    fixed = RigError(CAMERA, known, learn=False)
    assert fixed.correct(uvd)[0, 2] - 10.0 == pytest.approx(0.38, rel=0.01)
    exact = RigError(CAMERA, RigState.exact(), learn=False)
    assert np.array_equal(exact.correct(uvd), uvd)


def test_state_file_round_trip_and_hostile_ones(tmp_path: Path) -> None:
    state = _fly(_turn(2, 2e-3), seed=3, frames=10).state
    path = tmp_path / "calibration_state.json"
    write_json(path, document(state, CAMERA))
    again = read_state(path, CAMERA)
    assert np.allclose(again.mean, state.mean)
    assert again.probability == pytest.approx(state.probability)
    with pytest.raises(GpvoError, match="another camera"):
        read_state(path, replace(CAMERA, width=320))
    huge = {"covariance": [[1.7e308] * (2 * N_TERMS)] * (2 * N_TERMS)}
    for change in ({"mean": [1e9] * 30}, {"covariance": [[0.0]]}, huge, {"mean": "x"}, {"probability": None}):
        write_json(path, {**document(state, CAMERA), **change})
        with pytest.raises(GpvoError):
            read_state(path, CAMERA)


@pytest.mark.parametrize("hfov_deg", [5.0, 15.0, 28.0, 150.0])
def test_the_state_of_any_field_of_view_is_read_again(hfov_deg: float, tmp_path: Path) -> None:
    """Thirty rigs drawn from the prior: terms of high order are large numbers where the view is narrow."""
    f = CAMERA.cx_px / np.tan(np.deg2rad(hfov_deg / 2))
    camera, rng = replace(CAMERA, fx_px=f, fy_px=f), np.random.default_rng(0)
    covariance = prior_covariance(camera)
    for _ in range(30):
        mean = 0.3 * np.linalg.cholesky(covariance) @ rng.standard_normal(2 * N_TERMS)
        write_json(tmp_path / "state.json", document(RigState(mean, 0.01 * covariance, 1.0), camera))
        assert np.allclose(read_state(tmp_path / "state.json", camera).mean, mean)
    write_json(tmp_path / "state.json", document(RigError(camera).state, camera))
    read_state(tmp_path / "state.json", camera)


def test_an_exact_calibration_is_read_again_as_exact(tmp_path: Path) -> None:
    write_json(tmp_path / "state.json", document(RigState.exact(), CAMERA))
    state = read_state(tmp_path / "state.json", CAMERA)
    assert not state.covariance.any()
    assert not RigError(CAMERA, state).state.covariance.any()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_corrected_camera_chain(axis: int, tmp_path: Path) -> None:
    state = RigState(_turn(axis, 3e-3), np.eye(2 * N_TERMS), 1.0)
    rig = corrected(rig_of(None, CAMERA), state, CAMERA)
    path = tmp_path / "corrected.yaml"
    path.write_text(camchain(rig))
    read = read_camchain(path)
    w = se3.so3_log(read.T_right_left[:3, :3])
    assert w[axis] == pytest.approx(3e-3, rel=0.1)
    assert np.abs(np.delete(w, axis)).max() < 3e-4


def test_every_number_of_a_camera_chain_is_a_number_to_other_readers() -> None:
    """YAML 1.1, which Kalibr reads, takes 1e-05 for a text: it wants 1.0e-05."""
    lens = replace(rig_of(None, CAMERA).left, distortion=(1e-5, -3e-17, 0.0, 2.0, 0.0))
    T = se3.exp(np.array([-0.12, 1e-9, -2e-7, 1e-8, 3e-6, 0.0]))
    rig = StereoRig(lens, lens, T, T_imu_left=se3.inverse(T), timeshift_cam_imu_s=1e-6)
    for block in yaml.safe_load(camchain(rig)).values():
        for key in ("intrinsics", "distortion_coeffs", "resolution", "T_cam_imu", "timeshift_cam_imu"):
            assert np.asarray(block[key]).dtype.kind in "fi", key
    assert np.array_equal(yaml.safe_load(camchain(rig))["cam1"]["T_cn_cnm1"], T)


def test_how_much_a_corrected_calibration_explains() -> None:
    """A turn to first order in whole, as of a bend of fourth order half."""
    for coefficients, least, most in ((_turn(1, 3e-3), 0.0, 1e-9), (np.eye(2 * N_TERMS)[10] * 1e-2, 0.3, 0.7)):
        found_px, left_px = explained_px(rig_of(None, CAMERA), RigState(coefficients, np.eye(2 * N_TERMS), 1.0), CAMERA)
        assert found_px > 0.5
        assert least <= left_px / found_px < most


@pytest.mark.parametrize("name", ["pinhole", "euroc", "t265"])
def test_a_corrected_calibration_fits_behind_any_lens(name: str) -> None:
    """A right lens with a focal length 1 % too long and its centre 1 px off: disparities and rows, before and after."""
    written = camera_rig(name)
    lens = written.right
    true = replace(lens, fx_px=1.01 * lens.fx_px, fy_px=1.01 * lens.fy_px, cx_px=lens.cx_px + 1, cy_px=lens.cy_px - 1)
    c = Rectifier(written).camera
    v, u = (f.ravel() for f in np.mgrid[60 : c.height - 60 : 9j, 60 : c.width - 60 : 12j])
    places = np.column_stack([(u - c.cx_px) / c.fx_px, (v - c.cy_px) / c.fy_px, np.ones(len(u))])

    def displacement(rig: StereoRig) -> tuple[Array, Array]:
        """Where the rig's calibration puts points in the right image, and how far that is from where they are."""
        R = Rectifier(rig).R_rect_right
        ray = rig.right.unproject(true.project(places @ Rectifier(written).R_rect_right)[0])
        meant = places @ Rectifier(written).R_rect_right @ written.T_right_left[:3, :3]  # in left axes
        meant = meant @ rig.T_right_left[:3, :3].T @ R.T
        seen = ray @ R.T
        seen, meant = seen[:, :2] / seen[:, 2:], meant[:, :2] / meant[:, 2:]
        return seen, seen - meant

    seen, off = displacement(written)
    coefficients = np.linalg.lstsq(terms(*seen.T).T, off, rcond=None)[0].T.ravel()
    state = RigState(coefficients, 1e-12 * np.eye(2 * N_TERMS), 1.0)
    before_px, after_px = (
        c.fx_px * np.sqrt(2 * np.mean(displacement(r)[1] ** 2)) for r in (written, corrected(written, state, c))
    )
    found_px, left_px = explained_px(written, state, c)
    assert before_px > 2.0
    assert found_px > 2.0
    assert after_px < 0.1 * before_px
    assert left_px < 0.1 * found_px


def test_corrected_camera_chain_keeps_the_imu(tmp_path: Path) -> None:
    left = rig_of(None, CAMERA).left
    T_right_left = se3.exp(np.array([-0.12, 0.001, 0.002, 0.01, -0.02, 0.005]))
    T_imu_left = se3.exp(np.array([0.03, -0.02, 0.05, 0.3, 1.1, -0.7]))
    calibrated = StereoRig(left, left, T_right_left, T_imu_left=T_imu_left, timeshift_cam_imu_s=-0.0123)
    rig = rig_of(calibrated.describe(), CAMERA)
    path = tmp_path / "corrected.yaml"
    path.write_text(camchain(corrected(rig, RigState(_turn(1, 3e-3), np.eye(2 * N_TERMS), 1.0), CAMERA)))
    read = read_camchain(path)  # which also compares T_cn_cnm1 with both T_cam_imu
    assert read.T_imu_left is not None
    assert np.allclose(read.T_imu_left, T_imu_left, atol=1e-12)
    assert read.timeshift_cam_imu_s == -0.0123
    T_right_imu = np.array(read_yaml(path)["cam1"]["T_cam_imu"])
    assert np.allclose(T_right_imu, read.T_right_left @ se3.inverse(T_imu_left), atol=1e-12)
    assert "imu" not in camchain(rig_of(None, CAMERA))
