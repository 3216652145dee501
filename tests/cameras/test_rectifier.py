"""Rectification: exact geometry, sampling, masks."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan
from gpvo.cameras.rectify import Rectifier
from gpvo.cameras.rig import StereoRig
from gpvo.errors import CalibrationError
from gpvo.geometry import se3

FISHEYE = StereoRig(
    KannalaBrandt(190.4, 190.2, 254.9, 256.9, 512, 512, (0.010, -0.011, 0.006, -0.0017)),
    KannalaBrandt(189.6, 189.7, 252.5, 254.9, 512, 512, (0.014, -0.016, 0.009, -0.0023)),
    se3.exp(np.array([-0.1009, -0.002, -0.0015, 0.047, 0.001, -0.001])),
    T_imu_left=se3.exp(np.array([0.05, 0.02, -0.01, 1.0, -1.0, 0.5])),
)
RADTAN = StereoRig(
    PinholeRadtan(458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05)),
    PinholeRadtan(457.587, 456.134, 379.999, 255.238, 752, 480, (-0.28368365, 0.07451284, -0.00010473, -3.555e-05)),
    se3.exp(np.array([-0.110, 0.0004, -0.0008, 0.007, -0.0023, -0.014])),
)
# One camera below the other, and of another resolution.
UPRIGHT = StereoRig(
    RADTAN.left,
    PinholeRadtan(915.2, 912.3, 760.0, 510.5, 1504, 960),
    se3.exp(np.array([0.004, -0.12, 0.002, 0.01, -0.02, 0.015])),
)


def _project_to_rectified(rectifier: Rectifier, uv: np.ndarray, right: bool) -> np.ndarray:
    lens, R = (rectifier.rig.right, rectifier.R_rect_right) if right else (rectifier.rig.left, rectifier.R_rect_left)
    ray = lens.unproject(uv) @ R.T
    c = rectifier.camera
    return ray[:, :2] / ray[:, 2:] * (c.fx_px, c.fy_px) + (c.cx_px, c.cy_px)


@pytest.mark.parametrize("rig", [FISHEYE, RADTAN, UPRIGHT], ids=["fisheye", "radtan", "upright"])
@pytest.mark.parametrize("options", [{}, {"hfov_deg": 80.0}, {"hfov_deg": 90.0, "size": (320, 240)}])
def test_points_land_where_the_virtual_camera_says(rig, options):
    rectifier = Rectifier(rig, **options)
    rng = np.random.default_rng(0)
    P_left = rng.uniform([-1, -0.8, 1.5], [1, 0.8, 6], size=(300, 3))
    left = _project_to_rectified(rectifier, rig.left.project(P_left)[0], right=False)
    right = _project_to_rectified(rectifier, rig.right.project(se3.transform(rig.T_right_left, P_left))[0], right=True)
    expected = rectifier.camera.project(P_left @ rectifier.R_rect_left.T)
    np.testing.assert_allclose(left, expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(right[:, 1], left[:, 1], atol=1e-9)
    np.testing.assert_allclose(left[:, 0] - right[:, 0], expected[:, 2], atol=1e-9)


def _pattern(rig: StereoRig, lens, R_world_cam, centre) -> np.ndarray:
    """What a lens sees of a smooth pattern painted on the plane z = 3 of the left camera."""
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    rays = lens.unproject(np.stack([u.ravel(), v.ravel()], 1).astype(float)) @ R_world_cam.T
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(rays[:, 2] > 0.05, (3.0 - centre[2]) / rays[:, 2], np.nan)
        X = centre + rays * scale[:, None]
        value = 128 + 50 * np.sin(2.0 * X[:, 0]) + 50 * np.cos(1.7 * X[:, 1] + 0.3)
    return np.nan_to_num(value).reshape(lens.height, lens.width).round().astype(np.uint8)


@pytest.mark.parametrize("rig", [FISHEYE, RADTAN], ids=["fisheye", "radtan"])
def test_remapped_images_agree_with_the_geometry(rig):
    rectifier = Rectifier(rig, hfov_deg=75.0, size=(400, 300))
    T_left_right = se3.inverse(rig.T_right_left)
    raw = (
        _pattern(rig, rig.left, np.eye(3), np.zeros(3)),
        _pattern(rig, rig.right, T_left_right[:3, :3], T_left_right[:3, 3]),
    )
    got = rectifier.apply(*raw)
    c = rectifier.camera
    u, v = np.meshgrid(np.arange(c.width), np.arange(c.height))
    rays = np.stack([(u - c.cx_px) / c.fx_px, (v - c.cy_px) / c.fy_px, np.ones(u.shape)], -1) @ rectifier.R_rect_left
    for image, centre in zip(got, (np.zeros(3), rectifier.R_rect_left.T @ [c.baseline_m, 0, 0]), strict=True):
        X = centre + rays * ((3.0 - centre[2]) / rays[..., 2])[..., None]
        expected = 128 + 50 * np.sin(2.0 * X[..., 0]) + 50 * np.cos(1.7 * X[..., 1] + 0.3)
        error = np.abs(image.astype(float) - expected)[5:-5, 5:-5]
        # Half a grey value of rounding twice; a shift of half a pixel would cost more.
        assert error.mean() < 0.6
        assert error.max() < 3


def test_a_pair_one_above_the_other_lies_on_its_side():
    """All of both pictures is seen, at the left one's density, whichever camera is the upper one."""
    upper = StereoRig(UPRIGHT.left, UPRIGHT.left, se3.inverse(UPRIGHT.T_right_left))
    for rig in (UPRIGHT, upper):
        rectifier = Rectifier(rig)
        c = rectifier.camera
        assert (c.width, c.height) == (480, 752)
        assert c.fx_px == pytest.approx(457.5, abs=1)
        assert rectifier.mask is None or rectifier.mask.mean() > 0.9
        assert np.abs(rectifier.R_rect_left[2] - [0, 0, 1]).max() < 0.05


