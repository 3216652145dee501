"""Lens models at their borders."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan

PLAIN = PinholeRadtan(400.0, 410.0, 320.0, 240.0, 640, 480)


def test_pinhole_without_distortion():
    uv, valid = PLAIN.project(np.array([[0.0, 0.0, 2.0], [1.0, -0.5, 2.0], [0.0, 0.0, -1.0], [1.0, 1.0, 0.0]]))
    np.testing.assert_allclose(uv[:2], [[320, 240], [520, 137.5]])
    assert valid.tolist() == [True, True, False, False]
    assert np.isnan(uv[2:]).all()


def test_radtan_refuses_what_the_polynomial_folds_back():
    lens = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480, (-0.3, 0.0, 0.0, 0.0))
    # r (1 - 0.3 r^2) grows up to r = 1 / sqrt(0.9), where it is 0.7027.
    assert lens.max_radius == pytest.approx(1 / np.sqrt(0.9))
    _, valid = lens.project(np.array([[1.0, 0, 1], [1.2, 0, 1], [5.0, 0, 1]]))
    assert valid.tolist() == [True, False, False]
    rays = lens.unproject(np.array([[320 + 400 * 0.6, 240.0], [320 + 400 * 0.8, 240.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_rational_ends_where_its_denominator_does_and_comes_back_from_everywhere_before():
    lens = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480, (0.2, 0.0, 1e-3, -2e-3, 0.0, -0.4, 0.0, 0.0))
    assert lens.max_radius == pytest.approx(1 / np.sqrt(0.4))  # (1 + 0.2 s) / (1 - 0.4 s)
    r, a = np.meshgrid(np.linspace(0.0, 1.5, 16), np.linspace(0.0, 6.0, 7))
    points = np.column_stack([(r * np.cos(a)).ravel(), (r * np.sin(a)).ravel(), np.ones(r.size)])
    uv, valid = lens.project(points)
    assert valid.all()
    rays = lens.unproject(uv)
    np.testing.assert_allclose(rays / rays[:, 2:], points, atol=1e-9)
    assert not lens.project(np.array([[1.6, 0.0, 1.0], [5.0, 0.0, 1.0]]))[1].any()


def test_rational_folds_back_where_its_slope_ends():
    lens = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480, (0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0))
    assert lens.max_radius == pytest.approx(np.sqrt(2.0))  # r / (1 + r^2 / 2) has its highest point there


@pytest.mark.parametrize(
    "distortion", [(-0.3, 0.1, 1e-3, -2e-3, 0.02), (0.8, 0.05, 1e-3, -2e-3, 1e-3, 1.1, 0.12, 3e-3)]
)
def test_jacobian_is_that_of_the_distortion(distortion):
    lens = PinholeRadtan(400.0, 400.0, 320.0, 240.0, 640, 480, distortion)
    xy, h = np.random.default_rng(0).uniform(-0.6, 0.6, (40, 2)), 1e-6
    by_x, by_y = ((lens._distort(xy + e) - lens._distort(xy - e)) / (2 * h) for e in h * np.eye(2))
    x_by_x, y_by_y, mixed = lens._jacobian(xy)
    for ours, theirs in ((x_by_x, by_x[:, 0]), (y_by_y, by_y[:, 1]), (mixed, by_x[:, 1]), (mixed, by_y[:, 0])):
        np.testing.assert_allclose(ours, theirs, atol=1e-8)


def test_fisheye_looks_sideways_and_back():
    lens = KannalaBrandt(200.0, 200.0, 400.0, 400.0, 800, 800)
    points = np.array([[1.0, 0, 0], [1.0, 0, -1.0], [0, 0, 3.0], [0, 0, -1.0]])
    uv, valid = lens.project(points)
    np.testing.assert_allclose(uv[:3, 0], [400 + 200 * np.pi / 2, 400 + 200 * 0.75 * np.pi, 400])
    assert valid.tolist() == [True, True, True, False]
    np.testing.assert_allclose(
        lens.unproject(uv[:3]), points[:3] / np.linalg.norm(points[:3], axis=1)[:, None], atol=1e-12
    )


def test_fisheye_ends_where_its_polynomial_turns():
    lens = KannalaBrandt(200.0, 200.0, 400.0, 400.0, 800, 800, (-0.1, 0.0, 0.0, 0.0))
    assert lens.max_angle_rad == pytest.approx(1 / np.sqrt(0.3))
    angle = np.array([1.8, 1.9])
    _, valid = lens.project(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1))
    assert valid.tolist() == [True, False]
    assert np.isnan(lens.unproject(np.array([[400 + 200 * 1.3, 400.0]]))).all()
    assert np.isfinite(lens.unproject(np.array([[400 + 200 * 1.2, 400.0]]))).all()


def test_empty_input():
    for lens in (PLAIN, KannalaBrandt(200.0, 200.0, 400.0, 400.0, 800, 800)):
        uv, valid = lens.project(np.empty((0, 3)))
        assert uv.shape == (0, 2)
        assert valid.shape == (0,)
        assert lens.unproject(np.empty((0, 2))).shape == (0, 3)
