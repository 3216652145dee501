"""Calibration files as they come, with the traps that real ones hold."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from gpvo.cameras.kalibr import camchain_topics, read_camchain, read_imu_noise, read_sensor_pair
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan
from gpvo.cameras.readers import (
    CameraInfo,
    find_calibration,
    left_camera_offset,
    read_kitti_calib,
    read_opencv_stereo,
    read_stereo_yaml,
    rig_from_camera_info,
)
from gpvo.cameras.rectify import Rectifier, read_mask
from gpvo.cameras.rig import StereoRig
from gpvo.errors import CalibrationError
from gpvo.geometry import se3

T_RIGHT_LEFT = se3.exp(np.array([-0.1, 0.001, -0.002, 0.01, -0.02, 0.005]))
T_LEFT_IMU = se3.exp(np.array([0.05, -0.04, 0.02, 1.0, -1.2, 0.9]))


def rows(T) -> str:
    return "[" + ", ".join("[" + ", ".join(repr(float(v)) for v in row) + "]" for row in T) + "]"


def camchain(left="", right="", *, model="equidistant", chain=T_RIGHT_LEFT) -> str:
    block = f"""  camera_model: pinhole
  intrinsics: [190.0, 191.0, 255.0, 256.0]
  distortion_model: {model}
  distortion_coeffs: [0.01, -0.01, 0.006, -0.002]
  resolution: [512, 512]
