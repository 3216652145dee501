"""Lens models against OpenCV's, and against the formula that OpenVINS evaluates."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan
from gpvo.cameras.rectify import rectifying_rotations
from gpvo.geometry import se3

cv2 = pytest.importorskip("cv2")

EUROC = PinholeRadtan(458.654, 457.296, 367.215, 248.375, 752, 480, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05))
FIVE = PinholeRadtan(520.0, 521.0, 319.0, 241.0, 640, 480, (0.12, -0.25, 0.001, -0.0007, 0.11))
RATIONAL = PinholeRadtan(
    605.0, 605.5, 638.0, 366.0, 1280, 720, (0.5075, -2.6437, 8e-4, -2e-4, 1.5226, 0.3857, -2.4617, 1.4481)
)
WIDE = PinholeRadtan(280.0, 281.0, 321.0, 239.0, 640, 480, (0.8, 0.05, 1e-3, -2e-3, 1e-3, 1.1, 0.12, 3e-3))
TUMVI = KannalaBrandt(
    190.978477, 190.973307, 254.931706, 256.897442, 512, 512, (0.0034823894, 0.0007150348, -0.0020532361, 0.00020293673)
)
T265 = KannalaBrandt(
    282.019963, 280.714515, 415.955814, 396.661377, 848, 800, (-0.003269, 0.054053, -0.051594, 0.010749)
)


def _points(rng, lens, spread):
    xy = rng.uniform(-spread, spread, size=(500, 2))
    return np.concatenate([xy, np.ones((500, 1))], axis=1) * rng.uniform(0.3, 20, size=(500, 1))


@pytest.mark.parametrize("lens", [EUROC, FIVE, RATIONAL, WIDE], ids=["euroc", "five", "rational", "wide"])
def test_radtan_projects_as_opencv(lens):
    P = _points(np.random.default_rng(0), lens, 0.6)
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    theirs = cv2.projectPoints(P.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, np.array(lens.distortion))[0][:, 0]
    ours, valid = lens.project(P)
    assert valid.all()
    # 1e-9 rad at this focal length.
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * lens.fx_px)


@pytest.mark.parametrize("lens", [EUROC, RATIONAL, WIDE], ids=["euroc", "rational", "wide"])
def test_radtan_unprojects_as_opencv_does_after_many_steps(lens):
    u, v = np.meshgrid(np.linspace(0, lens.width - 1, 33), np.linspace(0, lens.height - 1, 25))
    uv = np.column_stack([u.ravel(), v.ravel()])
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-14)
    theirs = cv2.undistortPointsIter(uv[:, None], K, np.array(lens.distortion), None, None, criteria)[:, 0]
    ours = lens.unproject(uv)
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], theirs, atol=1e-9)


@pytest.mark.parametrize("lens", [TUMVI, T265], ids=["tumvi", "t265"])
def test_fisheye_projects_as_opencv(lens):
    P = _points(np.random.default_rng(1), lens, 4.0)
    K = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1.0]])
    D = np.array(lens.distortion)
    theirs = cv2.fisheye.projectPoints(P.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    ours, valid = lens.project(P)
    assert valid.all()
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * lens.fx_px)


def _openvins_distort(lens: KannalaBrandt, ray: np.ndarray) -> np.ndarray:
    """As in OpenVINS' CamEqui: the angle from the normalised radius, then the odd polynomial."""
    x, y = ray[0] / ray[2], ray[1] / ray[2]
    r = np.sqrt(x * x + y * y)
    theta = np.arctan(r)
    k = lens.distortion
    theta_d = theta + k[0] * theta**3 + k[1] * theta**5 + k[2] * theta**7 + k[3] * theta**9
    scale = theta_d / r if r > 1e-8 else 1.0
    return np.array([lens.fx_px * x * scale + lens.cx_px, lens.fy_px * y * scale + lens.cy_px])


def test_fisheye_projects_as_openvins():
    rng = np.random.default_rng(2)
    for P in _points(rng, T265, 3.0)[:100]:
        np.testing.assert_allclose(T265.project(P[None])[0][0], _openvins_distort(T265, P), atol=1e-9 * T265.fx_px)


def test_rectification_has_the_rows_of_opencv():
    """Our rotations differ from OpenCV's by a common rotation about the baseline at most."""
    T = se3.exp(np.array([-0.11, 0.002, -0.003, 0.01, -0.02, 0.015]))
    K = np.array([[450.0, 0, 320], [0, 450.0, 240], [0, 0, 1]])
    theirs_left, theirs_right = cv2.stereoRectify(
        K, np.zeros(5), K, np.zeros(5), (640, 480), T[:3, :3].copy(), T[:3, 3:].copy(), flags=0
    )[:2]
    ours_left, ours_right = rectifying_rotations(T)
    turn_left, turn_right = ours_left @ theirs_left.T, ours_right @ theirs_right.T
    np.testing.assert_allclose(turn_left, turn_right, atol=1e-9)
    np.testing.assert_allclose(turn_left[0], [1, 0, 0], atol=1e-9)
