"""Laws of every lens: what is projected comes back along the same ray, and the other way round."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.cameras.models import KannalaBrandt, PinholeRadtan, _Radial
from gpvo.cameras.rectify import rectifying_rotations
from gpvo.geometry import se3
from hypothesis import given, settings
from hypothesis import strategies as st

unit = st.floats(-1.0, 1.0)


@st.composite
def radtan(draw):
    f = draw(st.floats(200, 900))
    k = (0.35 * draw(unit), 0.1 * draw(unit), 0.002 * draw(unit), 0.002 * draw(unit), 0.05 * draw(unit))
    return PinholeRadtan(f, f * (1 + 0.05 * draw(unit)), 320 + 30 * draw(unit), 240 + 30 * draw(unit), 640, 480, k)


@st.composite
def fisheye(draw):
    f = draw(st.floats(150, 500))
    k = (0.05 * draw(unit), 0.05 * draw(unit), 0.04 * draw(unit), 0.01 * draw(unit))
    return KannalaBrandt(f, f * (1 + 0.05 * draw(unit)), 320 + 30 * draw(unit), 240 + 30 * draw(unit), 640, 480, k)


def _angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1))


@settings(max_examples=60, deadline=None)
@given(radtan(), st.integers(0, 2**31))
def test_radtan_round_trip(lens, seed):
    rng = np.random.default_rng(seed)
    # Well inside the range where the polynomial grows, tangential part included.
    r = rng.uniform(0, min(0.7 * lens.max_radius, 1.0), size=200)
    phi = rng.uniform(0, 2 * np.pi, size=200)
    rays = np.stack([r * np.cos(phi), r * np.sin(phi), np.ones(200)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    uv, valid = lens.project(rays * rng.uniform(0.1, 50, size=(200, 1)))
    assert valid.all()
    assert _angle(lens.unproject(uv), rays).max() < 1e-9


@pytest.mark.parametrize("least_slope", [0.5, 0.05, 0.001])
def test_radial_inverse_where_the_polynomial_is_nearly_flat(least_slope):
    # 1 + 3 k r^2 + 5 q r^4 is least at r = 1, where it is `least_slope`; rounding there moves the root by eps / slope.
    k = -(1 - least_slope) / 1.5
    q = -0.3 * k
    x = np.random.default_rng(0).uniform(0, 1.2, 200_000)
    radial = _Radial((k, q))
    found = radial.invert(radial(x), 1e3)
    assert np.abs(found - x).max() < 20 * np.finfo(float).eps / least_slope


@settings(max_examples=60, deadline=None)
@given(fisheye(), st.integers(0, 2**31))
def test_fisheye_round_trip_beyond_ninety_degrees(lens, seed):
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0, min(0.98 * lens.max_angle_rad, np.deg2rad(120)), size=300)
    theta[:3] = [0.0, 1e-12, 1e-7]
    phi = rng.uniform(0, 2 * np.pi, size=300)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    uv, valid = lens.project(rays * rng.uniform(0.1, 50, size=(300, 1)))
    assert valid.all()
    back = lens.unproject(uv)
    assert _angle(back, rays).max() < 1e-9
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1.0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(st.lists(unit, min_size=6, max_size=6))
def test_rectifying_rotations_align_rows(numbers):
    a = np.array(numbers)
    T_right_left = se3.exp(np.concatenate([[-0.1, 0.02 * a[1], 0.02 * a[2]], 0.15 * a[3:]]))
    R_left, R_right = rectifying_rotations(T_right_left)
    np.testing.assert_allclose(R_left @ R_left.T, np.eye(3), atol=1e-12)
    # The same orientation seen from both, and the right camera at +x.
    np.testing.assert_allclose(R_right @ T_right_left[:3, :3], R_left, atol=1e-12)
    centre_right = -T_right_left[:3, :3].T @ T_right_left[:3, 3]
    baseline = np.linalg.norm(centre_right)
    np.testing.assert_allclose(R_left @ centre_right, [baseline, 0, 0], atol=1e-12)