"""
    link = "" if chain is None else f"  T_cn_cnm1: {rows(chain)}\n"
    return f"cam0:\n{block}  rostopic: /cam0/image_raw\n{left}cam1:\n{block}{link}{right}"


@pytest.fixture
def write(tmp_path):
    def writer(text: str, name: str = "camchain.yaml"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return writer


def test_chain_alone(write):
    rig = read_camchain(write(camchain()))
    assert isinstance(rig.left, KannalaBrandt)
    assert rig.left.distortion == (0.01, -0.01, 0.006, -0.002)
    np.testing.assert_allclose(rig.T_right_left, T_RIGHT_LEFT, atol=1e-12)
    assert rig.T_imu_left is None
    assert camchain_topics(write(camchain())) == ("/cam0/image_raw", None)


@pytest.mark.parametrize(("key", "shift"), [("T_cam_imu", "0.005"), ("T_imu_cam", "5e-3")])
def test_either_direction_to_the_imu(write, key, shift):
    T_right_imu = T_RIGHT_LEFT @ T_LEFT_IMU
    T = [m if key == "T_cam_imu" else se3.inverse(m) for m in (T_LEFT_IMU, T_right_imu)]
    text = camchain(f"  {key}: {rows(T[0])}\n  timeshift_cam_imu: {shift}\n", f"  {key}: {rows(T[1])}\n", chain=None)
    rig = read_camchain(write(text))
    np.testing.assert_allclose(rig.T_right_left, T_RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(rig.T_imu_left, se3.inverse(T_LEFT_IMU), atol=1e-9)
    assert rig.timeshift_cam_imu_s == 0.005


def test_both_directions_are_refused(write):
    both = f"  T_cam_imu: {rows(T_LEFT_IMU)}\n  T_imu_cam: {rows(se3.inverse(T_LEFT_IMU))}\n"
    with pytest.raises(CalibrationError, match="both T_cam_imu and T_imu_cam"):
        read_camchain(write(camchain(both)))


def test_a_chain_of_half_the_baseline_is_caught_at_a_few_millimetres_too(write):
    T_right_left = T_RIGHT_LEFT.copy()
    T_right_left[:3, 3] *= 4e-3 / np.linalg.norm(T_right_left[:3, 3])
    imu = [f"  T_cam_imu: {rows(m)}\n" for m in (T_LEFT_IMU, T_right_left @ T_LEFT_IMU)]
    assert read_camchain(write(camchain(*imu, chain=T_right_left))).baseline_m == pytest.approx(4e-3)
    T_right_left[:3, 3] *= 0.5
    with pytest.raises(CalibrationError, match=r"disagree by 2\.0 mm"):
        read_camchain(write(camchain(*imu, chain=T_right_left)))


def test_chain_with_another_meaning_is_caught(write):
    """Published files have put the inverse, or camera-to-IMU values, under T_cn_cnm1."""
    imu = [f"  T_cam_imu: {rows(m)}\n" for m in (T_LEFT_IMU, T_RIGHT_LEFT @ T_LEFT_IMU)]
    read_camchain(write(camchain(*imu)))
    with pytest.raises(CalibrationError, match="disagree"):
        read_camchain(write(camchain(*imu, chain=T_LEFT_IMU)))
    with pytest.raises(CalibrationError, match="left and right are swapped"):
        read_camchain(write(camchain(chain=se3.inverse(T_RIGHT_LEFT))))


@pytest.mark.parametrize("head", ["%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "\ufeff", "# hello\n"])
def test_headers_that_yaml_refuses(write, head):
    assert read_camchain(write(head + camchain())).baseline_m == pytest.approx(np.linalg.norm(T_RIGHT_LEFT[:3, 3]))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "holds no keys"),
        ("cam0: [1, 2", "not readable as YAML"),
        ("cam0: !!python/object/apply:os.system ['echo']\n", "not readable as YAML"),
        ("nothing: 1\n", "neither a Kalibr"),
        ("cam0: {}\n", "no block 'cam1'"),
        (camchain(chain=None), "does not say where 'cam1' sits"),
        (camchain().replace("equidistant", "fov"), "'fov' is not supported"),
        (camchain().replace("camera_model: pinhole", "camera_model: omni"), "'omni' is not supported"),
        (camchain().replace("[190.0, 191.0, 255.0, 256.0]", "[190.0, 191.0, 255.0]"), "'intrinsics' holds 3 numbers"),
        (camchain().replace("190.0", ".nan"), "finite"),
        (camchain().replace("resolution", "solution"), "lacks the key 'resolution'"),
        (camchain().replace("  distortion_model: equidistant\n", ""), "'distortion_coeffs' of no distortion_model"),
    ],
)
def test_bad_files_in_one_line(write, text, reason):
    path = write(text)
    with pytest.raises(CalibrationError, match=reason) as caught:
        read_stereo_yaml(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_imu_yaml(write):
    text = (
        "accelerometer_noise_density: 0.0028\naccelerometer_random_walk: 0.00086\n"
        "gyroscope_noise_density: 0.00016\ngyroscope_random_walk: 0.000022\nupdate_rate: 200.0\n"
    )
    noise = read_imu_noise(write(text))
    assert (noise.acc_density_mps2_sqrthz, noise.gyro_walk_radps2_sqrthz) == (0.0028, 0.000022)
    assert read_imu_noise(write("imu0:\n" + "".join(f"  {line}\n" for line in text.splitlines()))) == noise
    with pytest.raises(CalibrationError, match="gyroscope_random_walk"):
        read_imu_noise(write(text.replace("gyroscope_random_walk", "walk")))


def sensor_yaml(T_BS, *, lens="[-0.28, 0.07, 0.0002, 1.8e-05]") -> str:
    data = ", ".join(repr(float(v)) for v in T_BS.ravel())
    return f"""sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.6, 457.3, 367.2, 248.4]
