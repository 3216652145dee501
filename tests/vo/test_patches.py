"""Patches found again as pictures of small planes: exact textures, seen undeformed and deformed."""

from __future__ import annotations

import numpy as np
import pytest
from gpvo.types import Array
from gpvo.vo.opencv import Image, Light, halve, image_stats
from gpvo.vo.patches import align, cut
from hypothesis import given
from hypothesis import strategies as st

_WINDOW = 15
_N = 40
_FLAT = np.zeros((_N, 2))


def _texture(seed: int) -> tuple[Array, Array, Array]:
    """Waves of 5 to 40 pixels in all directions: wave vectors (K, 2), phases and amplitudes (K,)."""
    rng = np.random.default_rng(seed)
    length, angle = rng.uniform(5.0, 40.0, 30), rng.uniform(0, 2 * np.pi, 30)
    wave = 2 * np.pi / length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return wave, rng.uniform(0, 2 * np.pi, 30), 28.0 * length / length.sum()


def _seen(texture: tuple[Array, Array, Array], x: Array, y: Array) -> Image:
    wave, phase, amplitude = texture
    value = sum(a * np.sin(k[0] * x + k[1] * y + p) for k, p, a in zip(wave, phase, amplitude, strict=True))
    return np.clip(np.round(110.0 + 3.0 * np.asarray(value)), 0, 255).astype(np.uint8)


def _pair(seed: int, A: Array, shift: Array, brighter: float = 0.0) -> tuple[Image, Image]:
    """An image, and the same deformed by ``A`` (2, 2) about (60, 60) and shifted."""
    y, x = np.mgrid[:120, :120].astype(float)
    texture = _texture(seed)
    back = np.linalg.inv(A)
    dx, dy = x - 60.0 - shift[0], y - 60.0 - shift[1]
    moved = _seen(texture, 60.0 + back[0, 0] * dx + back[0, 1] * dy, 60.0 + back[1, 0] * dx + back[1, 1] * dy)
    return _seen(texture, x, y), np.clip(moved + brighter, 0, 255).astype(np.uint8)


def _points(seed: int, A: Array, shift: Array) -> tuple[Array, Array, Array]:
    """Points (N, 2), where they are seen in the second image, and a start within 0.3 px of it."""
    rng = np.random.default_rng(seed)
    uv = 60.0 + rng.uniform(-35, 35, (_N, 2))
    there = 60.0 + shift + (uv - 60.0) @ A.T
    return uv.astype(np.float32), there, (there + rng.uniform(-0.3, 0.3, there.shape)).astype(np.float32)


small = st.floats(-0.12, 0.12)


@given(seed=st.integers(0, 1000), a=small, b=small, c=small, d=small, brighter=st.floats(0, 20))
def test_a_known_deformation_is_followed(seed: int, a: float, b: float, c: float, d: float, brighter: float) -> None:
    """To 0.03 px at the median whatever the deformation, and whether or not all became brighter."""
    A, shift = np.eye(2) + [[a, b], [c, d]], np.array([2.3, -1.6])
    first, second = _pair(seed, A, shift, brighter)
    uv, there, start = _points(seed, A, shift)
    found = align(cut(first, uv, _WINDOW), second, start, np.tile(A, (_N, 1, 1)), _FLAT)
    assert found.alike.mean() > 0.9
    assert np.median(np.abs(found.uv - there)[found.alike]) < 0.03