def test_defaults_keep_the_pixel_density():
    fisheye, radtan = Rectifier(FISHEYE).camera, Rectifier(RADTAN).camera
    assert fisheye.fx_px == pytest.approx(190.0, abs=0.5)
    assert (fisheye.width, fisheye.height) == (512, 512)
    assert radtan.fx_px == pytest.approx(457.4, abs=0.5)
    assert (radtan.width, radtan.height) == (752, 480)
    wide = StereoRig(
        KannalaBrandt(150.0, 150.0, 400.0, 400.0, 800, 800), KannalaBrandt(150.0, 150.0, 400.0, 400.0, 800, 800),
        FISHEYE.T_right_left,
    )  # fmt: skip
    camera = Rectifier(wide).camera
    assert np.rad2deg(2 * np.arctan(camera.width / 2 / camera.fx_px)) == pytest.approx(114, abs=1)


def test_rectified_pair_passes_untouched():
    lens = PinholeRadtan(700.0, 700.0, 600.0, 180.0, 1240, 376)
    rectifier = Rectifier(StereoRig(lens, lens, se3.exp(np.array([-0.54, 0, 0, 0, 0, 0]))))
    image = np.random.default_rng(0).integers(0, 255, size=(376, 1240), dtype=np.uint8)
    left, right = rectifier.apply(image, image)
    assert left is image
    assert right is image
    assert rectifier.is_identity
    assert rectifier.mask is None
    assert (rectifier.camera.cx_px, rectifier.camera.baseline_m) == (600.0, 0.54)


def test_mask_marks_the_lens_border_and_the_users_mask():
    wide = Rectifier(RADTAN, hfov_deg=110.0)
    assert wide.mask is not None
    assert wide.mask[240, 376]
    assert not wide.mask[0, 0]
    left = np.ones((512, 512), bool)
    left[:, :256] = False
    masked = Rectifier(FISHEYE.with_masks(left, None), hfov_deg=80.0)
    assert masked.mask is not None
    assert 0.3 < masked.mask.mean() < 0.7
    assert not masked.mask[256, 50]
    assert masked.mask[256, 460]
    assert masked.mask_right is None


def test_mounting_follows_the_rectifying_rotation():
    rectifier = Rectifier(FISHEYE)
    T = rectifier.mounting.T_imu_cam
    assert T is not None
    point_left = np.array([0.3, -0.2, 2.0])
    point_cam = rectifier.R_rect_left @ point_left
    np.testing.assert_allclose(se3.transform(T, point_cam), se3.transform(FISHEYE.T_imu_left, point_left), atol=1e-12)
    assert rectifier.mounting.T_body_cam is None


@pytest.mark.parametrize("hfov", [0.0, 179.0, float("nan")])
def test_impossible_field_of_view(hfov):
    with pytest.raises(CalibrationError, match="not possible"):
        Rectifier(FISHEYE, hfov_deg=hfov)