distortion_model: radial-tangential
distortion_coefficients: {lens}
"""


def test_euroc_sensor_pair_inverts_the_sense(write):
    T_BL = se3.inverse(T_LEFT_IMU)
    T_BR = T_BL @ se3.inverse(T_RIGHT_LEFT)
    left, right = write(sensor_yaml(T_BL), "left.yaml"), write(sensor_yaml(T_BR), "right.yaml")
    rig = read_sensor_pair(left, right)
    np.testing.assert_allclose(rig.T_right_left, T_RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(rig.T_imu_left, T_BL, atol=1e-12)
    assert rig.T_body_left is None
    np.testing.assert_allclose(read_sensor_pair(left, right, body_is_flu=True).T_body_left, T_BL, atol=1e-12)
    with pytest.raises(CalibrationError, match="swapped"):
        read_sensor_pair(right, left)


KITTI = """P0: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
P1: 7.2e+02 0 6.1e+02 -3.87e+02 0 7.2e+02 1.7e+02 0 0 0 1 0
P2: 7.2e+02 0 6.1e+02 4.5e+01 0 7.2e+02 1.7e+02 2.2e-01 0 0 1 2.7e-03
P3: 7.2e+02 0 6.1e+02 -3.4e+02 0 7.2e+02 1.7e+02 2.2e+00 0 0 1 2.7e-03
"""


@pytest.mark.parametrize("head", ["", "\ufeff"])
def test_kitti_pairs(write, head):
    path = write(head + KITTI, "calib.txt")
    grey = read_kitti_calib(path, left=0, right=1, size=(1241, 376))
    assert grey.is_rectified
    assert grey.baseline_m == pytest.approx(387 / 720)
    colour = read_kitti_calib(path, left=2, right=3, size=(1241, 376))
    assert colour.baseline_m == pytest.approx(385 / 720, rel=1e-3)
    assert colour.is_rectified
    # Camera 2 sits 6 cm to the left of camera 0: its origin has x = -45 / 720 there.
    assert left_camera_offset(path, 2)[0, 3] == pytest.approx(-45 / 720, rel=0.05)
    with pytest.raises(CalibrationError, match="swapped"):
        read_kitti_calib(path, left=1, right=0, size=(1241, 376))


@pytest.mark.parametrize("size", [(620, 188), (2482, 752)])
def test_kitti_of_another_resolution(write, size):
    with pytest.raises(CalibrationError, match="far from the middle"):
        read_kitti_calib(write(KITTI, "calib.txt"), left=0, right=1, size=size)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "lacks the line 'P0:'"),
        (KITTI.replace("P1", "Q1"), "lacks the line 'P1:'"),
        (KITTI.replace("-3.87e+02", "abc"), "line 2"),
        (KITTI.replace("-3.87e+02", ""), "11 numbers"),
        (KITTI.replace("-3.87e+02", "nan"), "finite"),
        (KITTI.replace("-3.87e+02", "0"), "both cameras in one place"),
        (KITTI.replace("P1: 7.2", "P1: 7.9"), "differ in their intrinsics"),
    ],
)
def test_bad_kitti(write, text, reason):
    with pytest.raises(CalibrationError, match=reason):
        read_kitti_calib(write(text, "calib.txt"), left=0, right=1, size=(1241, 376))


def _info(rectifier: Rectifier, lens, R, tx) -> CameraInfo:
    c = rectifier.camera
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    P = np.array([[c.fx_px, 0, c.cx_px, tx], [0, c.fy_px, c.cy_px, 0], [0, 0, 1, 0]])
    return CameraInfo(lens.width, lens.height, "plumb_bob", np.array(lens.distortion), K, R, P)


def test_camera_info_gives_back_the_rig():
    k = (-0.28, 0.07, 0.0002, 2e-05, 0.0)
    lens = PinholeRadtan(458.0, 457.0, 367.0, 248.0, 752, 480, k)
    rig = StereoRig(lens, lens, T_RIGHT_LEFT)
    rectifier = Rectifier(rig)
    c = rectifier.camera
    left = _info(rectifier, lens, rectifier.R_rect_left, 0.0)
    right = _info(rectifier, lens, rectifier.R_rect_right, -c.fx_px * c.baseline_m)
    raw = rig_from_camera_info(left, right, rectified=False)
    np.testing.assert_allclose(raw.T_right_left, T_RIGHT_LEFT, atol=1e-9)
    assert raw.left == lens
    rectified = rig_from_camera_info(left, right, rectified=True)
    assert rectified.is_rectified
    assert rectified.left.fx_px == c.fx_px
    with pytest.raises(CalibrationError, match="swapped"):
        rig_from_camera_info(right, left, rectified=True)
    blank = CameraInfo(752, 480, "plumb_bob", np.zeros(5), np.zeros((3, 3)), np.eye(3), np.zeros((3, 4)))
    with pytest.raises(CalibrationError, match="uncalibrated"):
        rig_from_camera_info(blank, right, rectified=False)


def test_camera_info_of_a_pair_one_above_the_other():
    """OpenCV and ROS write their baseline into the second row of the projection."""
    K = np.array([[400.0, 0, 320], [0, 410, 240], [0, 0, 1]])
    P = np.column_stack([K, np.zeros(3)])
    upper = CameraInfo(640, 480, "plumb_bob", np.zeros(5), K, np.eye(3), P)
    lower = replace(upper, P=P + np.outer([0, -410 * 0.12, 0], [0, 0, 0, 1]))
    for rectified in (True, False):
        rig = rig_from_camera_info(upper, lower, rectified=rectified)
        np.testing.assert_allclose(rig.T_right_left[:3, 3], [0, -0.12, 0], atol=1e-12)
        assert rig.is_upright


WINDOW = (64, 40, 512, 384)


@pytest.mark.parametrize("D", [(-0.28, 0.07, 2e-4, 2e-5, 0.0), (0.8, 0.05, 2e-4, 2e-5, 1e-3, 1.1, 0.12, 3e-3)])
@pytest.mark.parametrize("rectified", [False, True])
def test_camera_info_of_a_window_with_binned_pixels(D, rectified):
    """A pixel of the image covers two columns and three rows of the window; its centre is the middle of theirs."""
    lens = PinholeRadtan(458.0, 457.0, 367.0, 248.0, 752, 480, D)
    rectifier = Rectifier(StereoRig(lens, lens, T_RIGHT_LEFT))
    c = rectifier.camera
    ends = ((rectifier.R_rect_left, 0.0), (rectifier.R_rect_right, -c.fx_px * c.baseline_m))
    whole = [replace(_info(rectifier, lens, *end), distortion_model="rational_polynomial") for end in ends]
    shown = [replace(info, window=WINDOW, binning=(2, 3)) for info in whole]
    a, b = (
        rig_from_camera_info(*infos, rectified=rectified)
        for infos in (whole, [info.of_images((256, 128)) for info in shown])
    )
    np.testing.assert_allclose(b.T_right_left, a.T_right_left, atol=1e-12)
    points = np.array([[0.1, -0.2, 2.0], [-0.4, 0.3, 3.0], [0.0, 0.0, 1.0]])
    for of_all, of_window in ((a.left, b.left), (a.right, b.right)):
        assert (of_window.width, of_window.height) == (256, 128)
        expected = (of_all.project(points)[0] - WINDOW[:2] + 0.5) / (2, 3) - 0.5
        np.testing.assert_allclose(of_window.project(points)[0], expected, atol=1e-9)


def test_camera_info_that_states_the_binned_size_needs_no_binning():
    info = CameraInfo(752, 480, "plumb_bob", np.zeros(5), np.eye(3), np.eye(3), np.ones((3, 4)), binning=(2, 2))
    assert info.of_images((752, 480)).K.tolist() == np.eye(3).tolist()
    assert (info.of_images((752, 480)).width, info.of_images((1, 1)).width) == (752, 376)


def opencv_matrix(name, M) -> str:
    M = np.atleast_2d(M)
    data = ", ".join(repr(float(v)) for v in M.ravel())
    return f"{name}: !!opencv-matrix\n   rows: {M.shape[0]}\n   cols: {M.shape[1]}\n   dt: d\n   data: [ {data} ]\n"


def opencv_stereo(K, D, names=("K", "D")) -> str:
    text = "%YAML:1.0\n---\n" + "".join(opencv_matrix(f"{names[0]}{k}", K) for k in (1, 2))
    text += "".join(opencv_matrix(f"{names[1]}{k}", D) for k in (1, 2))
    return text + opencv_matrix("R", T_RIGHT_LEFT[:3, :3]) + opencv_matrix("T", T_RIGHT_LEFT[:3, 3:])


def test_t265_opencv_file(write):
    K = np.array([[286.0, 0, 419.0], [0, 286.5, 396.0], [0, 0, 1.0]])
    text = opencv_stereo(K, [-0.003, 0.04, -0.037, 0.006])
    rig = read_opencv_stereo(write(text), size=(848, 800))
    assert isinstance(rig.left, KannalaBrandt)
    np.testing.assert_allclose(rig.T_right_left, T_RIGHT_LEFT, atol=1e-12)
    with pytest.raises(CalibrationError, match=r"image size .*'resolution: \[WIDTH, HEIGHT\]' of your images"):
        read_stereo_yaml(write(text))
    named = read_stereo_yaml(write(text + "resolution: [640, 480]\nmodel: radtan\n"))
    assert isinstance(named.left, PinholeRadtan)


def test_four_coefficients_of_opencv_may_be_of_either_lens(write):
    K = np.array([[286.0, 0, 319.0], [0, 286.5, 239.0], [0, 0, 1.0]])
    text = opencv_stereo(K, [-0.003, 0.04, -0.037, 0.006]) + "resolution: [640, 480]\n"
    with pytest.raises(CalibrationError, match="'D1' holds four .*'model: fisheye' or 'model: radtan'") as caught:
        read_stereo_yaml(write(text))
    assert "\n" not in str(caught.value)
    for line, kind in (("model: fisheye", KannalaBrandt), ("distortion_model: plumb_bob", PinholeRadtan)):
        assert isinstance(read_stereo_yaml(write(f"{text}{line}\n")).left, kind)
    for D in ([0.0] * 4, [0.1, 0.0, 0.0, 0.0, 0.0]):
        assert isinstance(read_opencv_stereo(write(opencv_stereo(K, D)), size=(640, 480)).left, PinholeRadtan)


def test_eight_coefficients_of_opencv_are_rational_and_more_are_refused(write):
    K = np.array([[286.0, 0, 319.0], [0, 286.5, 239.0], [0, 0, 1.0]])
    D = [0.8, 0.05, 1e-3, -2e-3, 1e-3, 1.1, 0.12, 3e-3]
    for coefficients in (D, [*D, 0.0, 0.0, 0.0, 0.0]):
        assert read_opencv_stereo(write(opencv_stereo(K, coefficients)), size=(640, 480)).left.distortion == tuple(D)
    with pytest.raises(CalibrationError, match="thin prism"):
        read_opencv_stereo(write(opencv_stereo(K, [*D, 1e-3, 0.0, 0.0, 0.0])), size=(640, 480))


@pytest.mark.parametrize("names", [("M", "D"), ("cameraMatrix", "distCoeffs")])
def test_other_names_of_opencv(write, names):
    K = np.array([[286.0, 0, 319.0], [0, 286.5, 239.0], [0, 0, 1.0]])
    files = [write(opencv_stereo(K, [0.1, 0.0, 0.0, 0.0, 0.0], n), f"{n[0]}.yaml") for n in (("K", "D"), names)]
    one, other = (read_stereo_yaml(file, size=(640, 480)) for file in files)
    assert one.describe() == other.describe()


@pytest.mark.parametrize("ending", ["yaml", "json"])
def test_opencv_file_written_by_opencv(tmp_path, ending):
    path = tmp_path / f"stereo.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    K = np.array([[450.0, 0, 319.0], [0, 451.0, 239.0], [0, 0, 1.0]])
    for name, M in (("K1", K), ("K2", K), ("D1", np.zeros((1, 5))), ("D2", np.zeros((1, 5)))):
        storage.write(name, M)
    storage.write("R", T_RIGHT_LEFT[:3, :3].copy())
    storage.write("T", T_RIGHT_LEFT[:3, 3:].copy())
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.release()
    rig = read_stereo_yaml(path)
    np.testing.assert_allclose(rig.T_right_left, T_RIGHT_LEFT, atol=1e-12)
    assert (rig.left.width, rig.left.height) == (640, 480)


@pytest.mark.parametrize("white_is_usable", [True, False])
def test_mask_of_either_colour(tmp_path, white_is_usable):
    usable = cv2.circle(np.zeros((80, 100), np.uint8), (50, 40), 35, 255, -1) > 0
    cv2.imwrite(str(tmp_path / "m.png"), np.where(usable == white_is_usable, 255, 0).astype(np.uint8))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), usable)


def test_mask_that_is_none(tmp_path):
    (tmp_path / "m.png").write_text("no image")
    with pytest.raises(CalibrationError, match="not readable as an image"):
        read_mask(tmp_path / "m.png")
    with pytest.raises(CalibrationError, match="no such mask"):
        read_mask(tmp_path / "n.png")


def test_find_calibration(tmp_path, write):
    assert find_calibration(tmp_path) is None
    path = write(camchain(), "my_camchain.yaml")
    assert find_calibration(tmp_path) == path


def test_real_t265(real_data):
    rig = read_camchain(real_data / "t265" / "kalibr_imucam_chain.yaml")
    assert rig.baseline_m == pytest.approx(0.0627, abs=2e-4)
    masks = [read_mask(real_data / "t265" / f"mask_t265_cam{i}.png") for i in (0, 1)]
    rectifier = Rectifier(rig.with_masks(*masks))
    assert rectifier.camera.width == 848
    assert rectifier.mask is None or rectifier.mask.mean() > 0.9
    wide = Rectifier(rig.with_masks(*masks), hfov_deg=155.0)
    assert wide.mask is not None
    assert 0.3 < wide.mask.mean() < 0.99