def test_a_plane_that_comes_near_is_seen_in_perspective() -> None:
    """Over 20 textures under a homography: to 0.03 px at the median, and twice as well as without the perspective."""
    rng, A, shift = np.random.default_rng(0), np.array([[1.05, 0.0], [0.02, 1.1]]), np.array([0.4, 3.0])
    error: dict[bool, list[float]] = {True: [], False: []}
    y, x = np.mgrid[:120, :120].astype(float)
    for seed in range(20):
        g = np.array([0.0, -0.02])  # of the whole image; the patch's own follows from where it stands
        texture = _texture(seed)
        # The inverse of uv = m + shift + A o / (1 + g o), o = place - m, m the middle.
        dx, dy = x - 60.0 - shift[0], y - 60.0 - shift[1]
        M = A[None, None] - np.stack([dx, dy], -1)[..., :, None] * g
        o = np.linalg.solve(M, np.stack([dx, dy], -1)[..., None])[..., 0]
        first, second = _seen(texture, x, y), _seen(texture, 60.0 + o[..., 0], 60.0 + o[..., 1])
        place = rng.uniform(-15.0, 15.0, (_N, 2))
        depth = 1.0 + place @ g
        there = 60.0 + shift + place @ A.T / depth[:, None]
        own_A = A / depth[:, None, None] - (place @ A.T / depth[:, None] ** 2)[:, :, None] * g
        h = g / depth[:, None]
        start = (there + rng.uniform(-0.2, 0.2, there.shape)).astype(np.float32)
        for known, values in error.items():
            uv, again = (60.0 + place).astype(np.float32), start
            for _ in range(3):
                again = align(cut(first, uv, _WINDOW), second, again, own_A, h if known else _FLAT).uv
            values.append(float(np.median(np.abs(again - there))))
    assert np.mean(error[True]) < 0.03
    assert np.mean(error[False]) > 2.0 * np.mean(error[True])


@given(seed=st.integers(0, 1000), du=st.floats(-0.2, 0.2), dv=st.floats(-0.3, 0.3))
def test_the_slope_of_a_plane_is_found_with_its_disparity(seed: int, du: float, dv: float) -> None:
    """Disparity to 0.03 px and slope to 0.02 at the median, from a start of no slope."""
    A, shift = np.array([[1.0 - du, -dv], [0.0, 1.0]]), np.array([-7.4, 0.0])
    first, second = _pair(seed, A, shift)
    uv, there, start = _points(seed, A, shift)
    found = align(cut(first, uv, _WINDOW), second, start, np.tile(np.eye(2), (_N, 1, 1)))
    assert found.alike.mean() > 0.8
    assert np.median(np.abs(found.uv - there)[found.alike]) < 0.03
    assert np.median(np.abs(found.A[:, 0] - A[0])[found.alike]) < 0.02


def test_a_patch_that_grows_is_misplaced_by_a_square() -> None:
    """Over 20 textures that grow by 10 %: without the deformation the error is five times as large."""
    A, shift = 1.1 * np.eye(2), np.array([0.4, 0.7])
    error: dict[bool, list[float]] = {True: [], False: []}
    for seed in range(20):
        first, second = _pair(seed, A, shift)
        uv, there, start = _points(seed, A, shift)
        for known, values in error.items():
            deformed = np.tile(A if known else np.eye(2), (_N, 1, 1))
            again = start
            for _ in range(5):
                again = align(cut(first, uv, _WINDOW), second, again, deformed, _FLAT).uv
            values.append(float(np.median(np.abs(again - there))))
    assert np.mean(error[False]) > 5.0 * np.mean(error[True])


@pytest.mark.parametrize("window_px", [3, 4, 15, 22])
@pytest.mark.parametrize("place", [(-30.0, 5.0), (0.0, 0.0), (19.0, 19.0), (500.0, 500.0)])
def test_patches_beyond_the_border_are_no_error(window_px: int, place: tuple[float, float]) -> None:
    image = np.random.default_rng(0).integers(0, 255, (20, 20)).astype(np.uint8)
    uv = np.array([place], np.float32)
    for h in (np.zeros((1, 2)), np.array([[-1.0, 3.0]]), np.array([[-1.0 / 7, 0.0]]), None):
        found = align(cut(image, uv, window_px), image, uv, np.eye(2)[None], h)
        assert np.isfinite(found.uv).all()
        assert np.isfinite(found.A).all()
    assert len(align(cut(image, uv[:0], window_px), image, uv[:0], np.empty((0, 2, 2))).uv) == 0


def test_the_noise_of_an_image_is_what_immerkaers_mask_says() -> None:
    image = np.random.default_rng(1).integers(0, 255, (60, 81)).astype(np.uint8)
    rows = np.pad(image[20:40].astype(float), 1, mode="reflect")
    response = np.diff(np.diff(rows, 2, axis=0), 2, axis=1)
    expected = np.sqrt(np.pi / 2) / 6 * np.abs(response).mean() / 255
    assert image_stats(image, Light.of(halve(image))).noise_level == pytest.approx(expected, rel=1e-12)
